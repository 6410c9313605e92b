"""The endpoint /device/contacts: a remote hand comes in, contact proxies go out (docs/protocol.md).

Each connection has a tool of its own (`hosting.contact_source`). Hands replace one another: only
the newest one is answered, at the server's rate. A proxy is sent only while the client has seen
most of the last ones, so nothing queues for a client that does not read. Proxies are computed in
threads, without the interpreter lock.
"""

import asyncio
import contextlib
import logging
import time
from collections.abc import AsyncIterator, Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from starlette.responses import PlainTextResponse
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from hapticdb.errors import DatabaseError, HapticDBError, ProtocolError, UsageError
from hapticdb.hosting.contact_source import RATE, ContactSource
from hapticdb.pointshell.shell import PointShell
from hapticdb.protocol.contacts import (
    HandState,
    ProxyWish,
    pack_proxy,
    pack_terms,
    unpack_hand,
    unpack_wish,
)
from hapticdb.protocol.header import CloseCode, OtherVersionError
from hapticdb.realtime.resident_cells import ResidentCells
from hapticdb.server.access import Role
from hapticdb.server.limits import TokenBucket

LOG = logging.getLogger("hapticdb.server")
MOST_CLIENTS = 16
"""Most clients at a time. Larger: more remote hands, each about 1 ms of computing in 10 ms."""
MESSAGES_A_SECOND = 1000.0
"""Messages a second that are read from one client; a faster one is read no sooner, so that TCP
slows it down. Larger: a flood costs the server more."""
BURST = 64.0
"""Messages that may come at once. Larger: likewise."""
FIRST_WITHIN = 10.0
"""Seconds in which a client must ask for a tool."""
IDLE_AFTER = 30.0
"""Seconds without a hand after which a client is dropped. Larger: clients that hang keep their
place longer."""
UNSEEN = 32
"""Most proxies that a client may not have seen yet: a third of a second. Larger: longer round trips
are possible at the full rate, and more is on the way to a client that does not read."""
LOOKS_EVERY = 1.0
"""Seconds between two looks at the process that fetches cells. Larger: after its end, edits are
felt later."""
CLOSING_WITHIN = 5.0
"""Seconds that a client has to take a close frame. Larger: one that does not read keeps its place
longer."""
LARGEST = 1024
"""Bytes of the largest message that is accepted."""
REASON_BYTES = 120
"""Most bytes of a close frame's reason: WebSocket allows 123."""


RoleOfHeaders = Callable[[Mapping[str, str]], Role | None]
"""Finds the role of a client by the headers of its request; see `server.access`."""


async def is_admitted(websocket: WebSocket, role_of_headers: RoleOfHeaders, n_clients: int) -> bool:
    """Whether a client may be accepted. It is told if it may not feel, or is one too many.

    A browser, which has an origin, may not feel here.
    """
    role = role_of_headers(websocket.headers)
    if role is None or role < Role.TOUCHER or "origin" in websocket.headers:
        await websocket.close(1008)  # before it is accepted: the answer is 403
        return False
    if n_clients >= MOST_CLIENTS:
        await websocket.send_denial_response(
            PlainTextResponse("too many remote hands: try again later\n", 503)
        )
        return False
    return True


class Contacts:
    """What the endpoint serves: tools by name, in the cells of one environment, with distances.

    idle_after : seconds without a hand after which a client is dropped.
    """

    def __init__(
        self,
        cells: ResidentCells,
        tools: Mapping[str, PointShell],
        *,
        idle_after: float = IDLE_AFTER,
    ) -> None:
        self._cells, self._tools = cells, dict(tools)
        self._idle = idle_after
        self._threads = ThreadPoolExecutor(max_workers=4, thread_name_prefix="contacts")
        self.n_clients = 0
        """Clients that are connected now."""

    def close(self) -> None:
        """End the threads."""
        self._threads.shutdown(wait=True, cancel_futures=True)

    async def attend(self, websocket: WebSocket, wish: ProxyWish | None = None) -> None:
        """Serve one accepted client until it leaves.

        wish: what its first message asks for, if that has been read already.
        """
        self.n_clients += 1
        try:
            async with refusing(websocket):
                await self._serve(websocket, wish or await read_wish(websocket, self._tools))
        finally:
            self.n_clients -= 1

    async def _serve(self, websocket: WebSocket, wish: ProxyWish) -> None:
        loop = asyncio.get_running_loop()
        tool = self._tools[wish.tool]
        source = await loop.run_in_executor(self._threads, ContactSource, self._cells, tool, wish)
        state = _Client()
        try:
            await websocket.send_bytes(pack_terms(source.terms))
            async with asyncio.TaskGroup() as group:
                group.create_task(self._answer(websocket, state, source))
                group.create_task(self._supervise())
                await self._listen(websocket, state)
        except* WebSocketDisconnect:
            pass
        except* (HapticDBError, TimeoutError) as errors:
            raise errors.exceptions[0] from None
        finally:  # in a thread, because a proxy may just be computed
            await asyncio.shield(loop.run_in_executor(None, source.close))

    async def _supervise(self) -> None:
        """Let the process that fetches cells be started again if it has ended."""
        loop = asyncio.get_running_loop()
        while True:
            await asyncio.sleep(LOOKS_EVERY)
            try:
                await loop.run_in_executor(self._threads, self._cells.supervise)
            except HapticDBError as error:
                LOG.exception("the cells of contact proxies cannot be fetched any more")
                raise DatabaseError("cells cannot be fetched any more") from error

    async def _listen(self, websocket: WebSocket, state: "_Client") -> None:
        """Keep the newest hand; read no faster than is allowed."""
        while True:
            message = await asyncio.wait_for(_receive(websocket), self._idle)
            wait = state.allowed.wait()
            if wait > 0.0:
                await asyncio.sleep(wait)
            state.allowed.take()
            state.take(unpack_hand(message))

    async def _answer(self, websocket: WebSocket, state: "_Client", source: ContactSource) -> None:
        """Send a proxy for the newest hand, at the rate."""
        loop = asyncio.get_running_loop()
        due = loop.time()
        while True:
            due = max(due + 1.0 / RATE, loop.time())
            await asyncio.sleep(due - loop.time())
            hand = state.hand
            if hand is None or state.n_unseen > UNSEEN:
                continue
            proxy = await loop.run_in_executor(self._threads, _proxy, source, hand, state.arrived)
            state.sent = source.n_sent
            await websocket.send_bytes(proxy)


class _Client:
    """What is known of one client."""

    def __init__(self) -> None:
        self.allowed = TokenBucket(MESSAGES_A_SECOND, BURST)
        self.hand: HandState | None = None
        self.arrived = 0.0
        self.sent = 0

    @property
    def n_unseen(self) -> int:
        """Number of proxies that the client has not seen yet.

        A number that was not sent yet, such as one of an earlier connection, says nothing.
        """
        seen = 0 if self.hand is None or self.hand.seen > self.sent else self.hand.seen
        return self.sent - seen

    def take(self, hand: HandState) -> None:
        """Make a hand the newest one, unless an older message came late."""
        if self.hand is None or hand.sequence > self.hand.sequence:
            self.hand, self.arrived = hand, time.monotonic()


def _proxy(source: ContactSource, hand: HandState, arrived: float) -> bytes:
    return pack_proxy(source.proxy(hand, time.monotonic() - arrived))


@contextlib.asynccontextmanager
async def refusing(websocket: WebSocket) -> AsyncIterator[None]:
    """Close the connection with a plain reason if the block fails."""
    try:
        yield
    except OtherVersionError as error:
        await _refuse(websocket, CloseCode.VERSION, str(error))
    except (ProtocolError, UsageError) as error:
        await _refuse(websocket, CloseCode.MALFORMED, str(error))
    except TimeoutError:
        await _refuse(websocket, CloseCode.IDLE, "nothing came for too long")
    except (WebSocketDisconnect, asyncio.CancelledError):
        pass
    except HapticDBError:
        await _refuse(websocket, CloseCode.FAILED, "the server's database fails now")


async def _refuse(websocket: WebSocket, code: int, reason: str) -> None:
    if websocket.application_state is WebSocketState.CONNECTED:
        short = reason.encode()[:REASON_BYTES].decode("utf-8", "ignore")
        with contextlib.suppress(TimeoutError, WebSocketDisconnect):  # it does not read
            async with asyncio.timeout(CLOSING_WITHIN):
                await websocket.close(int(code), short)


async def read_wish(websocket: WebSocket, tools: Collection[str]) -> ProxyWish:
    """Wait for a client's first message, and judge it; TimeoutError after `FIRST_WITHIN`.

    tools : names of the tools that there are.
    """
    wish = unpack_wish(await asyncio.wait_for(_receive(websocket), FIRST_WITHIN))
    if not wish.tool and len(tools) == 1:
        return wish._replace(tool=next(iter(tools)))
    if wish.tool not in tools:
        raise UsageError(f"no tool of that name: there are {', '.join(sorted(tools))}")
    return wish


async def _receive(websocket: WebSocket) -> bytes:
    """Wait for the next binary message."""
    event: Mapping[str, Any] = await websocket.receive()
    if event["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(event.get("code", 1000))
    message = event.get("bytes")
    if message is None:
        raise ProtocolError("a text message, where a binary one must come")
    if len(message) > LARGEST:
        raise ProtocolError(f"a message of {len(message)} bytes: at most {LARGEST} may be sent")
    return bytes(message)

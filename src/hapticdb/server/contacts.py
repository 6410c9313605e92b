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
from collections.abc import AsyncIterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from starlette.responses import PlainTextResponse
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from hapticdb.errors import DatabaseError, HapticDBError, ProtocolError, UsageError
from hapticdb.hosting.contact_source import RATE, ContactSource
from hapticdb.page.tools import BUILT_IN, built_in
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
from hapticdb.query.law import inset_of
from hapticdb.realtime.resident_cells import ResidentCells
from hapticdb.server.access import Role
from hapticdb.server.limits import TokenBucket
from hapticdb.server.served import Served
from hapticdb.store.attributes import scene_bounds

LOG = logging.getLogger("hapticdb.server")
FAILED = "this environment cannot be felt by contact proxies now: its operator finds why in the log"
"""Reason of a close frame, 123 bytes at most."""
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
THREADS = 4
"""Threads that compute proxies. Larger: more hands at a time share the processors."""


class Contacts:
    """The endpoint of one server; its cells and tools are made for the first client.

    They are freed when the last client has left.
    """

    def __init__(self, served: Served) -> None:
        self._served = served
        self._tool_names = {Path(file).stem for file in served.tools} or {*BUILT_IN}
        self._changing = asyncio.Lock()
        self._threads = ThreadPoolExecutor(THREADS, thread_name_prefix="contacts")
        self._cells: ResidentCells | None = None
        self._tools: dict[str, PointShell] = {}
        self.n_clients = 0
        """Clients that are connected now."""

    async def serve(self, websocket: WebSocket) -> None:
        """Serve one client until it leaves.

        It is accepted at once, and granted its tool when cells and tools are there: that takes
        seconds for the first one, in which pings are answered; a minute where kernels are compiled
        first.
        """
        if not await self._is_admitted(websocket):
            return
        self.n_clients += 1
        try:
            await websocket.accept()
            async with _refusing(websocket):
                # read before the wait: uvicorn answers no ping while a message is not taken
                wish = await self._read_wish(websocket)
                cells = await self._opened()
                if cells is None:
                    await websocket.close(int(CloseCode.FAILED), FAILED)
                else:
                    await self._attend(websocket, wish, cells)
        finally:
            self.n_clients -= 1
            await asyncio.shield(self._rest())

    async def _is_admitted(self, websocket: WebSocket) -> bool:
        """Whether a client may be accepted. It is told if it may not feel, or is one too many.

        A browser, which has an origin, may not feel here.
        """
        role = self._served.access.role_of_headers(websocket.headers)
        if role is None or role < Role.TOUCHER or "origin" in websocket.headers:
            await websocket.close(1008)  # before it is accepted: the answer is 403
            return False
        if self.n_clients >= MOST_CLIENTS:
            await websocket.send_denial_response(
                PlainTextResponse("too many remote hands: try again later\n", 503)
            )
            return False
        return True

    async def _read_wish(self, websocket: WebSocket) -> ProxyWish:
        """Wait for a client's first message, and judge it; TimeoutError after `FIRST_WITHIN`."""
        wish = unpack_wish(await asyncio.wait_for(_receive(websocket), FIRST_WITHIN))
        if not wish.tool and len(self._tool_names) == 1:
            return wish._replace(tool=next(iter(self._tool_names)))
        if wish.tool not in self._tool_names:
            known = ", ".join(sorted(self._tool_names))
            raise UsageError(f"no tool of that name: there are {known}")
        return wish

    # -- cells and tools ---------------------------------------------------------------------

    async def _opened(self) -> ResidentCells | None:
        """Cells, made if need be with the tools; None if that fails now."""
        async with self._changing:
            if self._cells is None:
                try:
                    await self._served.preparation.done()
                    self._cells = await asyncio.to_thread(self._open)
                except HapticDBError:
                    LOG.exception("contact proxies cannot be served")
            return self._cells

    def _open(self) -> ResidentCells:
        cells = ResidentCells(self._served.urls[Role.TOUCHER], distances=True)
        try:
            self._tools = _tools(self._served.tools, cells)
        except BaseException:
            cells.close()
            raise
        return cells

    async def _rest(self) -> None:
        """Free cells and tools if nobody feels them."""
        async with self._changing:
            if not self.n_clients and self._cells is not None:
                cells, self._cells = self._cells, None
                await asyncio.to_thread(cells.close)

    # -- one client --------------------------------------------------------------------------

    async def _attend(self, websocket: WebSocket, wish: ProxyWish, cells: ResidentCells) -> None:
        loop, tool = asyncio.get_running_loop(), self._tools[wish.tool]
        source = await loop.run_in_executor(self._threads, ContactSource, cells, tool, wish)
        state = _Client()
        try:
            await websocket.send_bytes(pack_terms(source.terms))
            async with asyncio.TaskGroup() as group:
                group.create_task(self._answer(websocket, state, source))
                group.create_task(self._supervise(cells))
                await _listen(websocket, state)
        except* WebSocketDisconnect:
            pass
        except* (HapticDBError, TimeoutError) as errors:
            raise errors.exceptions[0] from None
        finally:  # in a thread, because a proxy may just be computed
            await asyncio.shield(loop.run_in_executor(None, source.close))

    async def _supervise(self, cells: ResidentCells) -> None:
        """Let the process that fetches cells be started again if it has ended."""
        loop = asyncio.get_running_loop()
        while True:
            await asyncio.sleep(LOOKS_EVERY)
            try:
                await loop.run_in_executor(self._threads, cells.supervise)
            except HapticDBError as error:
                LOG.exception("the cells of contact proxies cannot be fetched any more")
                raise DatabaseError("cells cannot be fetched any more") from error

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


async def _listen(websocket: WebSocket, state: _Client) -> None:
    """Keep the newest hand; read no faster than is allowed."""
    while True:
        message = await asyncio.wait_for(_receive(websocket), IDLE_AFTER)
        wait = state.allowed.wait()
        if wait > 0.0:
            await asyncio.sleep(wait)
        state.allowed.take()
        state.take(unpack_hand(message))


@contextlib.asynccontextmanager
async def _refusing(websocket: WebSocket) -> AsyncIterator[None]:
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


def _tools(files: tuple[str, ...], cells: ResidentCells) -> dict[str, PointShell]:
    """The operator's tools by the names of their files, in their own frames; else two probes."""
    size = cells.grid.voxel_size
    if files:
        inset = inset_of(size, "smooth")
        return {Path(file).stem: PointShell.from_file(file, inset=inset) for file in files}
    bounds = scene_bounds(cells.first_objects)
    diagonal = 0.0 if bounds is None else float(((bounds[1] - bounds[0]) ** 2).sum() ** 0.5)
    return {tool.name: tool.shell for tool in built_in(diagonal, size, smooth=True)}

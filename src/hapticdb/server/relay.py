"""Relay between a browser's WebSocket and the page, message by message, within limits.

From the browser only messages accepted by `messages.validated`, at the limits' rates; to the
browser everything, at its own rate.
"""

import asyncio
import contextlib
import logging
import re
from collections.abc import Coroutine, Iterator

from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.typing import Subprotocol

from hapticdb.server.access import Access, Role
from hapticdb.server.limits import Limits, TokenBucket
from hapticdb.server.messages import validated
from hapticdb.server.metrics import Metrics
from hapticdb.server.page_supervisor import PageSupervisor

LOG = logging.getLogger("hapticdb.server")
VERSION = re.compile(r"viser-v[0-9A-Za-z.+-]{1,32}")
"""WebSocket subprotocol with the version of viser's client, compared by the page."""
IDS = re.compile(r"(\d{1,10}(,\d{1,10}){0,49})?")
"""Form of the parts that a link shows."""
CLOSING_TIMEOUT = 5.0
"""Time limit of a browser's close handshake, seconds."""
RENEW_EVERY = 60.0
"""Seconds between two checks of a browser's cookie."""

GOING_AWAY, POLICY, TRY_LATER, SIGNED_OUT = 1001, 1008, 1013, 4401
"""WebSocket close codes; the last one is ours."""


class Closing(Exception):  # noqa: N818 - an end, and not always an error
    """Ends a browser's connection: code and words for it, `reason` as label of the metric."""

    def __init__(self, code: int, words: str, reason: str) -> None:
        super().__init__(words)
        self.code, self.words, self.reason = code, words, reason


class Relay:
    """Connections between browsers and the page, within roles and limits, with metrics."""

    def __init__(
        self, access: Access, supervisor: PageSupervisor, limits: Limits, figures: Metrics
    ) -> None:
        self._access, self._supervisor = access, supervisor
        self._limits, self._figures = limits, figures
        self._arrivals = TokenBucket(limits.browsers_per_second, limits.browsers_at_once)
        self._numbers: set[int] = set()

    async def browser(self, websocket: WebSocket) -> None:
        """Serve one browser until it or the page closes, or a limit is exceeded."""
        reason = "refused"
        try:
            reason = await self._served(websocket)
        except Closing as closing:
            reason = closing.reason
            LOG.info("a browser's connection ends: %s", closing.words)
            if websocket.application_state is not WebSocketState.DISCONNECTED:
                with contextlib.suppress(RuntimeError, TimeoutError, WebSocketDisconnect):
                    async with asyncio.timeout(CLOSING_TIMEOUT):
                        await websocket.close(closing.code, closing.words)
        finally:
            self._figures.connections.labels(reason).inc()

    async def _served(self, websocket: WebSocket) -> str:
        """Serve a browser; returns the reason of its end."""
        role = self._access.role_of_headers(websocket.headers)
        if role is None:
            raise Closing(POLICY, "sign in first", "refused")
        cookie = self._access.cookie_of(websocket.headers)
        if not self._access.renew(cookie):
            cookie = ""  # expired: the role comes from elsewhere
        if len(self._numbers) >= self._limits.browsers or not self._arrivals.take():
            raise Closing(TRY_LATER, "too many browsers; try again later", "full")
        shown = str(websocket.path_params.get("shown", ""))
        if not IDS.fullmatch(shown):
            raise Closing(POLICY, "a link shows at most 50 parts, by their ids", "refused")
        offered = [Subprotocol(p) for p in websocket.scope["subprotocols"] if VERSION.fullmatch(p)]
        if len(offered) != 1:
            raise Closing(POLICY, "this is no browser's page", "refused")
        with self._numbered() as number:
            name = f"Guest {number}"
            upstream = await self._connected(name, role, shown, offered[0])
            try:
                await websocket.accept(upstream.subprotocol)
                LOG.info("a browser is connected", extra={"guest": name, "role": role.word})
                with self._figures.browsers.labels(role.word).track_inprogress():
                    return await _either(
                        self._up(websocket, upstream, role, cookie), self._down(websocket, upstream)
                    )
            finally:
                await upstream.close(GOING_AWAY)
                LOG.info("a browser has left", extra={"guest": name, "role": role.word})

    @contextlib.contextmanager
    def _numbered(self) -> Iterator[int]:
        """Smallest free number, for one browser."""
        number = next(n for n in range(1, len(self._numbers) + 2) if n not in self._numbers)
        self._numbers.add(number)
        try:
            yield number
        finally:
            self._numbers.discard(number)

    async def _connected(
        self, name: str, role: Role, shown: str, version: Subprotocol
    ) -> ClientConnection:
        """Connect to the page."""
        try:
            if not self._supervisor.is_ready:
                raise ConnectionError("it is starting")
            return await connect(
                f"ws://127.0.0.1:{self._supervisor.port}/",
                additional_headers=self._supervisor.headers(name, role.word, shown),
                subprotocols=[version],
                compression=None,  # costs more time than the loopback interface
                max_size=None,
                max_queue=4,
                ping_interval=None,
                open_timeout=5.0,
                proxy=None,
            )
        except (OSError, InvalidHandshake, TimeoutError) as error:
            LOG.warning("the page cannot be reached: %s", error)
            raise Closing(TRY_LATER, "the page is starting; try again", "page away") from None

    async def _up(
        self, websocket: WebSocket, upstream: ClientConnection, role: Role, cookie: str
    ) -> str:
        """Forward the browser's accepted messages, while its cookie, if any, is valid."""
        strict = _Strictness(self._limits, self._figures)
        renewed = 0.0
        while True:
            try:
                async with asyncio.timeout(self._limits.idle_seconds):
                    received = await websocket.receive()
            except TimeoutError:
                raise Closing(GOING_AWAY, "nothing was done for a long time", "idle") from None
            if received["type"] == "websocket.disconnect":
                return "left"
            message = received.get("bytes") or b""
            self._figures.relayed.labels("in").inc(len(message))
            await strict.wait_for(message)
            verdict = validated(message, role)
            if verdict.passed is None:
                strict.refuse(verdict.reason)
                continue
            now = asyncio.get_running_loop().time()
            if cookie and now - renewed > RENEW_EVERY:
                renewed = now
                if not self._access.renew(cookie):
                    raise Closing(SIGNED_OUT, "signed out", "signed out")
            self._figures.messages.inc()
            try:
                await upstream.send(verdict.passed)
            except ConnectionClosed:
                return "page ended"

    async def _down(self, websocket: WebSocket, upstream: ClientConnection) -> str:
        """Forward the page's messages."""
        sent = self._figures.relayed.labels("out")
        with contextlib.suppress(ConnectionClosed, WebSocketDisconnect):
            async for message in upstream:
                if isinstance(message, bytes):
                    sent.inc(len(message))
                    await websocket.send_bytes(message)
            code = upstream.close_code or GOING_AWAY
            # 1002 is viser's code for another version of its client
            raise Closing(code if code == 1002 else GOING_AWAY, "the page has ended", "page ended")
        return "page ended" if upstream.close_code is not None else "left"


class _Strictness:
    """Rate limits of one browser: it waits at first, and is disconnected if it continues."""

    def __init__(self, limits: Limits, figures: Metrics) -> None:
        self._limits, self._figures = limits, figures
        self._messages = TokenBucket(limits.messages_per_second, limits.messages_at_once)
        self._bytes = TokenBucket(limits.bytes_per_second, limits.bytes_at_once)
        self._n_bad = 0
        self._throttled = 0.0

    async def wait_for(self, message: bytes) -> None:
        """Wait for the rate limits; meanwhile the browser's own queue grows."""
        size = len(message)
        wait = max(self._messages.wait(), self._bytes.wait(size))
        if wait > 0.0:
            self._throttled += wait
            self._figures.throttled.inc(wait)
            if self._throttled > self._limits.throttled_seconds:
                raise Closing(POLICY, "too many messages", "flood")
            await asyncio.sleep(wait)
        elif self._messages.wait(self._limits.messages_at_once / 2.0) == 0.0:
            self._throttled = 0.0  # it has paused
        self._messages.take()
        self._bytes.take(size)

    def refuse(self, reason: str) -> None:
        """Count a refused message."""
        self._figures.dropped.labels(reason).inc()
        self._n_bad += 1
        if self._n_bad > self._limits.bad_messages:
            raise Closing(POLICY, "too many messages that mean nothing here", "bad messages")


async def _either(*works: Coroutine[None, None, str]) -> str:
    """Run both directions until one ends, then cancel the other."""
    tasks = [asyncio.create_task(work) for work in works]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        return next(iter(done)).result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

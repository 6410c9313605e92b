"""uvicorn's HTTP and WebSocket protocols with further limits."""

import asyncio
import socket
from typing import Any, ClassVar

from h11 import Request
from uvicorn._types import ASGISendEvent
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import Frame

from hapticdb.server.limits import Limits, TokenBucket

PROTOCOL_ERROR, POLICY = 1002, 1008
"""WebSocket close codes."""


class _PatientHttp(H11Protocol):
    """HTTP protocol of every connection, with a time limit for each request.

    silent : connections without their next request, longest wait first.
    """

    limits: ClassVar[Limits] = Limits()
    silent: ClassVar[dict["_PatientHttp", None]] = {}

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the timer of the first request; set TCP_NODELAY for small messages."""
        super().connection_made(transport)
        # asyncio does so only for sockets with a protocol number, which accepted ones lack
        connection = transport.get_extra_info("socket")
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._silence: asyncio.TimerHandle | None = None
        self._expect_request()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the timer."""
        self.silent.pop(self, None)
        super().connection_lost(exc)

    def handle_events(self) -> None:
        """Handle received bytes, perhaps a request's last."""
        super().handle_events()
        if self.cycle is not self._last:
            self.silent.pop(self, None)

    def handle_websocket_upgrade(self, event: Request) -> None:
        """Hand over the connection to the WebSocket protocol."""
        self.silent.pop(self, None)
        super().handle_websocket_upgrade(event)

    def on_response_complete(self) -> None:
        """Start the timer of the next request."""
        self._expect_request()
        super().on_response_complete()

    def _expect_request(self) -> None:
        """Start the timer of a request; complete headers make it a cycle."""
        if self._silence is not None:
            self._silence.cancel()
        self._silence = self.loop.call_later(self.limits.request_seconds, self._cut_if_silent)
        self._last = self.cycle
        self.silent[self] = None
        if len(self.silent) > self.limits.silent:
            first = next(iter(self.silent))
            del self.silent[first]
            first.transport.abort()  # closing may wait for the client

    def _cut_if_silent(self) -> None:
        if self in self.silent:
            self.transport.close()


class StrictWebSocket(WebSocketsSansIOProtocol):
    """WebSocket protocol with limits of fragments and pings.

    A connection is cut if its client does not read: asyncio would wait for the client without end.
    """

    limits: ClassVar[Limits] = Limits()

    def __init__(self, *args: Any, **kwargs: Any) -> None:  # noqa: ANN401 - uvicorn's own
        super().__init__(*args, **kwargs)
        self._pings = TokenBucket(self.limits.pings_per_second, self.limits.pings_at_once)

    def handle_cont(self, event: Frame) -> None:
        """Handle a further fragment of a message."""
        if len(self.frames) >= self.limits.fragments:
            self._fail(PROTOCOL_ERROR, "a message in too many pieces")
            return
        super().handle_cont(event)

    def handle_ping(self) -> None:
        """Answer a ping, within the limit."""
        if self._pings.take():
            super().handle_ping()
        else:
            self._fail(POLICY, "too many pings")

    def handle_pong(self, event: Frame) -> None:
        """Accept a pong, perhaps unsolicited, within the limit."""
        if self._pings.take():
            super().handle_pong(event)
        else:
            self._fail(POLICY, "too many pongs")

    async def send(self, message: ASGISendEvent) -> None:
        """Send; an HTTP response completes the handshake, otherwise logged as an error."""
        await super().send(message)
        if self.initial_response is not None and self.close_sent:
            self.handshake_complete = True

    def keepalive_timeout(self) -> None:
        """Cut a client without a pong, so that waiting senders continue."""
        super().keepalive_timeout()
        self.transport.abort()

    def on_task_complete(self, task: "asyncio.Task[None]") -> None:
        """Give a client `close_timeout` to read the last messages, then cut it."""
        super().on_task_complete(task)
        self.loop.call_later(self.close_timeout, self.transport.abort)

    def _fail(self, code: int, words: str) -> None:
        if self.transport.is_closing():
            return
        self.conn.fail(code, words)
        self.queue.put_nowait({"type": "websocket.disconnect", "code": code, "reason": words})
        self.transport.write(b"".join(self.conn.data_to_send()))
        self.close_sent = True
        self.transport.close()


def limited(limits: Limits) -> tuple[type[_PatientHttp], type[StrictWebSocket]]:
    """Protocol classes under these limits."""
    return (
        type("LimitedHttp", (_PatientHttp,), {"limits": limits, "silent": {}}),
        type("LimitedWebSocket", (StrictWebSocket,), {"limits": limits}),
    )

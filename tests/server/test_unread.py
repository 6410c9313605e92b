"""Clients that stop reading: they are cut, and whoever sends to them goes on."""

import asyncio
import contextlib
import socket
import time
from collections.abc import AsyncIterator, Callable
from typing import Any, NoReturn, cast
from unittest.mock import AsyncMock

import pytest
import uvicorn
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocketState

from children import TIMEOUT
from hapticdb.server import relay
from hapticdb.server.access import Access
from hapticdb.server.limits import Limits
from hapticdb.server.metrics import Metrics
from hapticdb.server.page_supervisor import PageSupervisor
from hapticdb.server.relay import Relay
from hapticdb.server.transports import StrictWebSocket
from server.test_refused import UPGRADE

MORE_THAN_BUFFERS = bytes(16 << 20)


@contextlib.asynccontextmanager
async def unread(app: ASGIApp, *, ping: float | None) -> AsyncIterator[uvicorn.Server]:
    """A server, and a WebSocket to it that reads nothing."""
    config = uvicorn.Config(
        app, ws=StrictWebSocket, lifespan="off", log_config=None, ws_ping_interval=ping,
        ws_ping_timeout=ping, timeout_graceful_shutdown=1, ws_per_message_deflate=False,
    )  # fmt: skip
    server = uvicorn.Server(config)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        serving = asyncio.create_task(server.serve([listening]))
        with socket.create_connection(listening.getsockname(), TIMEOUT) as client:
            client.sendall(UPGRADE.format(host="127.0.0.1").encode())
            yield server
        server.should_exit = True
        await asyncio.wait_for(serving, TIMEOUT)


async def until(claim: Callable[[], object]) -> None:
    deadline = time.monotonic() + TIMEOUT
    while not claim():
        assert time.monotonic() < deadline
        await asyncio.sleep(0.01)


def test_send_to_client_without_pong_ends() -> None:
    ended: list[bool] = []

    async def send_for_ever(_scope: Scope, _receive: Receive, send: Send) -> None:
        await send({"type": "websocket.accept"})
        try:
            while True:
                await send({"type": "websocket.send", "bytes": MORE_THAN_BUFFERS})
        except (OSError, RuntimeError):
            ended.append(True)

    async def work() -> None:
        async with unread(send_for_ever, ping=0.2):
            await until(lambda: ended)

    asyncio.run(work())


def test_close_unread_last_message_cut(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    is_served: list[bool] = []
    begin = StrictWebSocket.connection_made

    def connection_made(self: StrictWebSocket, transport: Any) -> None:  # noqa: ANN401 - asyncio's
        begin(self, transport)
        self.close_timeout = 0.1

    monkeypatch.setattr(StrictWebSocket, "connection_made", connection_made)

    async def send_once(_scope: Scope, _receive: Receive, send: Send) -> None:
        await send({"type": "websocket.accept"})
        await send({"type": "websocket.send", "bytes": MORE_THAN_BUFFERS})
        is_served.append(True)

    async def work() -> None:
        async with unread(send_once, ping=None) as server:
            await until(lambda: is_served)
            await until(lambda: not server.server_state.connections)

    asyncio.run(work())


def unwilling() -> Any:  # noqa: ANN401 - in place of a WebSocket
    """A WebSocket that sends something malformed and takes no close frame."""

    async def close(*_: object) -> NoReturn:
        await asyncio.sleep(2.0 * TIMEOUT)
        raise AssertionError

    made = AsyncMock(application_state=WebSocketState.CONNECTED, headers=Headers(), close=close)
    made.receive.return_value = {"type": "websocket.receive", "bytes": b"malformed"}
    return made


def test_relay_client_without_close_frame_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(relay, "CLOSING_TIMEOUT", 0.01)
    figures = Metrics()
    served = Relay(Access({}), cast("PageSupervisor", None), Limits(), figures)

    async def work() -> None:
        await asyncio.wait_for(served.browser(unwilling()), TIMEOUT)

    asyncio.run(work())
    assert b'hapticdb_browser_connections_total{end="refused"} 1.0' in figures.text()

"""Clients that are refused, or send nothing: they cost others nothing, and log no error."""

import asyncio
import contextlib
import logging
import socket
from collections.abc import AsyncIterator
from http.client import HTTPConnection

import pytest
import uvicorn
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket

from children import TIMEOUT
from hapticdb.server.guards import Guards
from hapticdb.server.limits import Limits
from hapticdb.server.transports import limited

UPGRADE = (
    "GET / HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
)


async def answer(scope: Scope, receive: Receive, send: Send) -> None:
    await PlainTextResponse("well")(scope, receive, send)


@contextlib.asynccontextmanager
async def serving(app: ASGIApp, limits: Limits) -> AsyncIterator[tuple[str, int]]:
    """Address of a server under these limits."""
    http, websocket = limited(limits)
    config = uvicorn.Config(
        app, http=http, ws=websocket, lifespan="off", log_config=None, timeout_graceful_shutdown=1,
        limit_concurrency=limits.connections,
    )  # fmt: skip
    server = uvicorn.Server(config)
    with socket.create_server(("127.0.0.1", 0), backlog=128) as listening:
        running = asyncio.create_task(server.serve([listening]))
        yield listening.getsockname()
        server.should_exit = True
        await asyncio.wait_for(running, TIMEOUT)


def status(place: tuple[str, int]) -> int:
    """Status of the answer to a request."""
    connection = HTTPConnection(*place, timeout=TIMEOUT)
    with contextlib.closing(connection):
        connection.request("GET", "/healthz")
        return connection.getresponse().status


def test_server_idle_connections_leave_room() -> None:
    """More than the server takes at once; some have sent a part of a request."""
    limits = Limits(connections=32, silent=8, request_seconds=TIMEOUT)

    async def work() -> None:
        async with serving(answer, limits) as place:
            with contextlib.ExitStack() as idle:
                for n in range(2 * limits.connections):
                    made = idle.enter_context(socket.create_connection(place, TIMEOUT))
                    made.sendall(b"GET / HTTP/1.1\r\nHost:" if n % 2 else b"")
                    await asyncio.sleep(0)
                assert await asyncio.to_thread(status, place) == 200

    asyncio.run(work())


def test_server_slow_answer_survives_idle_connections() -> None:
    limits = Limits(silent=2, request_seconds=TIMEOUT)

    async def work() -> None:
        has_come, may_answer = asyncio.Future[None](), asyncio.Future[None]()

        async def answer_late(scope: Scope, receive: Receive, send: Send) -> None:
            has_come.set_result(None)
            await asyncio.wait_for(may_answer, TIMEOUT)
            await answer(scope, receive, send)

        async with serving(answer_late, limits) as place:
            asked = asyncio.create_task(asyncio.to_thread(status, place))
            await asyncio.wait_for(has_come, TIMEOUT)
            with contextlib.ExitStack() as idle:
                for _ in range(8):
                    made = await asyncio.to_thread(socket.create_connection, place, TIMEOUT)
                    idle.enter_context(made)
                may_answer.set_result(None)
                assert await asked == 200

    asyncio.run(work())


@pytest.mark.parametrize("host", ["127.0.0.1", "rebound.example"])
def test_server_refused_websocket_not_logged(host: str, caplog: pytest.LogCaptureFixture) -> None:
    async def close(scope: Scope, receive: Receive, send: Send) -> None:
        await WebSocket(scope, receive, send).close(1008)

    def refused(place: tuple[str, int]) -> bytes:
        with socket.create_connection(place, TIMEOUT) as client:
            client.sendall(UPGRADE.format(host=host).encode())
            return client.recv(1 << 16)

    async def work() -> None:
        async with serving(Guards(close), Limits()) as place:
            said = await asyncio.to_thread(refused, place)
            assert said.startswith(b"HTTP/1.1 403 ")

    with caplog.at_level(logging.WARNING):
        asyncio.run(work())
    assert caplog.records == []

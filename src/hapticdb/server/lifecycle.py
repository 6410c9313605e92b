"""Start and shutdown of a server and its processes, in order."""

import asyncio
import contextlib
import logging
import socket
from collections.abc import Awaitable, Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import uvicorn

from hapticdb.errors import UsageError
from hapticdb.page.connection import PageRequest
from hapticdb.server.access import Access, Role
from hapticdb.server.app import application
from hapticdb.server.front_page import client_page
from hapticdb.server.health import HealthChecker, HostCollector
from hapticdb.server.messages import LARGEST
from hapticdb.server.metrics import Metrics
from hapticdb.server.page_supervisor import PageSupervisor
from hapticdb.server.relay import Relay
from hapticdb.server.served import Served, Serving, check
from hapticdb.server.transports import limited
from hapticdb.session.host import SessionHost

if TYPE_CHECKING:
    from starlette.types import ASGIApp

LOG = logging.getLogger("hapticdb.server")
HEADER_BYTES = 16 << 10
"""Most bytes of a request's headers."""


class _Server(uvicorn.Server):
    """uvicorn without its signal handlers, in favour of the verb's."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


def listening(serving: Serving) -> socket.socket:
    """Bind the server's socket; UsageError for an unavailable address."""
    try:
        found = socket.getaddrinfo(
            serving.host, serving.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )
        return socket.create_server(found[0][4][:2], family=found[0][0], backlog=128)
    except (OSError, OverflowError) as error:
        raise UsageError(
            f"cannot listen on port {serving.port} of {serving.host}: {error}; choose another by "
            "--port, 0 for a free one"
        ) from None


async def run(serving: Serving, ready: Callable[[int], None], stop: asyncio.Event) -> None:
    """Serve until `stop` is set; then shut down in order, so that no recording is lost.

    First the server refuses connections and closes the browsers'; then the page ends its sessions;
    then the host ends the remaining ones and finishes their recordings.

    ready : called with the port once browsers can connect; stop : event to end the server.
    """
    check(serving)
    page = await asyncio.to_thread(client_page, serving.title)
    async with contextlib.AsyncExitStack() as ends:
        sock = ends.enter_context(listening(serving))
        port = int(sock.getsockname()[1])
        access = Access(serving.tokens, open_role=serving.open_role, port=port)
        url, rendering = serving.urls[Role.VIEWER], serving.rendering
        host = await asyncio.to_thread(SessionHost, url, rendering=rendering)
        ends.push_async_callback(asyncio.to_thread, host.close)

        served = Served(access, serving.limits, Metrics(), host)
        served.figures.registry.register(HostCollector(host))
        supervisor = PageSupervisor(serving.page, partial(_page_request, serving), host.serve)
        served.figures.page_starts.set_function(lambda: supervisor.n_starts)
        ends.push_async_callback(supervisor.stop)
        if not await _unless(stop, supervisor.start()):
            return
        supervising = asyncio.create_task(supervisor.supervise())
        ends.push_async_callback(_cancelled, supervising)
        health_checker = HealthChecker(served, supervisor)
        ends.push_async_callback(asyncio.to_thread, health_checker.close)
        app = application(
            served, page, Relay(access, supervisor, serving.limits, served.figures), health_checker,
            prefix=serving.prefix, title=serving.title, host_names=serving.host_names,
        )  # fmt: skip
        server = _Server(_config(app, serving))
        running = asyncio.create_task(server.serve([sock]))
        ready(port)
        LOG.info("serving", extra={"port": port})
        await _unless(stop, asyncio.shield(running))
        LOG.info("stopping")
        server.should_exit = True
        await running
    LOG.info("stopped")


def _page_request(serving: Serving, server: int, host: int, secret: str) -> PageRequest:
    urls = {role.word: url for role, url in serving.urls.items()}
    return PageRequest(
        urls, serving.tools, server, host, secret, serving.recordings, serving.title,
        is_direct=serving.rendering == "direct", machine=serving.machine,
        tool_unit=serving.tool_unit,
    )  # fmt: skip


async def _unless(stop: asyncio.Event, work: Awaitable[None]) -> bool:
    """Await work; returns False if `stop` is set before its end."""
    stopping = asyncio.create_task(stop.wait())
    working = asyncio.ensure_future(work)
    try:
        await asyncio.wait([working, stopping], return_when=asyncio.FIRST_COMPLETED)
        if not working.done():
            return False
        await working
        return True
    finally:
        stopping.cancel()
        working.cancel()


async def _cancelled(task: "asyncio.Task[None]") -> None:
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task


def _config(app: "ASGIApp", serving: Serving) -> uvicorn.Config:
    limits = serving.limits
    http, websocket = limited(limits)
    return uvicorn.Config(
        app,
        http=http,
        ws=websocket,
        ws_max_size=64 * LARGEST,  # a smaller one above the limit is dropped, and counted
        ws_per_message_deflate=False,  # compressing costs more time than it saves here
        ws_ping_interval=20.0,
        ws_ping_timeout=60.0,  # on a slow network a pong waits behind the scene
        lifespan="off",
        log_config=None,
        access_log=False,
        server_header=False,
        limit_concurrency=limits.connections,
        timeout_graceful_shutdown=max(int(limits.stop_seconds), 1),
        h11_max_incomplete_event_size=HEADER_BYTES,
        ssl_certfile=None if serving.certificate is None else Path(serving.certificate),
        ssl_keyfile=None if serving.key is None else Path(serving.key),
    )

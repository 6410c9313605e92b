"""A server for tests, in a process of its own: the endpoint for cells of any environment.

``ws://127.0.0.1:PORT/NAME`` serves the environment whose URL is NAME in base64. Each endpoint lives
while it has clients.
"""

import asyncio
import base64
import contextlib
import json
import os
import signal
import socket
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Self

import uvicorn
from starlette.applications import Starlette
from starlette.routing import WebSocketRoute
from starlette.types import Receive, Scope, Send

import children
from hapticdb.protocol.cells import MOST_REQUEST
from hapticdb.server.cells.endpoint import CellsEndpoint
from hapticdb.server.cells.limits import CellsLimits
from hapticdb.store.base import Store
from hapticdb.store.remote import connection

TOKEN = "a-token-of-the-tests"  # noqa: S105
LIFE_S = 5400.0
"""Seconds after which a server that a run has left is ended."""


def impatient(store: Store) -> Store:
    """Give an answer up soon, in a fetching process."""
    connection.ANSWER_SECONDS = connection.OPEN_SECONDS = 5.0
    return store


def may_enter(headers: Mapping[str, str]) -> bool:
    return headers.get("authorization", f"Bearer {TOKEN}") == f"Bearer {TOKEN}"


class AnyEnvironment:
    """Routes a connection to the endpoint of the environment that its path names."""

    def __init__(self, limits: CellsLimits) -> None:
        self._limits = limits
        self._endpoints: dict[str, CellsEndpoint] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        name = scope["path_params"]["name"]
        url = base64.urlsafe_b64decode(name).decode()
        endpoint = self._endpoints.get(url)
        if endpoint is None:
            endpoint = CellsEndpoint(url, may_enter=may_enter, limits=self._limits)
            self._endpoints[url] = endpoint
        try:
            await endpoint(scope, receive, send)
        finally:
            if not endpoint.n_clients and self._endpoints.pop(url, None) is not None:
                await endpoint.close()


async def serve(limits: CellsLimits, certificate: tuple[str, str] | None, port: int) -> None:
    app = Starlette(routes=[WebSocketRoute("/{name}/device/cells", AnyEnvironment(limits))])
    listening = socket.create_server(("127.0.0.1", port))
    files: dict[str, Any] = {}
    if certificate:
        files = {"ssl_certfile": certificate[0], "ssl_keyfile": certificate[1]}
    config = uvicorn.Config(
        app, ws="websockets-sansio", ws_max_size=MOST_REQUEST, ws_per_message_deflate=False,
        log_level="warning", lifespan="off", timeout_graceful_shutdown=1, **files,
    )  # fmt: skip
    server = uvicorn.Server(config)
    print(listening.getsockname()[1], flush=True)  # noqa: T201 - to the parent
    end = asyncio.get_running_loop().create_task(parent_ends(server))
    await server.serve([listening])
    end.cancel()


async def parent_ends(server: uvicorn.Server) -> None:
    """End the server when the pipe from its parent is closed."""
    loop = asyncio.get_running_loop()
    await loop.run_in_executor(None, sys.stdin.buffer.read)
    server.should_exit = True


class DeviceServer:
    """The server's process, from the test's side."""

    def __init__(
        self,
        log: Path,
        certificate: tuple[str, str] | None = None,
        *,
        port: int = 0,
        **limits: float,
    ) -> None:
        told = json.dumps({"limits": limits, "certificate": certificate, "port": port})
        self.log = log
        self._opened = contextlib.ExitStack()
        errors = self._opened.enter_context(log.open("ab"))
        command = [sys.executable, __file__, told]
        path = {"PYTHONPATH": os.pathsep.join(sys.path)}
        self.process = self._opened.enter_context(
            children.child(
                command,
                stdin=children.PIPE,
                stderr=errors.fileno(),
                env=os.environ | path,
                patience=LIFE_S,
            )
        )
        self.scheme = "wss" if certificate else "ws"
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            self.close()
            raise AssertionError(f"the server did not start: {log.read_text()}")
        self.port = int(line)

    def url(self, environment: str, *, port: int | None = None, query: str = "") -> str:
        name = base64.urlsafe_b64encode(environment.encode()).decode()
        return f"{self.scheme}://127.0.0.1:{port or self.port}/{name}{query}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextlib.contextmanager
    def stalled(self) -> Iterator[None]:
        """Stop the process meanwhile: it answers nothing and closes nothing."""
        self.process.send_signal(signal.SIGSTOP)
        try:
            yield
        finally:
            self.process.send_signal(signal.SIGCONT)

    def kill(self) -> None:
        """End the process as a failure of its machine does: without a word."""
        self.process.kill()
        self.process.wait(children.PATIENCE)

    def close(self) -> None:
        with contextlib.suppress(OSError):
            if self.process.stdin is not None:
                self.process.stdin.close()
        self._opened.close()


if __name__ == "__main__":
    asked = json.loads(sys.argv[1])
    asyncio.run(serve(CellsLimits(**asked["limits"]), asked["certificate"], asked["port"]))

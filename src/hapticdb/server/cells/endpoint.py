"""The endpoint for cells as an ASGI application, to be mounted as a WebSocket route."""

import asyncio
import contextlib
from collections.abc import Callable, Mapping

from starlette.responses import PlainTextResponse
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocket

from hapticdb.protocol.header import CloseCode
from hapticdb.server.access import Role
from hapticdb.server.cells.answers import Answers
from hapticdb.server.cells.client import CellsClient
from hapticdb.server.cells.limits import CellsLimits
from hapticdb.server.cells.readers import Readers
from hapticdb.server.cells.watcher import Watcher
from hapticdb.server.served import Served

Admission = Callable[[Mapping[str, str]], bool]
"""Tells by the headers of an opening request, names in lower case, whether a client may read."""


class CellsEndpoint:
    """Serves the cells of one environment to clients that compute their own forces.

    An ASGI application: ``WebSocketRoute("/device/cells", endpoint)``. Its application calls
    `close` at its end, in the event loop. The largest message and the compression are the web
    server's: for uvicorn ``ws_max_size=MOST_REQUEST`` and ``ws_per_message_deflate=False``.

    Parameters
    ----------
    url : str
        The environment; it is opened to read.
    may_enter : callable
        Whether a client with these headers may read the environment.
    limits : CellsLimits
        What clients may ask for.
    """

    def __init__(
        self, url: str, *, may_enter: Admission, limits: CellsLimits | None = None
    ) -> None:
        self._url = url
        self._may_enter = may_enter
        self.limits = limits or CellsLimits()
        self._answers = Answers()
        self._clients: set[CellsClient] = set()
        self._readers: Readers | None = None
        self._watcher: Watcher | None = None
        self._is_closed = False

    @property
    def n_clients(self) -> int:
        """Number of clients that are connected now."""
        return len(self._clients)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection, from its opening request to its end."""
        socket = WebSocket(scope, receive, send)
        status = self._status_of(socket)
        if status:
            await _deny(socket, status)
            return
        readers, watcher = self._opened()
        client = CellsClient(socket, readers, watcher, self._answers, self.limits)
        self._clients.add(client)
        try:
            await socket.accept()
            await client.serve()
        except asyncio.CancelledError:
            pass  # only the server's end cancels, and uvicorn would log a traceback
        finally:
            self._clients.discard(client)
            if not self._clients:
                await self._rest()

    def _status_of(self, socket: WebSocket) -> int:
        """HTTP status of a refusal; 0 for a client that may enter."""
        # a page in a browser always names its origin; a token in a header it cannot send
        if "origin" in socket.headers or not self._may_enter(socket.headers):
            return 403
        return 503 if self._is_closed or len(self._clients) >= self.limits.clients else 0

    def _opened(self) -> tuple[Readers, Watcher]:
        """Stores and watcher, from the first client on: both belong to the event loop."""
        if self._readers is None:
            limits = self.limits
            self._readers = Readers(self._url, threads=limits.threads, snapshots=limits.snapshots)
        if self._watcher is None:
            self._watcher = Watcher(self._url, self._tell)
        return self._readers, self._watcher

    def _tell(self) -> None:
        """Wake all clients: there is a new revision, or another environment."""
        if self._readers is None or self._watcher is None:
            return
        is_other = self._readers.identity not in {None, self._watcher.identity}
        self._readers.identity = self._watcher.identity
        for client in self._clients:
            if is_other:
                client.send_away(CloseCode.REPLACED, "another environment is here now")
            else:
                client.wake()

    async def close(self) -> None:
        """Send all clients away, and close all stores."""
        self._is_closed = True
        for client in list(self._clients):
            client.send_away(CloseCode.ENDS, "the server ends")
        await self._rest()

    async def _rest(self) -> None:
        """Close watcher and stores: without clients nothing is held open."""
        watcher, self._watcher = self._watcher, None
        readers, self._readers = self._readers, None
        if watcher is not None:
            watcher.stop()
        if readers is not None:
            await readers.close()


async def serve_cells(socket: WebSocket) -> None:
    """Serve one connection with what the server's application knows: `Served`."""
    served: Served = socket.app.state.served

    def may_enter(headers: Mapping[str, str]) -> bool:
        role = served.access.role_of_headers(headers)
        return role is not None and role >= Role.TOUCHER

    if not hasattr(socket.app.state, "cells"):
        socket.app.state.cells = CellsEndpoint(served.urls[Role.TOUCHER], may_enter=may_enter)
    endpoint: CellsEndpoint = socket.app.state.cells
    await endpoint(socket.scope, socket.receive, socket.send)


async def _deny(socket: WebSocket, status: int) -> None:
    """Refuse an opening request by an HTTP status and a plain line."""
    texts = {403: "this client may not feel this environment", 503: "too many clients now"}
    with contextlib.suppress(RuntimeError):
        await socket.send_denial_response(PlainTextResponse(texts[status], status))

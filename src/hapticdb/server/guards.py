"""Checks of Host and Origin on every request, and security headers of every response.

A page of another site can make a browser send requests to this server, but cannot set the headers
Host and Origin. Host is checked against DNS rebinding, Origin against cross-site requests: on every
WebSocket and every changing request. A WebSocket without Origin passes: browsers always send one,
so the client is a program, with the token of a role.
"""

import logging
import socket
from collections.abc import Sequence
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from hapticdb.server.served import is_address

LOG = logging.getLogger("hapticdb.server")
SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
"""Methods without changes, sent by browsers without an Origin."""
HEADERS = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    "x-frame-options": "DENY",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
    "content-security-policy": "default-src 'none'; frame-ancestors 'none'; base-uri 'none'",
}
"""Default headers of every response."""


class Guards:
    """Middleware: checks Host and Origin of requests, adds headers to responses.

    host_names : accepted names of the server, besides numeric addresses, ``localhost`` and the
    machine's own name.
    """

    def __init__(self, app: ASGIApp, host_names: Sequence[str] = ()) -> None:
        self._app = app
        own = {"localhost", socket.gethostname().lower(), socket.getfqdn().lower()}
        self._names = own | {name.lower() for name in host_names}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)

        async def send_guarded(message: Message) -> None:
            if message["type"] in {"http.response.start", "websocket.http.response.start"}:
                added = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    added.setdefault(name, value)
            await send(message)

        refusal = self._refusal(scope, headers)
        if refusal:
            LOG.info("refused: %s", refusal)
            answer = PlainTextResponse(refusal + "\n", 403)
            await answer(scope, receive, send_guarded)
            return
        await self._app(scope, receive, send_guarded)

    def _refusal(self, scope: Scope, headers: Headers) -> str:
        """Reason to refuse a request; empty if it passes."""
        host = headers.getlist("host")
        if len(host) != 1 or not self._is_ours(host[0]):
            return "this server does not answer under that host name"
        is_checked = scope["type"] == "websocket" or scope["method"] not in SAFE_METHODS
        origins = headers.getlist("origin")
        if is_checked and not all(_is_same(origin, host[0]) for origin in origins):
            return "a page of another site may not do that"
        if scope["type"] == "http" and is_checked and not origins:
            return "the header Origin is missing"
        return ""

    def _is_ours(self, host: str) -> bool:
        """Whether a Host header names this server; numeric addresses cannot be rebound."""
        try:
            parts = urlsplit(f"//{host}")
            name = parts.hostname or ""
            _ = parts.port  # raises if it is no number
        except ValueError:
            return False
        return name in self._names or is_address(name)


def _is_same(origin: str, host: str) -> bool:
    """Whether an origin is the request's host; a proxy may have terminated TLS."""
    scheme, mark, authority = origin.lower().partition("://")
    return bool(mark) and scheme in {"http", "https"} and authority == host.lower()

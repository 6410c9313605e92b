"""What every request must satisfy before an endpoint sees it, and headers of every answer.

A page of another site can make a browser send requests to this server. It cannot choose the headers
Host and Origin, so both are checked: Host against rebound names (DNS rebinding), Origin on every
WebSocket and on every request that changes something. A WebSocket without Origin passes: browsers
always send one there, so a program opens it, with the token of a role.
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
"""Methods that change nothing, and that browsers send without an Origin."""
HEADERS = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    "x-frame-options": "DENY",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
    "content-security-policy": "default-src 'none'; frame-ancestors 'none'; base-uri 'none'",
}
"""Headers of every answer, unless its endpoint sets its own."""


class Guards:
    """Checks Host and Origin of everything that comes in, and adds headers to what goes out.

    host_names : under which the server may be reached, beside addresses in digits, ``localhost``
    and the machine's own name.
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
        """Why a request is refused; empty if it passes."""
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
        """Whether a Host header names this server; digits cannot be rebound."""
        try:
            parts = urlsplit(f"//{host}")
            name = parts.hostname or ""
            _ = parts.port  # raises if it is no number
        except ValueError:
            return False
        return name in self._names or is_address(name)


def _is_same(origin: str, host: str) -> bool:
    """Whether an origin is the host that the request went to; a proxy may have ended TLS."""
    scheme, mark, authority = origin.lower().partition("://")
    return bool(mark) and scheme in {"http", "https"} and authority == host.lower()

"""The ASGI application: routes."""

import asyncio

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
from starlette.types import ASGIApp

from hapticdb.server.front_page import ClientPage, SignIn
from hapticdb.server.guards import Guards
from hapticdb.server.health import HealthChecker
from hapticdb.server.relay import Relay
from hapticdb.server.served import Served

LOOPBACK = frozenset({"127.0.0.1", "::1", "localhost"})
"""Addresses of this machine; behind a proxy, a request has the proxy's client instead."""
FORWARDED = ("forwarded", "x-forwarded-for", "x-forwarded-host", "via")
"""Headers of forwarding proxies."""


def application(
    served: Served,
    page: ClientPage,
    relay: Relay,
    health_checker: HealthChecker,
    *,
    prefix: str,
    title: str,
    host_names: tuple[str, ...] = (),
) -> ASGIApp:
    """Application of a server's parts; `prefix`, `title` and `host_names` as of `Serving`."""
    door = SignIn(served.access, page, served.limits, prefix, title)

    async def healthz(_: Request) -> Response:
        health = await health_checker.health()
        return JSONResponse(health.words(), 200 if health.is_well else 503)

    async def metrics(request: Request) -> Response:
        if not _may_read_figures(request, served):
            return PlainTextResponse(
                "this needs a token, or a request from the same machine\n", 403
            )
        await health_checker.health()  # measures the database
        text = await asyncio.to_thread(served.figures.text)  # sessions may be starting
        return Response(text, media_type="text/plain; version=0.0.4")

    routes: list[BaseRoute] = [
        Route("/", door.view, methods=["GET", "POST"]),
        Route("/see/{shown}", door.view, methods=["GET", "POST"]),
        Route("/healthz", healthz, methods=["GET"]),
        Route("/metrics", metrics, methods=["GET"]),
        WebSocketRoute("/", relay.browser),
        WebSocketRoute("/see/{shown}", relay.browser),
    ]
    # viser's client omits the last slash of the page's address
    bare: list[BaseRoute] = [WebSocketRoute(prefix, relay.browser)] if prefix else []
    app = Starlette(routes=[*bare, Mount(prefix, routes=routes)] if prefix else routes)
    return Guards(app, host_names)


def _may_read_figures(request: Request, served: Served) -> bool:
    """Whether a request comes from this machine without a proxy, or has a valid token."""
    shown = request.headers.get("authorization") or served.access.cookie_of(request.headers)
    if shown and served.access.role_of_headers(request.headers) is not None:
        return True
    address = request.client.host if request.client is not None else ""
    is_direct = not any(name in request.headers for name in FORWARDED)
    return address in LOOPBACK and is_direct and request.url.hostname in LOOPBACK

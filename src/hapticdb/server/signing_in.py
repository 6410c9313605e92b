"""The first page of a browser: a token becomes a cookie, and the cookie opens the view."""

import asyncio
import html
from urllib.parse import parse_qs

from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response

from hapticdb.server.access import Access
from hapticdb.server.client_page import ClientPage, digest_source
from hapticdb.server.limits import Limits, TokenBucket

STYLE = (
    "body{font:16px system-ui,sans-serif;max-width:24rem;margin:20vh auto;padding:0 1rem}"
    "input,button{font:inherit;padding:.5rem;width:100%;box-sizing:border-box;margin-top:.5rem}"
)
FORM = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{title}</title><style>{style}</style></head>
<body><h1>{title}</h1><p>{words}</p>
<form method="post" action="{prefix}/sign-in">
<label>Token <input type="password" name="token" autocomplete="current-password" required
autofocus></label><button>Open</button></form></body></html>
"""
ONWARD = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<meta http-equiv="refresh" content="0;url={prefix}/"></head><body></body></html>
"""
"""Leads on to the view without the token in the address. A redirect would lose the cookie, which is
SameSite=Strict, where the link stands on another site."""
POLICY = (
    f"default-src 'none'; style-src '{digest_source(STYLE.encode())}'; form-action 'self'; "
    "frame-ancestors 'none'; base-uri 'none'"
)


class FrontDoor:
    """Answers a browser's first requests: the view, or the form that asks for a token."""

    def __init__(
        self, access: Access, page: ClientPage, limits: Limits, prefix: str, title: str
    ) -> None:
        self._access, self._page, self._limits = access, page, limits
        self._prefix, self._title = prefix, title
        self._tries = TokenBucket(limits.sign_ins_per_second, limits.sign_ins_at_once)

    async def view(self, request: Request) -> Response:
        """Answer a GET of the page."""
        if "token" in request.query_params:
            return self._sign_in(request, request.query_params["token"])
        if self._access.role_of_headers(request.headers) is None:
            return self._form("This page needs a token. Whoever started the server has it.", 401)
        return self._view(request)

    async def sign_in(self, request: Request) -> Response:
        """Answer the form."""
        body = b""
        try:
            async with asyncio.timeout(self._limits.request_seconds):
                async for piece in request.stream():
                    body += piece
                    if len(body) > self._limits.form_bytes:
                        return PlainTextResponse("the form is too large\n", 413)
        except TimeoutError:
            return PlainTextResponse("the form came too slowly\n", 408, {"connection": "close"})
        except ClientDisconnect:
            return Response(status_code=400)
        fields = parse_qs(body.decode("ascii", "replace"), max_num_fields=4)
        return self._sign_in(request, fields.get("token", [""])[0])

    def _sign_in(self, request: Request, token: str) -> Response:
        if not self._tries.take():
            return self._form("Too many attempts. Wait a few seconds, then try again.", 429)
        cookie = self._access.sign_in(token)
        if cookie is None:
            return self._form("That token is wrong.", 403)
        answer: Response
        if request.method == "GET":
            answer = HTMLResponse(
                ONWARD.format(title=html.escape(self._title), prefix=self._prefix)
            )
        else:
            answer = RedirectResponse(f"{self._prefix}/", 303)
        answer.set_cookie(
            self._access.cookie_name,
            cookie,
            path=self._prefix or "/",  # the socket of viser has no slash behind the prefix
            secure=request.url.scheme == "https",
            httponly=True,
            samesite="strict",
        )
        return answer

    def _form(self, words: str, status: int) -> Response:
        page = FORM.format(
            title=html.escape(self._title),
            style=STYLE,
            words=html.escape(words),
            prefix=self._prefix,
        )
        return HTMLResponse(page, status, {"content-security-policy": POLICY})

    def _view(self, request: Request) -> Response:
        page = self._page
        headers = {
            "content-security-policy": page.policy,
            "cache-control": "private, no-cache",
            "etag": page.tag,
            "vary": "accept-encoding, cookie",
        }
        if request.headers.get("if-none-match") == page.tag:
            return Response(status_code=304, headers=headers)
        if "gzip" in request.headers.get("accept-encoding", ""):
            return HTMLResponse(page.packed, headers=headers | {"content-encoding": "gzip"})
        return HTMLResponse(page.html, headers=headers)

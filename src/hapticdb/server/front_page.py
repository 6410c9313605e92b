"""First pages of a browser: sign-in by token, and viser's client.

The client is one HTML file with its program packed. A small script unpacks it and adds it to the
document. The content security policy allows these two scripts by their digests, so no other script
runs, and no text of a part can become one.
"""

import asyncio
import base64
import gzip
import hashlib
import html
import importlib.util
import re
from pathlib import Path
from typing import NamedTuple
from urllib.parse import parse_qs

import numpy as np
from numpy.typing import NDArray
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response

from hapticdb.errors import MissingExtraError, pip_line
from hapticdb.server.access import Access
from hapticdb.server.limits import Limits, TokenBucket

ALPHABET = (
    b"!#$%()*+,-./0123456789:;=?@ABCDEFGHIJKLMNOPQRSTUVWXYZ[\\]^_abcdefghijklmnopqrstuvwxyz{|}~"
)
"""Digits of the packed program, in base 88: five of them make four bytes."""
LOADER = re.compile(
    r'<script data-p="(?P<packed>[^"]*)" data-ss="(?P<style>\d+)" data-cs="(?P<code>\d+)">'
    r"(?P<script>.*?)</script>",
    re.DOTALL,
)
TITLE = "<title>Viser</title>"
BUTTON = ".mantine-ActionIcon-root"
HAS_GUI = (
    f"body:has({BUTTON}:not([style*=none]) :is(.tabler-icon-adjustments,.tabler-icon-arrow-back))"
)
"""Selects the body once viser has had widgets of the page."""
HIDING = (
    f"<style>#webgl-software-rendering,{BUTTON}:has(.tabler-icon-share)"
    ",.tabler-icon-adjustments{display:none!important}"
    f"{BUTTON}:has(.tabler-icon-adjustments){{width:auto}}"
    f"{BUTTON}:has(.tabler-icon-adjustments)::after{{content:'Picture';font-size:.85rem}}"
    ".tabler-icon-arrow-back{pointer-events:none}"
    ".mantine-Stack-root:has(>.mantine-TextInput-root input[value*='://'])"
    "{visibility:hidden!important}"
    "body:has(.tabler-icon-arrow-back) button:has(.tabler-icon-photo){visibility:visible}"
    "div:has(>.mantine-Button-root .tabler-icon-photo){order:-1}"
    "[data-dock-area]>*>.mantine-Text-root:only-child{visibility:hidden}"
    "div:has(>p>label:empty){display:none}"
    "[role=tablist]{flex-wrap:nowrap!important}[role=tab]{padding:0 .65em!important}"
    "body::after{position:fixed;z-index:9999;font:16px system-ui,sans-serif}"
    f"{HAS_GUI}:has(.tabler-icon-player-pause,.mantine-Loader-root[style*=absolute])::after{{"
    "content:'The server has ended, or cannot be reached. You see the last picture.';"
    "inset:0 0 auto;padding:.5rem 1rem;background:#c62838;color:#fff}"
    f"body:not({HAS_GUI})::after{{content:'Connecting ...';inset:0;display:grid;"
    "place-items:center;background:#fafbfc}</style>"
)
"""Hides viser's note about software rendering, its text in an empty tab, the place of an empty
label, and its settings, which begin with the server's address. They stay laid out, because viser
measures them; their button for pictures stays. Keeps the tabs in one row. Covers everything until
the first widgets come; a line on top reports a lost connection."""


class ClientPage(NamedTuple):
    """The page of a browser, plain and gzipped; its ETag, and its content security policy."""

    html: bytes
    packed: bytes
    tag: str
    policy: str


def client_page(title: str) -> ClientPage:
    """Client of viser with a title; MissingExtraError without viser, or for another client."""
    spec = importlib.util.find_spec("viser")
    if spec is None or spec.origin is None:
        raise MissingExtraError(f"the browser view needs more packages: {pip_line('view')}")
    text = (Path(spec.origin).parent / "client" / "build" / "index.html").read_text("utf-8")
    loader = LOADER.search(text)
    if loader is None or TITLE not in text:
        raise MissingExtraError(
            "this version of viser has a client of an unknown form: pip install 'viser==1.1.1'"
        )
    page = text.replace(TITLE, f"<title>{title}</title>{HIDING}").encode()
    return ClientPage(
        page,
        gzip.compress(page),
        f'"{hashlib.sha256(page).hexdigest()[:32]}"',
        _policy([loader["script"].encode(), _program(loader)]),
    )


def _policy(scripts: list[bytes]) -> str:
    """Content security policy for exactly these scripts, without other origins."""
    digests = " ".join(f"'{digest_source(script)}'" for script in scripts)
    return "; ".join(
        [
            "default-src 'none'",
            f"script-src {digests} 'wasm-unsafe-eval'",  # zstd is WebAssembly
            "worker-src blob:",  # the socket's worker is part of the program
            # data: and blob: are the page's own bytes (its light, textures): nothing leaves by them
            "connect-src 'self' data: blob:",
            "img-src 'self' data: blob:",
            "font-src data:",
            "style-src 'unsafe-inline'",  # widgets set styles; a style runs nothing
            "form-action 'none'",
            "base-uri 'none'",
            "frame-ancestors 'none'",
        ]
    )


def digest_source(script: bytes) -> str:
    """Source expression of a policy for exactly this inline script or style."""
    return f"sha256-{base64.b64encode(hashlib.sha256(script).digest()).decode()}"


def _program(loader: re.Match[str]) -> bytes:
    """Unpack the client's program, as its loader does."""
    import zstandard  # noqa: PLC0415 - comes with viser

    digits = np.frombuffer(loader["packed"].encode(), np.uint8)
    n_styles, n_code = int(loader["style"]), int(loader["code"])
    unpacked = zstandard.ZstdDecompressor().decompress(
        _bytes_of(digits), max_output_size=n_styles + n_code
    )
    return unpacked[n_styles : n_styles + n_code]


def _bytes_of(digits: NDArray[np.uint8]) -> bytes:
    """Bytes of a text in base 88; the last n < 5 digits make n - 1 bytes."""
    value_of = np.zeros(256, np.int64)
    value_of[np.frombuffer(ALPHABET, np.uint8)] = np.arange(88)
    values = value_of[digits]
    rest = len(values) % 5
    whole = values[: len(values) - rest].reshape(-1, 5) @ 88 ** np.arange(4, -1, -1)
    tail = 0
    for value in values[len(values) - rest :]:
        tail = tail * 88 + int(value)
    return whole.astype(">u4").tobytes() + tail.to_bytes(max(rest - 1, 0), "big")


STYLE = (
    "body{font:16px system-ui,sans-serif;max-width:24rem;margin:20vh auto;padding:0 1rem}"
    "input,button{font:inherit;padding:.5rem;width:100%;box-sizing:border-box;margin-top:.5rem}"
)
FORM = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{title}</title><style>{style}</style></head>
<body><h1>{title}</h1><p>{words}</p>
<form method="post">
<label>Token <input type="password" name="token" autocomplete="current-password" required
autofocus></label><button>Open</button></form></body></html>
"""
ONWARD = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<meta http-equiv="refresh" content="0;url={url}"></head><body></body></html>
"""
"""Leads to the view, with a URL without the token. After a link from another site, a redirect would
lose the cookie, which is SameSite=Strict."""
POLICY = (
    f"default-src 'none'; style-src '{digest_source(STYLE.encode())}'; form-action 'self'; "
    "frame-ancestors 'none'; base-uri 'none'"
)


class SignIn:
    """Sign-in and view: the view with a valid cookie, otherwise the form for a token."""

    def __init__(
        self, access: Access, page: ClientPage, limits: Limits, prefix: str, title: str
    ) -> None:
        self._access, self._page, self._limits = access, page, limits
        self._prefix, self._title = prefix, title
        self._tries: dict[str, TokenBucket] = {}

    async def view(self, request: Request) -> Response:
        """Answer a request of the page: a POST is that of the form, with the token."""
        if request.method == "POST":
            return await self._posted(request)
        if "token" in request.query_params:
            return self._sign_in(request, request.query_params["token"])
        if self._access.role_of_headers(request.headers) is None:
            return self._form("This page needs a token. Whoever started the server has it.", 401)
        return self._view(request)

    async def _posted(self, request: Request) -> Response:
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
        if not self._may_try(request):
            return self._form("Too many attempts. Wait a few seconds, then try again.", 429)
        cookie = self._access.sign_in(token)
        if cookie is None:
            return self._form("That token is wrong.", 403)
        rest = request.url.remove_query_params("token")
        url = f"{rest.path}?{rest.query}" if rest.query else rest.path
        answer: Response
        if request.method == "GET":
            title, url = html.escape(self._title), html.escape(url)
            answer = HTMLResponse(ONWARD.format(title=title, url=url))
        else:
            answer = RedirectResponse(url, 303)
        answer.set_cookie(
            self._access.cookie_name,
            cookie,
            path=self._prefix or "/",  # viser's socket has no slash behind the prefix
            secure=request.url.scheme == "https",
            httponly=True,
            samesite="strict",
        )
        return answer

    def _may_try(self, request: Request) -> bool:
        """Whether an address may try a token now; an IPv6 address counts as its network of /64."""
        address = "" if request.client is None else request.client.host
        address = ":".join(address.split(":")[:4])
        limits = self._limits
        if address not in self._tries:
            if len(self._tries) >= 4096:  # a new address replaces the oldest
                del self._tries[next(iter(self._tries))]
            self._tries[address] = TokenBucket(limits.sign_ins_per_second, limits.sign_ins_at_once)
        return self._tries[address].take()

    def _form(self, words: str, status: int) -> Response:
        title, words = html.escape(self._title), html.escape(words)
        page = FORM.format(title=title, style=STYLE, words=words)
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

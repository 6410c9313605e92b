"""viser's client as the server hands it out: one HTML file, and the policy that it runs under.

The file holds its program packed. A small script unpacks it and adds it to the document. The
content security policy names both scripts by their digests, so no other script runs, and no text of
a part can become one.
"""

import base64
import gzip
import hashlib
import importlib.util
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import MissingExtraError

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


class ClientPage(NamedTuple):
    """The page of a browser, also packed by gzip; a tag that changes with it, and its policy."""

    html: bytes
    packed: bytes
    tag: str
    policy: str


def client_page(title: str) -> ClientPage:
    """Read viser's client and give it a title of plain words.

    Raises
    ------
    MissingExtraError
        If viser is not installed, or in a version whose client is of another form.
    """
    spec = importlib.util.find_spec("viser")
    if spec is None or spec.origin is None:
        raise MissingExtraError(
            "the browser view needs the extra 'view': pip install 'hapticdb[view]'"
        )
    text = (Path(spec.origin).parent / "client" / "build" / "index.html").read_text("utf-8")
    loader = LOADER.search(text)
    if loader is None or TITLE not in text:
        raise MissingExtraError(
            "this version of viser has a client of an unknown form: pip install 'viser==1.1.1'"
        )
    html = text.replace(TITLE, f"<title>{title}</title>").encode()
    return ClientPage(
        html,
        gzip.compress(html),
        f'"{hashlib.sha256(html).hexdigest()[:32]}"',
        _policy([loader["script"].encode(), _program(loader)]),
    )


def _policy(scripts: list[bytes]) -> str:
    """Policy under which exactly these scripts run, and nothing is fetched from elsewhere."""
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
    """Source expression of a policy that allows exactly this inline script or style."""
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
    """Bytes of a text in base 88; the last digits hold one byte less than they are."""
    value_of = np.zeros(256, np.int64)
    value_of[np.frombuffer(ALPHABET, np.uint8)] = np.arange(88)
    values = value_of[digits]
    rest = len(values) % 5
    whole = values[: len(values) - rest].reshape(-1, 5) @ 88 ** np.arange(4, -1, -1)
    tail = 0
    for value in values[len(values) - rest :]:
        tail = tail * 88 + int(value)
    return whole.astype(">u4").tobytes() + tail.to_bytes(max(rest - 1, 0), "big")

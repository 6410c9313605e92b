"""Servers for tests, each in a thread of this process, and what clients need to reach them."""

import asyncio
import contextlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from http.client import HTTPConnection, HTTPResponse
from pathlib import Path

import msgspec
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.sync.connection import Connection
from websockets.typing import Subprotocol

from children import TIMEOUT, joined
from hapticdb.server.access import Role
from hapticdb.server.lifecycle import run
from hapticdb.server.served import Serving

PROTOCOL = [Subprotocol(f"viser-v{viser.__version__}")]
TOKENS = {f"a-token-for-{role.word}": role for role in Role}
"""A token for each role."""
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [1, 2, 3], "fov": 1,
    "near": 0.1, "far": 100, "image_height": 100, "image_width": 200, "look_at": [0, 0, 0],
    "up_direction": [0, 0, 1],
}  # fmt: skip
"""The first message of viser's client."""


@dataclass
class Running:
    """A server that runs."""

    port: int
    prefix: str

    @property
    def place(self) -> str:
        return f"127.0.0.1:{self.port}"

    @property
    def address(self) -> str:
        return f"http://{self.place}{self.prefix}/"

    def ask(
        self, path: str, method: str = "GET", body: bytes = b"", **headers: str
    ) -> tuple[HTTPResponse, bytes]:
        """Send a request; its answer and the answer's body. Underscores in names are hyphens."""
        connection = HTTPConnection("127.0.0.1", self.port, timeout=TIMEOUT)
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        try:
            connection.request(method, self.prefix + path, body or None, named)
            answer = connection.getresponse()
            return answer, answer.read()
        finally:
            connection.close()

    def browser(self, role: Role | None = None, **headers: str) -> ClientConnection:
        """Connect as viser's client does."""
        shown = {} if role is None else {"Authorization": f"Bearer a-token-for-{role.word}"}
        return browser_at(self.place + self.prefix, **shown | headers)


def browser_at(place: str, **headers: str) -> ClientConnection:
    """Connect to the page at a host, port and prefix, as viser's client does.

    Origin empty: without that header.
    """
    shown = {"Origin": f"http://{place.partition('/')[0]}"} | headers
    if not shown["Origin"]:
        del shown["Origin"]
    return connect(
        f"ws://{place}", subprotocols=PROTOCOL, additional_headers=shown, proxy=None,
        compression=None, open_timeout=TIMEOUT,
    )  # fmt: skip


def urls(url: str | Path) -> dict[Role, str]:
    """The same address for each role."""
    return dict.fromkeys(Role, str(url))


@contextlib.contextmanager
def running(serving: Serving) -> Iterator[Running]:
    ready = threading.Event()
    ports: list[int] = []
    errors: list[BaseException] = []
    loops: list[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = []

    def tell(port: int) -> None:
        ports.append(port)
        ready.set()

    async def work() -> None:
        stop = asyncio.Event()
        loops.append((asyncio.get_running_loop(), stop))
        await run(serving, tell, stop)

    def serve() -> None:
        try:
            asyncio.run(work())
        except BaseException as error:  # noqa: BLE001 - given to the test
            errors.append(error)
        ready.set()

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    assert ready.wait(TIMEOUT)
    if errors:
        joined(thread)
        raise errors[0]
    try:
        yield Running(ports[0], serving.prefix)
    finally:
        loop, stop = loops[0]
        loop.call_soon_threadsafe(stop.set)
        joined(thread)
    assert errors == []


def sent(connection: Connection, message: object) -> None:
    """Send a message as viser's client encodes it."""
    connection.send(msgspec.msgpack.encode(message))


def messages(connection: Connection, seconds: float = TIMEOUT) -> list[dict[str, object]]:
    """Messages of the next frame of the page."""
    import zstandard  # noqa: PLC0415 - comes with viser

    frame = connection.recv(timeout=seconds)
    assert isinstance(frame, bytes)
    size, packed = (int.from_bytes(frame[at : at + 8], "little") for at in (0, 8))
    inner = zstandard.ZstdDecompressor().decompress(frame[16 : 16 + packed], max_output_size=size)
    found: list[dict[str, object]] = msgspec.msgpack.decode(inner)["messages"]
    return found


def text_until(connection: Connection, words: str) -> str:
    """Read what the page sends until these words are in it; all that was read."""
    seen = ""
    while words not in seen:
        seen += str(messages(connection))
    return seen


def close_code(connection: Connection) -> int:
    """Read until the server closes the connection; its code."""
    try:
        for _ in range(100_000):
            connection.recv(timeout=TIMEOUT)
    except ConnectionClosed as closed:
        return 1006 if closed.rcvd is None else closed.rcvd.code
    raise AssertionError("the server goes on")

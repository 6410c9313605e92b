"""One client of cells beside others, without a network: what its requests do to what they share."""

import asyncio
import contextlib
import threading
from collections.abc import AsyncIterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeVar, cast

import numpy as np
import pytest
from starlette.websockets import WebSocket, WebSocketState

from children import PATIENCE, joined
from hapticdb import Grid
from hapticdb.protocol import cells as bodies
from hapticdb.protocol.header import Kind, MessageHeader, header_of
from hapticdb.server.cells import readers, recent
from hapticdb.server.cells.answers import Answers
from hapticdb.server.cells.client import CellsClient
from hapticdb.server.cells.limits import CellsLimits
from hapticdb.server.cells.readers import Readers
from hapticdb.server.cells.recent import RecentCells
from hapticdb.server.cells.watcher import Watcher
from hapticdb.store.base import Store
from hapticdb.store.connect import create_store, open_store
from hapticdb.testing import blob, write_voxels
from hapticdb.testing.scenes import EVERYWHERE, covering

Item = TypeVar("Item")
GRID = Grid(0.01, (0, 0, 0), 6)
SCAN = bodies.pack_ranges(*EVERYWHERE, distances=False)


@pytest.fixture
def url(tmp_path: Path) -> str:
    made = str(tmp_path / "scene.db")
    with closing(create_store(made, GRID, "brick")) as store:
        write_voxels(store, blob(1, (20, 20, 20)), "one")
        write_voxels(store, blob(2, (24, 20, 20)), "two")
    return made


async def taken(queue: "asyncio.Queue[Item]") -> Item:
    return await asyncio.wait_for(asyncio.Queue.get(queue), PATIENCE)


class Peer:
    """The client's end: a socket in memory, and a watcher that the test moves."""

    def __init__(self, url: str) -> None:
        self.application_state = WebSocketState.CONNECTED
        self.watcher = SimpleNamespace(revision=-1, is_confirmed=False)
        self.readers = Readers(url, threads=4, snapshots=1)
        self.closed: int | None = None
        self._to_server: asyncio.Queue[dict[str, object]] = asyncio.Queue()
        self._to_client: asyncio.Queue[bytes | None] = asyncio.Queue()
        self.client = CellsClient(
            cast("WebSocket", self), self.readers, cast("Watcher", self.watcher), Answers(),
            CellsLimits(),
        )  # fmt: skip

    async def receive(self) -> dict[str, object]:
        return await taken(self._to_server)

    async def send_bytes(self, message: bytes) -> None:
        self._to_client.put_nowait(message)

    async def close(self, code: int, _reason: str) -> None:
        self.closed = code
        self._to_client.put_nowait(None)

    def send(self, kind: Kind, body: bytes = b"", number: int = 1) -> None:
        message = MessageHeader(kind, number).packed() + body
        self._to_server.put_nowait({"type": "websocket.receive", "bytes": message})

    async def until(self, kind: Kind) -> bytes:
        """Next message of a kind."""
        while True:
            message = await taken(self._to_client)
            assert message is not None, f"closed with {self.closed}"
            if header_of(message).kind == kind:
                return message


@contextlib.asynccontextmanager
async def greeted(url: str) -> AsyncIterator[Peer]:
    peer = Peer(url)
    serving = asyncio.create_task(peer.client.serve())
    peer.send(Kind.HELLO)
    await peer.until(Kind.WELCOME)
    try:
        yield peer
    finally:
        peer.client.send_away(1001, "the test ends")
        await asyncio.wait_for(serving, PATIENCE)
        await peer.readers.close()


def test_a_scan_that_ends_while_news_are_made_ends_no_client(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """News are made in a thread, of the cells that were read before; the scan is noted beside."""
    is_made, is_noted = threading.Event(), threading.Event()
    note = RecentCells.note

    class Waiting:
        """numpy for `touched`, which waits between two batches."""

        def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - whatever numpy has
            return getattr(np, name)

        @staticmethod
        def searchsorted(*args: Any, **kwargs: Any) -> Any:  # noqa: ANN401
            is_made.set()
            assert is_noted.wait(PATIENCE)
            return np.searchsorted(*args, **kwargs)

    def noting(self: RecentCells, asked: bodies.Asked) -> None:
        note(self, asked)
        if is_made.is_set():
            is_noted.set()

    async def work() -> None:
        async with greeted(url) as peer:
            peer.send(Kind.WATCH)
            await peer.until(Kind.NUMBERS)
            for cell in (0, 7):  # nothing is in the cell that is looked at first
                lows, highs = np.array([cell << 9]), np.array([(cell << 9) + 511])
                peer.send(Kind.SCAN, bodies.pack_ranges(lows, highs, distances=False))
                await peer.until(Kind.ROWS)
            with closing(open_store(url)) as writer:
                writer.remove(1, covering(writer))
            monkeypatch.setattr(recent, "np", Waiting())
            monkeypatch.setattr(RecentCells, "note", noting)
            peer.watcher.revision = 3
            peer.client.wake()
            assert await asyncio.to_thread(is_made.wait, PATIENCE)
            peer.send(Kind.SCAN, SCAN)
            assert header_of(await peer.until(Kind.NEWS)).revision == 3
            await peer.until(Kind.ROWS)
            peer.send(Kind.REVISION)
            await peer.until(Kind.NUMBERS)

    asyncio.run(work())


def test_a_request_that_is_refused_closes_no_store(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []

    def opening(url: str, *, read_only: bool) -> Store:
        opened.append(url)
        return open_store(url, read_only=read_only)

    monkeypatch.setattr(readers, "open_store", opening)

    async def work() -> None:
        async with greeted(url) as peer:
            for _ in range(3):
                peer.send(Kind.QUANTILES, bodies.pack_numbers(0))
                await peer.until(Kind.REFUSED)

    asyncio.run(work())
    assert opened == [url]


def test_what_is_found_for_one_client_keeps_nobody_who_asks_for_something_else() -> None:
    answers = Answers()
    is_begun, may_end = threading.Event(), threading.Event()
    found: list[int] = []

    def slow() -> int:
        is_begun.set()
        assert may_end.wait(PATIENCE)
        return 1

    first = threading.Thread(target=lambda: found.append(answers._once(("size", 1), slow)))
    second = threading.Thread(target=lambda: found.append(answers._once(("costs", 1), lambda: 2)))
    first.start()
    assert is_begun.wait(PATIENCE)
    second.start()
    second.join(5.0)
    before = list(found)
    may_end.set()
    joined(first)
    joined(second)
    assert before == [2]
    assert answers._once(("size", 1), lambda: 3) == 1


def test_what_could_not_be_found_is_looked_for_again() -> None:
    answers = Answers()
    with pytest.raises(ZeroDivisionError):
        answers._once(("size", 1), lambda: 1 // 0)
    assert answers._once(("size", 1), lambda: 3) == 3

"""The endpoint for cells under messages that are malformed, mutated, or too many."""

import os
import socket
import threading
import time
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest
from websockets.sync.client import ClientConnection, connect

from children import PATIENCE, joined, until
from hapticdb import Grid
from hapticdb.protocol import cells as bodies
from hapticdb.protocol.header import (
    LAYOUT,
    MAGIC,
    VERSION,
    CloseCode,
    Kind,
    MessageHeader,
    Refusal,
    header_of,
)
from hapticdb.store.base import NO_KEYS
from hapticdb.store.connect import create_store
from hapticdb.store.remote.store import RemoteStore
from hapticdb.testing import blob, write_voxels
from hapticdb.testing.scenes import EVERYWHERE
from remote.bare_client import BareClient
from remote.device_server import DeviceServer

GRID = Grid(0.01, (0, 0, 0), 6)
MOST_GROWTH = 16 << 20
"""Bytes by which the server may grow under a flood: caches fill, and allocators keep what was
freed. A leak of one request in a hundred is more."""
EXPECTED_ENDS = {int(CloseCode.MALFORMED), int(CloseCode.VERSION)}
SENTINEL = 0x5EA1ED
"""Number of the request that follows each message: its answer shows that the message was read."""


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> str:
    url = str(tmp_path_factory.mktemp("flooded") / "scene.db")
    with closing(create_store(url, GRID, "brick")) as store:
        write_voxels(store, blob(1, (20, 20, 20)), "one")
        write_voxels(store, blob(2, (24, 20, 20)), "two")
    return url


def raw_client(server: DeviceServer, environment: str) -> ClientConnection:
    client = connect(
        server.url(environment) + "/device/cells", proxy=None, compression=None,
        open_timeout=PATIENCE, max_size=None,
    )  # fmt: skip
    client.send(MessageHeader(Kind.HELLO, 1).packed())
    assert header_of(client.recv(timeout=PATIENCE, decode=False)).kind == Kind.WELCOME
    return client


def valid_messages() -> list[bytes]:
    """One request of each kind, as a client sends it."""
    lows, highs = (np.asarray(one, dtype=np.int64) for one in EVERYWHERE)
    keys = np.arange(0, 400, 7, dtype=np.int64)
    with_body = {
        Kind.LOOKUP: bodies.pack_keys(keys, distances=False),
        Kind.LOOKUP_EACH: bodies.pack_keys(keys[:4], distances=False),
        Kind.SCAN: bodies.pack_ranges(lows, highs, distances=True),
        Kind.COUNT: bodies.pack_ranges(keys, keys + 2, distances=False),
        Kind.ROWS_OF: bodies.pack_rows_of(1, lows, highs, distances=False),
        **{kind: bodies.pack_numbers(1) for kind in (Kind.CHANGES, Kind.OBJECTS, Kind.OBJECT)},
        **{kind: bodies.pack_numbers(16) for kind in (Kind.QUANTILES, Kind.FRESHNESS)},
        Kind.BEGIN: bodies.pack_numbers(-1),
    }
    bare = (Kind.HELLO, Kind.REVISION, Kind.SIZE, Kind.COSTS, Kind.END, Kind.WATCH, Kind.NOTED)
    return [
        MessageHeader(kind, 5).packed() + with_body.get(kind, b"")
        for kind in [*with_body, *bare]
    ]  # fmt: skip


class Mutator:
    """Messages that are wrong in many ways, the same ones for the same seed."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._valid = valid_messages()
        self._ways: list[Callable[[bytes], bytes]] = [
            self._noise, self._body, self._cut, self._flipped, self._number, self._longer,
        ]  # fmt: skip

    def message(self) -> bytes:
        way = self._ways[self._rng.integers(len(self._ways))]
        return way(self._valid[self._rng.integers(len(self._valid))])

    def _noise(self, _: bytes) -> bytes:
        return self._rng.bytes(int(self._rng.integers(200)))

    def _body(self, _: bytes) -> bytes:
        """A sound header before any bytes."""
        kind = int(self._rng.integers(256))
        head = LAYOUT.pack(MAGIC, VERSION, kind, 5, int(self._rng.integers(-1, 9)))
        return head + self._rng.bytes(int(self._rng.integers(200)))

    def _cut(self, message: bytes) -> bytes:
        return message[: int(self._rng.integers(len(message) + 1))]

    def _flipped(self, message: bytes) -> bytes:
        changed = bytearray(message)
        for at in self._rng.integers(len(changed), size=int(self._rng.integers(1, 5))):
            changed[at] ^= 1 << int(self._rng.integers(8))
        return bytes(changed)

    def _number(self, message: bytes) -> bytes:
        """A number that programs forget: the least, the greatest, or beside them."""
        size = int(self._rng.integers(1, 3)) * 4
        edges = (0, 1, 2 ** (8 * size - 1), 2 ** (8 * size) - 1)
        edge = edges[self._rng.integers(len(edges))] + int(self._rng.integers(-1, 2))
        edge %= 1 << 8 * size
        at = int(self._rng.integers(3, max(len(message) - size, 3) + 1))
        return message[:at] + edge.to_bytes(size, "little") + message[at + size :]

    def _longer(self, message: bytes) -> bytes:
        return message + self._rng.bytes(int(self._rng.integers(1, 100)))


class Flooded:
    """Sends wrong messages one after another, each until the server has read it."""

    def __init__(self, server: DeviceServer, environment: str, seed: int) -> None:
        self._address = server.url(environment) + "/device/cells"
        self._mutator = Mutator(seed)
        self._client: BareClient | None = None
        self.n_ended = self.n_refused = self.n_answered = 0

    def send(self) -> None:
        message = self._mutator.message()
        client = self._client = self._client or BareClient(self._address)
        client.send(message, MessageHeader(Kind.REVISION, SENTINEL).packed())
        while (found := client.receive()) is not None:
            header = header_of(found)
            if header.kind == Kind.REFUSED:
                code = int.from_bytes(found[LAYOUT.size : LAYOUT.size + 2], "little")
                assert code != Refusal.FAILED, message
                self.n_refused += 1
            if header.number == SENTINEL:
                self.n_answered += 1
                return
        assert client.close_code in EXPECTED_ENDS, (message, client.close_reason)
        assert client.close_reason
        self.close()
        self.n_ended += 1

    def close(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            client.close()


def resident_bytes(pid: int) -> int:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.parametrize(
    ("seed", "count"),
    [(0, 400), *(pytest.param(seed, 1000, marks=pytest.mark.long) for seed in (1, 2, 3))],
)
def test_wrong_messages_end_or_are_refused_and_harm_nobody(
    environment: str, tmp_path: Path, seed: int, count: int
) -> None:
    """No error inside the server, no memory that stays; a healthy client is answered as before.

    The long ones are 3,000 messages together.
    """
    with (
        DeviceServer(tmp_path / "log", requests_a_second=1e9, burst_requests=1e9) as server,
        closing(RemoteStore(server.url(environment))) as healthy,
        closing(Flooded(server, environment, seed)) as flooded,
    ):
        expected = healthy.scan(*EVERYWHERE)
        healthy.costs("any machine")  # measured once in a server's life: 138 MB of what that loads
        memory = []
        for number in range(count):
            flooded.send()
            if number % 100 == 99:
                found = healthy.scan(*EVERYWHERE)
                np.testing.assert_array_equal(found.keys, expected.keys)
                np.testing.assert_array_equal(found.occupancy, expected.occupancy)
                memory.append(resident_bytes(server.process.pid))
        assert server.process.poll() is None
        assert flooded.n_ended + flooded.n_answered == count
        assert min(flooded.n_ended, flooded.n_refused, flooded.n_answered) > count // 100
        assert memory[-1] - memory[len(memory) // 4] < MOST_GROWTH
        assert healthy._connection.n_connected == 1
    assert "Traceback" not in (tmp_path / "log").read_text()


def asking(client: ClientConnection, count: int, answered: list[float]) -> None:
    """Send requests without a pause; note when each answer has come."""

    def read() -> None:
        for _ in range(count):
            client.recv(timeout=PATIENCE)
            answered.append(time.monotonic())

    reader = threading.Thread(target=read)
    reader.start()
    for number in range(count):
        client.send(MessageHeader(Kind.SIZE, number + 1).packed())
    joined(reader)


def test_a_flood_of_requests_waits_and_nobody_else_does(environment: str, tmp_path: Path) -> None:
    """The flood is still being answered when a client with as many requests as allowed is done."""
    rate, burst, count = 100.0, 100.0, 1000
    answered: list[float] = []
    with (
        DeviceServer(tmp_path / "log", requests_a_second=rate, burst_requests=burst) as server,
        closing(RemoteStore(server.url(environment))) as healthy,
        raw_client(server, environment) as flooding,
    ):
        started = time.monotonic()
        flood = threading.Thread(target=asking, args=(flooding, count, answered))
        flood.start()
        until(lambda: len(answered) > burst)
        for _ in range(int(burst) // 2):
            assert healthy.revision() == 2
        n_answered = len(answered)
        joined(flood)
    assert n_answered < count
    assert len(answered) == count
    allowed = burst + rate * (np.array(answered) - started) + 1.0
    assert (np.arange(1, count + 1) <= allowed).all()


def test_a_flood_of_large_answers_waits(environment: str, tmp_path: Path) -> None:
    """Bytes are limited as requests are."""
    lows, highs = (np.asarray(one, dtype=np.int64) for one in EVERYWHERE)
    message = MessageHeader(Kind.SCAN, 9).packed() + bodies.pack_ranges(
        lows, highs, distances=False
    )
    rate = 32e3
    n_bytes: list[tuple[float, int]] = []
    with (
        DeviceServer(tmp_path / "log", bytes_a_second=rate, burst_bytes=rate) as server,
        closing(RemoteStore(server.url(environment))) as healthy,
        raw_client(server, environment) as flooding,
    ):
        started = time.monotonic()
        for _ in range(40):
            flooding.send(message)
        while len(n_bytes) < 40:
            answer = flooding.recv(timeout=PATIENCE)
            n_bytes.append((time.monotonic() - started, len(answer)))
            assert healthy.revision() == 2
    seconds, sizes = np.array(n_bytes).T
    assert sizes.sum() > 2 * rate
    assert (np.cumsum(sizes) <= rate + rate * seconds + sizes[0]).all()


def test_clients_that_leave_in_the_middle_are_no_error(environment: str, tmp_path: Path) -> None:
    """Answers and pushes are under way when the connection breaks."""
    lows, highs = (np.asarray(one, dtype=np.int64) for one in EVERYWHERE)
    scan = MessageHeader(Kind.SCAN, 9).packed() + bodies.pack_ranges(lows, highs, distances=False)
    with (
        DeviceServer(tmp_path / "log") as server,
        closing(RemoteStore(server.url(environment))) as healthy,
    ):
        for number in range(30):
            client = raw_client(server, environment)
            client.send(MessageHeader(Kind.WATCH, 2).packed())
            for _ in range(10 + number):
                client.send(scan)
            with suppress(OSError):
                client.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
                client.socket.shutdown(socket.SHUT_RDWR)
            client.close()
        assert healthy.revision() == 2
        assert not len(healthy.lookup(NO_KEYS))
    assert "Traceback" not in (tmp_path / "log").read_text()

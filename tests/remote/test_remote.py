"""What a client of a server sees beyond the contract: its limits, its secrets, its losses."""

import threading
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from hapticdb import Grid
from hapticdb.errors import (
    AccessError,
    ConnectionLostError,
    OutdatedError,
    ProtocolError,
    ReadOnlyError,
    UsageError,
)
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.protocol import cells as bodies
from hapticdb.protocol.fields import FieldsRead, FieldsWritten
from hapticdb.protocol.header import CloseCode, Kind, MessageHeader, header_of
from hapticdb.store.connect import create_store, open_store
from hapticdb.store.remote import store as remote_store
from hapticdb.store.remote.store import RemoteStore
from hapticdb.store.urls import parse_address
from hapticdb.testing import blob, is_noticed, voxel_object, write_voxels
from hapticdb.testing.scenes import EVERYWHERE, covering
from remote.device_server import DeviceServer

GRID = Grid(0.01, (0, 0, 0), 6)
ANSWER_S = 30.0


@pytest.fixture
def environment(tmp_path: Path) -> str:
    url = str(tmp_path / "secret-folder.db")
    with closing(create_store(url, GRID, "brick")) as store:
        write_voxels(store, blob(1, (20, 20, 20)), "one")
        write_voxels(store, blob(2, (24, 20, 20)), "two")
    return url


@pytest.fixture
def remote(device_server: DeviceServer, environment: str) -> Iterator[RemoteStore]:
    with closing(RemoteStore(device_server.url(environment))) as store:
        yield store


def test_a_wrong_token_is_refused_and_shown_nowhere(
    device_server: DeviceServer, environment: str
) -> None:
    with pytest.raises(AccessError, match="does not let this client in") as refused:
        open_store(device_server.url(environment, query="?token=wrong-but-secret"))
    assert "wrong-but-secret" not in str(refused.value)


def test_a_page_in_a_browser_is_refused(device_server: DeviceServer, environment: str) -> None:
    endpoint = device_server.url(environment) + "/device/cells"
    with pytest.raises(InvalidStatus) as refused:
        connect(endpoint, origin="http://example.org", proxy=None)  # type: ignore[arg-type]
    assert refused.value.response.status_code == 403


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("ws://", "write ws://host:port"),
        ("ws://me:secret@host", "write ws://host:port"),
        ("ws://host:99999", "no such address"),
        ("ws://host?tocken=secret", "the parameters token and ca"),
        ("ws://host?ca=file", "ca is for wss://"),
        ("ws://host?token=a%20b", "no header can carry"),
    ],
)
def test_urls_that_cannot_be_are_refused(url: str, words: str) -> None:
    with pytest.raises(UsageError, match=words) as refused:
        parse_address(url)
    assert "secret" not in str(refused.value)


def test_nothing_is_written_through_a_server(remote: RemoteStore) -> None:
    with pytest.raises(ReadOnlyError, match="behind a server"):
        remote.remove(1, covering(remote))
    with pytest.raises(ReadOnlyError):
        remote.removed("any")
    with pytest.raises(ReadOnlyError):
        create_store(remote.url, GRID)


def test_links_have_no_folders(device_server: DeviceServer, tmp_path: Path) -> None:
    url = str(tmp_path / "e.db")
    ijk = blob(1, (20, 20, 20))
    with closing(create_store(url, GRID, "brick")) as store:
        made = voxel_object(GRID, ijk, "part")
        told = {"unit": "m", "source": "/srv/parts/part.stl", "in": ["C:\\parts"]}
        made = replace(made, link="/srv/parts/part.stl", attributes=told)
        store.add(made, rows_of_voxels(ijk, GRID, "brick"))
        own = store.object(1)
    with closing(RemoteStore(device_server.url(url))) as remote:
        (found,) = remote.objects()
    assert (found.link, found.attributes) == ("part.stl", {"unit": "m"})
    assert (found.rows_crc, found.digest, found.revision) == (own.rows_crc, own.digest, 1)


def test_what_a_client_has_read_is_pushed_with_a_write(
    remote: RemoteStore, environment: str
) -> None:
    """The snapshot after it needs no answer of the server for revision, writes and rows."""
    remote.watch()
    before = remote.scan(*EVERYWHERE)
    with closing(open_store(environment)) as writer:
        writer.remove(1, covering(writer))
        expected = writer.scan(*EVERYWHERE)
        cells = np.unique(before.keys >> 6)
    assert is_noticed(remote)
    asked_before = remote._connection._number
    with remote.snapshot():
        assert remote.revision() == 3
        assert [(change.action, change.id) for change in remote.changes(2)] == [("remove", 1)]
        rows = remote.pushed_rows(cells, distances=False)
    assert remote._connection._number == asked_before
    assert rows is not None
    for found, wanted in zip(rows[:3], expected[:3], strict=True):
        np.testing.assert_array_equal(found, wanted)
    assert remote.version() == 3


def test_a_client_that_watches_is_not_silent_for_long(
    remote: RemoteStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server drops whoever sends nothing, and beats alone need no question."""
    remote.watch()
    told: list[Kind] = []
    tell = remote._connection.tell

    def telling(kind: Kind, *, revision: int) -> None:
        told.append(kind)
        tell(kind, revision=revision)

    monkeypatch.setattr(remote._connection, "tell", telling)
    assert not remote.has_changed()
    assert told == []
    monkeypatch.setattr(remote_store, "SILENT_SECONDS", -1.0)
    assert not remote.has_changed()
    assert told == [Kind.NOTED]
    assert remote.revision() == 2


def test_what_was_pushed_is_not_mixed_with_a_later_revision(
    remote: RemoteStore, environment: str
) -> None:
    remote.watch()
    with closing(open_store(environment)) as writer:
        writer.remove(1, covering(writer))
        assert is_noticed(remote)
        with remote.snapshot():
            assert remote.revision() == 3
            writer.remove(2, covering(writer))
            with pytest.raises(OutdatedError):
                remote.scan(*EVERYWHERE)
    assert not len(remote.scan(*EVERYWHERE))
    assert remote.revision() == 4


def test_snapshots_hold_beside_a_writer(remote: RemoteStore, environment: str) -> None:
    """Rows, objects and counts of a snapshot are of one revision, however much is written."""
    end = threading.Event()

    def write() -> None:
        with closing(open_store(environment)) as writer:
            for n in range(200):
                if end.is_set():
                    return
                added = write_voxels(writer, blob(3, (40, 40, 40)), f"{n}")
                writer.remove(added, covering(writer))

    beside = threading.Thread(target=write)
    beside.start()
    seen = set()
    try:
        for _ in range(30):
            with remote.snapshot():
                ids = {obj.id for obj in remote.objects()}
                rows = remote.scan(*EVERYWHERE)
                assert set(rows.ids.tolist()) == ids
                assert remote.count(*EVERYWHERE) == len(rows)
                seen.add(remote.revision())
    finally:
        end.set()
        beside.join(ANSWER_S)
    assert len(seen) > 1


def raw_client(server: DeviceServer, environment: str) -> ClientConnection:
    return connect(server.url(environment) + "/device/cells", proxy=None, compression=None)


def test_malformed_messages_end_their_own_connection_alone(
    device_server: DeviceServer, environment: str, remote: RemoteStore
) -> None:
    """Each with a plain reason; a session beside goes on."""
    hello = MessageHeader(Kind.HELLO, 1).packed()
    scan = MessageHeader(Kind.SCAN, 2).packed()
    huge = b"\x00\x00\x00\x00\xff\xff\xff\xff"
    rng = np.random.default_rng(1)
    random_ones: list[bytes | str] = [
        hello[: int(rng.integers(3))] + rng.bytes(20) for _ in range(20)
    ]
    expected = len(remote.scan(*EVERYWHERE))
    cases: list[tuple[list[bytes | str], int | None]] = [
        ([b"short"], CloseCode.MALFORMED),
        ([hello, scan + huge], CloseCode.MALFORMED),
        ([hello, scan + bytes(8) + b"more"], CloseCode.MALFORMED),
        ([hello, b"hd\x09" + bytes(13)], CloseCode.VERSION),
        ([hello, "text"], CloseCode.MALFORMED),
        ([scan + bytes(8)], CloseCode.MALFORMED),
        *[([hello, message], None) for message in random_ones],
    ]
    for messages, code in cases:
        with raw_client(device_server, environment) as client:
            with suppress(ConnectionClosed):
                for message in messages:
                    client.send(message)
                while True:
                    client.recv(timeout=ANSWER_S)
            assert client.close_code in ({int(code)} if code else {4400, 4426})
            assert "secret-folder" not in (client.close_reason or "")
            assert client.close_reason
        assert len(remote.scan(*EVERYWHERE)) == expected


def test_rows_beyond_an_answer_are_continued(device_server: DeviceServer, tmp_path: Path) -> None:
    """More ranges, and more rows, than one message may have."""
    url = str(tmp_path / "many.db")
    grid = Grid(0.01, (0, 0, 0), 7)
    rng = np.random.default_rng(0)
    with closing(create_store(url, grid, "voxel")) as store:
        write_voxels(store, np.unique(rng.integers(0, 128, (60_000, 3)), axis=0), "many")
        expected = store.scan(*EVERYWHERE)
        with closing(RemoteStore(device_server.url(url))) as remote:
            assert len(expected) > bodies.MOST_ROWS
            for rows in (
                remote.scan(*EVERYWHERE),
                remote.lookup(np.unique(expected.keys)),
                remote.scan(expected.keys.copy(), expected.keys.copy()),
                remote.rows_of(1, *EVERYWHERE),
            ):
                for found, wanted in zip(rows[:2], expected[:2], strict=True):
                    np.testing.assert_array_equal(found, wanted)
            assert remote.count(expected.keys.copy(), expected.keys.copy()) == len(expected)


@pytest.mark.parametrize("resume", [0, 3, 5])
def test_an_answer_that_leads_nowhere_is_refused(
    remote: RemoteStore, monkeypatch: pytest.MonkeyPatch, resume: int
) -> None:
    """A server that answers no rows, and that it goes on where the question began or before."""
    none = np.zeros(0, np.int64)
    body = bodies.RowsBody(none, none, np.zeros(0, np.uint8), resume=resume).write(FieldsWritten())
    monkeypatch.setattr(remote, "_ask", lambda *_, **__: FieldsRead(body.joined(), 0))
    keys = np.array([5, 9])
    with pytest.raises(ProtocolError, match="leads nowhere"):
        remote.scan(keys, keys + 1)
    with pytest.raises(ProtocolError, match="leads nowhere"):
        remote.lookup(keys)


def test_a_server_that_comes_back_is_used_again(environment: str, tmp_path: Path) -> None:
    server = DeviceServer(tmp_path / "log")
    store = RemoteStore(server.url(environment))
    assert store.revision() == 2
    server.close()
    with pytest.raises(ConnectionLostError):
        store.revision()
    with DeviceServer(tmp_path / "log", port=server.port), closing(store):
        assert store.revision() == 2
        assert {one.id for one in store.objects()} == {1, 2}


def test_a_header_answers_with_its_number(device_server: DeviceServer, environment: str) -> None:
    with raw_client(device_server, environment) as client:
        client.send(MessageHeader(Kind.HELLO, 77).packed())
        found = header_of(client.recv(timeout=ANSWER_S, decode=False))
        assert (found.kind, found.number) == (Kind.WELCOME, 77)

"""How a reader learns of others' writes, as far as the contract leaves it to each engine."""

import contextlib
import itertools
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psycopg
import pytest
from hypothesis import given
from hypothesis import strategies as st
from psycopg import sql

import hapticdb
from children import finished, joined
from crashes import server, template  # noqa: F401 - fixtures
from hapticdb import Grid
from hapticdb.store.base import SupportsWatch
from hapticdb.store.connect import create_store, open_store
from hapticdb.store.postgres import watching
from hapticdb.store.postgres.address import LONGEST_NAME, parse
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.schema_of import drop
from hapticdb.store.postgres.store import PostgresStore
from hapticdb.store.postgres.watching import channel_of
from hapticdb.store.sqlite import place as sqlite_place
from hapticdb.store.sqlite.store import SQLiteStore
from hapticdb.testing import is_noticed, write_voxels
from servers import Place

ROOT = Path(__file__).parent.parent.parent
GRID = Grid(0.005, (0, 0, 0), 7)
VOXEL = np.array([[1, 2, 3]])
WRITE = """
import sys
import numpy as np
from hapticdb.store.connect import open_store
from hapticdb.testing import write_voxels
write_voxels(open_store(sys.argv[1]), np.array([[4, 5, 6]]), "of another process")
"""


@pytest.fixture
def url(place: Place) -> str:
    """URL of an empty environment on a server."""
    where = place()
    create_store(where, GRID).close()
    return where


@pytest.fixture
def file(tmp_path: Path) -> str:
    """Path of an empty environment in a file."""
    create_store(tmp_path / "e.db", GRID).close()
    return str(tmp_path / "e.db")


numbers = itertools.count()


def write(where: str) -> None:
    with hapticdb.open(where) as env:
        write_voxels(env.store, VOXEL, f"{next(numbers)}")


# --- both engines -------------------------------------------------------------------------------


def test_a_commit_of_another_process_is_noticed_by_one_that_only_watches(
    file: str, url: str
) -> None:
    for where in (file, url):
        with contextlib.closing(open_store(where, read_only=True)) as reader:
            assert isinstance(reader, SupportsWatch)
            reader.watch()
            finished([sys.executable, "-c", WRITE, where], check=True)
            assert is_noticed(reader)
            assert not reader.has_changed()


# --- SQLite -------------------------------------------------------------------------------------


@pytest.mark.parametrize("is_replaced", [False, True])
def test_a_file_that_is_gone_or_another_is_told_until_it_is_back(
    file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, is_replaced: bool
) -> None:
    monkeypatch.setattr(sqlite_place, "LOOK_SECONDS", 0.0)
    reader = SQLiteStore.open(file, read_only=True)
    reader.watch()
    assert not reader.has_changed()
    kept = tmp_path / "kept"
    Path(file).rename(kept)
    words = "cannot be reached any more"
    if is_replaced:
        create_store(tmp_path / "other.db", GRID).close()
        (tmp_path / "other.db").rename(file)
        words = "is another file than before: open it again"
    for _ in range(2):
        with pytest.raises(hapticdb.errors.ConnectionLostError, match=words):
            reader.has_changed()
    kept.replace(file)
    assert not reader.has_changed()
    reader.close()


# --- PostgreSQL ---------------------------------------------------------------------------------


@pytest.fixture
def reader(url: str) -> Iterator[PostgresStore]:
    """A reader that watches."""
    store = PostgresStore.open(url, read_only=True)
    store.watch()
    yield store
    store.close()


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A list that gets one entry for each round trip that asks for the revision."""
    found: list[int] = []
    ask = watching.Watch._ask

    def counted(watch: watching.Watch) -> bool:
        found.append(1)
        return ask(watch)

    monkeypatch.setattr(watching.Watch, "_ask", counted)
    return found


def test_notifications_during_reads_neither_disturb_nor_get_lost(
    url: str, reader: PostgresStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watching, "HEARING_S", 1e9)
    reader.watch()
    key = GRID.encode(VOXEL) >> 9
    n_writes = 50

    def write_many() -> None:
        with hapticdb.open(url) as env:
            for _ in range(n_writes):
                write_voxels(env.store, VOXEL, f"{next(numbers)}")

    writer = threading.Thread(target=write_many, daemon=True)
    writer.start()
    seen = 0
    while writer.is_alive():
        for n_found in (len(reader.lookup(key)), len(reader.objects())):
            assert n_found >= seen
            seen = n_found
    joined(writer)
    assert len(reader.lookup(key)) == len(reader.objects()) == n_writes
    assert is_noticed(reader)


def test_a_reader_that_lost_its_connection_listens_again(
    url: str, reader: PostgresStore, admin: psycopg.Connection, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watching, "HEARING_S", 1e9)
    for is_used_meanwhile in (False, True):
        reader.watch()
        pid = reader.connection.driver.info.backend_pid
        admin.execute("SELECT pg_terminate_backend(%s, 5000)", (pid,))
        write(url)
        if is_used_meanwhile:
            reader.objects()
        assert is_noticed(reader)
        assert not reader.has_changed()
        write(url)
        assert is_noticed(reader)


def test_a_writer_that_does_not_notify_is_noticed_too(
    url: str, reader: PostgresStore, admin: psycopg.Connection
) -> None:
    schema = sql.Identifier(parse(url).environment)
    raise_it = sql.SQL("UPDATE {}.environment SET revision = revision + 1").format(schema)
    for _ in range(2):
        admin.execute(raise_it)
        assert is_noticed(reader)
        assert not reader.has_changed()


def test_a_server_that_refuses_to_be_listened_to_is_asked_instead(
    url: str, asked: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ServerConnection.command

    def refuse(connection: ServerConnection, text: str) -> None:
        if text.startswith("LISTEN"):
            raise psycopg.errors.ReadOnlySqlTransaction("cannot execute LISTEN during recovery")
        command(connection, text)

    monkeypatch.setattr(ServerConnection, "command", refuse)
    monkeypatch.setattr(watching, "HEARING_S", 1e9)
    reader = PostgresStore.open(url, read_only=True)
    reader.watch()
    for _ in range(2):
        asked.clear()
        write(url)
        assert is_noticed(reader)
        assert asked
    reader.close()


def test_an_environment_made_anew_is_told_from_the_one_before(
    url: str, reader: PostgresStore
) -> None:
    write(url)
    assert is_noticed(reader)
    with contextlib.closing(PostgresStore.open(url)) as store:
        drop(store.connection)
    create_store(url, GRID).close()
    write(url)  # the same revision as before
    for _ in range(2):
        with pytest.raises(
            hapticdb.errors.ConnectionLostError, match="another environment than before"
        ):
            is_noticed(reader)
    again = PostgresStore.open(url, read_only=True)
    assert again.identity != reader.identity
    again.close()


def test_the_channel_and_its_payload_are_as_documented(url: str, admin: psycopg.Connection) -> None:
    page = " ".join((ROOT / "docs" / "format.md").read_text().split())
    assert "channel `hapticdb_NAME`, NAME being the schema's, with the revision as payload" in page
    channel = f"hapticdb_{parse(url).environment}"
    admin.execute(sql.SQL("LISTEN {}").format(sql.Identifier(channel)))
    write(url)
    write(url)
    heard = admin.notifies(timeout=10, stop_after=2)
    assert [(n.channel, n.payload) for n in heard] == [(channel, "1"), (channel, "2")]


@given(st.lists(st.text(min_size=1, max_size=LONGEST_NAME), min_size=2, max_size=2, unique=True))
def test_every_environment_has_a_channel_of_its_own_that_the_server_takes(names: list[str]) -> None:
    fitting = [name.encode()[:LONGEST_NAME].decode(errors="ignore") for name in names]
    channels = {channel_of(name) for name in fitting}
    assert len(channels) == len(set(fitting))
    assert all(len(channel.encode()) <= LONGEST_NAME for channel in channels)

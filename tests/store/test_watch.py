"""How a reader learns of others' writes, as far as the contract leaves it to each engine."""

import contextlib
import itertools
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psycopg
import pytest
from psycopg import sql
from psycopg.pq.abc import PGresult

import hapticdb
from children import TIMEOUT
from hapticdb import Grid
from hapticdb.store.connect import create_store
from hapticdb.store.postgres import watching
from hapticdb.store.postgres.address import LONGEST_NAME, parse
from hapticdb.store.postgres.connecting.server_connection import ServerConnection
from hapticdb.store.postgres.environment_schema import drop
from hapticdb.store.postgres.postgres_store import PostgresStore
from hapticdb.store.postgres.watching import channel_of
from hapticdb.store.sqlite import opened_file as sqlite_place
from hapticdb.store.sqlite.sqlite_store import SQLiteStore
from servers import Place, roles
from voxels import is_noticed, write_voxels

GRID = Grid(0.005, (0, 0, 0), 7)
VOXEL = np.array([[1, 2, 3]])


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


@pytest.mark.parametrize("is_replaced", [False, True])
def test_has_changed_file_missing_or_replaced(
    file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, is_replaced: bool
) -> None:
    monkeypatch.setattr(sqlite_place, "CHECK_SECONDS", 0.0)
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


@pytest.fixture
def reader(url: str) -> Iterator[PostgresStore]:
    store = PostgresStore.open(url, read_only=True)
    store.watch()
    yield store
    store.close()


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A list that gets one entry for each round trip that asks for the revision."""
    found: list[int] = []
    ask = watching.Watch._query_revision

    def counted(watch: watching.Watch) -> None:
        found.append(1)
        ask(watch)

    monkeypatch.setattr(watching.Watch, "_query_revision", counted)
    return found


def test_has_changed_after_reconnect(
    url: str, reader: PostgresStore, admin: psycopg.Connection, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watching, "LISTENING_S", 1e9)
    for is_used_meanwhile in (False, True):
        reader.watch()
        pid = reader._connection.driver.info.backend_pid
        admin.execute("SELECT pg_terminate_backend(%s, 5000)", (pid,))
        write(url)
        if is_used_meanwhile:
            reader.objects()
        assert is_noticed(reader)
        assert not reader.has_changed()
        write(url)
        assert is_noticed(reader)


def test_has_changed_without_notification(
    url: str, reader: PostgresStore, admin: psycopg.Connection
) -> None:
    schema = sql.Identifier(parse(url).environment)
    raise_it = sql.SQL("UPDATE {}.environment SET revision = revision + 1").format(schema)
    for _ in range(2):
        admin.execute(raise_it)
        assert is_noticed(reader)
        assert not reader.has_changed()


def test_has_changed_without_listen(
    url: str, asked: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ServerConnection.command

    def refuse(connection: ServerConnection, text: str) -> PGresult:
        if text.startswith("LISTEN"):
            raise psycopg.errors.ReadOnlySqlTransaction("cannot execute LISTEN during recovery")
        return command(connection, text)

    monkeypatch.setattr(ServerConnection, "command", refuse)
    monkeypatch.setattr(watching, "LISTENING_S", 1e9)
    reader = PostgresStore.open(url, read_only=True)
    reader.watch()
    for _ in range(2):
        asked.clear()
        write(url)
        assert is_noticed(reader)
        assert asked
    reader.close()


def test_has_changed_recreated_environment(url: str, reader: PostgresStore) -> None:
    write(url)
    assert is_noticed(reader)
    with contextlib.closing(PostgresStore.open(url)) as store:
        drop(store._connection)
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


def test_channel_and_payload_as_documented(url: str, admin: psycopg.Connection) -> None:
    channel = f"hapticdb_{parse(url).environment}"
    admin.execute(sql.SQL("LISTEN {}").format(sql.Identifier(channel)))
    write(url)
    write(url)
    heard = admin.notifies(timeout=TIMEOUT, stop_after=2)
    assert [(n.channel, n.payload) for n in heard] == [(channel, "1"), (channel, "2")]


def test_channel_of_long_names_distinct() -> None:
    names = ["n" * LONGEST_NAME, "n" * (LONGEST_NAME - 1) + "m", "語" * 21, "語" * 20 + "本"]
    channels = {channel_of(name) for name in names}
    assert len(channels) == len(names)
    assert all(len(channel.encode()) <= LONGEST_NAME for channel in channels)


FORGED = [
    "", "nonsense", "-1", "0", "²", "9" * 5000, "9223372036854775807", "1e300",
    "\x1b[2J", "x" * 7999,
]  # fmt: skip


@pytest.fixture
def stranger(database: str, admin: psycopg.Connection) -> Iterator[psycopg.Connection]:
    """A connection of a role that has no right on any environment."""
    role = f"stranger {os.getpid()} {next(numbers)}"
    with (
        roles(admin, role),
        psycopg.connect(parse(database).conninfo, autocommit=True) as connection,
    ):
        connection.execute(sql.SQL("SET SESSION AUTHORIZATION {}").format(sql.Identifier(role)))
        yield connection


def test_has_changed_forged_notifications(
    url: str, reader: PostgresStore, stranger: psycopg.Connection, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each edit is noticed by its own notification, as without forged ones."""
    monkeypatch.setattr(watching, "LISTENING_S", 1e9)
    channel = channel_of(parse(url).environment)
    with pytest.raises(psycopg.errors.InsufficientPrivilege):
        stranger.execute(sql.SQL("SELECT * FROM {}.change").format(sql.Identifier(channel[9:])))
    seen: dict[bool, list[int]] = {False: [], True: []}
    reader.watch()
    for is_forged in (False, True):
        for payload in FORGED:
            if is_forged:
                stranger.execute(
                    "SELECT pg_notify(%s, %s || n) FROM generate_series(1, 200) AS n",
                    (channel, payload[:7990]),
                )
                stranger.execute("SELECT pg_notify(%s, %s)", (channel, payload))
                reader.has_changed()
            write(url)
            assert is_noticed(reader)
            seen[is_forged].append(reader.revision())
    n = len(FORGED)
    assert seen == {False: list(range(1, n + 1)), True: list(range(n + 1, 2 * n + 1))}


def test_has_changed_notification_flood(
    url: str,
    reader: PostgresStore,
    stranger: psycopg.Connection,
    asked: list[int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Clock:
        now = 1e6

        def monotonic(self) -> float:
            return self.now

    clock = Clock()
    monkeypatch.setattr(watching, "time", clock)
    reader.watch()
    asked.clear()
    channel = channel_of(parse(url).environment)
    for n in range(100):  # the prefetch process looks each millisecond
        clock.now += 1e-3
        stranger.execute(
            "SELECT pg_notify(%s, %s::text || n) FROM generate_series(1, 20) n", (channel, n)
        )
        reader.objects()  # a read also receives waiting notifications
        assert not reader.has_changed()
    assert 1 <= len(asked) <= 0.1 / watching.HINTED_S
    write(url)
    reader.objects()
    clock.now += watching.HINTED_S
    assert reader.has_changed()

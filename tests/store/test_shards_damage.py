"""Servers that do not belong together, and writes that fail: what is lost is told, never felt."""

import threading
from collections.abc import Iterator
from concurrent import futures
from contextlib import closing
from typing import Any
from urllib.parse import quote

import psycopg
import pytest
from psycopg import sql

from hapticdb import ConnectionLostError, DamagedError, ShardAwayError
from hapticdb.check import check_environment
from hapticdb.store.postgres import schema_of
from hapticdb.store.postgres.address import parse
from hapticdb.store.postgres.connecting import connection
from hapticdb.store.postgres.connecting.link import Link
from hapticdb.store.postgres.private_server import PrivateServer
from hapticdb.store.postgres.shards.connecting import links
from hapticdb.store.postgres.shards.connecting.links import ShardConnection, Shards
from hapticdb.store.postgres.shards.store import ShardedStore
from labelled import GRID, contents_of, labelled_object, labelled_rows
from servers import Place
from sharded import ShardedServers

BEFORE = {1: 1, 2: 2, 3: 3}
SETTINGS = "synchronous_commit", "idle_in_transaction_session_timeout"
CARELESS = "-c synchronous_commit=off -c idle_in_transaction_session_timeout=60000"


@pytest.fixture
def url(sharded_place: Place) -> str:
    """An environment with objects 1 to 3 of labels 1 to 3."""
    where = sharded_place()
    with closing(ShardedStore.create(where, GRID, "brick", distances=True)) as store:
        for label in BEFORE:
            add(store, label)
    return where


@pytest.fixture
def store(url: str) -> Iterator[ShardedStore]:
    with closing(ShardedStore.open(url)) as made:
        yield made


@pytest.fixture
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "RECONNECT_SECONDS", 0.2)


def add(store: ShardedStore, label: int) -> int:
    return store.add(labelled_object(label), labelled_rows(label))


def replace(store: ShardedStore, object_id: int, label: int) -> None:
    store.replace(labelled_object(label, object_id), labelled_rows(label), lambda _: [])


def on(server: PrivateServer, url: str, statement: str) -> list[tuple[Any, ...]]:
    """Rows of a statement on one server, in the environment's schema."""
    with psycopg.connect(server.conninfo(), autocommit=True) as client:
        name = sql.Identifier(parse(url).environment)
        client.execute(sql.SQL("SET search_path = {}").format(name))
        found = client.execute(statement)
        return found.fetchall() if found.description else []


def cut(server: PrivateServer) -> None:
    """End all connections of clients."""
    with psycopg.connect(server.conninfo(), autocommit=True) as client:
        client.execute(
            "SELECT pg_terminate_backend(pid, 5000) FROM pg_stat_activity"
            " WHERE pid <> pg_backend_pid() AND backend_type = 'client backend'"
        )


def dead(servers: ShardedServers, url: str) -> set[tuple[int, int]]:
    """Objects and versions on shards that the coordinator does not name."""
    live = set(on(servers.coordinator, url, "SELECT id, version FROM live"))
    found: set[tuple[int, int]] = set()
    for shard in servers.shards:
        for table in ("brick", "band", "written"):
            found |= set(on(shard, url, f"SELECT DISTINCT id, version FROM {table}"))
    return found - live


# --- writes that fail ---------------------------------------------------------------------------


def test_a_write_that_failed_takes_no_rows_with_the_next_one(
    store: ShardedStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise ShardAwayError("gone")

    with monkeypatch.context() as patch:
        patch.setattr(Shards, "each", fail)
        with pytest.raises(ShardAwayError, match="nothing is written"):
            replace(store, 1, 10)
    add(store, 4)
    assert contents_of(store) == {**BEFORE, 4: 4}


@pytest.mark.usefixtures("_impatient")
def test_a_write_is_tried_once_while_a_shard_is_away(
    sharded_servers: ShardedServers, store: ShardedStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries: list[int] = []
    each = Shards.each

    def counted(*given: Any) -> object:  # noqa: ANN401 - passed on
        tries.append(1)
        return each(*given)

    monkeypatch.setattr(Shards, "each", counted)
    driver = store.connection.driver
    sharded_servers.shards[1].kill()
    with pytest.raises(ShardAwayError, match="nothing is written: shard 2"):
        add(store, 4)
    assert len(tries) == 1
    assert store.connection.driver is driver
    sharded_servers.shards[1].start()
    assert add(store, 4) == 4
    assert contents_of(store) == {**BEFORE, 4: 4}


def test_an_environment_whose_commit_is_not_confirmed_keeps_its_shards(
    sharded_place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    where = sharded_place()
    created = schema_of.created

    def unsure(*given: Any, **named: Any) -> None:  # noqa: ANN401 - passed on
        created(*given, **named)
        raise ConnectionLostError("whether that was done is not known yet")

    with monkeypatch.context() as patch:
        patch.setattr(schema_of, "created", unsure)
        with pytest.raises(ConnectionLostError):
            ShardedStore.create(where, GRID)
    with closing(ShardedStore.open(where)) as store:
        assert add(store, 1) == 1


def test_commits_wait_for_the_disk_and_the_coordinator_for_the_shards(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the servers are set to: rows that are named must outlive a crash."""
    seen: list[tuple[str, str]] = []
    command = Link.command

    def looking(link: Link, text: str) -> None:
        if text == "COMMIT":
            asked = [link.driver.execute(f"SHOW {name}").fetchone() for name in SETTINGS]
            seen.append((str(asked[0]), str(asked[1])))
        command(link, text)

    with closing(ShardedStore.open(f"{url}&options={quote(CARELESS)}")) as careless:
        add(careless, 4)
        monkeypatch.setattr(Link, "command", looking)
        add(careless, 5)
    assert [pair[0] for pair in seen] == ["('local',)"] * 4
    assert seen[-1][1] == "('0',)"  # the coordinator commits last


# --- Ctrl-C -------------------------------------------------------------------------------------


@pytest.mark.parametrize("is_late", [False, True], ids=["cancelled", "given up"])
def test_after_ctrl_c_no_thread_uses_a_connection(
    store: ShardedStore, monkeypatch: pytest.MonkeyPatch, is_late: bool
) -> None:
    waits = [futures.wait]
    may_end = threading.Event()
    begun = threading.Barrier(4)

    def interrupted(*given: Any) -> object:  # noqa: ANN401 - passed on
        if waits:
            begun.wait(60)
            waits.pop()
            raise KeyboardInterrupt
        return futures.wait(*given)

    def work(_: int, shard: ShardConnection) -> None:
        begun.wait(60)
        if is_late:
            assert may_end.wait(60)
        shard.rows("SELECT pg_sleep(60)")

    shards = store._shards
    contents_of(store)
    monkeypatch.setattr(links, "wait", interrupted)
    monkeypatch.setattr(links, "PARTING_S", 0.2 if is_late else 60.0)
    with pytest.raises(KeyboardInterrupt):
        shards.each(work)
    assert all(shards.is_connected(shard) is not is_late for shard in range(len(shards)))
    assert contents_of(store) == BEFORE
    assert add(store, 4) == 4
    may_end.set()


# --- sweeps -------------------------------------------------------------------------------------


def test_what_a_snapshot_kept_is_swept_after_a_later_write(
    sharded_servers: ShardedServers, store: ShardedStore, url: str
) -> None:
    with closing(ShardedStore.open(url, read_only=True)) as reader:
        with reader.snapshot():
            assert contents_of(reader) == BEFORE
            for label in range(10, 13):
                replace(store, 1, label)
            assert contents_of(reader) == BEFORE
            assert len(dead(sharded_servers, url)) == 3
        replace(store, 2, 14)
    assert dead(sharded_servers, url) == set()


@pytest.mark.usefixtures("_impatient")
def test_a_sweep_goes_on_beside_a_shard_that_is_away(
    sharded_servers: ShardedServers, store: ShardedStore, url: str
) -> None:
    with closing(ShardedStore.open(url, read_only=True)) as reader, reader.snapshot():
        contents_of(reader)
        replace(store, 1, 10)
    sharded_servers.shards[0].kill()
    with pytest.raises(ShardAwayError, match="shard 1"):
        store.sweep()
    sharded_servers.shards[0].start()
    assert on(sharded_servers.shards[0], url, "SELECT 1 FROM written WHERE id = 1 OFFSET 1")
    for shard in sharded_servers.shards[1:]:
        assert not on(shard, url, "SELECT 1 FROM written WHERE id = 1 OFFSET 1")
    assert store.sweep().versions == 1
    assert dead(sharded_servers, url) == set()


# --- copies that do not belong together ---------------------------------------------------------


def test_a_shard_that_has_lost_writes_is_refused(
    sharded_servers: ShardedServers, store: ShardedStore, url: str
) -> None:
    assert contents_of(store) == BEFORE
    shard = sharded_servers.shards[1]
    on(shard, url, "UPDATE mark SET writes = writes - 1")
    for attempt in (lambda: contents_of(store), lambda: add(store, 4), lambda: add(store, 5)):
        with pytest.raises(DamagedError, match=r"shard 2 .* has lost writes: it has 2 of 3"):
            attempt()
    assert on(shard, url, "SELECT writes FROM mark") == [(2,)]
    (finding, *_) = check_environment(url).findings
    assert "lost writes" in finding
    on(shard, url, "UPDATE mark SET writes = writes + 1")
    assert contents_of(store) == BEFORE


def test_a_coordinator_that_is_older_than_its_shards_is_refused(
    sharded_servers: ShardedServers, store: ShardedStore, url: str
) -> None:
    on(sharded_servers.shards[2], url, "UPDATE mark SET swept = 4")
    for attempt in (
        lambda: store.scan(labelled_rows(1).keys[:1], labelled_rows(1).keys[-1:]),
        lambda: add(store, 4),
    ):
        with pytest.raises(DamagedError, match="is older than its shards"):
            attempt()
    (finding, *_) = check_environment(url).findings
    assert "older than its shards" in finding


def test_a_coordinator_put_back_at_the_same_revision_is_read_anew(
    sharded_servers: ShardedServers, store: ShardedStore, url: str
) -> None:
    coordinator = sharded_servers.coordinator
    with closing(ShardedStore.open(url, read_only=True)) as reader, reader.snapshot():
        ((old,),) = on(coordinator, url, "SELECT version FROM live WHERE id = 1")
        replace(store, 1, 10)
        assert len(contents_of(store)) == 3
        on(coordinator, url, f"UPDATE live SET version = {old} WHERE id = 1")
        on(coordinator, url, "UPDATE object SET digest = '1' WHERE id = 1")
        cut(coordinator)
        assert contents_of(store) == BEFORE


def test_a_server_of_another_environment_in_a_shards_place_is_never_read(
    sharded_servers: ShardedServers, store: ShardedStore, url: str
) -> None:
    contents_of(store)
    shard = sharded_servers.shards[1]
    ((token,),) = on(shard, url, "SELECT token::text FROM mark")
    on(shard, url, "UPDATE mark SET token = gen_random_uuid()")
    cut(shard)
    for _ in range(3):
        with pytest.raises(DamagedError, match="holds rows of another environment"):
            contents_of(store)
    on(shard, url, f"UPDATE mark SET token = '{token}'")
    assert contents_of(store) == BEFORE

"""Environments on several servers: made, opened, told, written, swept; who may do what."""

import contextlib
import os
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import LiteralString
from urllib.parse import quote

import numpy as np
import psycopg
import pytest
from psycopg import sql

import hapticdb
from hapticdb import (
    AccessError,
    ConflictError,
    DamagedError,
    EnvironmentExistsError,
    EnvironmentNotFoundError,
    Grid,
    OutdatedError,
    ReadOnlyError,
    ShardAwayError,
    UsageError,
)
from hapticdb.check import check_environment
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.query.cost_model import CostModel
from hapticdb.query.frame import Strategy
from hapticdb.store.connect import grant, open_store
from hapticdb.store.postgres.address import parse
from hapticdb.store.postgres.connecting import connection
from hapticdb.store.postgres.private_server import PrivateServer
from hapticdb.store.postgres.shards import sweeping
from hapticdb.store.postgres.shards.store import ShardedStore
from hapticdb.testing import floor_voxels, write_voxels
from hapticdb.testing.scenes import covering, everything, voxel_object
from hapticdb.transfer import copy_environment
from servers import Place
from sharded import ShardedServers

GRID = Grid(0.005, (0, 0, 0), 7)
FLOOR = floor_voxels(GRID, width=96)
"""On all three shards: 12 x 12 x 1 bricks across the grid's middle."""


def on(server: PrivateServer, url: str, statement: LiteralString) -> list[tuple[object, ...]]:
    """Rows of a statement on one server, in the environment's schema."""
    with psycopg.connect(server.conninfo(), autocommit=True) as connection:
        name = sql.Identifier(parse(url).environment)
        connection.execute(sql.SQL("SET search_path = {}").format(name))
        found = connection.execute(statement)
        return found.fetchall() if found.description else []


def count(server: PrivateServer, url: str) -> int:
    """Rows that a shard has, live or not."""
    return int(str(on(server, url, "SELECT count(*) FROM brick")[0][0]))


@pytest.fixture
def store(sharded_place: Place) -> Iterator[ShardedStore]:
    """A store with a floor on all shards."""
    made = ShardedStore.create(sharded_place(), GRID)
    write_voxels(made, FLOOR, "floor")
    yield made
    made.close()


def moved(store: ShardedStore, by: int) -> None:
    """Replace the floor by one that is so many voxels higher."""
    ijk = FLOOR + np.array([0, 0, by])
    (before,) = store.objects()
    record = replace(voxel_object(store.grid, ijk, "floor"), id=before.id)
    store.replace(record, rows_of_voxels(ijk, store.grid, store.layout), covering(store))


# -- made and opened -------------------------------------------------------------------------------


def test_rows_are_on_all_shards_and_none_at_the_coordinator(
    store: ShardedStore, sharded_servers: ShardedServers
) -> None:
    counts = [count(shard, store.url) for shard in sharded_servers.shards]
    assert all(counts)
    assert sum(counts) == len(everything(store))
    assert count(sharded_servers.coordinator, store.url) == 0


def test_the_coordinators_url_alone_opens_it(
    store: ShardedStore, sharded_servers: ShardedServers
) -> None:
    url = f"{sharded_servers.url}&environment={parse(store.url).environment}"
    with contextlib.closing(open_store(url, read_only=True)) as opened:
        assert isinstance(opened, ShardedStore)
        assert len(everything(opened)) == len(everything(store))


def test_a_url_with_other_shards_is_refused(
    store: ShardedStore, sharded_servers: ShardedServers
) -> None:
    one = quote(sharded_servers.hosts[0], safe="")
    url = f"{sharded_servers.url}&shards={one}&environment={parse(store.url).environment}"
    with pytest.raises(UsageError, match="leave shards= out"):
        open_store(url)


def test_a_schema_on_a_shard_is_never_replaced_and_nothing_is_left_elsewhere(
    sharded_place: Place, sharded_servers: ShardedServers
) -> None:
    url = sharded_place()
    name = parse(url).environment
    taken = sharded_servers.shards[1]
    with psycopg.connect(taken.conninfo(), autocommit=True) as connection:
        connection.execute(sql.SQL("CREATE SCHEMA {}").format(sql.Identifier(name)))
    with pytest.raises(EnvironmentExistsError, match=r"shard 2 .*exists already on this server"):
        ShardedStore.create(url, GRID)
    with pytest.raises(EnvironmentNotFoundError):
        open_store(url)
    for server in (sharded_servers.coordinator, *sharded_servers.shards):
        with psycopg.connect(server.conninfo(), autocommit=True) as connection:
            asked = "SELECT count(*) FROM pg_namespace WHERE nspname = %s"
            found = connection.execute(asked, (name,)).fetchone()
            assert found == (int(server is taken),)


def test_an_unused_environment_is_deleted_on_all_servers(sharded_place: Place) -> None:
    url = sharded_place()
    ShardedStore.create(url, GRID).discard()
    with pytest.raises(EnvironmentNotFoundError):
        open_store(url)
    ShardedStore.create(url, GRID).close()  # no schema is in the way


def test_an_unused_environment_leaves_no_servers_for_sql(
    sharded_place: Place, sharded_servers: ShardedServers
) -> None:
    servers = "SELECT srvname FROM pg_foreign_server"
    with psycopg.connect(sharded_servers.coordinator.conninfo(), autocommit=True) as coordinator:
        before = coordinator.execute(servers).fetchall()
        unused = ShardedStore.create(sharded_place(), GRID)
        unused.offer_sql()
        assert len(coordinator.execute(servers).fetchall()) == len(before) + 3
        unused.discard()
        assert coordinator.execute(servers).fetchall() == before


def test_a_server_with_rows_of_another_environment_is_refused(
    store: ShardedStore, sharded_servers: ShardedServers
) -> None:
    on(sharded_servers.shards[2], store.url, "UPDATE mark SET token = gen_random_uuid()")
    with (
        contextlib.closing(ShardedStore.open(store.url, read_only=True)) as opened,
        pytest.raises(DamagedError, match=r"shard 3 .*another environment"),
    ):
        everything(opened)


# -- copied, felt, told ----------------------------------------------------------------------------


def test_a_copy_spreads_the_rows_evenly(sharded_place: Place) -> None:
    corner = ShardedStore.create(sharded_place(), GRID)
    ends = [np.arange(112), np.arange(32), np.arange(32)]
    ijk = np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1).reshape(-1, 3)
    write_voxels(corner, ijk, "corner")
    shares = [shard.rows or 0 for shard in analyzed(corner).shards()]
    assert max(shares) >= 2 * min(shares), "even borders cut the grid, not the scene"
    url = sharded_place()
    copy_environment(corner.url, url)
    with contextlib.closing(ShardedStore.open(url)) as copy:
        rows = [shard.rows or 0 for shard in analyzed(copy).shards()]
        assert sum(rows) == len(everything(corner))
        assert max(rows) < 2 * min(rows)
        everything_equal(copy, corner)
    corner.close()


def analyzed(store: ShardedStore) -> ShardedStore:
    """The store, after the servers have counted their rows."""
    store._shards.each(lambda _, shard: shard.command("ANALYZE brick"))
    return store


def everything_equal(one: ShardedStore, other: ShardedStore) -> None:
    assert one.scan(*EVERY).keys.tolist() == other.scan(*EVERY).keys.tolist()
    assert one.scan(*EVERY).occupancy.tolist() == other.scan(*EVERY).occupancy.tolist()


EVERY = (np.array([0]), np.array([2**62]))


@pytest.mark.parametrize("strategy", ["array", "points", "maxgap", "cbgroup"])
def test_each_strategy_feels_the_same_as_in_one_file(
    store: ShardedStore, tmp_path: Path, strategy: Strategy
) -> None:
    one_server = str(tmp_path / "one.db")
    copy_environment(store.url, one_server)
    shell = hapticdb.PointShell(*ball_shell(), np.zeros(3))
    with hapticdb.open(store.url) as env, hapticdb.open(one_server) as same:
        for height in (0.30, 0.315, 0.325):
            pose = np.eye(4)
            pose[:3, 3] = 0.32, 0.32, height
            one, other = (e.touch(shell, pose, strategy=strategy, law="plane") for e in (env, same))
            assert one.force.tolist() == other.force.tolist()
            assert one.torque.tolist() == other.torque.tolist()
            assert one.hits.tolist() == other.hits.tolist()
            assert [obj.id for obj in one.objects] == [obj.id for obj in other.objects]


def ball_shell() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    normals = rng.normal(size=(200, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return 0.2 * normals, -normals


def test_statement_is_refused_in_one_line(store: ShardedStore) -> None:
    shell = hapticdb.PointShell(*ball_shell(), np.zeros(3))
    with (
        hapticdb.open(store.url) as env,
        pytest.raises(UsageError, match="choose another strategy"),
    ):
        env.touch(shell, np.eye(4), strategy="statement", law="plane")


def test_costs_are_fitted_and_kept_without_those_of_statement(store: ShardedStore) -> None:
    with hapticdb.open(store.url) as env:
        costs = env.calibrate()
    assert costs.aggregate == np.inf
    kept = store.costs(next(iter(store._connection.rows("SELECT machine FROM cost")))[0])
    assert kept is not None
    assert "descent" in kept
    assert "aggregate" not in kept
    assert CostModel.from_figures(kept) == costs


def test_an_edit_of_an_object_that_another_has_written_is_refused(store: ShardedStore) -> None:
    with hapticdb.open(store.url) as env:
        (floor,) = env.objects()
        moved(store, 4)
        before = everything(store).keys.tolist()
        with pytest.raises(ConflictError):
            env.remove(floor.id, revision=floor.revision)
        assert everything(store).keys.tolist() == before
        assert env.remove(floor.id).name == "floor"
        assert not len(everything(store))
        assert [change.action for change in store.changes()] == ["add", "move", "remove"]


# -- swept -----------------------------------------------------------------------------------------


def total(store: ShardedStore, servers: ShardedServers) -> int:
    """Rows on all shards, live or not."""
    return sum(count(shard, store.url) for shard in servers.shards)


def test_a_write_sweeps_what_it_replaced(
    store: ShardedStore, sharded_servers: ShardedServers
) -> None:
    moved(store, 4)
    assert total(store, sharded_servers) == len(everything(store))
    store.remove(1, covering(store))
    assert total(store, sharded_servers) == len(everything(store)) == 0


def test_a_snapshot_keeps_its_rows_until_it_ends(
    store: ShardedStore, sharded_servers: ShardedServers
) -> None:
    with contextlib.closing(ShardedStore.open(store.url, read_only=True)) as reader:
        before = everything(reader).keys.tolist()
        with reader.snapshot():
            moved(store, 4)
            moved(store, 16)
            assert everything(reader).keys.tolist() == before
            assert store.sweep().kept > 0
            assert everything(reader).keys.tolist() == before
        after = everything(store)
        assert everything(reader).keys.tolist() == after.keys.tolist() != before
    assert store.sweep().kept == 0
    assert total(store, sharded_servers) == len(after)


def test_a_snapshot_whose_rows_are_gone_says_so(
    store: ShardedStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    nobody = "SELECT NULL::bigint"
    monkeypatch.setattr(sweeping, "NOW", sweeping.NOW.replace(sweeping.HELD, nobody))
    monkeypatch.setattr(sweeping, "HELD", nobody)
    with contextlib.closing(ShardedStore.open(store.url, read_only=True)) as reader:
        with reader.snapshot():
            moved(store, 4)
            with pytest.raises(OutdatedError):
                everything(reader)
        assert everything(reader).keys.tolist() == everything(store).keys.tolist()


def test_rows_of_a_write_that_was_never_published_are_not_there_and_are_swept(
    store: ShardedStore, sharded_servers: ShardedServers, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = everything(store).keys.tolist()

    def fail(*_: object) -> None:
        raise DamagedError("killed before the commit")

    with monkeypatch.context() as patch:
        patch.setattr("hapticdb.store.postgres.tables.writing.PostgresWriter._log", fail)
        with pytest.raises(DamagedError):
            moved(store, 8)
    assert everything(store).keys.tolist() == before
    assert total(store, sharded_servers) == 2 * len(before)
    assert store.sweep() == (1, 0)
    assert total(store, sharded_servers) == len(before)
    assert everything(store).keys.tolist() == before


# -- in SQL ----------------------------------------------------------------------------------------


def test_sql_at_the_coordinator_reads_the_rows_that_count(
    store: ShardedStore, sharded_servers: ShardedServers
) -> None:
    in_sql = "SELECT z_val, id, occupancy FROM brick_live WHERE cell >= 0 ORDER BY z_val, id"
    is_whole = "SELECT is_whole FROM shard_check"
    store.offer_sql()
    for by in (0, 4):
        moved(store, by)
        found = on(sharded_servers.coordinator, store.url, in_sql)
        wanted = everything(store)
        assert [row[0] for row in found] == wanted.keys.tolist()
        assert b"".join(bytes(row[2]) for row in found) == wanted.occupancy.tobytes()  # type: ignore[call-overload]
        assert on(sharded_servers.coordinator, store.url, is_whole) == [(True,)]
    store.offer_sql()
    assert on(sharded_servers.coordinator, store.url, in_sql) == found


# -- away, restored --------------------------------------------------------------------------------


def test_a_shard_that_is_away_is_named(
    store: ShardedStore, sharded_servers: ShardedServers
) -> None:
    store.analyze(10_000)
    shard = sharded_servers.shards[1]
    whole = everything(store)
    try:
        shard.kill()
        with contextlib.closing(ShardedStore.open(store.url, read_only=True)) as reader:
            with pytest.raises(ShardAwayError, match=r"shard 2 \("):
                everything(reader)
            part = reader.scan_partly(*EVERY)
            assert reader.shards_away() == (f"shard 2 ({sharded_servers.hosts[1]})",)
            ((low, high),) = part.away
            is_there = (whole.keys < low) | (whole.keys > high)
            assert part.rows.keys.tolist() == whole.keys[is_there].tolist()
            assert 0 < len(part.rows) < len(whole)
            assert [bool(one.trouble) for one in reader.shards()] == [False, True, False]
            assert reader.quantiles(10_000).n_rows == len(whole)
            findings = list(reader.checker().findings())
            assert len(findings) == 1
            assert "shard 2" in findings[0]
            shard.start()
            for _ in range(100):
                part = reader.scan_partly(*EVERY)
                if not len(part.away):
                    break
                time.sleep(0.05)
            assert part.rows.keys.tolist() == whole.keys.tolist()
            assert reader.shards_away() == ()
    finally:
        shard.start()


def test_a_shard_from_an_older_copy_is_found(
    store: ShardedStore, sharded_servers: ShardedServers
) -> None:
    on(sharded_servers.shards[0], store.url, "UPDATE mark SET writes = writes - 1")
    report = check_environment(store.url)
    assert any("shard 1" in finding and "lost writes" in finding for finding in report.findings)


# -- rights ----------------------------------------------------------------------------------------


@pytest.fixture
def role(sharded_servers: ShardedServers) -> Iterator[str]:
    """A role on all servers that has no right yet."""
    name = f"{os.getpid()} role of shards"
    servers = (sharded_servers.coordinator, *sharded_servers.shards)
    for server in servers:
        with psycopg.connect(server.conninfo(), autocommit=True) as connection:
            connection.execute(sql.SQL("CREATE ROLE {} LOGIN").format(sql.Identifier(name)))
    yield name
    for server in servers:
        with psycopg.connect(server.conninfo(), autocommit=True) as connection:
            connection.execute(sql.SQL("DROP OWNED BY {}").format(sql.Identifier(name)))
            connection.execute(sql.SQL("DROP ROLE {}").format(sql.Identifier(name)))


def test_an_editor_edits_and_a_viewer_reads(store: ShardedStore, role: str) -> None:
    url = store.url.replace("user=hapticdb", f"user={quote(role)}")
    with pytest.raises((AccessError, ReadOnlyError, DamagedError)):
        ShardedStore.open(url, read_only=True)
    grant(store.url, role, "viewer")
    with contextlib.closing(ShardedStore.open(url, read_only=True)) as viewer:
        assert len(everything(viewer)) == len(everything(store))
        with viewer.snapshot():
            assert len(viewer.objects()) == 1
    with pytest.raises(ReadOnlyError):
        ShardedStore.open(url)
    grant(store.url, role, "editor")
    with contextlib.closing(ShardedStore.open(url)) as editor:
        moved(editor, 4)
        write_voxels(editor, FLOOR - np.array([0, 0, 20]), "second")
        editor.remove(1, covering(editor))
        editor.analyze(10_000)
        assert editor.sweep().kept == 0
        everything_equal(editor, store)
    grant(store.url, role, "nobody")
    with pytest.raises((AccessError, ReadOnlyError, DamagedError)):
        ShardedStore.open(url, read_only=True)


def test_a_shard_without_a_free_connection_is_named(
    store: ShardedStore, sharded_servers: ShardedServers, role: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "RECONNECT_SECONDS", 0.2)
    grant(store.url, role, "viewer")
    url = store.url.replace("user=hapticdb", f"user={quote(role)}")
    limit = sql.SQL("ALTER ROLE {} CONNECTION LIMIT {}")
    with psycopg.connect(sharded_servers.shards[1].conninfo(), autocommit=True) as admin:
        admin.execute(limit.format(sql.Identifier(role), sql.Literal(0)))
        with contextlib.closing(ShardedStore.open(url, read_only=True)) as viewer:
            for _ in range(2):
                with pytest.raises(ShardAwayError, match=r"shard 2 \(.* has no free conn") as told:
                    everything(viewer)
                assert "raise max_connections" in str(told.value)
                assert "\n" not in str(told.value)
            admin.execute(limit.format(sql.Identifier(role), sql.Literal(-1)))
            everything_equal(viewer, store)


def test_only_an_owner_grants(store: ShardedStore, role: str) -> None:
    grant(store.url, role, "editor")
    url = store.url.replace("user=hapticdb", f"user={quote(role)}")
    with pytest.raises((AccessError, ReadOnlyError)):
        grant(url, role, "viewer")

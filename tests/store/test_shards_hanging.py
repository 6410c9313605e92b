"""A server that hangs: connected, and silent. Its processes are stopped by SIGSTOP.

Each wait has an end. A shard that hangs is named; a write that needs it leaves nothing behind; and
when the server goes on, everything is as if it had only been slow.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import closing

import numpy as np
import pytest

import hapticdb
from command_line import Run, refused, run  # noqa: F401 - a fixture
from frozen import freeze, frozen, impatient, thaw
from hapticdb import ConnectionLostError, PointShell, ShardAwayError, StuckError
from hapticdb.check import check_environment
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.store.postgres.connecting import answering, wire
from hapticdb.store.postgres.private_server import PrivateServer
from hapticdb.store.postgres.shards.store import ShardedStore
from hapticdb.testing.scenes import everything, voxel_object
from labelled import GRID, contents_of, labelled_object, labelled_rows
from servers import Place
from sharded import ShardedServers
from steps import MOST_STEPS, Steps, steps  # noqa: F401 - a fixture among them
from store.test_shards_killed import (  # noqa: F401 - a fixture among them
    KINDS,
    after_edit,
    assert_goes_on,
    edit,
    url,
    victims,
)

SOON_S = 30.0
"""Seconds within which a wait with the usual limits must have ended."""
SHARD_3 = r"shard 3 \(.*\) of "
EVERY_BRICK = np.stack(np.meshgrid(*[np.arange(0, 128, 4)] * 3), axis=-1).reshape(-1, 3)
"""A voxel in each brick of the grid: more rows for each shard than a socket takes at once."""


@pytest.fixture
def store(url: str) -> Iterator[ShardedStore]:  # noqa: F811 - a fixture
    with closing(ShardedStore.open(url)) as opened:
        yield opened


def assert_hangs(error: BaseException) -> None:
    """Assert that an error is one line, and says that a server hangs or cannot be reached."""
    assert "\n" not in str(error)
    assert "hangs" in str(error) or "cannot be reached" in str(error)


# --- reads --------------------------------------------------------------------------------------


def test_a_read_names_the_shard_that_hangs_and_goes_on_when_it_answers(
    store: ShardedStore, sharded_servers: ShardedServers
) -> None:
    before = everything(store)
    elsewhere = before.keys[:20]  # in the first third of the keys
    with impatient(), frozen(sharded_servers.shards[2]):
        for _ in range(2):  # a connection that hangs, then none
            with pytest.raises(ShardAwayError, match=SHARD_3) as told:
                everything(store)
            assert_hangs(told.value)
            assert len(store.lookup(np.unique(elsewhere)))
    assert everything(store).keys.tolist() == before.keys.tolist()


def test_a_read_without_its_coordinator_ends_and_blames_no_shard(
    store: ShardedStore, sharded_servers: ShardedServers
) -> None:
    before = everything(store)
    with impatient(), frozen(sharded_servers.coordinator):
        for error in (StuckError, ConnectionLostError):
            with pytest.raises(error) as told:
                everything(store)
            assert_hangs(told.value)
            assert "shard " not in str(told.value)
            assert not isinstance(told.value, ShardAwayError)
    assert everything(store).keys.tolist() == before.keys.tolist()


def test_partial_reads_leave_out_all_shards_that_hang_at_once(
    store: ShardedStore, sharded_servers: ShardedServers
) -> None:
    """Two shards hang; the third one's rows come all the same, in the patience of one."""
    n_rows = len(everything(store))
    ends = np.array([0]), np.array([(1 << 3 * GRID.bits - 6) - 1])
    assert len(store.scan_partly(*ends).rows) == n_rows
    with frozen(*sharded_servers.shards[1:]):
        rows, away = store.scan_partly(*ends)
        assert 0 < len(rows) < n_rows
        assert len(away) == 2
        assert [name[:7] for name in store.shards_away()] == ["shard 2", "shard 3"]
    deadline = time.monotonic() + SOON_S
    while len(store.scan_partly(*ends).away):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert len(store.scan_partly(*ends).rows) == n_rows


# --- writes -------------------------------------------------------------------------------------


def hung_at(
    servers: ShardedServers,
    where: str,
    steps: Steps,  # noqa: F811
    at: int,
    victim: PrivateServer,
) -> bool:
    """Freeze a server before step `at` of an edit, check all; whether there was such a step."""
    kind = KINDS[at % len(KINDS)]
    with closing(ShardedStore.open(where)) as store:
        before = contents_of(store)
        highest = max(change.id for change in store.changes())
        steps.before(at, lambda: freeze(victim))
        done, told = None, ""
        try:
            with impatient():
                done = edit(store, kind, 400 + at, before)
        except (ConnectionLostError, StuckError) as error:
            told = str(error)
        finally:
            thaw(victim)
        n_seen = len(steps.seen)
        steps.none()
    if told:
        assert "\n" not in told
        whose = [f"shard {n} (" for n, one in enumerate(servers.shards, 1) if one is victim]
        assert all(name in told for name in whose)
    after = after_edit(kind, 400 + at, before, highest + 1)
    assert done in (None, after)
    assert_goes_on(servers, where, [before, after] if done is None else [after])
    return n_seen >= at


@pytest.mark.parametrize("which", [0, 1], ids=["shard", "coordinator"])
def test_a_server_that_hangs_at_a_step_leaves_an_object_whole(
    sharded_servers: ShardedServers,
    url: str,  # noqa: F811
    steps: Steps,  # noqa: F811
    which: int,
) -> None:
    assert hung_at(sharded_servers, url, steps, 16, victims(sharded_servers)[which])


@pytest.mark.long
@pytest.mark.parametrize("which", [0, 1], ids=["shard", "coordinator"])
def test_a_server_that_hangs_at_any_step_leaves_an_object_whole(
    sharded_servers: ShardedServers,
    url: str,  # noqa: F811
    steps: Steps,  # noqa: F811
    which: int,
) -> None:
    n_without = 0
    for at in sharded_servers.steps_tried:
        is_there = hung_at(sharded_servers, url, steps, at, victims(sharded_servers)[which])
        n_without = 0 if is_there else n_without + 1
        if n_without == len(KINDS):
            break
    assert 30 < at < MOST_STEPS - 1


def test_a_write_to_a_shard_that_hangs_is_refused_in_one_line(
    store: ShardedStore, sharded_servers: ShardedServers
) -> None:
    before = contents_of(store)
    with impatient(), frozen(sharded_servers.shards[2]):
        for _ in range(2):
            with pytest.raises(ShardAwayError, match=f"nothing is written: {SHARD_3}") as told:
                store.add(labelled_object(77), labelled_rows(77))
            assert_hangs(told.value)
        assert contents_of_objects(store) == sorted(before)
    assert contents_of(store) == before
    new = store.add(labelled_object(77), labelled_rows(77))
    assert contents_of(store) == {**before, new: 77}


def contents_of_objects(store: ShardedStore) -> list[int]:
    """Ids of the objects, which the coordinator knows without a shard."""
    return sorted(obj.id for obj in store.objects())


def test_a_shard_that_hangs_within_a_copy_ends_the_write(
    store: ShardedStore, sharded_servers: ShardedServers, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = contents_of(store)
    packed: Callable[..., bytes] = wire.copy_rows
    rows = rows_of_voxels(EVERY_BRICK, GRID, "brick")

    def pack(*args: object) -> bytes:
        freeze(sharded_servers.shards[2])  # the COPY has begun, its rows are not sent yet
        return packed(*args)

    try:
        with monkeypatch.context() as patch, impatient():
            patch.setattr(wire, "copy_rows", pack)
            with pytest.raises(ShardAwayError, match=SHARD_3) as told:
                store.add(voxel_object(GRID, EVERY_BRICK, "every brick"), rows)
        assert_hangs(told.value)
    finally:
        thaw(sharded_servers.shards[2])
    assert contents_of(store) == before
    store.sweep()
    store.add(labelled_object(78), labelled_rows(78))
    assert check_environment(store.url).findings == []


def test_a_statement_that_takes_long_is_not_given_up_while_its_server_answers_others(
    store: ShardedStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(answering, "SILENCE_S", 0.1)
    connections = [store._connection, *map(store._shards.connection, range(3))]
    for connection in connections:
        with connection.without_limit():
            connection.execute("SELECT pg_sleep(0.5)")
        connection.write(lambda c=connection: c.command("SELECT pg_sleep(0.5)"))  # type: ignore[misc]
    assert contents_of(store)


# --- with the usual limits, by the command line -------------------------------------------------


@pytest.mark.long
def test_touch_ends_soon_and_info_names_the_shard(
    sharded_place: Place,
    sharded_servers: ShardedServers,
    run: Run,  # noqa: F811 - a fixture
) -> None:
    where = sharded_place()
    with closing(ShardedStore.create(where, GRID)) as store:
        rows = rows_of_voxels(EVERY_BRICK, GRID, "brick")
        store.add(voxel_object(GRID, EVERY_BRICK, "every brick"), rows)
    everywhere = PointShell(
        points=((EVERY_BRICK[::16] + 0.5) * GRID.voxel_size).astype(np.float64),
        normals=np.tile([0.0, 0.0, 1.0], (len(EVERY_BRICK[::16]), 1)),
        center=np.zeros(3),
    )
    with hapticdb.open(where, read_only=True) as env:
        expected = env.touch(everywhere, np.eye(4)).hits.tolist()
        assert expected
        with frozen(sharded_servers.shards[2]):
            began = time.monotonic()
            with pytest.raises(ShardAwayError, match=SHARD_3):
                env.touch(everywhere, np.eye(4))
            assert time.monotonic() - began < SOON_S
            began = time.monotonic()
            code, out, _ = run("info", where)
            assert time.monotonic() - began < 2 * SOON_S
            assert code == 0
            assert "shard 3" in out
            assert "away" in out
            refused(run("check", where), "shard 3")
        assert env.touch(everywhere, np.eye(4)).hits.tolist() == expected

"""Borders between shards move, and all rows stay; what is interrupted is taken up."""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

import contextlib
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hapticdb
from command_line import Run, refused, run  # noqa: F401 - a fixture
from hapticdb import Grid, PointShell
from hapticdb.query.frame import Strategy
from hapticdb.store.base import CELL_SHIFT, Layout, row_shift
from hapticdb.store.postgres.shards.borders import carrying, rebalancing
from hapticdb.store.postgres.shards.loading import IndexesOnShards
from hapticdb.store.postgres.shards.pieces import even_borders
from hapticdb.store.postgres.shards.store import ShardedStore
from hapticdb.store.sharding import Rebalanced, RebalanceProgress
from hapticdb.testing.scenes import (
    everything,
)
from rebalanced import (  # noqa: F401 - a fixture among them
    GRID,
    assert_only_own_rows,
    contents,
    made,
    on_shards,
    replace,
    shape,
    small_batches,
)
from servers import Place
from sharded import ShardedServers

pytestmark = pytest.mark.usefixtures("small_batches")

KINDS = [
    ("brick", "z", True),
    ("brick", "hilbert", False),
    ("voxel", "z", False),
    ("voxel", "lexicographic", False),
]


@pytest.mark.parametrize(("layout", "curve", "distances"), KINDS)
def test_rows_are_the_same_and_spread_evenly(
    sharded_place: Place,
    sharded_servers: ShardedServers,
    layout: Layout,
    curve: Any,  # noqa: ANN401 - the name of a curve
    distances: bool,
) -> None:
    grid = Grid(GRID.voxel_size, GRID.origin, GRID.bits, curve)
    with made(sharded_place(), layout, distances=distances, grid=grid) as store:
        before = contents(store)
        told: list[RebalanceProgress] = []
        report = store.rebalance(told.append)
        assert contents(store) == before
        assert_only_own_rows(sharded_servers, store)
        n_rows = len(before["scan"][0])
        assert sum(report.rows_before) == sum(report.rows_after) == n_rows
        assert report.environment == store.url
        assert [name.split()[:2] for name in report.shards] == [
            ["shard", str(n)] for n in (1, 2, 3)
        ]
        # a cell is never on two shards: a border is off by less than one cell's rows
        cells = np.array(before["scan"][0]) >> (CELL_SHIFT - row_shift(layout))
        most = np.unique(cells, return_counts=True)[1].max()
        assert max(abs(n - n_rows / 3) for n in report.rows_after) <= 2 * most
        assert [one.rows_done for one in told] == sorted({one.rows_done for one in told})
        assert told[-1] == (report.moved_rows, report.moved_rows)
        assert len(told) > 3
        assert report.moved_bytes > 8 * report.moved_rows
        again = store.rebalance()
        assert (again.moved_rows, again.rows_after) == (0, report.rows_after)
        assert contents(store) == before


def test_borders_move_both_ways_and_back(
    sharded_place: Place, sharded_servers: ShardedServers
) -> None:
    with made(sharded_place()) as store:
        before = contents(store)
        shards = store._rebalancer
        number = shards._begun()
        for cells in ((0, 20, 40), (0, 0, 0), (0, 64, 64), (0, 3, 60), (0, 171, 342)):
            wanted = np.array(cells, dtype=np.int64) << CELL_SHIFT
            while shards._moved(wanted, number) is not None:
                assert everything(store).keys.tolist() == before["scan"][0]
            shards._deleted(number)
            assert contents(store) == before
            assert_only_own_rows(sharded_servers, store)
        (counts,) = on_shards(sharded_servers, store, "SELECT writes FROM mark")[1]
        ((published,),) = store.connection.rows("SELECT writes FROM shard WHERE number = 2")
        assert counts[0] == published  # `check` compares them
        assert not list(store.checker().findings())


def test_an_environment_without_rows_is_balanced(sharded_place: Place) -> None:
    with contextlib.closing(ShardedStore.create(sharded_place(), GRID)) as store:
        report = store.rebalance()
        assert (report.moved_rows, report.rows_after) == (0, (0, 0, 0))
        ((firsts,),) = store.connection.rows("SELECT array_agg(first_key) FROM shard")
        assert firsts == even_borders(GRID, 3).tolist()


# --- interrupted --------------------------------------------------------------------------------


class Killed(BaseException):
    """Ends a rebalance anywhere, as Ctrl-C or a kill would."""


def killing(after: int, *, is_done: bool) -> Callable[[Any], Any]:
    """Wrap a function so that a call ends in `Killed`, before or after it has done its work."""
    left = after

    def wrap(function: Any) -> Any:  # noqa: ANN401 - any function
        def called(*args: Any, **options: Any) -> Any:  # noqa: ANN401
            nonlocal left
            left -= 1
            if left < 0 and not is_done:
                raise Killed
            result = function(*args, **options)
            if left < 0:
                raise Killed
            return result

        return called

    return wrap


STEPS = [
    (rebalancing.Rebalancer, "_begun", 0, True),  # the rebalance has its number
    (rebalancing.Rebalancer, "_planned", 0, True),
    (rebalancing.Rebalancer, "_carried", 0, False),  # the write lock is held
    (carrying.Carrier, "_list", 1, False),  # older copies are deleted
    (carrying, "_copied", 2, False),  # versions are listed
    (carrying, "_copied", 3, False),  # the rows are copied, the distances are not
    (carrying, "_copied", 3, True),
    (carrying.Carrier, "carry", 1, True),  # the new shard has committed
    (rebalancing, "borders_after", 2, False),
    (rebalancing.Rebalancer, "_moved", 2, True),  # the border has moved
    (rebalancing.Rebalancer, "_deleted", 0, False),  # all borders have
    (rebalancing.Rebalancer, "_wait_for_snapshots", 0, True),
    (rebalancing.Rebalancer, "_delete", 0, True),  # some rows are deleted
    (IndexesOnShards, "vacuum", 0, False),
]


QUICK = {"_moved", "_delete"}
"""Steps of the quick suite."""


@pytest.mark.parametrize(
    ("owner", "name", "after", "is_done"),
    [
        pytest.param(
            *step,
            id=f"{step[1]}-{step[2]}-{step[3]}",
            marks=[] if step[1] in QUICK else [pytest.mark.long],
        )
        for step in STEPS
    ],
)
def test_a_rebalance_killed_at_any_step_is_taken_up(
    sharded_place: Place,
    sharded_servers: ShardedServers,
    owner: Any,  # noqa: ANN401 - a class or a module
    name: str,
    after: int,
    is_done: bool,
) -> None:
    url = sharded_place()
    with made(url, distances=True) as store, pytest.MonkeyPatch.context() as patch:
        before = contents(store)
        patch.setattr(owner, name, killing(after, is_done=is_done)(getattr(owner, name)))
        with pytest.raises(Killed):
            store.rebalance()
        patch.undo()
        small = {"voxel": 500, "brick": 20, "band": 60}
        patch.setattr(carrying, "BATCH_ROWS", small)
        with contextlib.closing(ShardedStore.open(url)) as another:
            assert contents(another) == before
            replace(another, 6, shape(2000))  # a write beside what was left
            replace(another, 6, shape(5))
            assert everything(another).keys.tolist() == before["scan"][0]
            written = contents(another)
            report = another.rebalance()
            assert contents(another) == written
            assert max(report.rows_after) < sum(report.rows_after) / 2
            assert_only_own_rows(sharded_servers, another)
            another.sweep()
            assert contents(another) == written
            assert not list(another.checker().findings())
        assert contents(store) == written  # the one that was killed lives


@pytest.mark.parametrize("n_pieces", [1, 2])
def test_a_rebalance_killed_within_a_copy_can_go_on(sharded_place: Place, n_pieces: int) -> None:
    with made(sharded_place(), distances=True) as store:
        before = contents(store)
        with pytest.MonkeyPatch.context() as patch:
            sent, n_sent = carrying._sent, 0

            def cut_off(*args: Any) -> Iterator[bytes]:  # noqa: ANN401 - as they are
                nonlocal n_sent
                for piece in sent(*args):
                    yield piece
                    n_sent += len(piece) > 100  # not the header alone
                    if n_sent >= n_pieces:
                        raise Killed

            patch.setattr(carrying, "_sent", cut_off)
            with pytest.raises(Killed):
                store.rebalance()
        assert contents(store) == before  # by the same connections
        assert store.rebalance().moved_rows
        assert contents(store) == before


def test_older_copies_at_the_new_shard_are_replaced(
    sharded_place: Place, sharded_servers: ShardedServers
) -> None:
    """An object is replaced after its old rows were copied and before the border moved."""
    with made(sharded_place()) as store:
        with pytest.MonkeyPatch.context() as patch:
            end = killing(1, is_done=True)  # the first one moves a range without rows
            patch.setattr(carrying.Carrier, "carry", end(carrying.Carrier.carry))
            patch.setattr(carrying, "BATCH_ROWS", {"voxel": 10**9, "brick": 10**9, "band": 10**9})
            with pytest.raises(Killed):
                store.rebalance()
        stale = sum(
            n for ((n,),) in on_shards(sharded_servers, store, "SELECT count(*) FROM brick")
        )
        assert stale > len(everything(store))
        for object_id in (1, 2, 4):
            replace(store, object_id, shape(100 + object_id))
        before = contents(store)
        store.rebalance()
        assert contents(store) == before
        store.sweep()
        held = sum(n for ((n,),) in on_shards(sharded_servers, store, "SELECT count(*) FROM brick"))
        assert held == len(everything(store))


@pytest.mark.parametrize("kind", ["array", "points", "maxgap", "cbgroup", "auto"])
def test_a_frame_feels_the_same(sharded_place: Place, kind: Strategy) -> None:
    url = sharded_place()
    rng = np.random.default_rng(1)
    shell = PointShell(
        points=((shape(0) + 0.5) * GRID.voxel_size).astype(np.float64),
        normals=np.tile([0.0, 0.0, 1.0], (len(shape(0)), 1)),
        center=np.zeros(3),
        is_closed=True,
    )
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[1:, :3, 3] = rng.uniform(-0.03, 0.03, (3, 3))
    with made(url) as store, hapticdb.open(url, read_only=True) as env:
        before = [env.touch(shell, pose, kind, law="plane") for pose in poses]
        store.rebalance()
        for was, pose in zip(before, poses, strict=True):
            now = env.touch(shell, pose, kind, law="plane")
            assert len(now.hits)
            assert (now.hits == was.hits).all()
            assert (now.force == was.force).all()
            assert (now.torque == was.torque).all()


# --- the verb -----------------------------------------------------------------------------------


def test_the_verb_says_what_has_moved(run: Run, sharded_place: Place) -> None:
    url = sharded_place()
    with made(url) as store:
        code, out, err = run("rebalance", url)
        assert (code, err) == (0, "")
        assert re.fullmatch(r"\S+: [\d,]+ rows moved \([\d.]+ MB\); rows of the servers .*\n", out)
        code, out, _ = run("rebalance", url)
        assert (code, "balanced already" in out) == (0, True)
        code, out, _ = run("rebalance", url, "--json")
        found = json.loads(out)
        assert list(found) == list(Rebalanced._fields)
        assert sum(found["rows_after"]) == len(everything(store))


def test_an_environment_on_one_server_has_nothing_to_rebalance(
    run: Run, place: Place, tmp_path: Path
) -> None:
    for url in (place(), str(tmp_path / "a.db")):
        hapticdb.create(url, GRID).close()
        refused(run("rebalance", url), "has one server: nothing to rebalance")

"""Resident cells while a shard is away: its cells are unknown, all others as in the database."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from banded import write_points
from hapticdb import Environment, PointShell, ShardAwayError
from hapticdb.kernels.resident.cells import UNKNOWN
from hapticdb.query.cost_model import CostModel
from hapticdb.resident import costs
from hapticdb.resident.frames import ResidentFrames
from hapticdb.resident.partial import ASK_AGAIN, AwayCells, meeting, shards_away
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import LEAST_BUDGET, CellTable
from hapticdb.store.base import Keys, Store
from hapticdb.store.connect import open_store
from hapticdb.testing import write_voxels
from realtime.halved import SHARD, Halved
from realtime.worlds import block, cells_of, make, move, scatter
from resident.test_residency import check, voxels_by_cell

NOBODY: tuple[str, ...] = ()


class Clock:
    """Seconds that only a test moves."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


class Setting(NamedTuple):
    """An environment with objects in both halves, and a residency over a store in two halves.

    lower, upper : cells of the halves; `away` : the file that takes the upper one away.
    """

    env: Environment
    store: Halved
    residency: Residency
    clock: Clock
    away: Path
    lower: Keys
    upper: Keys

    def load(self, cells: Keys) -> int:
        """A round: ask for those of the cells that may be asked for; returns how many those are."""
        self.residency.begin_round()
        asked = self.residency.without_away(self.residency.missing(cells))
        self.residency.load(asked)
        return len(asked)

    def load_all(self, cells: Keys) -> None:
        """Rounds until no cell may be asked for: a round has room for a quarter of the table."""
        for _ in range(9):
            if not self.load(cells):
                return
        raise AssertionError("cells are asked for again and again")

    def known(self, cells: Keys) -> NDArray[np.bool_]:
        return np.asarray(self.residency.slots_of(cells) != UNKNOWN)


def begun(folder: Path, table: CellTable, *, is_silent: bool = False) -> Setting:
    env = make(folder)
    scatter(env)
    away, clock = folder / "away", Clock()
    opened = open_store(env.url, read_only=True)
    store = Halved(opened, away=str(away), is_silent=is_silent)
    residency = Residency(cast("Store", store), table, clock=clock)
    cells = cells_of(env.grid)
    is_upper = cells >> 32 >= env.grid.side >> 6
    return Setting(env, store, residency, clock, away, cells[~is_upper], cells[is_upper])


@pytest.fixture
def table() -> Iterator[CellTable]:
    with CellTable.create(LEAST_BUDGET) as made:
        yield made


@pytest.fixture
def scene(tmp_path: Path, table: CellTable) -> Setting:
    return begun(tmp_path, table)


# --- ranges ---------------------------------------------------------------------------------------

BORDERS = st.lists(st.integers(0, 60), max_size=12, unique=True).map(sorted)


@given(BORDERS, st.lists(st.tuples(st.integers(0, 60), st.integers(0, 9)), max_size=8))
def test_a_range_meets_what_is_away_if_they_have_a_key_in_common(
    borders: list[int], ranges: list[tuple[int, int]]
) -> None:
    away = np.array(borders[: len(borders) // 2 * 2], dtype=np.int64).reshape(-1, 2)
    gone = {key for low, high in away.tolist() for key in range(low, high + 1)}
    lows = np.array([low for low, _ in ranges], dtype=np.int64)
    highs = lows + np.array([more for _, more in ranges], dtype=np.int64)
    assert meeting(away, lows, highs).tolist() == [
        bool(gone & set(range(low, high + 1)))
        for low, high in zip(lows.tolist(), highs.tolist(), strict=True)
    ]


# --- when cells are asked for again ---------------------------------------------------------------


def test_cells_that_were_away_are_asked_for_again_after_a_pause_that_grows() -> None:
    clock = Clock()
    away = AwayCells(clock)
    cells, gone = np.arange(4), np.array([False, True, True, False])
    pauses = []
    for _ in range(6):
        away.note(cells, gone, NOBODY)
        assert away.without(cells).tolist() == [0, 3]
        away.note(np.array([9]), np.array([True]), NOBODY)  # does not put the others off
        away.note(np.array([7]), np.array([False]), NOBODY)
        assert away.without(np.array([9, 7])).tolist() == [7]
        began = clock.now
        while not away.is_due(NOBODY):
            away.release(NOBODY)
            assert len(away) == 3
            clock.now += ASK_AGAIN[0] / 4
        pauses.append(clock.now - began)
        away.release(NOBODY)
        assert away.without(cells).tolist() == cells.tolist()
    assert pauses == pytest.approx([0.05, 0.1, 0.2, 0.4, 0.5, 0.5], abs=0.013)
    away.note(cells, np.zeros(4, dtype=np.bool_), NOBODY)  # the shard is back
    away.note(cells, gone, NOBODY)
    clock.now += ASK_AGAIN[0]
    assert away.is_due(NOBODY)


@pytest.mark.parametrize("now", [(), ("shard 3 (c)",), ("shard 2 (b)", "shard 3 (c)")])
def test_cells_are_asked_for_at_once_when_other_shards_are_away(now: tuple[str, ...]) -> None:
    away = AwayCells(Clock())
    away.note(np.arange(2), np.ones(2, dtype=np.bool_), ("shard 2 (b)",))
    assert not away.is_due(("shard 2 (b)",))
    away.note(np.array([7]), np.array([True]), now)
    assert away.is_due(now)
    away.release(now)
    assert not len(away)


def test_nothing_is_due_while_nothing_was_away() -> None:
    away = AwayCells(Clock())
    away.note(np.arange(2), np.zeros(2, dtype=np.bool_), NOBODY)
    assert not away.is_due(("shard 2 (b)",))


# --- cells ----------------------------------------------------------------------------------------


def test_cells_of_a_shard_that_is_away_stay_unknown_and_the_others_are_published(
    scene: Setting,
) -> None:
    scene.away.touch()
    cells = np.concatenate([scene.upper[:9], scene.lower[:9]])
    loaded = scene.residency.load(scene.residency.missing(cells))
    assert (loaded.cells, loaded.n_away) == (9, 9)
    assert scene.known(cells).tolist() == [False] * 9 + [True] * 9
    assert check(scene.residency, voxels_by_cell(scene.env)) == 9
    assert scene.residency.shards_away == (SHARD,)
    scene.away.unlink()
    assert scene.load(cells) == 9
    assert scene.known(cells).all()
    assert check(scene.residency, voxels_by_cell(scene.env)) == 18


def test_cells_with_distances_likewise(tmp_path: Path) -> None:
    with make(tmp_path) as env, CellTable.create(8 << 20, distances=True) as table:
        write_points(env.store, np.array([[63.5, 12.5, 12.5]]))  # on the border of the halves
        away = tmp_path / "away"
        residency = Residency(cast("Store", Halved(env.store, away=str(away))), table)
        below, above = np.array([1 << 32]), np.array([2 << 32])
        away.touch()
        for _ in range(2):
            residency.load(residency.missing(np.concatenate([above, below])))
        assert residency.slots_of(above) == UNKNOWN
        (slot,) = residency.slots_of(below)
        assert slot > 0
        away.unlink()
        residency.make_resident(np.concatenate([above, below]))
        (slot,) = residency.slots_of(above)
        assert slot > 0
        assert table.cells.payload is not None
        assert table.cells.payload[slot].any()


def test_cells_that_are_away_are_not_asked_for_in_each_round(
    tmp_path: Path, table: CellTable
) -> None:
    """Also when the store does not tell which shards are away."""
    scene = begun(tmp_path, table, is_silent=True)
    scene.away.touch()
    cells = np.concatenate([scene.upper, scene.lower])
    for _ in range(200):
        scene.load(cells)
        scene.clock.now += 1e-3
    assert scene.known(scene.lower).all()
    assert 2 <= scene.store.n_refused <= 4
    scene.away.unlink()
    scene.clock.now += ASK_AGAIN[1]
    scene.load_all(cells)
    assert scene.known(cells).all()


def test_writes_make_touched_cells_of_a_shard_that_is_away_unknown_and_no_others(
    scene: Setting,
) -> None:
    cells = np.concatenate([scene.upper, scene.lower])
    scene.load_all(cells)
    assert scene.known(cells).all()
    scene.away.touch()
    move(scene.env.store, 1, block((5, 5, 5), (9, 9, 9)))  # leaves places in both halves
    scene.residency.refresh()
    assert scene.residency.revision == scene.env.store.revision()
    assert scene.known(scene.lower).all()
    assert 0 < np.count_nonzero(~scene.known(scene.upper)) < len(scene.upper)
    assert check(scene.residency, voxels_by_cell(scene.env)) == np.count_nonzero(scene.known(cells))
    assert scene.load(cells) == 0  # they were away a moment ago
    scene.away.unlink()
    scene.load_all(cells)
    assert scene.known(cells).all()
    check(scene.residency, voxels_by_cell(scene.env))


STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("load"), st.integers(0, 63), st.integers(1, 64)),
        st.tuples(st.just("move"), st.integers(1, 3), st.integers(0, 99)),
        st.tuples(st.sampled_from(["go", "return", "refresh", "outdated"]), st.just(0), st.just(0)),
        st.tuples(st.just("pass"), st.integers(1, 9), st.just(0)),
    ),
    min_size=1,
    max_size=16,
)


@given(STEPS)
@settings(deadline=None, max_examples=25)
def test_whatever_is_published_is_what_the_database_holds(
    tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[str, int, int]]
) -> None:
    """A shard goes and comes back, others write, in any order; at the end all cells are there."""
    with CellTable.create(LEAST_BUDGET) as table:
        scene = begun(tmp_path_factory.mktemp("steps"), table)
        cells = np.random.default_rng(0).permutation(np.concatenate([scene.lower, scene.upper]))
        for kind, first, second in steps:
            if kind == "load":
                scene.load(cells[first : first + second])
            elif kind == "move":
                at = np.random.default_rng(second).integers(0, 110, 3)
                move(scene.env.store, first, block(at, at + 11))
            elif kind == "go":
                scene.away.touch()
            elif kind == "return":
                scene.away.unlink(missing_ok=True)
            elif kind == "pass":
                scene.clock.now += 0.1 * first
            else:
                scene.store.n_outdated = int(kind == "outdated")
                scene.residency.refresh()
            if scene.residency.revision == scene.env.store.revision():
                check(scene.residency, voxels_by_cell(scene.env))
        scene.away.unlink(missing_ok=True)
        scene.store.n_outdated = 0
        scene.load_all(cells)
        assert scene.known(cells).all()
        check(scene.residency, voxels_by_cell(scene.env))
        scene.env.close()


def test_a_statement_that_was_outdated_is_repeated_in_a_snapshot(scene: Setting) -> None:
    scene.store.n_outdated = 1
    loaded = scene.residency.load(scene.lower[:9])
    assert loaded.cells == 9
    assert check(scene.residency, voxels_by_cell(scene.env)) == 9


# --- work that needs all cells --------------------------------------------------------------------


def test_work_that_needs_all_cells_says_which_shard_is_away(
    scene: Setting, sphere: PointShell
) -> None:
    frames = ResidentFrames(scene.residency, sphere)
    left, right = np.eye(4), np.eye(4)
    left[0, 3], right[0, 3] = -0.08, 0.08
    expected = frames.feel(right)
    scene.away.touch()
    frames.feel(right)  # in memory already
    frames.feel(left)
    right[1, 3] = 0.08
    with pytest.raises(ShardAwayError, match=r"shard 2 \(server2\) of .* is away, with \d+ of"):
        frames.feel(right)
    scene.away.unlink()
    assert not frames.feel(right).unknown.any()
    right[1, 3] = 0.0
    assert (frames.feel(right).wrenches == expected.wrenches).all()
    frames.close()


def test_a_shard_that_came_back_in_the_middle_has_no_name_in_the_error(
    tmp_path: Path, table: CellTable
) -> None:
    scene = begun(tmp_path, table, is_silent=True)
    scene.away.touch()
    with pytest.raises(ShardAwayError, match=r"^a shard of .* is away, with 4 of the cells"):
        scene.residency.make_resident(scene.upper[:4])


def test_costs_are_not_measured_while_a_shard_is_away(
    scene: Setting, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(store: Store) -> CostModel:
        raise ShardAwayError(f"{store.url} is away")

    store = cast("Store", scene.store)
    monkeypatch.setattr(costs, "calibrate", refuse)
    assert costs.costs_at_start(store, lambda: 0.0) == CostModel.of_equal_parts()
    scene.away.touch()
    monkeypatch.setattr(costs, "calibrate", None)
    assert costs.costs_at_start(store, lambda: 0.0) == CostModel.of_equal_parts()


def test_a_store_on_one_server_has_no_shards(tmp_path: Path, table: CellTable) -> None:
    with make(tmp_path) as env:
        write_voxels(env.store, block((3, 3, 3), (9, 9, 9)))
        assert shards_away(env.store) == ()
        residency = Residency(env.store, table)
        residency.make_resident(cells_of(env.grid))
        assert (residency.shards_away, residency.is_due) == ((), False)

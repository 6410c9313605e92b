"""Only clusters that a changed cell concerns wake; nothing else about a frame changes."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hapticdb.kernels.large.waking import WOKEN
from hapticdb.kernels.resident import cell_table
from hapticdb.kernels.resident.cells import CHANGES_KEPT, UNKNOWN
from hapticdb.query.law import ForceLaw
from hapticdb.resident.frames import FeltFrames, ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import CellTable
from hapticdb.resident.writer import UnpublishedCells
from hapticdb.store.base import NO_KEYS, Keys
from hapticdb.store.connect import open_store
from realtime.worlds import cells_of
from resident.test_sleeping import rod, same, scene, walk

Poses = NDArray[np.float64]
LAWS = ["plane", "distance"]


class World(NamedTuple):
    """Residency of an environment that another connection edits, without cells."""

    residency: Residency
    law: ForceLaw | None
    place: Callable[[int], None]
    cells: Keys

    def frames(self, n_points: int, seed: int, length: float, run: int) -> ResidentFrames:
        """Frames of a rod that fetch nothing: cells that are not there are unknown."""
        made = ResidentFrames(
            self.residency, rod(n_points, seed, length), self.law, run=run, sleeps=run > 0
        )
        made.fetch = len  # type: ignore[method-assign, assignment]
        return made

    def evict(self, cells: Keys) -> None:
        """Forget known cells (n,)."""
        writer = self.residency.writer
        known = cells[self.residency.slots_of(cells) != UNKNOWN]
        writer.publish(known, UnpublishedCells(), NO_KEYS, self.residency.revision)

    def load(self, cells: Keys) -> None:
        """Read those of cells (n,) that are unknown."""
        missing = self.residency.missing(cells)
        if len(missing):
            self.residency.load(missing)


@contextmanager
def world(folder: Path, law: str) -> Iterator[World]:
    """An object near the middle of a grid of 4^3 cells, or 2^3 with distances."""
    with (
        scene(folder, law) as (env, for_frames, place),
        CellTable.create(4 << 20, distances=law == "distance") as table,
    ):
        residency = Residency(open_store(env.url, read_only=True), table)
        yield World(residency, for_frames, place, cells_of(env.grid))


def expect_same(sleeping: ResidentFrames, flat: ResidentFrames, poses: Poses) -> FeltFrames:
    """Assert that both feel the same, bit for bit, and miss the same cells."""
    expected = flat.feel(poses)
    assert same(sleeping.feel(poses), expected)
    assert set(sleeping.missed[1 : 1 + sleeping.missed[0]].tolist()) == set(
        flat.missed[1 : 1 + flat.missed[0]].tolist()
    )
    return expected


@pytest.mark.parametrize("law", LAWS)
@given(st.integers(0, 100_000))
@settings(deadline=None, max_examples=4)
def test_frames_equal_the_flat_loop_while_cells_come_go_and_change(
    tmp_path_factory: pytest.TempPathFactory, law: str, seed: int
) -> None:
    """Cells are loaded and evicted, objects move, and the hand moves, turns and jumps."""
    rng = np.random.default_rng(seed)
    with world(tmp_path_factory.mktemp("waking"), law) as made:
        run = int(rng.choice([1, 8, 64]))
        length = float(rng.choice([0.02, 0.12]))
        step = float(rng.choice([1e-4, 2e-3]))
        n_points = int(rng.integers(1, 3000))
        flat = made.frames(n_points, seed, length, 0)
        sleeping = made.frames(n_points, seed, length, run)
        poses = walk(45, seed, step, float(rng.choice([0.02, 0.1])))
        for at in range(0, 45, 3):
            some = rng.permutation(made.cells)[: int(rng.integers(1, len(made.cells) + 1))]
            what = rng.integers(0, 5)
            if what <= 1:
                made.load(some)
            elif what == 2:
                made.evict(some)
            elif what == 3:
                made.place(int(rng.integers(30, 56 if law == "distance" else 90)))
                made.residency.refresh()
            expect_same(sleeping, flat, poses[at : at + 3])


@pytest.mark.parametrize("law", LAWS)
def test_clusters_far_from_a_changed_cell_sleep_on(tmp_path: Path, law: str) -> None:
    """A rod lies through a row of cells beside the object; one cell at its end changes."""
    with world(tmp_path, law) as made:
        made.load(made.cells)
        length = 0.2 if law == "plane" else 0.12
        sleeping, flat = (made.frames(4000, 1, length, run) for run in (16, 0))
        pose = np.eye(4)[None]
        pose[:, 1:3, 3] = -0.04
        expect_same(sleeping, flat, pose)
        kept = sleeping.asleep.sleepers
        asleep = int((kept.run_rests[:, 3] >= 0.0).sum())
        assert asleep > 100
        furthest = made.cells[-1:]
        made.evict(furthest)
        expect_same(sleeping, flat, pose)
        made.load(furthest)
        expect_same(sleeping, flat, pose)
        assert kept.state[WOKEN] == 0
        made.evict(made.cells[:1] + (0 if law == "distance" else (1 << 16) + 1))
        expect_same(sleeping, flat, pose)
        assert 0 < kept.state[WOKEN] < 0.8 * asleep


def test_all_clusters_wake_when_changes_were_lost(tmp_path: Path) -> None:
    """More cells change between two frames than are kept; an edit is among them."""
    with world(tmp_path, "plane") as made:
        made.load(made.cells)
        sleeping, flat = (made.frames(2000, 1, 0.12, run) for run in (16, 0))
        pose = np.eye(4)[None]
        made.place(90)
        made.residency.refresh()
        made.load(made.cells)
        expect_same(sleeping, flat, pose)
        kept = sleeping.asleep.sleepers
        asleep = int((kept.run_rests[:, 3] >= 0.0).sum())
        made.place(62)
        made.residency.refresh()
        made.load(made.cells)
        table = made.residency.table
        others = np.full(CHANGES_KEPT, 63 << 32)
        cell_table.publish(table.cells.control, table.version, made.residency.revision, others)
        felt = expect_same(sleeping, flat, pose)
        assert felt.hits[0] > 0
        assert kept.state[WOKEN] == asleep

"""Frames over resident cells with distances equal those over the database's rows, bit for bit."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from banded import move_points, write_points
from hapticdb import Environment
from hapticdb.errors import UsageError
from hapticdb.grid import CurveName
from hapticdb.query.law import PLANE, SMOOTH, ForceLaw
from hapticdb.resident.frames import ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import LEAST_BUDGET, CellTable
from hapticdb.store.connect import open_store
from realtime.worlds import cloud, make, poses_in

BUDGET = 8 << 20
LAWS: list[ForceLaw] = [SMOOTH, PLANE]
Wrenches = NDArray[np.float64]


def scene(env: Environment) -> dict[int, Wrenches]:
    """Sheets of points, a third of a voxel apart, through borders of cells; id -> points."""
    objects = {}
    middle = env.grid.side / 2
    across = np.argwhere(np.ones((40, 40))) / 3.0 - 7.0
    for axis in range(3):
        points = np.insert(across, axis, 0.3 * axis, axis=1) + middle + 2.0 * axis
        objects[write_points(env.store, points, f"sheet {axis}")] = points
    return objects


@pytest.mark.parametrize("curve", ["z", "hilbert"])
def test_both_laws_feel_the_same_in_memory_as_in_the_database(
    tmp_path: Path, curve: CurveName
) -> None:
    """With an object left out, flat and in clusters, and after another user's move."""
    env = make(tmp_path, 7, "brick", curve)
    objects = scene(env)
    shell = cloud(200, seed=1, extent=4.0 * env.grid.voxel_size)
    poses = poses_in(env.grid, 5)
    poses[:, :3, 3] *= 0.12  # around the middle, where the objects are
    store = open_store(env.url, read_only=True)
    for run, exclude in ((0, []), (8, [2])):
        with CellTable.create(BUDGET, distances=True) as table:
            residency = Residency(store, table, exclude)
            both = [(law, ResidentFrames(residency, shell, law, run=run)) for law in LAWS]
            for _ in range(2):
                n_hits = []
                for law, frames in both:
                    felt, hits = frames.wrenches(poses)
                    assert law is PLANE or felt.any(axis=1).sum() > 2
                    n_hits.append(hits.tolist())
                    for wrench, pose in zip(felt, poses, strict=True):
                        touch = env.touch(shell, pose, exclude=exclude, law=law)
                        same = np.concatenate([touch.force, touch.torque])
                        assert (wrench + 0.0).tobytes() == (same + 0.0).tobytes()
                assert n_hits[0] == n_hits[1]
                objects[1] = objects[1] + np.array([1.0, -2.0, 3.5])
                move_points(env.store, 1, objects[1])
                residency.refresh()


def test_a_law_that_reads_distances_demands_cells_that_have_them(tmp_path: Path) -> None:
    env = make(tmp_path)
    with CellTable.create(LEAST_BUDGET) as table:
        residency = Residency(env.store, table)
        with pytest.raises(UsageError, match=r"reads distances.*CellTable.create\(distances=True"):
            ResidentFrames(residency, cloud(5), SMOOTH)

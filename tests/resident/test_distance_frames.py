"""Frames over resident cells with distances equal those over the database's rows, bit for bit."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from banded import move_points, write_points
from hapticdb import Environment, PointShell
from hapticdb.errors import UsageError
from hapticdb.grid import CurveName
from hapticdb.kernels.field.law import DistanceFieldLaw
from hapticdb.kernels.field.packing import unpack
from hapticdb.kernels.query import contact, refining
from hapticdb.resident.frames import ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import LEAST_BUDGET, CellTable
from hapticdb.store.base import BRICK_SHIFT
from hapticdb.store.connect import open_store
from realtime.worlds import make, poses_in

BUDGET = 8 << 20
Wrenches = NDArray[np.float64]


class Smooth:
    """The distance law of 1000 N/m."""

    stiffness = 1000.0
    for_kernels = DistanceFieldLaw(stiffness)


def scene(env: Environment) -> dict[int, Wrenches]:
    """Sheets of points, a third of a voxel apart, through borders of cells; id -> points."""
    objects = {}
    middle = env.grid.side / 2
    across = np.argwhere(np.ones((40, 40))) / 3.0 - 7.0
    for axis in range(3):
        points = np.insert(across, axis, 0.3 * axis, axis=1) + middle + 2.0 * axis
        objects[write_points(env.store, points, f"sheet {axis}")] = points
    return objects


def ball(n_points: int, env: Environment) -> PointShell:
    """Points in a ball of 8 voxels with random normals, neighbours by index near in space."""
    rng = np.random.default_rng(1)
    normals = rng.normal(size=(n_points, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    points = rng.uniform(-8.0, 8.0, (n_points, 3)) * env.grid.voxel_size
    return PointShell(points[np.argsort(points[:, 0])], normals, np.array([0.001, 0.0, -0.002]))


def on_database(
    env: Environment, shell: PointShell, pose: Wrenches, exclude: list[int]
) -> tuple[Wrenches, int]:
    """Wrench and number of hits of a frame on rows of the database."""
    grid, origin = env.grid, np.array(env.grid.origin)
    placed, asked, keys = contact.locate(
        shell.points, shell.normals, shell.center, pose, origin, grid.voxel_size, grid.bits,
        grid.curve_code, BRICK_SHIFT,
    )  # fmt: skip
    rows = env.store.lookup(keys, distances=True)
    assert rows.distances is not None
    values = unpack(rows.distances.data, rows.distances.ends)
    felt = refining.refine(
        placed, asked, keys, rows.keys, rows.ids, rows.occupancy, values, np.array(exclude, int),
        origin, grid.voxel_size, Smooth().for_kernels,
    )  # fmt: skip
    return felt[0], len(felt[1])


@pytest.mark.parametrize("curve", ["z", "hilbert"])
def test_both_laws_feel_the_same_in_memory_as_in_the_database(
    tmp_path: Path, curve: CurveName
) -> None:
    """With an object left out, flat and in clusters, and after another user's move."""
    env = make(tmp_path, 7, "brick", curve)
    objects = scene(env)
    shell = ball(200, env)
    poses = poses_in(env.grid, 5)
    poses[:, :3, 3] *= 0.12  # around the middle, where the objects are
    store = open_store(env.url, read_only=True)
    for run, exclude in ((0, []), (8, [2])):
        with CellTable.create(BUDGET, distances=True) as table:
            residency = Residency(store, table, exclude)
            smooth = ResidentFrames(residency, shell, Smooth(), run=run)
            plane = ResidentFrames(residency, shell, run=run)
            for _ in range(2):
                felt, hits = smooth.wrenches(poses)
                flat, flat_hits = plane.wrenches(poses)
                assert felt.any(axis=1).sum() > 2
                for n, pose in enumerate(poses):
                    wrench, count = on_database(env, shell, pose, exclude)
                    assert (felt[n] + 0.0).tobytes() == (wrench + 0.0).tobytes()
                    assert hits[n] == flat_hits[n] == count
                    touch = env.touch(shell, pose, exclude=exclude, law="plane")
                    same = np.concatenate([touch.force, touch.torque])
                    assert (flat[n] + 0.0).tobytes() == (same + 0.0).tobytes()
                objects[1] = objects[1] + np.array([1.0, -2.0, 3.5])
                move_points(env.store, 1, objects[1])
                residency.refresh()


def test_a_law_that_reads_distances_demands_cells_that_have_them(tmp_path: Path) -> None:
    env = make(tmp_path)
    with CellTable.create(LEAST_BUDGET) as table:
        residency = Residency(env.store, table)
        with pytest.raises(UsageError, match=r"reads distances.*CellTable.create\(distances=True"):
            ResidentFrames(residency, ball(5, env), Smooth())

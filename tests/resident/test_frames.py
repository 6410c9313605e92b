"""A frame against resident cells equals the frame against the database, bit for bit."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from banded import move_points, write_points
from hapticdb import Environment, PointShell
from hapticdb.errors import UsageError
from hapticdb.grid import CurveName
from hapticdb.query.law import DISTANCE, PLANE, ForceLaw
from hapticdb.resident.frames import ResidentFrames
from hapticdb.resident.point_runs import RUN
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import LEAST_BUDGET, CellTable
from hapticdb.store.base import Layout
from hapticdb.store.connect import open_store
from naive_frame import touch_of_shell
from session.worlds import HIERARCHICAL, cloud, ids_by_voxel, make, poses_in, scatter
from voxels import write_voxels


@pytest.mark.parametrize("bits", [3, 6])
@pytest.mark.parametrize(("layout", "curve"), HIERARCHICAL)
def test_resident_frames_equal_oracle_bits(
    tmp_path: Path, layout: Layout, curve: CurveName, bits: int
) -> None:
    """In each layout and curve, inside and outside the grid, with an object left out, clustered."""
    env = make(tmp_path, bits, layout, curve)
    scatter(env, n_voxels=min(8**bits // 4, 4000))
    ids = ids_by_voxel(env)
    shell = cloud(150, extent=env.grid.edge / 12)
    poses = poses_in(env.grid, 6)
    for run, exclude in ((0, []), (8, [2])):
        with CellTable.create(LEAST_BUDGET) as table:
            frames = ResidentFrames(Residency(env.store, table, exclude), shell, run=run)
            collides = frames.collides(poses)
            felt = frames.evaluate(poses)
            frames.close()
        assert collides.tolist() == (felt.hits > 0).tolist()
        assert felt.hits.any()
        assert not felt.unknown.any()
        for n, pose in enumerate(poses):
            naive = touch_of_shell(ids, env.grid, shell, pose, exclude)
            wrench = np.array([*naive.force, *naive.torque])
            assert (felt.wrenches[n] + 0.0).tobytes() == (wrench + 0.0).tobytes()
            assert felt.hits[n] == len(naive.hits)
            assert felt.contacts[n] == len(naive.contacts)
            assert felt.deepest[n] == max(naive.depths, default=0.0)
            touch = env.touch(shell, pose, exclude=exclude)
            assert (wrench + 0.0).tobytes() == (
                np.concatenate([touch.force, touch.torque]) + 0.0
            ).tobytes()


def test_resident_frames_tool_beyond_table(tmp_path: Path) -> None:
    env = make(tmp_path, bits=8)
    voxels = np.random.default_rng(0).integers(0, 256, (60_000, 3))
    write_voxels(env.store, np.unique(voxels, axis=0))
    with CellTable.create(LEAST_BUDGET) as table:
        assert table.n_slots < 512
        larger = ResidentFrames(Residency(env.store, table), cloud(5000, extent=0.1))
        with pytest.raises(UsageError, match=r"more than fit into .*give a larger budget"):
            larger.evaluate(np.eye(4))


def test_resident_frames_margin_beyond_table(tmp_path: Path) -> None:
    """Small clusters far apart: each lies in one cell, and with a margin touches up to eight."""
    env = make(tmp_path, bits=9)
    size = env.grid.voxel_size
    rng = np.random.default_rng(1)
    middles = np.array(env.grid.origin) + size * (32.0 * rng.integers(1, 15, (90, 3)) + 1.0)
    points = np.repeat(middles, RUN, axis=0) + rng.uniform(0.0, size, (90 * RUN, 3))
    normals = np.tile((0.0, 0.0, 1.0), (len(points), 1))
    shell = PointShell(points, normals, np.zeros(3))
    write_voxels(env.store, env.grid.voxels_of(middles))
    with CellTable.create(LEAST_BUDGET) as table:
        frames = ResidentFrames(Residency(env.store, table), shell)
        n_cells = len(np.unique(env.grid.voxels_of(points) // 32, axis=0))
        assert n_cells <= (table.n_slots - 1) // 2 < 8 * n_cells
        felt = frames.evaluate(np.eye(4))
        assert (felt.unknown[0], felt.hits[0]) == (0, len(points))


BUDGET = 8 << 20
LAWS: list[ForceLaw] = [DISTANCE, PLANE]
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
def test_resident_frames_equal_database_frames(tmp_path: Path, curve: CurveName) -> None:
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
                    felt, hits = frames.evaluate(poses)[:2]
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


def test_resident_frames_distance_law_needs_distances(tmp_path: Path) -> None:
    env = make(tmp_path)
    with CellTable.create(LEAST_BUDGET) as table:
        residency = Residency(env.store, table)
        with pytest.raises(UsageError, match=r"reads distances.*CellTable.create\(distances=True"):
            ResidentFrames(residency, cloud(5), DISTANCE)

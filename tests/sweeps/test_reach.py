"""How far a look at one pose may carry: the proved distance is never above the exact one.

Voxels are the objects here, and single points the tool, so that bounds have no slack to hide in: a
reach, a way or a radius that is too small proves too much. The exact distances are plain formulas.
"""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import hapticdb
from hapticdb import Environment, Grid, PointShell
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import LEAST_BUDGET, CellTable
from hapticdb.sweeps.deciding import Decider
from hapticdb.sweeps.path import SweepPath
from hapticdb.sweeps.result import Decision
from hapticdb.testing import write_voxels
from naive_motion import middle_of, placed, poses_at

Floats = NDArray[np.float64]

SIZE = 0.01
GRID = Grid(SIZE, (0.0, 0.0, 0.0), 7)
ROUND = 1e-8
"""Metres: more than rounding errors."""
ALONG = np.array([1.0, -1.0, 0.0]) / np.sqrt(2.0)
OUT = np.array([-1.0, -1.0, 0.0]) / np.sqrt(2.0)
"""Past a voxel's edge along z, and away from the voxel."""
EDGE = SIZE * np.array([64.0, 64.0, 64.5])
"""A place on the edge of the voxel (64, 64, 64)."""


def scene(folder: Path, *voxels: tuple[int, int, int]) -> Environment:
    env = hapticdb.create(folder / "s.db", GRID)
    write_voxels(env.store, np.array(voxels, dtype=np.int64))
    return env


def tool(*points: Floats) -> PointShell:
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    return PointShell(np.array(points), normals, np.zeros(3), cover=0.0, is_closed=False)


def decided(env: Environment, shell: PointShell, poses: Floats, *, closer: bool) -> Decision:
    """What is proved by voxels at the samples; closer: and between them, in halves."""
    decider = Decider(shell, SweepPath.of(poses, shell, SIZE), SIZE, None, refines=False)
    with env.store.snapshot(), CellTable.create(LEAST_BUDGET) as table:
        residency = Residency(env.store, table, may_measure=False)
        decider.look_by_voxels(residency, has_distances=False)
        if closer:
            decider.look_closer(residency)
    return decider.decision(None)


def through(*places: Floats) -> Floats:
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = places
    return poses


def exact(points: Floats, poses: Floats, voxels: Floats, fine: int = 400) -> float:
    """Least distance of points on their way from voxels (V, 3), by poses of plain formulas."""
    times = np.linspace(0.0, len(poses) - 1.0, fine * max(len(poses) - 1, 1) + 1)
    there = placed(poses_at(poses, middle_of(points), times), points)[:, :, None] / SIZE
    gaps = np.maximum(np.maximum(voxels - there, there - voxels - 1.0), 0.0)
    return SIZE * float(np.linalg.norm(gaps, axis=-1).min())


@pytest.mark.parametrize("closer", [False, True], ids=["samples", "halves"])
@pytest.mark.parametrize("gap", [0.02, 0.12, 0.3])
def test_a_point_that_is_nearest_between_two_looks_keeps_no_more_than_its_gap(
    tmp_path: Path, gap: float, *, closer: bool
) -> None:
    """The edge is in the middle of the fifth of nine steps."""
    nearest = EDGE + gap * SIZE * OUT
    half = 0.5 * 4.49 * SIZE * ALONG
    with scene(tmp_path, (64, 64, 64)) as env:
        found = decided(
            env, tool(np.zeros(3)), through(nearest - half, nearest + half), closer=closer
        )
    assert found.is_clear == (closer or gap > 0.1)
    assert found.at_least <= gap * SIZE
    if found.is_clear and gap > 0.1:
        assert found.at_least > 0.0


@pytest.mark.parametrize("away", range(3, 16))
def test_a_wall_ahead_is_not_passed_unseen(tmp_path: Path, away: int) -> None:
    """From close beside a voxel, which makes looks short, straight through another one."""
    start = SIZE * np.array([40.0, 41.3, 40.5])
    end = start + SIZE * np.array([away + 14.0, 0.0, 0.0])
    with scene(tmp_path, (40, 40, 40), (40 + away, 41, 40)) as env:
        found = decided(env, tool(np.zeros(3)), through(start, end), closer=False)
    assert not found.is_clear


voxels = st.lists(st.tuples(*[st.integers(60, 68)] * 3), min_size=1, max_size=3, unique=True)
places = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array)


@pytest.mark.long
@settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40, deadline=None
)
@given(
    dots=voxels,
    points=st.lists(places, min_size=1, max_size=3),
    turns=st.lists(places, min_size=2, max_size=3),
    ways=st.lists(places, min_size=3, max_size=3),
    closer=st.booleans(),
)
def test_no_more_is_proved_than_points_keep_from_voxels(
    tmp_path_factory: pytest.TempPathFactory,
    dots: list[tuple[int, int, int]],
    points: list[Floats],
    turns: list[Floats],
    ways: list[Floats],
    *,
    closer: bool,
) -> None:
    shell = tool(*(3.0 * SIZE * point for point in points))
    poses = through(*(SIZE * (64.5 + 7.0 * way) for way in ways[: len(turns)]))
    poses[:, :3, :3] = Rotation.from_rotvec(0.7 * np.array(turns)).as_matrix()
    with scene(tmp_path_factory.mktemp("s"), *dots) as env:
        found = decided(env, shell, poses, closer=closer)
    least = exact(shell.points, poses, np.array(dots, dtype=float))
    if found.is_clear:
        assert least > 0.0
        assert found.at_least <= least + ROUND
    else:
        assert least < SIZE

"""Clusters that are skipped change nothing."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hapticdb import PointShell
from hapticdb.resident.frames import FrameResults, ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import LEAST_BUDGET, CellTable
from session.worlds import make, scatter, turned

Poses = NDArray[np.float64]


def rod(n_points: int, seed: int, length: float) -> PointShell:
    """A shell of random points along a rod, sorted along the rod, with random normals."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(n_points, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    points = rng.uniform(-0.5, 0.5, (n_points, 3)) * (length, 0.004, 0.004)
    return PointShell(points[np.argsort(points[:, 0])], normals, np.array([0.001, 0.002, -0.003]))


def walk(count: int, seed: int, step: float, reach: float) -> Poses:
    """Poses (count, 4, 4) of a hand that moves in steps, turns, and now and then jumps."""
    rng = np.random.default_rng(seed)
    place, axis = rng.uniform(-reach, reach, 3), turned(rng, np.zeros(3))
    poses = np.empty((count, 4, 4))
    for n in range(count):
        if rng.random() < 0.05:
            place = rng.uniform(-reach, reach, 3)
        place = np.clip(place + rng.normal(0.0, step, 3), -reach, reach)
        angle = rng.normal(0.0, 0.03)
        about = np.eye(4)
        about[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        axis = axis @ about
        poses[n] = axis
        poses[n, :3, 3] = place
    return poses


def same(one: FrameResults, other: FrameResults) -> bool:
    """Whether two results have the same bits."""
    return all((a + 0.0).tobytes() == (b + 0.0).tobytes() for a, b in zip(one, other, strict=True))


def in_parts(frames: ResidentFrames, poses: Poses, size: int) -> FrameResults:
    """The frames at all poses, a few at a time, as a session asks for them."""
    parts = [frames.evaluate(poses[at : at + size]) for at in range(0, len(poses), size)]
    return FrameResults(*(np.concatenate(column) for column in zip(*parts, strict=True)))


@given(st.integers(0, 10_000))
@settings(deadline=None, max_examples=4)
def test_cluster_skipping_same_bits(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    """Slow and fast hands that turn and jump, small and large runs, one pose or many at once."""
    env = make(tmp_path_factory.mktemp("clusters"))
    scatter(env, n_objects=2, n_voxels=600, seed=seed)
    rng = np.random.default_rng(seed)
    shell = rod(int(rng.integers(1, 6000)), seed, float(rng.choice([0.01, 0.1, 0.25])))
    poses = walk(60, seed, float(rng.choice([1e-5, 1e-3, 1e-2])), 0.15)
    with CellTable.create(LEAST_BUDGET) as table:
        residency = Residency(env.store, table)
        flat = ResidentFrames(residency, shell, run=0).evaluate(poses)
        for run in (1, int(rng.integers(2, 64)), 64, None):
            clustered = ResidentFrames(residency, shell, run=run)
            assert same(in_parts(clustered, poses, int(rng.integers(1, 20))), flat)
            clustered.close()
    env.close()

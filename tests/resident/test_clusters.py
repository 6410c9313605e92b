"""Clusters that are skipped change nothing; a budget of points gives the same in each replay."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from banded import move_points, write_points
from hapticdb import Environment, PointShell
from hapticdb.query.law import SMOOTH, ForceLaw
from hapticdb.resident.frames import FeltFrames, ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import LEAST_BUDGET, CellTable
from realtime.worlds import block, make, move, scatter, turned
from voxels import write_voxels

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


def same(one: FeltFrames, other: FeltFrames) -> bool:
    """Whether two results have the same bits, but for the number of points looked at."""
    return all(
        (getattr(one, name) + 0.0).tobytes() == (getattr(other, name) + 0.0).tobytes()
        for name in ("wrenches", "hits", "contacts", "unknown", "deepest")
    )


def in_parts(frames: ResidentFrames, poses: Poses, size: int) -> FeltFrames:
    """The frames at all poses, a few at a time, as a session asks for them."""
    parts = [frames.feel(poses[at : at + size]) for at in range(0, len(poses), size)]
    return FeltFrames(*(np.concatenate(column) for column in zip(*parts, strict=True)))


@given(st.integers(0, 10_000))
@settings(deadline=None, max_examples=4)
def test_clusters_change_nothing(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    """Slow and fast hands that turn and jump, small and large runs, one pose or many at once."""
    env = make(tmp_path_factory.mktemp("clusters"))
    scatter(env, n_objects=2, n_voxels=600, seed=seed)
    rng = np.random.default_rng(seed)
    shell = rod(int(rng.integers(1, 6000)), seed, float(rng.choice([0.01, 0.1, 0.25])))
    poses = walk(60, seed, float(rng.choice([1e-5, 1e-3, 1e-2])), 0.15)
    with CellTable.create(LEAST_BUDGET) as table:
        residency = Residency(env.store, table)
        flat = ResidentFrames(residency, shell, run=0).feel(poses)
        for run in (1, int(rng.integers(2, 64)), 64, None):
            clustered = ResidentFrames(residency, shell, run=run)
            assert same(in_parts(clustered, poses, int(rng.integers(1, 20))), flat)
            clustered.close()
            listing = ResidentFrames(residency, shell, run=run, budget_points=len(shell))
            assert same(listing.feel(poses), flat)
            listing.close()
    env.close()


def test_a_tool_far_from_everything_looks_at_no_point(tmp_path: Path) -> None:
    """And one that comes near with a tip looks at few."""
    env = make(tmp_path)
    write_voxels(env.store, block((64, 64, 64), (66, 66, 66)))
    shell = rod(8000, 0, 0.1)
    poses = np.tile(np.eye(4), (100, 1, 1))
    poses[:, 0, 3] = np.linspace(0.1, 0.05, 100)
    with CellTable.create(LEAST_BUDGET) as table:
        frames = ResidentFrames(Residency(env.store, table), shell, budget_points=len(shell))
        felt = frames.feel(poses)
    assert not felt.looked_at[:40].any()
    assert 0 < felt.looked_at[-1] < 2000
    assert felt.hits[-1] > 0


@contextmanager
def scene(
    folder: Path, law: str
) -> Iterator[tuple[Environment, ForceLaw | None, Callable[[int], None]]]:
    """An environment with an object near the middle, its law, and what moves the object."""
    env = make(folder, bits=7 if law == "plane" else 6)
    points = np.argwhere(np.ones((8, 8, 8))) / 1.5 + 30.0
    if law == "plane":
        write_voxels(env.store, block((62, 60, 60), (68, 68, 68)))
    else:
        write_points(env.store, points)

    def place(at: int) -> None:
        if law == "plane":
            move(env.store, 1, block((at, 60, 60), (at + 6, 68, 68)))
        else:
            move_points(env.store, 1, points + np.array([at - 62.0, 0.0, 0.0]))

    yield env, None if law == "plane" else SMOOTH, place
    env.close()


@pytest.mark.parametrize("which", ["plane", "distance"])
def test_a_budget_is_kept_and_is_the_same_in_any_order(tmp_path: Path, which: str) -> None:
    """Within it nothing changes. The order and number of poses asked at once do not matter."""
    shell = rod(5000, 3, 0.08)
    poses = walk(40, 4, 5e-4, 0.02)
    with (
        scene(tmp_path, which) as (env, law, _),
        CellTable.create(8 << 20, distances=law is not None) as table,
    ):
        residency = Residency(env.store, table)
        full = ResidentFrames(residency, shell, law, budget_points=len(shell)).feel(poses)
        assert not full.left_out.any()
        budget = int(np.median(full.looked_at[full.looked_at > 0]))
        first = ResidentFrames(residency, shell, law, budget_points=budget)
        felt = first.feel(poses)
        assert (felt.looked_at <= budget).all()
        assert ((felt.looked_at + felt.left_out) == full.looked_at).all()
        within = full.looked_at <= budget
        assert within.any()
        assert not within.all()
        assert (felt.left_out[within] == 0).all()
        assert felt.wrenches[within].tobytes() == full.wrenches[within].tobytes()
        assert (felt.looked_at[~within] > budget // 2).all()
        second = ResidentFrames(residency, shell, law, budget_points=budget)
        order = np.random.default_rng(0).permutation(len(poses))
        again = in_parts(second, poses[order], 3)
        for one, other in zip(felt, again, strict=True):
            assert one[order].tobytes() == other.tobytes()


SIDE_OF_SHEET = 64
"""Points of the sheet below on each side."""


def sheet(pitch: float) -> PointShell:
    """A square sheet of points in Z-order, as files give it: row y, column x."""
    n = np.arange(SIDE_OF_SHEET**2)
    x, y = (sum((n >> 2 * bit + axis & 1) << bit for bit in range(6)) for axis in (0, 1))
    points = np.stack([x, y, np.zeros_like(x)], axis=1) * pitch
    return PointShell(points, np.tile([0.0, 0.0, 1.0], (len(n), 1)), np.zeros(3))


def test_beyond_the_budget_each_row_of_a_sheet_keeps_its_share_of_hits(tmp_path: Path) -> None:
    """One row of points lies in a bar one voxel wide: a choice in a pattern misses such rows."""
    env = make(tmp_path)
    pitch = env.grid.voxel_size
    write_voxels(env.store, block((32, 64, 64), (95, 64, 64)))
    place = env.grid.origin + (np.array([32, 64, 64]) + 0.5) * pitch
    shares = []
    with CellTable.create(8 << 20) as table:
        residency = Residency(env.store, table)
        whole = ResidentFrames(residency, sheet(pitch), budget_points=SIDE_OF_SHEET**2)
        part = ResidentFrames(residency, sheet(pitch), budget_points=128)
        for row in range(SIDE_OF_SHEET):
            pose = np.eye(4)
            pose[:3, 3] = place - [0.0, row * pitch, 0.0]
            felt, some = whole.feel(pose), part.feel(pose)
            assert felt.hits[0] == SIDE_OF_SHEET
            assert 64 <= some.looked_at[0] <= 128
            shares.append(some.hits[0] / some.looked_at[0] * felt.looked_at[0] / felt.hits[0])
    assert min(shares) > 0.0
    assert np.mean(shares) == pytest.approx(1.0, abs=0.1)
    assert np.std(shares) < 0.5


def test_beyond_the_budget_the_indices_of_hits_are_those_of_the_shell(tmp_path: Path) -> None:
    env = make(tmp_path)
    write_voxels(env.store, block((50, 50, 50), (78, 78, 78)))
    shell = rod(3000, 0, 0.05)
    with CellTable.create(LEAST_BUDGET) as table:
        residency = Residency(env.store, table)
        full = ResidentFrames(residency, shell, run=0)
        hit = set(full.hits[: full.feel(np.eye(4)).hits[0]].tolist())
        part = ResidentFrames(residency, shell, budget_points=200)
        felt = part.feel(np.eye(4))
        found = part.hits[: felt.hits[0]].tolist()
        assert 0 < len(found) <= 200
        assert found == sorted(set(found))
        assert set(found) <= hit

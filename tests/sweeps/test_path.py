"""What a path says of its motion, against plain formulas and densely sampled places of the tool."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticdb import PointShell
from hapticdb.pointshell.shell import fibonacci_sphere
from hapticdb.sweeps.path import FINEST, SweepPath
from naive_motion import middle_of, placed, poses_at

Floats = NDArray[np.float64]

SIZE = 0.01
RADIUS = 0.05
ROUND = 1e-9
"""Metres, at least: rounding errors, here and in the path."""
BALL = PointShell(RADIUS * fibonacci_sphere(100), -fibonacci_sphere(100), np.zeros(3), cover=0.004)
ROD = PointShell(
    np.array([[x, y, 0.01] for x in (-0.02, 0.18) for y in (0.0, 0.004)]),
    np.tile([0.0, 0.0, 1.0], (4, 1)), np.zeros(3), cover=0.0,
)  # fmt: skip

lengths = st.sampled_from([0.0, 1e-9, 1e-4, 0.003, 0.05, 0.2])
angles = st.one_of(
    st.sampled_from([0.0, 1e-13, 1e-9, 1e-5, 0.1, 1.5, 3.0, np.pi - 1e-9, np.pi]),
    st.floats(0.0, float(np.pi)),
)
directions = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)
moves = st.tuples(lengths, directions, angles, directions)


def unit(direction: Any) -> Floats:  # noqa: ANN401 - a triple
    return np.asarray(direction / np.linalg.norm(direction))


def path_poses(moved: list[Any], seed: int, middle: Floats) -> Floats:
    """A random pose, and poses that follow it by moves: length, direction, angle, axis."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.uniform(-1.0, 1.0, 3)
    poses = [pose]
    for length, way, angle, axis in moved:
        last, pose = poses[-1], np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(angle * unit(axis)).as_matrix() @ last[:3, :3]
        there = last[:3, :3] @ middle + last[:3, 3] + length * unit(way)
        pose[:3, 3] = there - pose[:3, :3] @ middle
        poses.append(pose)
    return np.array(poses)


@settings(max_examples=60, deadline=None)
@given(
    moved=st.lists(moves, min_size=1, max_size=3),
    seed=st.integers(0, 99),
    shell=st.sampled_from([BALL, ROD]),
    shares=st.lists(st.integers(0, FINEST), min_size=1, max_size=5),
)
def test_poses_between_samples_are_those_of_plain_formulas(
    moved: list[Any], seed: int, shell: PointShell, shares: list[int]
) -> None:
    middle = middle_of(shell.points)
    poses = path_poses(moved, seed, middle)
    path = SweepPath.of(poses, shell, SIZE)
    steps = np.diff(path.starts)
    for m, count in enumerate(steps.tolist()):
        places = path.starts[m] + count * (np.array(shares) // 2) / (FINEST // 2)
        places = np.rint(places * FINEST) / FINEST
        found = path.at(places)
        times = m + (places - path.starts[m]) / count
        expected = poses_at(poses, middle, times)
        nearly_pi = moved[m][2] > np.pi - 1e-6  # either way round is a smallest turn
        if not nearly_pi:
            assert np.allclose(found, expected, atol=1e-8)
        here, there = (placed(poses, middle[None]) for poses in (found, expected))
        assert np.allclose(here, there, atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(axis=directions, seed=st.integers(0, 99), share=st.integers(0, FINEST))
def test_half_a_turn_goes_evenly_one_way_round(axis: Any, seed: int, share: int) -> None:  # noqa: ANN401
    poses = path_poses([(0.0, (1, 0, 0), np.pi, axis)], seed, np.zeros(3))
    path = SweepPath.of(poses, BALL, SIZE)
    place = np.rint((len(path) - 1) * share) / FINEST
    turn = path.at(np.array([place]))[0, :3, :3] @ poses[0, :3, :3].T
    expected = np.pi * place / (len(path) - 1)
    found = Rotation.from_matrix(turn).as_rotvec()
    assert np.linalg.norm(found) == pytest.approx(expected, abs=1e-6)
    assert np.linalg.norm(np.cross(found, unit(axis))) == pytest.approx(0.0, abs=1e-6)


@settings(max_examples=60, deadline=None)
@given(
    moved=st.lists(moves, min_size=1, max_size=3),
    seed=st.integers(0, 99),
    shell=st.sampled_from([BALL, ROD]),
    spread=st.sampled_from([0.0, 2e-7]),
    share=st.floats(0.0, 1.0),
    half=st.sampled_from([0.0, 0.5, 0.25, 1.0 / 64.0]),
)
def test_reaches_bound_the_way_to_a_place_and_around_it(
    moved: list[Any], seed: int, shell: PointShell, spread: float, share: float, half: float
) -> None:
    """Of the points, and of all places that they cover.

    spread: what given poses deviate from rigid ones by, as those of a file do.
    """
    middle = middle_of(shell.points)
    poses = path_poses(moved, seed, middle)
    poses[:, :3, :3] += spread * np.random.default_rng(seed).uniform(-1.0, 1.0, (len(poses), 3, 3))
    path = SweepPath.of(poses, shell, SIZE)
    last = len(path) - 1
    place = np.rint(share * last * FINEST) / FINEST
    spent, around = path.reaches(np.array([place]), np.array([half]))
    before = path.at(np.unique(np.append(np.linspace(0.0, place, 100), place)))
    ends = np.clip([place - half, place + half], 0.0, last)
    beside = path.at(np.linspace(ends[0], ends[1], 65))
    here = path.at(np.array([place]))
    radius = np.linalg.norm(shell.points - middle, axis=1).max() + (shell.cover or 0.0)
    points = np.concatenate([shell.points, middle + radius * fibonacci_sphere(60)])
    there = placed(here, points)
    from_start = np.linalg.norm(placed(before, points)[0] - there, axis=2)
    from_place = np.linalg.norm(placed(beside, points) - there, axis=2)
    assert from_start.max() <= (spent[0] + path.slack) * SIZE + ROUND
    assert from_place.max() <= around[0] * SIZE + ROUND
    if half == 0.5:  # what the first look stands for: a quarter of a voxel, or little more
        assert around[0] <= 0.25 + 2.0 * path.slack
        assert from_place.max() <= path.off + ROUND
    if half == 0.0:
        assert around[0] == 0.0
    counts = np.diff(path.starts)
    m = path.segments([np.floor(place)])[0]
    closest = path.motion[m] / counts[m] * half / SIZE
    assert around[0] >= closest
    assert spent[0] * SIZE <= path.motion.sum() + (path.slack * len(path)) * SIZE + 1e-6

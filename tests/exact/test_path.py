"""What a path says of its motion, against plain formulas and densely sampled places of the tool."""

import warnings
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticdb.errors import UsageError
from hapticdb.exact.moving_clash import hinge
from hapticdb.exact.path import ToolPath
from hapticdb.pointshell.shell import fibonacci_sphere
from naive_motion import middle_of, placed, poses_at

Floats = NDArray[np.float64]

ROUND = 1e-9
"""Metres, at least: rounding errors, here and in the path."""
BALL = 0.05 * fibonacci_sphere(100)
ROD = np.array([[x, y, 0.01] for x in (-0.02, 0.18) for y in (0.0, 0.004)])

lengths = st.sampled_from([0.0, 1e-9, 1e-4, 0.003, 0.05, 0.2])
angles = st.one_of(
    st.sampled_from([0.0, 1e-13, 1e-9, 1e-5, 0.1, 1.5, 3.0, np.pi - 1e-9, np.pi]),
    st.floats(0.0, float(np.pi)),
)
directions = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)
moves = st.tuples(lengths, directions, angles, directions)
shares = st.lists(st.floats(0.0, 1.0), min_size=1, max_size=5)


def unit(direction: Any) -> Floats:  # noqa: ANN401 - a triple
    return np.asarray(direction / np.linalg.norm(direction))


def path_poses(moved: list[Any], seed: int, center: Floats) -> Floats:
    """A random pose, and poses that follow it by moves: length, direction, angle, axis."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.uniform(-1.0, 1.0, 3)
    poses = [pose]
    for length, way, angle, axis in moved:
        last, pose = poses[-1], np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(angle * unit(axis)).as_matrix() @ last[:3, :3]
        there = last[:3, :3] @ center + last[:3, 3] + length * unit(way)
        pose[:3, 3] = there - pose[:3, :3] @ center
        poses.append(pose)
    return np.array(poses)


@settings(max_examples=60, deadline=None)
@given(
    moved=st.lists(moves, min_size=1, max_size=3),
    seed=st.integers(0, 99),
    corners=st.sampled_from([BALL, ROD]),
    shares=shares,
)
def test_tool_path_poses_closed_form(
    moved: list[Any], seed: int, corners: Floats, shares: list[float]
) -> None:
    center = middle_of(corners)
    poses = path_poses(moved, seed, center)
    path = ToolPath.of(poses, corners, center)
    for m, length in enumerate(np.diff(path.parameters).tolist()):
        if not length:
            continue
        ways = path.parameters[m] + length * np.array(shares)
        found = path.at(ways)
        expected = poses_at(poses, center, m + (ways - path.parameters[m]) / length)
        nearly_pi = moved[m][2] > np.pi - 1e-6  # either way round is a smallest turn
        if not nearly_pi:
            assert np.allclose(found, expected, atol=1e-8)
        here, there = (placed(poses, center[None]) for poses in (found, expected))
        assert np.allclose(here, there, atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(axis=directions, seed=st.integers(0, 99), share=st.floats(0.0, 1.0))
def test_tool_path_half_turn_constant_rate(axis: Any, seed: int, share: float) -> None:  # noqa: ANN401
    poses = path_poses([(0.0, (1, 0, 0), np.pi, axis)], seed, np.zeros(3))
    path = ToolPath.of(poses, BALL, np.zeros(3))
    turn = path.at([share * path.length])[0, :3, :3] @ poses[0, :3, :3].T
    found = Rotation.from_matrix(turn).as_rotvec()
    assert np.linalg.norm(found) == pytest.approx(np.pi * share, abs=1e-6)
    assert np.linalg.norm(np.cross(found, unit(axis))) == pytest.approx(0.0, abs=1e-6)


@settings(max_examples=60, deadline=None)
@given(
    moved=st.lists(moves, min_size=1, max_size=3),
    seed=st.integers(0, 99),
    corners=st.sampled_from([BALL, ROD]),
    about=st.sampled_from([0.0, 0.3]),
    spread=st.sampled_from([0.0, 2e-7]),
    shares=shares,
)
def test_tool_path_parameter_bounds_motion(
    moved: list[Any], seed: int, corners: Floats, about: float, spread: float, shares: list[float]
) -> None:
    """about: metres from the tool's middle to the centre of the turns; spread: what given poses
    deviate from rigid ones by, as those of a file do."""
    center = middle_of(corners) + about
    poses = path_poses(moved, seed, center)
    poses[:, :3, :3] += spread * np.random.default_rng(seed).uniform(-1.0, 1.0, (len(poses), 3, 3))
    path = ToolPath.of(poses, corners, center)
    ways = path.length * np.array([0.0, *shares, 1.0])
    there = placed(path.at(ways), corners)
    moved_by = np.linalg.norm(there[:, None] - there[None], axis=3).max(axis=2)
    assert (moved_by <= np.abs(ways[:, None] - ways[None]) + ROUND).all()


@pytest.mark.parametrize(("degrees", "told"), [(169.0, ""), (172.0, "172 degrees"), (270.0, "")])
def test_tool_path_shorter_rotation_and_warning(degrees: float, told: str) -> None:
    way = ToolPath.of(hinge(2, (0, 0, 0), 0.0, degrees)[[0, -1]], BALL, np.zeros(3))
    assert np.degrees(np.linalg.norm(way.motion.turns)) == pytest.approx(
        min(degrees, 360.0 - degrees)
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        way.checked()
    assert [told in str(one.message) for one in caught] == [True] * bool(told)


def test_tool_path_half_turn_refused() -> None:
    way = ToolPath.of(hinge(2, (0, 0, 0), 0.0, 180.0)[[0, -1]], BALL, np.zeros(3))
    with pytest.raises(UsageError, match=r"from pose 0 to pose 1 .* give a pose between"):
        way.checked()

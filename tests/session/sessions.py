"""Shared by the tests of sessions: a floor, waiting, and reading recorded frames."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import children
from children import TIMEOUT
from hapticdb import Environment, PointShell
from hapticdb.poses import poses_of
from hapticdb.query.law import ForceLaw
from hapticdb.recording.file import Recording
from hapticdb.session.session import Session
from hapticdb.session.states import LARGE_FROM
from voxels import floor_voxels, write_voxels

RATE = 500.0
"""Frames a second of the tests' sessions."""
NEVER_STALE = 1e6
"""A staleness in seconds that no test reaches."""
Recorded = NDArray[np.void]


def until(claim: Callable[[], object], session: Session | None = None) -> None:
    """Wait until a claim is true, and run a session's `wait` meanwhile."""
    if session is None:
        children.until(claim)
        return
    deadline = time.monotonic() + TIMEOUT
    while not claim():
        assert time.monotonic() < deadline
        assert session.wait(0.02) is None


def floored(env: Environment) -> Environment:
    write_voxels(env.store, floor_voxels(env.grid, width=48), "floor")
    return env


def floor_points(height: float) -> NDArray[np.float64]:
    """Points on a floor (n, 3), in voxels, so dense that the floor is flat to 0.01 voxels."""
    across = np.arange(24.0, 40.0, 0.25) + 0.125
    x, y = np.meshgrid(across, across, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)


def in_z_order(n_i: int, n_j: int) -> NDArray[np.int64]:
    """Places (n_i * n_j, 2) of a grid in the order of a Z-order curve."""
    ij = np.argwhere(np.ones((n_i, n_j), dtype=bool))
    codes = sum(((ij[:, a] >> b) & 1) << (2 * b + a) for a in range(2) for b in range(10))
    return ij[np.argsort(codes)]


def standing_plate() -> PointShell:
    """A plate of `LARGE_FROM` points: its lower edge is felt, the rest stands up."""
    ij = in_z_order(64, 64)
    points = np.column_stack([(ij[:, 0] - 31.5) * 4e-4, np.zeros(len(ij)), ij[:, 1] * 4e-4])
    shell = PointShell(points, np.tile((0.0, 0.0, 1.0), (len(ij), 1)), np.array([0, 0, 0.012]))
    assert len(shell) == LARGE_FROM
    return shell


def recorded(path: Path) -> Recorded:
    return np.array(Recording(path).frames())


def felt_at(
    env: Environment, shell: PointShell, frames: Recorded, law: ForceLaw
) -> NDArray[np.float64]:
    """Wrenches (n, 6) of touches at the tool's recorded poses."""
    touches = (env.touch(shell, pose, "array", law=law) for pose in poses_of(frames["tool"]))
    return np.array([(*touch.force, *touch.torque) for touch in touches])

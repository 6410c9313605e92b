"""Shared by the tests of sessions: a floor, waiting, and reading recorded frames."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import children
from children import PATIENCE
from hapticdb import Environment
from hapticdb.realtime.session import Session
from hapticdb.recording.file import Recording
from hapticdb.testing import floor_voxels, write_voxels

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
    deadline = time.monotonic() + PATIENCE
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


def recorded(path: Path) -> Recorded:
    return np.concatenate(list(Recording(path).frames()))

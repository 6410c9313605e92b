"""One sweep of the part's surface judges a path, as any other path."""

import math
import time
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.exact.sweep import sweep
from hapticdb.extraction.free_space import Room
from hapticdb.extraction.problem import Problem
from hapticdb.extraction.result import How, WayOut

Floats = NDArray[np.float64]

LEAST = 0.1
"""Seconds that each sweep has."""
BACK = 0.1
"""Voxels from the first hit at which a motion ends. Larger: less of a narrow way is used."""


def judge(problem: Problem, poses: Floats, how: How, until: float = math.inf) -> WayOut:
    """Sweep the parts along a path of displacements (M, 4, 4), until a time of `monotonic`."""
    left = max(min(problem.until, until) - time.monotonic(), LEAST)
    found = sweep(
        problem.env, problem.shell, poses, where=problem.where, exclude=problem.exclude,
        contact=problem.contact, overlap=problem.overlap, seated=True, seconds=left, until_hit=True,
    )  # fmt: skip
    return WayOut(poses, how, found)


class Passed(NamedTuple):
    """The part of a motion before its first hit.

    given (M, 4, 4), at (M,) : the poses of the motion, and the metres before each; poses (n, 4, 4),
    ways (n,) : poses along it before the hit, and the metres before each.
    """

    given: Floats
    at: Floats
    poses: Floats
    ways: Floats

    def until(self, n: int) -> Floats:
        """Poses (K, 4, 4) of the motion to the n-th of `poses`."""
        return np.concatenate([self.given[self.at < self.ways[n]], self.poses[n : n + 1]])


def passed(problem: Problem, room: Room, poses: Floats, until: float) -> Passed:
    """Sweep the parts along a path of displacements (M, 4, 4) to shortly before the first hit."""
    way = judge(problem, poses, "pull", until)
    path = way.swept.path
    ways = room.ways(path)
    if not way.swept.is_free:
        ways = ways[ways <= way.free_share * path.length - BACK * problem.voxel_size]
    return Passed(path.poses, path.ways, path.at(ways), ways)

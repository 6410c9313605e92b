"""Proof of a path by one sweep of the part's surface."""

import math
import time
from typing import NamedTuple

import numpy as np

from hapticdb.array_types import Floats
from hapticdb.exact.sweep import sweep
from hapticdb.extraction.extraction_results import How, RemovalPath
from hapticdb.extraction.free_space import Room
from hapticdb.extraction.problem import Problem

LEAST = 0.1
"""Seconds of each sweep, at least."""
BACK = 0.1
"""Voxels from the first hit to the end of a motion. Larger: less use of a narrow path."""


def prove(problem: Problem, poses: Floats, how: How, until: float = math.inf) -> RemovalPath:
    """Sweep the parts along displacements (M, 4, 4), until a time of `time.monotonic`."""
    left = max(min(problem.until, until) - time.monotonic(), LEAST)
    found = sweep(
        problem.env, problem.shell, poses, where=problem.where, exclude=problem.exclude,
        contact=problem.contact, overlap=problem.overlap, seated=True, seconds=left, until_hit=True,
    )  # fmt: skip
    return RemovalPath(poses, how, found)


class Passed(NamedTuple):
    """The part of a motion before its first hit.

    given (M, 4, 4), at (M,) : poses of the motion and their path parameters, metres; poses
    (n, 4, 4), parameters (n,) : samples before the hit, and their path parameters.
    """

    given: Floats
    at: Floats
    poses: Floats
    parameters: Floats

    def until(self, n: int) -> Floats:
        """Poses (K, 4, 4) of the motion up to the n-th of `poses`."""
        # the given corners before the sample, so that no bend is cut short
        return np.concatenate([self.given[self.at < self.parameters[n]], self.poses[n : n + 1]])


def passed(problem: Problem, room: Room, poses: Floats, until: float) -> Passed:
    """Sweep the parts along displacements (M, 4, 4), and return the part before the first hit."""
    proved = prove(problem, poses, "pull", until)
    path = proved.swept.path
    parameters = room.parameters(path)
    if not proved.swept.is_free:
        # short of the hit, where the part already touches
        parameters = parameters[
            parameters <= proved.free_share * path.length - BACK * problem.voxel_size
        ]
    return Passed(path.poses, path.parameters, path.at(parameters), parameters)

"""Screw motions: a turn about an axis with a shift along it, as a bolt leaves its thread."""

import time

import numpy as np
from numpy.typing import NDArray

from hapticdb.extraction.free_space import FreeSpace
from hapticdb.extraction.judge import judge
from hapticdb.extraction.loosening import Twist
from hapticdb.extraction.problem import Problem, corners_of
from hapticdb.extraction.pulls import Pull, Pulls
from hapticdb.extraction.result import WayOut

Floats = NDArray[np.float64]

MOST_AXES = 8
"""Greatest number of directions of axes, those that fewest contacts oppose. Larger: oblique threads
are left, too."""


def unscrewed(
    problem: Problem, space: FreeSpace, pulls: Pulls, pitch: float, until: float
) -> WayOut | None:
    """First screw motion that is not refuted, along likely pulls, to the right and to the left.

    pitch : metres a turn. The axis goes through the middle of the part. A bolt turns for its own
    length, a nut until it is past what it is near; then either goes straight.
    """
    for pull in [pull for pull in pulls.done if pull.is_likely][:MOST_AXES]:
        heights = problem.corners @ pull.direction
        near = [corners_of(obj.bounds) @ pull.direction for obj in space.start.objects]
        past = max((one.max() - heights.min() for one in near), default=0.0)
        for hand in (1.0, -1.0):
            for length in (np.ptp(heights), past):
                if time.monotonic() > until:
                    return None
                screwed = min(float(length), pull.length)
                poses = _helix(problem, pull, hand * 2.0 * np.pi / pitch, screwed)
                way = judge(problem, poses, "screw")
                if not way.in_way:
                    return way
                helix = problem.path(poses[:-1]).length
                if way.free_share * way.length < 0.99 * helix:
                    break  # it is not this thread's
    return None


def _helix(problem: Problem, pull: Pull, turn: float, length: float) -> Floats:
    """Displacements (M, 4, 4) by `length` metres with radians a metre, and on as far as a pull."""
    twist = Twist(pull.direction, turn * pull.direction, problem.center, 0.0)
    poses = twist.along(np.eye(4), length, np.inf)
    last = poses[-1].copy()
    last[:3, 3] += (pull.length - length) * pull.direction
    return np.concatenate([poses, last[None]])

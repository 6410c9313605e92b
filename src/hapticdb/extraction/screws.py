"""Screw motions: a turn about an axis with a shift along it, as a bolt leaves its thread."""

import time

import numpy as np
from numpy.typing import NDArray

from hapticdb.extraction.judge import judge
from hapticdb.extraction.loosening import Twist
from hapticdb.extraction.problem import Problem
from hapticdb.extraction.pulls import Pulls, shifted
from hapticdb.extraction.result import WayOut

Floats = NDArray[np.float64]

MOST_AXES = 8
"""Greatest number of directions of axes, those that fewest contacts oppose. Larger: oblique threads
are left, too."""


def unscrewed(problem: Problem, pulls: Pulls, pitch: float, until: float) -> WayOut | None:
    """First screw motion that is not refuted, along likely pulls, to the right and to the left.

    pitch : metres a turn. The axis goes through the middle of the part. The part turns on its way
    for its own length along the axis, since no thread holds it longer, and then goes straight.
    """
    axes = [pull for pull in pulls.done if pull.is_likely][:MOST_AXES]
    for pull in axes:
        heights = problem.shell.outline @ pull.direction
        screwed = min(float(np.ptp(heights)), pull.length)
        end = shifted(pull.length * pull.direction)
        for hand in (1.0, -1.0):
            if time.monotonic() > until:
                return None
            turn = hand * 2.0 * np.pi / pitch * pull.direction
            twist = Twist(pull.direction, turn, problem.center, 0.0)
            poses = twist.along(np.eye(4), screwed, np.inf)
            last = end.copy()
            last[:3, :3] = poses[-1, :3, :3]
            last[:3, 3] += problem.center - last[:3, :3] @ problem.center
            way = judge(problem, np.concatenate([poses, last[None]]), "screw")
            if not way.in_way:
                return way
    return None

"""Screw motions: a turn about an axis with a shift along it, as a bolt leaves its thread."""

import time

import numpy as np

from hapticdb.extraction.directions import AXES, distinct
from hapticdb.extraction.judge import judge
from hapticdb.extraction.loosening import Twist
from hapticdb.extraction.problem import Exit, Problem
from hapticdb.extraction.result import WayOut
from hapticdb.grid import corners_of


def unscrewed(problem: Problem, leaving: Exit, pitch: float, until: float) -> WayOut | None:
    """First screw motion that is not refuted, along the part's axes and the world's, of both hands.

    pitch : metres a turn. The axis goes through the middle of the part. A bolt turns for its own
    length, a nut until it is past what its box meets; then either goes straight.
    """
    low, high = problem.corners.min(axis=0), problem.corners.max(axis=0)
    boxes = [obj.bounds for obj in problem.standing]
    met = [corners_of(box) for box in boxes if (box[0] <= high).all() and (box[1] >= low).all()]
    axes = distinct(np.concatenate([problem.own_axes, -problem.own_axes, AXES]))
    for direction, way_out in zip(axes, leaving.distances(axes).tolist(), strict=True):
        heights = problem.corners @ direction
        past = max((one @ direction).max() for one in [*met, problem.corners]) - heights.min()
        for hand in (1.0, -1.0):
            for length in (np.ptp(heights), past):
                if time.monotonic() > until:
                    return None
                turn = hand * 2.0 * np.pi / pitch * direction
                twist = Twist(direction, turn, problem.center, 0.0)
                poses = twist.along(np.eye(4), min(float(length), way_out), np.inf)
                last = poses[-1].copy()
                last[:3, 3] += max(way_out - float(length), 0.0) * direction
                poses = np.concatenate([poses, last[None]])
                way = judge(problem, poses, "screw", until)
                if not way.in_way:
                    return way
                if way.free_share * way.length < way.swept.path.ways[-2]:
                    break  # it is not this thread's
    return None

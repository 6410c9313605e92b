"""Removal paths of straight legs along the axes, from free poses of a part.

A part in a room often leaves it as furniture does: up, along to the door, and out. The random
samples of a planner seldom hit the few poses in line with the door.
"""

import math
import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from hapticdb.array_types import Floats
from hapticdb.extraction.contact_escape import EscapePath
from hapticdb.extraction.directions import AXES
from hapticdb.extraction.free_space import Room
from hapticdb.extraction.problem import Exit, Problem

STOPS = (1, 2, 4)
"""Stops on a leg for the start of the next one, tried in turn. More: narrower doors, but the square
of the number in motions."""
BETWEEN, MOST_STOPS = 0.5, 8
"""Spacing of the second leg's stops, radii of the part, and their greatest number."""
MOST_MOTIONS = 3000
"""Motions checked, at most."""
MOST_STARTS = 12
"""Starts, at most. Larger: fewer stops on each."""


class Legs(NamedTuple):
    """Search by legs for one problem.

    problem, room, leaving : the parts, their free space, their exit; until : end of the search,
    `time.monotonic`.
    """

    problem: Problem
    room: Room
    leaving: Exit
    until: float

    def search(self, starts: list[EscapePath]) -> tuple[EscapePath, Floats] | None:
        """A start, and a path (M, 4, 4) to its end or a stop before it, then one or two legs out.

        One leg from all ends comes first, then two legs, then also stops on the path to each start.
        Starts along an axis precede others.
        """
        first = sorted(starts, key=lambda one: not _is_along_axis(one))[:MOST_STARTS]
        tried: set[bytes] = set()
        for start, poses, axis in self._tries(first):
            # by bits: the same stop and axis may come up again
            motion = poses[-1].tobytes() + axis.tobytes()
            if motion in tried:
                continue
            tried.add(motion)
            if len(tried) > MOST_MOTIONS or time.monotonic() > self.until:
                return None
            here, out = poses[-1], self._end(poses[-1], axis)
            if self.room.is_motion_free(np.stack([here, out])):
                return start, np.concatenate([poses, out[None]])
        return None

    def _tries(self, starts: list[EscapePath]) -> Iterator[tuple[EscapePath, Floats, Floats]]:
        """Starts, paths (M, 4, 4) to a stop, and axes (3,) of the last leg."""
        for start in starts:
            for axis in AXES:
                yield start, start.poses, axis
        for n_stops in STOPS:
            for start in starts:
                for stop in self._stops(start.poses[-2], start.poses[-1], n_stops):
                    path = np.concatenate([start.poses[:-1], stop[None]])
                    for axis in AXES:
                        for last in self._along(stop, axis, n_stops):
                            longer = np.concatenate([path, last[None]])
                            # across the first leg: a second one along it adds nothing
                            for out in AXES[np.abs(AXES @ axis) < 0.5]:
                                yield start, longer, out

    def _end(self, here: Floats, axis: Floats) -> Floats:
        """Displacement (4, 4) straight on along an axis until the part is out."""
        shift = self.problem.shift(here)
        distance = float(self.leaving.distances(axis[None])[0]) - float(shift @ axis)
        out = here.copy()
        out[:3, 3] += max(distance, 0.0) * axis
        return out

    def _along(self, here: Floats, axis: Floats, n_stops: int) -> Floats:
        """Stops (n, 4, 4) on the free leg along an axis; none if it is shorter than a voxel."""
        ends = np.stack([here, self._end(here, axis)])
        last = self.room.farthest(ends)
        distance = float(np.linalg.norm(last[:3, 3] - here[:3, 3]))
        if distance < self.problem.voxel_size:
            return np.empty((0, 4, 4))
        wanted = math.ceil(distance / (BETWEEN * self.problem.radius))
        return _between(here, last, max(n_stops, min(wanted, MOST_STOPS)))

    def _stops(self, begin: Floats, end: Floats, n_stops: int) -> Floats:
        """Free stops (n, 4, 4) on the last leg to a start, its end included."""
        # a motion with a turn has no straight leg to stop on
        if not np.array_equal(begin[:3, :3], end[:3, :3]):
            return end[None]
        stops = _between(begin, end, n_stops)
        return np.asarray(stops[self.room.are_free(stops)])


def _is_along_axis(start: EscapePath) -> bool:
    """Whether the last leg to a start is parallel to an axis."""
    shift = start.poses[-1, :3, 3] - start.poses[-2, :3, 3]
    return bool(np.abs(shift).max() >= 0.999 * np.linalg.norm(shift))


def _between(begin: Floats, end: Floats, n: int) -> Floats:
    """Displacements (n, 4, 4), evenly spaced shifts from the second one back to the first."""
    stops = np.tile(end, (n, 1, 1))
    shares = np.linspace(1.0, 0.0, n, endpoint=False)[:, None]
    stops[:, :3, 3] = begin[:3, 3] + shares * (end[:3, 3] - begin[:3, 3])
    return stops

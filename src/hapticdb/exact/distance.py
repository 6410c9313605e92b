"""Distances of the tool and one object along a path, and their first collision."""

import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.exact.path import ToolPath
from hapticdb.exact.separation import MovedPair
from hapticdb.kernels.surfaces.sides import TriangleTree
from hapticdb.kernels.triangles.nearest import Nearest
from hapticdb.kernels.triangles.sweeping import MEETING, Search
from hapticdb.pointshell.moving import MovingSurface
from hapticdb.store.base import Object

Floats = NDArray[np.float64]

COARSE, FINE = 9e-6, 1e-6
"""Tolerances of a least distance, metres, and per mille of it if more: coarse always, fine after a
short search."""
EASY = 20_000
"""Proximity queries of a short search, at most."""
STRETCHES = 256
"""Stretches of a path for the broad phase. More: fewer objects in the narrow phase."""
STEPS = 1 << 16
"""Entries of a search between two readings of the clock: some hundredths of a second. Larger: a
time limit is overrun by more."""


class OverTimeError(Exception):
    """The time of a sweep is over."""


class Least(NamedTuple):
    """A distance, metres, its path parameter, and the nearest places (3,) there."""

    at_most: float
    way: float
    on_object: Floats
    on_tool: Floats


class Pair:
    """The tool and one object along a path.

    tree : triangles of the object, world frame; until : end, `time.monotonic`, by OverTimeError;
    end : last path parameter, the whole path unless given; error : chord errors of both, metres.
    """

    def __init__(
        self, tree: TriangleTree, tool: MovingSurface, way: ToolPath, until: float = np.inf,
        end: float | None = None, error: float = 0.0,
    ) -> None:  # fmt: skip
        self.error = error
        self.tree, self.tool, self.way, self.until = tree, tool, way, until
        self.length = way.length if end is None else end
        self.looks = 0

    def measure(self, ways: Floats, farthest: Floats, enough: float = 0.0) -> Nearest:
        """Measure at path parameters (n,), as `kernels.triangles.nearest`."""
        self.check_time()
        self.looks += len(ways)
        return self.tool.nearest(self.tree, self.way.at(ways), farthest, enough)

    def nearest_at(self, pose: Floats) -> Nearest:
        """Measure at one pose (4, 4) of the tool, however far."""
        return self.tool.nearest(self.tree, pose[None], np.array([np.inf]))

    def first_met(self, moved: MovedPair, begin: float, end: float) -> float:
        """Path parameter of the first collision after a small motion, or the end."""
        motion = self.way.motion
        search = Search(
            moved.object, moved.tool, motion._replace(centers=motion.centers + moved.motion.shift),
            radius=moved.radius, begin=begin, best=2.0 * MEETING, fine=COARSE,
        )  # fmt: skip
        self._finish(search, end)
        return float(search.found.way[0]) if search.found.way[0] >= 0.0 else end

    def least(self, begin: float, best: float) -> tuple[Least | None, float]:
        """Least distance from a path parameter on, if it is less than `best`; else None.

        Returns the proved bound, too. In a collision it is the first one. After few proximity
        queries, the tolerance is nine times finer.
        """
        found, closed, looks = self._search(begin, best, COARSE)
        known = best if found is None else found.at_most
        if MEETING < known < np.inf and looks <= EASY:
            nearer, closed, _ = self._search(begin, known, FINE)
            found = nearer or found
        if found is None:
            return None, closed
        return found, 0.0 if found.at_most <= MEETING else max(min(closed, found.at_most), 0.0)

    def _search(self, begin: float, best: float, fine: float) -> tuple[Least | None, float, int]:
        """The same to `fine` metres, and the number of proximity queries."""
        search = self.tool.search(self.tree, self.way.motion, begin=begin, best=best, fine=fine)
        self._finish(search, self.length)
        (at_most, closed), (way,), (on_object, on_tool) = search.found
        if way < 0.0:
            return None, float(closed), search.looks
        near = self.measure(np.array([way]), np.array([at_most]))  # all of both surfaces, there
        if near.pairs[0, 0] >= 0:
            at_most, on_object, on_tool = near.at_most[0], near.on_a[0], near.on_b[0]
        found = Least(float(at_most), float(way), on_object, on_tool)
        return found, float(closed), search.looks

    def _finish(self, search: Search, end: float) -> None:
        """Search to an end; on a part of the path, as if they collided there."""
        if end < self.way.length:
            search.found.distance[0], search.found.way[0] = MEETING, end
        is_over = False
        while not is_over:
            self.check_time()
            is_over = search.go_on(STEPS)
        self.looks += search.looks
        if end < self.way.length and search.found.way[0] >= end:
            search.found.way[0] = -1.0

    def check_time(self) -> None:
        """End the sweep by OverTimeError if its time is over."""
        if time.monotonic() > self.until:
            raise OverTimeError


def box_gaps(
    tool: MovingSurface, way: ToolPath, objects: Sequence[Object]
) -> tuple[Floats, Floats]:
    """Ends (N + 1,) of stretches of a path; distances (O, N) of boxes, never too large."""
    edges = np.linspace(0.0, way.length, (STRETCHES if way.length else 1) + 1)
    bounds = np.array([obj.bounds for obj in objects]).reshape(-1, 2, 3)
    middles = way.at(0.5 * (edges[:-1] + edges[1:]))
    return edges, tool.box_gaps(bounds, middles, 0.5 * np.diff(edges))


def error_of(distance: float) -> float:
    """Tolerance of a least distance, metres."""
    return COARSE * max(1.0, 1e3 * distance)

"""Distances of the tool and one object along a path, and their first collision."""

import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from hapticdb.exact.path import ToolPath
from hapticdb.exact.profile import gap_on_screw, screw_of
from hapticdb.exact.separation import MovedPair
from hapticdb.kernels.surfaces.triangle_bvh import TriangleBVH
from hapticdb.kernels.triangles.path_distance import MEETING, Search
from hapticdb.kernels.triangles.path_motion import PathMotion
from hapticdb.kernels.triangles.surface_distance import Nearest
from hapticdb.pointshell.shape import bvh_of
from hapticdb.pointshell.tool_surface import ToolSurface
from hapticdb.store.base import Object

Floats = NDArray[np.float64]
T = TypeVar("T")

COARSE, FINE = 9e-6, 1e-6
"""Tolerances of a least distance, metres, and per mille of it if more: coarse always, fine after a
short search."""
EASY = 20_000
"""Proximity queries of a short search, at most."""
STRETCHES = 256
"""Stretches of a path for the broad phase. More: fewer objects in the narrow phase."""
FEW, SAMPLES, PARTS = 64, 128, 2048
"""Poses of a path that is searched whole; samples of a longer one, and its parts, of which those
far from the object are left out. More: a shorter search, and more time before it."""
TURNED, ENOUGH = 16, 0.009
"""Samples of a screw motion, and relative tolerance of a least distance on it."""
STEPS = 1 << 16
"""Entries of a search between two readings of the clock: some hundredths of a second. Larger: a
time limit is overrun by more."""


class OverTimeError(Exception):
    """The time of a sweep is over."""


def in_time(given: Iterable[T], until: float) -> Iterator[T]:
    """Pass on what is given; OverTimeError once the time, `time.monotonic`, is over."""
    for one in given:
        if time.monotonic() > until:
            raise OverTimeError
        yield one


class Least(NamedTuple):
    """A distance, metres, its path parameter, and the nearest places (3,) there."""

    at_most: float
    parameter: float
    on_object: Floats
    on_tool: Floats


class Pair:
    """The tool and one object along a path.

    tree : triangles of the object, world frame; until : end, `time.monotonic`, by OverTimeError;
    end : last path parameter, by default of the whole path; error : chord errors of both, metres;
    bounds (2, 3) : the object's box, if the search is to leave out what is far from it.
    """

    def __init__(
        self, tree: TriangleBVH, tool: ToolSurface, path: ToolPath, until: float = np.inf,
        end: float | None = None, error: float = 0.0, bounds: Floats | None = None,
    ) -> None:  # fmt: skip
        self.error, self._bounds = error, bounds
        self.tree, self.tool, self.path, self.until = tree, tool, path, until
        self.length = path.length if end is None else end
        self.queries = 0

    def measure(self, parameters: Floats, farthest: Floats, enough: float = 0.0) -> Nearest:
        """Measure at path parameters (n,), as `kernels.triangles.surface_distance`."""
        self.check_time()
        self.queries += len(parameters)
        return self.tool.nearest(self.tree, self.path.at(parameters), farthest, enough)

    def nearest_at(self, pose: Floats) -> Nearest:
        """Measure at one pose (4, 4) of the tool, however far."""
        return self.tool.nearest(self.tree, pose[None], np.array([np.inf]))

    def first_collision(self, moved: MovedPair, begin: float, end: float) -> float:
        """Path parameter of the first collision after a small motion, or the end."""
        motion = self.path.motion
        search = Search(
            moved.object, moved.tool, motion._replace(centers=motion.centers + moved.motion.shift),
            radius=moved.radius, begin=begin, best=2.0 * MEETING, fine=COARSE,
        )  # fmt: skip
        self._finish(search, end)
        return float(search.found.parameter[0]) if search.found.parameter[0] >= 0.0 else end

    def least(self, begin: float, best: float) -> tuple[Least | None, float]:
        """Least distance from a path parameter on, if it is less than `best`; else None.

        Returns the proved bound, too. In a collision it is the first one. After few proximity
        queries, the tolerance is nine times finer.
        """
        found, closed = self._turned(begin, best) or self._straight(begin, best)
        if found is None:
            return None, closed
        return found, 0.0 if found.at_most <= MEETING else max(min(closed, found.at_most), 0.0)

    def _straight(self, begin: float, best: float) -> tuple[Least | None, float]:
        # coarse first: its result bounds the finer search, and its queries show the cost
        found, closed, queries = self._search(begin, best, COARSE)
        known = best if found is None else found.at_most
        if MEETING < known < np.inf and queries <= EASY:
            nearer, closed, _ = self._search(begin, known, FINE)
            found = nearer or found
        return found, closed

    def _turned(self, begin: float, best: float) -> tuple[Least | None, float] | None:
        """The same by the profiles of both surfaces on a screw motion; None without a proof.

        The rest of path and surfaces is searched. All of it is, for half of the time, if the bounds
        are far apart.
        """
        motion, tree, tool = self.path.motion, self.tree, self.tool.tree
        reach = float(np.linalg.norm(self.tool.corners - motion.center, axis=1).max())
        screw = None if self._bounds is not None or self.tool.radius else screw_of(motion, reach)
        if screw is None:
            return None
        low, high = motion.parameters[[screw.first, screw.last]].clip(begin, self.length)
        start = self._nearest_of(np.linspace(low, high, TURNED), best)
        far = best if start is None else start.at_most
        if not MEETING < far < np.inf:
            return None
        pose = self.path.at(motion.parameters[screw.first : screw.first + 1])[0]
        placed = tool.corners @ pose[:3, :3].T + pose[:3, 3]
        bound, is_within, rest = gap_on_screw(tree.corners, placed, screw, far, self.check_time)
        if bound <= MEETING:
            return None
        parts = [(tree, tool, 0, screw.first), (tree, tool, screw.last, len(motion.turns))]
        if rest.any():
            left = bvh_of((tool if is_within else tree).corners[rest])
            sides = (tree, left) if is_within else (left, tool)
            parts.insert(1, (*sides, screw.first, screw.last))
        pieces = [(a, b, part_of(motion, n, m + 1)) for a, b, n, m in parts if n < m]
        found, closed, _ = self._search(begin, best, FINE, start, pieces)
        closed = min(closed, bound)
        known = MEETING if found is None else found.at_most
        if found is not None and known > MEETING and known - closed > max(ENOUGH * known, FINE):
            until, now = self.until, time.monotonic()
            self.until = now + 0.5 * (until - now)
            # without the time for a finer proof the coarse one remains
            with suppress(OverTimeError):
                found, finer, _ = self._search(begin, known, ENOUGH * known, found)
                closed = max(closed, finer)
            self.until = until
        return found, closed

    def _search(
        self, begin: float, best: float, fine: float, least: Least | None = None,
        pieces: Iterable[tuple[TriangleBVH, TriangleBVH, PathMotion]] | None = None,
    ) -> tuple[Least | None, float, int]:  # fmt: skip
        """The same to `fine` metres, and the number of proximity queries.

        least : initial upper bound; pieces : surfaces and their parts of the path, by default all.
        """
        # upper bound from samples: branch and bound prunes from its first entry
        least, closed, queries = least or self._sampled(begin, best), best, 0
        if pieces is None:
            motions = self._motions(best if least is None else least.at_most)
            pieces = ((self.tree, self.tool.tree, motion) for motion in motions)
        for tree, tool, motion in pieces:
            known, end = best if least is None else least.at_most, self.length
            if least is not None and known <= MEETING:
                # a collision is known: only an earlier one matters, also before the path's end
                end = min(float(np.nextafter(end, 0.0)), least.parameter)
                if motion.parameters[0] >= end:
                    break
            search = Search(
                tree, tool, motion, radius=self.tool.radius, begin=begin, best=known, fine=fine
            )
            self._finish(search, end)
            queries += search.queries
            (at_most, bound), (parameter,), (on_object, on_tool) = search.found
            closed = min(closed, float(bound))
            if parameter < 0.0:
                continue
            near = self.measure(
                np.array([parameter]), np.array([at_most])
            )  # all of both surfaces there
            if near.pairs[0, 0] >= 0:
                at_most, on_object, on_tool = near.at_most[0], near.on_a[0], near.on_b[0]
            least = Least(float(at_most), float(parameter), on_object, on_tool)
        return least, closed, queries

    def _sampled(self, begin: float, best: float) -> Least | None:
        """The nearest of some samples, if nearer than `best`: a long search begins with it."""
        if self._bounds is None or len(self.path.parameters) <= FEW:
            return None
        return self._nearest_of(np.linspace(begin, self.length, SAMPLES), best)

    def _nearest_of(self, parameters: Floats, best: float) -> Least | None:
        near = self.measure(parameters, np.full(len(parameters), best))
        n = int(np.argmin(near.at_most))
        if near.pairs[n, 0] < 0:
            return None
        return Least(float(near.at_most[n]), float(parameters[n]), near.on_a[n], near.on_b[n])

    def _motions(self, best: float) -> Iterator[PathMotion]:
        """Parts of the path on which the boxes are nearer than `best`; all of it without boxes."""
        parameters, motion = self.path.parameters, self.path.motion
        if self._bounds is None or len(parameters) <= FEW:
            yield motion
            return
        edges = np.linspace(0.0, self.path.length, PARTS + 1)
        middles = self.path.at(0.5 * (edges[:-1] + edges[1:]))
        gaps = self.tool.box_gaps(self._bounds[None], middles, 0.5 * np.diff(edges))[0]
        # run-length: padded with False, so begins and ends alternate
        # a known collision has a distance of 0: boxes that overlap before it are near, too
        is_near = gaps < max(best, 2.0 * MEETING)
        ends = np.flatnonzero(np.diff(np.concatenate([[False], is_near, [False]])))
        for first, last in ends.reshape(-1, 2).tolist():
            # whole segments of the path: outward on both sides
            low = int(self.path.segments(edges[first : first + 1])[0])
            high = int(np.searchsorted(parameters, edges[last])) + 1
            yield part_of(motion, low, high)

    def _finish(self, search: Search, end: float) -> None:
        """Search to an end; on a part of the path, as if they collided there."""
        if end < self.path.length:
            # the search ends at its first collision, so a made-up one cuts the rest of the path off
            search.found.distance[0], search.found.parameter[0] = MEETING, end
        is_over = False
        while not is_over:
            self.check_time()
            is_over = search.go_on(STEPS)
        self.queries += search.queries
        if end < self.path.length and search.found.parameter[0] >= end:
            # the made-up collision again: nothing was found before it
            search.found.parameter[0] = -1.0

    def check_time(self) -> None:
        """End the sweep by OverTimeError if its time is over."""
        if time.monotonic() > self.until:
            raise OverTimeError


def part_of(motion: PathMotion, low: int, high: int) -> PathMotion:
    """Motion through poses low .. high - 1."""
    return motion._replace(
        parameters=motion.parameters[low:high], centers=motion.centers[low:high],
        rotations=motion.rotations[low:high], turns=motion.turns[low : high - 1],
    )  # fmt: skip


def box_gaps(tool: ToolSurface, path: ToolPath, objects: Sequence[Object]) -> tuple[Floats, Floats]:
    """Ends (N + 1,) of stretches of a path; distances (O, N) of boxes, never too large."""
    edges = np.linspace(0.0, path.length, (STRETCHES if path.length else 1) + 1)
    bounds = np.array([obj.bounds for obj in objects]).reshape(-1, 2, 3)
    # parameters bound motion: half a stretch is the most that the tool leaves its middle pose
    middles = path.at(0.5 * (edges[:-1] + edges[1:]))
    return edges, tool.box_gaps(bounds, middles, 0.5 * np.diff(edges))


def error_of(distance: float) -> float:
    """Tolerance of a least distance, metres."""
    return COARSE * max(1.0, 1e3 * distance)

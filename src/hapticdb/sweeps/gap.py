"""Least distance of two surfaces along a path, and where they meet first: branch and bound.

A place of the path is told by its way: the metres that the tool's farthest-moving place has moved
at most. So the distance of two surfaces changes by no more than the way does, and one measurement
in the middle of a stretch bounds the distance on all of it. A stretch is halved until its bound is
as good as the nearest place that is known.
"""

import time
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.surfaces.sides import TriangleTree
from hapticdb.kernels.triangles.nearest import Nearest
from hapticdb.pointshell.moving import MovingSurface
from hapticdb.sweeps.way import Way

Floats = NDArray[np.float64]

FINE = 9e-6
"""Metres to which a least distance is found, if that is more than `SHARE` of it."""
SHARE = 0.009
"""Share of a least distance to which it is found. Larger: fewer measurements."""
MEETING = 1e-5
"""Metres: surfaces that come so near have met."""
AT_ONCE = 512
"""Stretches that are measured together. Larger: more memory, and a limit of time is overrun by
more."""


class OverTimeError(Exception):
    """The time of a sweep is over."""


class Least(NamedTuple):
    """A distance, metres, the way where it is found, and the places (3,) that are so near there."""

    at_most: float
    way: float
    on_object: Floats
    on_tool: Floats


class Pair:
    """The tool and one object along a path.

    tree : triangles of the object, world frame; until : time of `time.monotonic` at which it ends
    by OverTimeError.
    """

    def __init__(
        self, tree: TriangleTree, tool: MovingSurface, way: Way, until: float = np.inf
    ) -> None:
        self.tree, self.tool, self.way, self.until = tree, tool, way, until
        self.looks = 0

    def measure(
        self, ways: Floats, farthest: Floats, then: float = np.inf, enough: float = 0.0
    ) -> Nearest:
        """Measure at ways (n,); the others are as for `kernels.triangles.nearest`."""
        if time.monotonic() > self.until:
            raise OverTimeError
        self.looks += len(ways)
        return self.tool.nearest(self.tree, self.way.at(ways), farthest, then=then, enough=enough)

    def least(self, lows: Floats, highs: Floats, best: float) -> tuple[Least | None, float]:
        """Least distance on stretches of the path (n,), if it is less than `best`; else None.

        Returns what is proved of the stretches, too. Ends as soon as the surfaces have met.
        """
        found: Least | None = None
        closed = best
        while len(lows):
            (low, high), (lows, highs) = _last(lows, highs)
            middles, halves = 0.5 * (low + high), 0.5 * (high - low)
            wanted = best - error_of(best) if np.isfinite(best) else best
            near = self.measure(middles, wanted + halves, best, MEETING)
            n = int(np.argmin(near.at_most))
            if near.at_most[n] < best:
                best = float(near.at_most[n])
                found = Least(best, float(middles[n]), near.on_a[n], near.on_b[n])
            if best <= MEETING:
                return found, 0.0
            bounds = near.at_least - halves
            is_open = bounds < best - error_of(best)
            closed = min(closed, float(bounds[~is_open].min(initial=np.inf)))
            low, high = _halved(low, high, is_open)
            lows, highs = np.concatenate([lows, low]), np.concatenate([highs, high])
        return found, max(min(closed, best), 0.0)

    def first(self, lows: Floats, highs: Floats, known: Least) -> Least:
        """Where on stretches of the path (n,), ascending, the surfaces meet first.

        known : where they do. Before the place that is told they keep half of `MEETING` apart.
        """
        found = known
        lows, highs = lows[::-1], highs[::-1]
        while len(lows):
            (low, high), (lows, highs) = _last(lows, highs)
            middles, halves = 0.5 * (low + high), 0.5 * (high - low)
            near = self.measure(middles, MEETING + halves, MEETING)
            met = np.flatnonzero((near.at_most <= MEETING) & (middles < found.way))
            if len(met):
                n = int(met[np.argmin(middles[met])])
                found = Least(float(near.at_most[n]), float(middles[n]), near.on_a[n], near.on_b[n])
            is_open = (near.at_least - halves < 0.5 * MEETING) & (low < found.way)
            is_open &= halves > 0.25 * MEETING
            low, high = _halved(low[::-1], high[::-1], is_open[::-1])
            is_before = lows < found.way
            lows = np.concatenate([lows[is_before], low[::-1]])
            highs = np.concatenate([highs[is_before], high[::-1]])
        return found


def error_of(distance: float) -> float:
    """Metres to which a least distance is found."""
    return max(FINE, SHARE * distance)


def _last(lows: Floats, highs: Floats) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
    """The last stretches, `AT_ONCE` at most, and those before them."""
    return (lows[-AT_ONCE:], highs[-AT_ONCE:]), (lows[:-AT_ONCE], highs[:-AT_ONCE])


def _halved(lows: Floats, highs: Floats, is_open: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Both halves of the stretches that are open, in order."""
    low, high = lows[is_open], highs[is_open]
    middle = 0.5 * (low + high)
    return np.stack([low, middle], axis=1).ravel(), np.stack([middle, high], axis=1).ravel()

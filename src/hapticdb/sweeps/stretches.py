"""Stretches of a path, and how near each object's box comes to the tool's on each of them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hapticdb.store.base import Object
from hapticdb.sweeps.way import Way

Floats = NDArray[np.float64]

MOST = 256
"""Stretches of a path. More: fewer objects and stretches are looked at, more boxes compared."""
AT_ONCE = 4096
"""Objects whose boxes are compared together. Larger: more memory."""


class Stretches:
    """A path in equal stretches.

    lows, highs (W,) : ways, metres; gaps (O, W) : least distance of each object's box to the tool's
    box on each stretch, never too large; least (O,) : of all stretches.
    """

    def __init__(self, way: Way, corners: Floats, objects: Sequence[Object]) -> None:
        """Compare boxes; corners (V, 3) : the tool's, its frame."""
        edges = np.linspace(0.0, way.length, (MOST if way.length > 0.0 else 1) + 1)
        self.lows, self.highs = edges[:-1], edges[1:]
        poses = way.at(0.5 * (self.lows + self.highs))
        low, high = corners.min(axis=0), corners.max(axis=0)
        middles = poses[:, :3, :3] @ (0.5 * (low + high)) + poses[:, :3, 3]
        reach = np.abs(poses[:, :3, :3]) @ (0.5 * (high - low))
        reach += 0.5 * (self.highs - self.lows)[:, None]
        lower, upper = middles - reach, middles + reach
        boxes = np.array([obj.bounds for obj in objects]).reshape(-1, 2, 3)
        self.gaps = np.empty((len(objects), len(self.lows)))
        for at in range(0, len(objects), AT_ONCE):
            some = boxes[at : at + AT_ONCE, :, None]
            apart = np.maximum(np.maximum(some[:, 0] - upper, lower - some[:, 1]), 0.0)
            self.gaps[at : at + AT_ONCE] = np.linalg.norm(apart, axis=2)
        self.least = self.gaps.min(axis=1, initial=np.inf)

    def nearer(self, gaps: Floats, than: float, begin: float) -> tuple[Floats, Floats]:
        """Ways of the stretches where gaps (W,) are less, without what is before `begin`."""
        is_near = (gaps < than) & (self.highs >= begin)
        return np.maximum(self.lows[is_near], begin), self.highs[is_near]

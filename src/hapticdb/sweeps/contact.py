"""Objects that the tool touches where its path starts: followed until they are apart."""

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.sweeps.cut import NONE, Cut, Mesh, cut
from hapticdb.sweeps.gap import Pair

Floats = NDArray[np.float64]

SLIDE = 4.0
"""Contact tolerances that the tool moves on while it touches, from which it slides."""
STEP, STEP_OF_GROWTH = 1.5, 0.75
"""Way between two looks: contact tolerances, or a share of what a cut may grow by if that is more.
Larger: fewer looks, and less is allowed at each."""
KEPT = 0.53
"""Share of that way by which a cut must stay below what is allowed, since it is deeper by half of
the way at most between two looks."""
EASE = 0.2
"""Contact tolerances by which surfaces are shifted, to see that they only touch."""
SHIFT = 0.05
"""Contact tolerances by which surfaces are shifted, to measure how deep they overlap."""
DEEP = 0.06
"""Share of the start's cut by which it may grow, if that is more than the tolerance: measurements
differ by half as much where places and corners are few. Larger: more of it is allowed."""
BLOCK = 64
"""Looks that are measured together."""
WAYS = np.array([way for way in product((0.0, 1.0, -1.0), repeat=3) if any(way)])
WAYS /= np.linalg.norm(WAYS, axis=1)[:, None]
"""Directions (26, 3) of the shifts that may free surfaces."""
PATIENCE = 16
"""Looks without shifts, after none of them freed the surfaces."""


class FollowedContact(NamedTuple):
    """How a contact goes on: as `result.TouchedObject`, with ways in metres.

    until : way at which they are apart, or where it ends; is_apart : whether they are apart there;
    refused : way and cut where they overlap by more than is allowed, or None.
    """

    start: float
    deepest: float
    allowed: float
    until: float
    is_apart: bool = False
    refused: tuple[float, Cut] | None = None

    def is_sliding(self, contact: float) -> bool:
        """Whether the tool moves on while it touches."""
        return self.until > SLIDE * contact


def follow(pair: Pair, contact: float, object_mesh: Mesh, tool_mesh: Mesh) -> FollowedContact:
    """Follow a contact from the start of the path, where the surfaces are within `contact` metres.

    A cut may grow to the greater one of the start's and `contact`, and by `contact` more, or by
    `DEEP` of the start's if that is more.
    """
    depths = _Depths(pair, contact, object_mesh, tool_mesh)
    start = depths.cut(pair.way.at([0.0])[0], np.inf, contact).depth
    growth = max(contact, DEEP * start)
    step = max(STEP * contact, STEP_OF_GROWTH * growth)
    allowed = max(start, contact) + growth
    deepest, way, length = start, 0.0, pair.way.length
    while way < length:
        ways = np.minimum(way + step * np.arange(1, BLOCK + 1), length)
        ways = ways[: int(np.searchsorted(ways, length)) + 1]
        gaps = pair.measure(ways, np.full(len(ways), 2.0 * contact)).at_least
        for way, gap, pose in zip(ways.tolist(), gaps.tolist(), pair.way.at(ways), strict=True):
            if gap > contact:
                return FollowedContact(start, deepest, allowed, way, is_apart=True)
            found = NONE
            if gap <= 0.0:
                found = depths.of(pose, allowed + contact, allowed - KEPT * step)
            deepest = max(deepest, found.depth)
            if found.depth > allowed - KEPT * step:
                return FollowedContact(start, deepest, allowed, way, refused=(way, found))
    return FollowedContact(start, deepest, allowed, length)


class _Depths:
    """How deep the surfaces overlap at poses, or a bound of it."""

    def __init__(self, pair: Pair, contact: float, object_mesh: Mesh, tool_mesh: Mesh) -> None:
        self._pair, self._object, self._tool = pair, object_mesh, tool_mesh
        self._contact, self._ease = contact, EASE * contact
        self._shifts = self._ease * WAYS
        self._known = 0
        self._resting = 0

    def of(self, pose: Floats, most: float, enough: float) -> Cut:
        """Cut at a pose, as `cut`.

        Surfaces that a shift by `ease` frees overlap by that much at most, which is told then.
        """
        if self._is_freed(pose):
            return Cut(self._ease, pose[:3, 3])
        return self.cut(pose, most, enough)

    def _is_freed(self, pose: Floats) -> bool:
        """Whether a small shift frees the surfaces; the last one that did is tried first."""
        if self._resting:
            self._resting -= 1
            return False
        order = [self._known, *(n for n in range(len(self._shifts)) if n != self._known)]
        for some in (order[:1], order[1:]):
            poses = np.tile(pose, (len(some), 1, 1))
            poses[:, :3, 3] += self._shifts[some]
            far = np.full(len(some), self._ease)
            apart = self._pair.tool.nearest(self._pair.tree, poses, far).at_least
            self._pair.looks += len(some)
            free = np.flatnonzero(apart > 0.0)
            if len(free):
                self._known = some[int(free[0])]
                return True
        self._resting = PATIENCE
        return False

    def cut(self, pose: Floats, most: float, enough: float) -> Cut:
        """Cut at a pose, up to `most` metres; `enough` ends its search."""
        return cut(self._object, self._tool, pose, most, SHIFT * self._contact, enough)

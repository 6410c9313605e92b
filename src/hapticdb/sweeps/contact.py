"""Objects that the tool touches where its path starts: followed until they are apart.

Where a small motion of the tool frees it, tool and object overlap by no more than that motion
(`easing`). So the tool that is moved aside is swept on: until it meets the object, the contact is
no deeper. Where no such motion is found, how deep they overlap is measured, look by look (`cut`).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.sweeps.cut import NONE, Cut, Mesh, cut
from hapticdb.sweeps.easing import Easing
from hapticdb.sweeps.gap import Pair

Floats = NDArray[np.float64]

SLIDE = 4.0
"""Contact tolerances that the tool moves on while it touches, from which it slides."""
STRIDE = 3.0
"""Contact tolerances between two looks whether the surfaces are apart, where they are eased."""
STEP, STEP_OF_GROWTH = 1.5, 0.75
"""Way between two looks at a cut: contact tolerances, or a share of what a cut may grow by if that
is more. Larger: fewer looks, and less is allowed at each."""
KEPT = 0.53
"""Share of that way by which a cut must stay below what is allowed, since it is deeper by half of
the way at most between two looks."""
SHIFT = 0.05
"""Contact tolerances by which surfaces are shifted, to measure how deep they overlap."""
DEEP = 0.06
"""Share of the start's cut by which it may grow, if that is more than the tolerance: measurements
differ by half as much where places and corners are few. Larger: more of it is allowed."""
FLOOR = 0.9
"""Share of the last cut below which the next one is not measured. Less: slower looks, and longer
ways between them where a cut gets less."""
BLOCK = 64
"""Looks whether surfaces are apart that are done together."""
REACH = 0.9
"""Share of the way up to the next look on which a cut would stay as deep. Larger: fewer looks, more
of which are done again, nearer."""
PATIENCE = 16
"""Shortest ways between looks until motions that ease a cut are tried again."""


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
    return _Following(pair, contact, object_mesh, tool_mesh).followed()


class _Following:
    """State of a contact that is followed."""

    def __init__(self, pair: Pair, contact: float, object_mesh: Mesh, tool_mesh: Mesh) -> None:
        self._pair, self._contact = pair, contact
        self._object, self._tool = object_mesh, tool_mesh
        self._depth = contact
        self._start = self._cut(pair.way.at([0.0])[0], np.inf, contact).depth
        growth = max(contact, DEEP * self._start)
        self._step = max(STEP * contact, STEP_OF_GROWTH * growth)
        self._allowed = max(self._start, contact) + growth
        deep = self._start > contact
        self._easing = Easing(pair, self._start + 0.5 * growth if deep else contact)
        self._deepest = self._depth = self._start

    def followed(self) -> FollowedContact:
        """Follow it to its end."""
        way, length = 0.0, self._pair.length
        while way < length:
            eased = self._easing.until(way)
            if eased > way + self._step or eased >= length:
                self._deepest = max(self._deepest, self._easing.reach)
                apart = self._first_apart(way, eased)
                if apart is not None:
                    return self._told(apart, is_apart=True)
                way = eased
                self._depth = self._easing.reach
                continue
            told = self._looked(way, min(way + PATIENCE * self._step, length))
            if told is not None:
                return told
            way = min(way + PATIENCE * self._step, length)
        return self._told(length)

    def _told(
        self, until: float, refused: tuple[float, Cut] | None = None, *, is_apart: bool = False
    ) -> FollowedContact:
        return FollowedContact(self._start, self._deepest, self._allowed, until, is_apart, refused)

    def _first_apart(self, begin: float, end: float) -> float | None:
        """The first look between two ways at which the surfaces are apart."""
        stride = STRIDE * self._contact
        for first in np.arange(begin, end, BLOCK * stride).tolist():
            ways = np.minimum(first + stride * np.arange(1, BLOCK + 1), end)
            ways = ways[: int(np.searchsorted(ways, end)) + 1]
            far = np.flatnonzero(self._gaps(ways, self._contact) > self._contact)
            if len(far):
                return float(ways[far[0]])
        return None

    def _gaps(self, ways: Floats, enough: float = 0.0) -> Floats:
        far = np.full(len(ways), 2.0 * self._contact)
        return self._pair.measure(ways, far, enough).at_least

    def _looked(self, begin: float, end: float) -> FollowedContact | None:
        """Look at the cut between two ways; how it ends if it does.

        On a way of some length a cut gets deeper by as much at most. So between two looks it is no
        deeper than half of both cuts and the way. Where that is too much, a nearer look follows.
        """
        way, length = begin, 0.0
        while way < end:
            if not length:
                length = max(REACH * 2.0 * (self._allowed - self._depth), self._step)
            there = min(way + length, end)
            enough = min(2.0 * self._allowed - self._depth - (there - way), self._allowed)
            is_nearest = length <= self._step
            if is_nearest:
                enough = self._allowed - KEPT * self._step
            found, is_apart = self._look(there, enough, is_nearest=is_nearest)
            if is_apart:
                return self._told(there, is_apart=True)
            if found.depth <= enough:
                self._depth, way, length = found.depth, there, 0.0
                self._deepest = max(self._deepest, found.depth)
            elif is_nearest:
                self._deepest = max(self._deepest, found.depth)
                return self._told(there, (there, found))
            else:
                length = max(0.5 * length, self._step)
        return None

    def _look(self, way: float, enough: float, *, is_nearest: bool) -> tuple[Cut, bool]:
        """The cut at a way, and whether the surfaces are apart there.

        Unless it is the nearest look, a greater cut is not looked at closely.
        """
        gap = self._gaps(np.array([way]))[0]
        if gap > 0.0:
            return NONE, gap > self._contact
        self._pair.check_time()
        most = self._allowed + self._contact
        pose = self._pair.way.at([way])[0]
        return self._cut(pose, most, enough if is_nearest else np.inf), False

    def _cut(self, pose: Floats, most: float, enough: float) -> Cut:
        """Cut at a pose, up to `most` metres; `enough` ends its search."""
        known = min(max(self._depth, self._contact), enough)
        floor = FLOOR * known if known > self._contact else 0.0
        shift = SHIFT * self._contact
        return cut(self._object, self._tool, pose, most, shift, enough, known, floor)

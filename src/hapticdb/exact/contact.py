"""Contacts at the start of a path, followed by separating motions until the surfaces are apart.

The path is free of a touched object if one small motion (`separation`) of the tool or the object
lets the tool follow the path without a collision: no place of the tool gets to another side of
anything, however thin. Changes of the motion along the path are proved. The depth at single poses
is no criterion, since it has no memory of sides.
"""

from collections.abc import Iterator
from itertools import chain, islice

import numpy as np
from numpy.typing import NDArray

from hapticdb.exact.distance import Pair
from hapticdb.exact.separation import GROWTH, NOTHING, SAME, MovedPair, Separation
from hapticdb.kernels.triangles.path_distance import MEETING
from hapticdb.pointshell.shape import CollisionShape

Floats = NDArray[np.float64]

CLEARANCE = 2.0 * MEETING
"""Gap after a separating motion, metres."""
SLIDE = 4.0
"""Length of a sliding contact, contact tolerances, at least."""
STRIDE = 3.0
"""Contact tolerances between two proximity queries for the end of a contact."""
BLOCK, MOST_BLOCK = 8, 4096
"""Proximity queries of a batch: the first one, and the largest."""
SHARES = (0.02, 0.15, 0.3, 0.5, 0.75)
"""Shares of the reach for the least motion of coinciding surfaces."""
MOST_TRIED = 8
"""Motions at the start that are swept. More: fewer false hits, slower hits."""
BACKS = (0.2, 1.0, 5.0)
"""Reaches before a collision for the change to another motion."""
BEYOND = 0.25
"""Reaches beyond a collision for another motion, at least."""
MOST_CHANGES = 30
"""Changes of motions along the path."""
ON, FINE_HIT = 2.0, 0.1
"""Reaches beyond a hit for the pose of its depth, and the depth's relative tolerance."""
MOST_QUERIES = 1500
"""Distance queries for a depth: some hundredths of a second. Any number gives a lower bound."""


class Contact:
    """A contact from the start of the path, between surfaces within `contact` metres.

    start : upper bound of the overlap at the start, metres, infinite without a separating motion;
    start_at_least : proved penetration depth there; reach : of the motions; by : kind of the last
    one, empty without any; error : as given; parameter : path parameter followed so far, metres;
    is_over, is_apart, is_hit : whether it has ended, by separation or by a collision.
    """

    def __init__(
        self, pair: Pair, shape: CollisionShape, contact: float, gap: float, *, seated: bool,
        error: float = 0.0,
    ) -> None:  # fmt: skip
        """Begin; gap : of the surfaces, from below; seated : whether the tool may overlap more.

        error : chord errors of both surfaces. The reach of motions is less by them, so the true
        surfaces are free, too; with a negative one, a hit is a hit of the true surfaces.
        """
        self._pair, self._contact, self.error = pair, contact, error
        self._separation = Separation(shape, pair.tool, pair.check_time)
        self._still = self._separation.moved(NOTHING)
        self.start, self.start_at_least, self.by = contact, 0.0, ""
        self.reach = contact - error + CLEARANCE
        self.parameter, self.is_over, self.is_apart, self.is_hit = 0.0, False, False, False
        self._since, self._block, self._changes = 0.0, BLOCK, 0
        self._moved = self._begun(gap, seated=seated)
        if self._moved is None:
            self.start, self.is_over, self.is_hit = np.inf, True, True
        else:
            self.by = self._moved.motion.by

    def _begun(self, gap: float, *, seated: bool) -> MovedPair | None:
        """The first motion that frees the surfaces at the start; None if there is none."""
        pose, found = self._pair.path.at([0.0])[0], self._separation
        self._motions: Iterator[MovedPair] = iter(())
        self._motions = found.separating(pose, self.reach, CLEARANCE, gap=gap)
        # lazily: the other motions stay in the iterator until a collision
        first = next(self._motions, None)
        if first is not None:
            if gap > SAME + abs(self.error):
                self.start = 0.0
            return first if gap > SAME else self._on_nearest_side(first)
        reach, nearly = None, GROWTH * self._contact + CLEARANCE
        if seated:  # mostly that frees: the depth of what is sunk so little takes long to prove
            reach = found.least(pose, self.reach, nearly, CLEARANCE, gap=gap)
        if reach is None:
            depth = found.depth(pose, self._contact, most=MOST_QUERIES)[0]
            self.start_at_least = max(depth - abs(self.error), 0.0)
        # the proved depth is a lower bound of the reach: no search below it
        if reach is None and seated:
            least = max(nearly, depth + CLEARANCE)
            reach = found.least(pose, least, found.most_reach, CLEARANCE, gap=gap)
        if reach is None:
            return None
        self.reach, self.start = reach, reach - CLEARANCE + abs(self.error)
        self._motions = found.separating(pose, reach, CLEARANCE, gap=gap)
        return next(self._motions, None)

    def _on_nearest_side(self, first: MovedPair) -> MovedPair:
        """The first motion on the side of the least one, for coinciding surfaces.

        So a foil on an open sheet is on the side of its touching face.
        """
        pose, found = self._pair.path.at([0.0])[0], self._separation
        for share in SHARES:
            reach = CLEARANCE + share * (self.reach - CLEARANCE)
            motions = found.separating(pose, reach, CLEARANCE, gap=0.0, thorough=False)
            if (least := next(motions, None)) is not None:
                others = chain([first], self._motions)
                self._motions = (one for one in others if found.joins(least, one, pose))
                return next(self._motions, least)
        return first

    def is_leaky(self) -> bool:
        """Whether all that frees coinciding surfaces leaves one in an open one, almost enclosed."""
        pose, found = self._pair.path.at([0.0])[0], self._separation
        if self._moved is None:
            return False
        some = chain([self._moved], found.separating(pose, self.reach, CLEARANCE, gap=0.0))
        return all(found.is_nested(pose, one, is_leaky=True) for one in some)

    @property
    def is_sliding(self) -> bool:
        """Whether the tool moves on while it touches."""
        return self.parameter > SLIDE * self._contact

    def advance(self, end: float) -> None:
        """Follow the contact to a path parameter, or to its end."""
        while self.parameter < end and not self.is_over:
            stop, is_apart = self._next_apart(end)
            while self.parameter < stop and not self.is_over:
                self._pair.check_time()
                self._go_on(stop)
            # apart is not enough: the tool may have gone through, and be on the other side
            if is_apart and not self.is_over and self._is_left(stop):
                self.is_over = self.is_apart = True

    def depth(self) -> tuple[float, Floats]:
        """Penetration depth beyond the hit, proved from below, and its place (3,), world frame."""
        parameter = min(self.parameter + ON * self.reach, self._pair.path.length)
        pose = self._pair.path.at([parameter])[0]
        depth, place = self._separation.depth(pose, self._contact, FINE_HIT, MOST_QUERIES)
        return max(depth - abs(self.error), 0.0), place

    def _next_apart(self, end: float) -> tuple[float, bool]:
        """The next sample with separate surfaces, or the last one of a block."""
        stride = STRIDE * self._contact
        parameters = np.minimum(self.parameter + stride * np.arange(1, self._block + 1), end)
        parameters = parameters[: int(np.searchsorted(parameters, end)) + 1]
        # doubled: a short contact costs few queries, a long one few calls
        self._block = min(2 * self._block, MOST_BLOCK)
        enough = self._contact + abs(self.error)
        gaps = self._pair.measure(
            parameters, np.full(len(parameters), 2.0 * enough), enough
        ).at_least
        # a sample that is apart only ends the block: `_is_left` proves the way there
        apart = np.flatnonzero(gaps > enough)
        return (float(parameters[apart[0]]), True) if len(apart) else (float(parameters[-1]), False)

    def _is_left(self, parameter: float) -> bool:
        """Whether the tool itself gets from its moved place back to its own."""
        assert self._moved is not None  # noqa: S101 - it is followed
        return self._separation.joins(self._moved, self._still, self._pair.path.at([parameter])[0])

    def _go_on(self, stop: float) -> None:
        """Follow the motion to a path parameter, change it at a collision, or note a hit."""
        assert self._moved is not None  # noqa: S101 - as above
        collision = self._pair.first_collision(self._moved, self.parameter, stop)
        self.parameter = max(self.parameter, collision)
        if collision >= stop:
            return
        pose = self._pair.path.at([self.parameter])[0]
        for moved in islice(self._motions, MOST_TRIED):
            if not self._separation.is_free(moved, pose, MEETING):
                continue
            # from the start of the path: the motion must free the whole contact, not its rest alone
            reached = self._pair.first_collision(moved, 0.0, stop)
            if reached > self.parameter:
                self._change(moved, 0.0, reached)
                return
        # no single motion is left: only a change between two can go on
        self._motions = iter(())
        if self._changes == MOST_CHANGES or not self._hand_over(collision):
            self.is_over = self.is_hit = True

    def _hand_over(self, collision: float) -> bool:
        """Change to a shift beyond a collision, a little before it."""
        assert self._moved is not None  # noqa: S101 - as above
        beyond = min(collision + BEYOND * self.reach, self._pair.path.length)
        there = self._pair.path.at([beyond])[0]
        # a little before the collision both motions may be free, and joined
        for back in BACKS:
            parameter = max(collision - back * self.reach, self._since)
            pose = self._pair.path.at([parameter])[0]
            shifts = self.reach * self._separation.shifts(pose)
            for moved in self._separation.shifted(pose, shifts, CLEARANCE, self._still):
                if (
                    # cheapest test first: one pose, one change, then a stretch of the path
                    self._separation.is_free(moved, there, MEETING)
                    and self._separation.joins(self._moved, moved, pose)
                    and self._pair.first_collision(moved, parameter, beyond) >= beyond
                ):
                    self._change(moved, parameter, beyond)
                    self._changes += 1
                    return True
        return False

    def _change(self, moved: MovedPair, since: float, parameter: float) -> None:
        self._moved, self._since, self.parameter, self.by = moved, since, parameter, moved.motion.by

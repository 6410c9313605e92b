"""Objects that the tool touches where its path starts: followed until they are apart."""

from typing import NamedTuple

import numpy as np

from hapticdb.sweeps.cut import Cut, Mesh, cut
from hapticdb.sweeps.gap import Pair

SLIDE = 4.0
"""Contact tolerances that the tool moves on while it touches, from which it slides."""


class Followed(NamedTuple):
    """How a contact goes on: as `result.Touching`, with ways in metres.

    until : way at which they are apart, the path's length if they never are; refused : way and cut
    where they overlap by more than is allowed, or None.
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


def follow(pair: Pair, contact: float, object_mesh: Mesh, tool_mesh: Mesh) -> Followed:
    """Follow a contact from the start of the path, where the surfaces are within `contact` metres.

    A cut may grow to the greater one of the start's and `contact`, and by `contact` more. It is
    measured every `contact` metres of the way while surfaces cross, and a depth changes by half of
    that in between: so half of `contact` is kept in hand.
    """
    most = np.inf
    way, start, deepest = 0.0, 0.0, 0.0
    allowed = 2.0 * contact
    while True:
        gap = float(pair.measure(np.array([way]), np.array([2.0 * contact])).at_least[0])
        if gap > contact and way > 0.0:
            return Followed(start, deepest, allowed, way, is_apart=True)
        found = Cut(0.0, np.zeros(3))
        if gap <= 0.0:
            found = cut(object_mesh, tool_mesh, pair.way.at([way])[0], most)
        if way == 0.0:
            start = found.depth
            allowed = max(start, contact) + contact
            most = allowed + contact
        deepest = max(deepest, found.depth)
        if found.depth > allowed - 0.5 * contact:
            return Followed(start, deepest, allowed, way, refused=(way, found))
        if way >= pair.way.length:
            return Followed(start, deepest, allowed, way)
        way = min(way + gap + contact, pair.way.length)

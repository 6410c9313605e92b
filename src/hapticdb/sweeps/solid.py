"""A closed surface: whether it holds places, and bounds of how deep they are in it.

A depth is the distance of a place inside from the border; outside it is the distance, negative. Of
one body every triangle is border, so the distance to the nearest triangle is the depth. Of several
bodies that overlap, `border` says which pieces may be border: the nearest of them bounds a distance
from below, and the nearest one that surely is bounds it from above.
"""

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.surfaces import nearest, sides
from hapticdb.pointshell.coverage import Interior
from hapticdb.pointshell.orientation import Surface
from hapticdb.sweeps.border import LINES, border_of, split_bodies
from hapticdb.sweeps.pieces import Cut, cut

Floats = NDArray[np.float64]

FINER = 0.2
"""Radius of the smallest pieces where bodies of one object cross, as a share of the largest ones.
Smaller: closer bounds there, more memory."""
MOST_PIECES = 150_000
"""Greatest number of pieces that a surface is cut into, or twice its triangles. Larger: depths are
known more closely where triangles are large, with more memory."""


class Solid:
    """A surface with its inside, if all of it is closed.

    Parameters
    ----------
    surface : Surface
        Triangles, metres, as `orient` returns them.
    goal : float
        Radius of its pieces, metres; larger where there would be too many.

    Attributes
    ----------
    is_closed : bool
        Whether every triangle belongs to a closed body, and it is known to which one where bodies
        meet in edges; otherwise there are no depths.
    pieces : Cut
        All of the surface that may be border.
    is_sure : (P,) bool
        Whether a piece is border, all of it, to within `unsure`.
    unsure : float
        Metres.
    """

    def __init__(self, surface: Surface, goal: float) -> None:
        self.is_closed = bool((surface.bodies > 0).all())
        if self.is_closed:
            apart = split_bodies(surface)
            self.is_closed, surface = apart is not None, apart or surface
        self.surface = surface
        most = max(MOST_PIECES, 2 * len(surface.triangles))
        while (pieces := cut(surface.triangles, goal, most)) is None:
            goal *= 2.0
        self.pieces: Cut = pieces
        self.is_sure = np.ones(len(pieces.middles), dtype=bool)
        self.unsure = 0.0
        triangles = near = surface.triangles
        self._interior = Interior(surface) if self.is_closed else None
        if self._interior is not None and int(surface.bodies.max()) > 1:
            border = border_of(surface, self._interior, pieces, FINER * goal, 2 * most)
            self.pieces, self.is_sure, self.unsure = border.pieces, border.is_sure, border.unsure
            points = np.repeat(border.witnesses[:, None], 3, axis=1)
            triangles = border.pieces.triangles
            near = np.concatenate([triangles[border.is_sure], points])
        if not len(near):
            self.is_closed = False
            triangles = near = surface.triangles
        self._walls = None if triangles is surface.triangles else _tree_of(surface.triangles)
        self._tree = _tree_of(triangles)
        self._sure = self._tree if near is triangles else _tree_of(near)

    def distances(self, places: Floats, enough: float) -> Floats:
        """Least distances (n,) of places (n, 3) from the border; what is near may be too large.

        A value above `enough` is a lower bound of the distance, and one below says that it is near.
        """
        return nearest.distances_to(self._tree, places, enough)

    def depths(self, places: Floats, enough: float) -> tuple[Floats, Floats]:
        """Bounds (n,) of the depth of places (n, 3) from below and above.

        Places within `enough` of the border are not told from others there, on either side.
        """
        farthest = nearest.distances_to(self._sure, places, max(enough - self.unsure, 0.0))
        farthest += self.unsure
        low, high = -farthest, farthest.copy()  # on whichever side, it is no deeper than that
        far = np.flatnonzero(farthest > enough)
        if len(far):
            least = farthest[far]
            if self._sure is not self._tree:
                least = np.minimum(nearest.distances_to(self._tree, places[far]), least)
            is_inside = self.holds(places[far])
            is_doubtful = self._on_wall(places[far])
            high[far] = np.where(is_inside | is_doubtful, farthest[far], -least)
            low[far] = np.where(is_inside & ~is_doubtful, least, -farthest[far])
        return low, high

    def _on_wall(self, places: Floats) -> NDArray[np.bool_]:
        """Whether places (n, 3) are on a body's surface, so that it is not known who holds them.

        Where bodies meet, such a place may be far from the border.
        """
        if self._walls is None:
            return np.zeros(len(places), dtype=bool)
        wide = 2.0 * self.unsure
        return np.asarray(nearest.distances_to(self._walls, places, 0.0, wide) <= self.unsure)

    def holds(self, places: Floats) -> NDArray[np.bool_]:
        """Whether places (n, 3) are inside, (n,); on the surface either answer may come."""
        if self._interior is None or not len(places):
            return np.zeros(len(places), dtype=bool)
        return self._interior.bodies_around(places, None, LINES) > 0


def _tree_of(triangles: Floats) -> sides.TriangleTree:
    return sides.triangle_tree(triangles, np.zeros(len(triangles), dtype=np.int64))

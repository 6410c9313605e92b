"""A closed surface: whether it holds places, and bounds of their distances from its triangles.

Any place of the surface bounds a distance from above. The balls around pieces of the surface bound
it from below.
"""

import numpy as np
from numpy.typing import NDArray

from hapticdb.pointshell.coverage import Interior
from hapticdb.pointshell.orientation import Surface
from hapticdb.sweeps.pieces import Cut, cut

Floats = NDArray[np.float64]

FINER = 0.3
"""Radius of the pieces of an object of several bodies, as a share of those of others: only middles
of pieces bound distances there from above. Smaller: closer bounds, more memory."""
MOST_PIECES = 150_000
"""Greatest number of pieces that a surface is cut into, or twice its triangles. Larger: depths are
known more closely where triangles are large, with more memory."""
NEAREST = 8
"""Pieces around a place whose triangles are measured exactly. Larger: closer bounds, more time."""
AT_ONCE = 1 << 14
"""Places measured together. Larger: more memory."""
PROBES = 8
"""Places looked at along a way into the solid, to see how thick it is there."""
MOST_PROBED = 8192
"""Pieces, evenly chosen, from whose middles these ways begin. Larger: thinner spots are seen, in
more time."""
OUTSIDE = 1e-3
"""Distance from the surface, as a share of the pieces' radius, at which it is seen whether another
body of the same object holds a piece."""


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
        Whether every triangle belongs to a closed body; otherwise there are no depths.
    pieces : Cut
        All of the surface.
    """

    def __init__(self, surface: Surface, goal: float) -> None:
        from scipy.spatial import cKDTree  # noqa: PLC0415 - a third of a second

        self.surface = surface
        self.is_closed = bool((surface.bodies > 0).all())
        most = max(MOST_PIECES, 2 * len(surface.triangles))
        is_several = self.is_closed and int(surface.bodies.max()) > 1
        goal *= FINER if is_several else 1.0
        while (pieces := cut(surface.triangles, goal, most)) is None:
            goal *= 2.0
        self.pieces: Cut = pieces
        self._radius = float(pieces.radii.max())
        self._tree = cKDTree(pieces.middles)
        self._interior = Interior(surface) if self.is_closed else None
        self._outer = None
        if is_several:
            # where bodies overlap, the surface of one inside another is no border of the solid
            out = pieces.middles - OUTSIDE * self._radius * surface.normals[pieces.sources]
            is_border = ~self.holds(out)
            self._outer = cKDTree(pieces.middles[is_border]) if is_border.any() else None
            self.is_closed = self._outer is not None

    def distances(self, places: Floats, enough: float) -> tuple[Floats, Floats]:
        """Least and greatest distance (n,) of places (n, 3) from the border of the solid.

        Where the greatest one is at most `enough`, the least one is not looked for: it is 0.
        """
        least, most = np.zeros(len(places)), np.empty(len(places))
        for at in range(0, len(places), AT_ONCE):
            some = places[at : at + AT_ONCE]
            most[at : at + AT_ONCE] = self._most(some)
            rest = at + np.flatnonzero(most[at : at + AT_ONCE] > enough)
            if len(rest):
                least[rest], exact = self._least(places[rest])
                if self._outer is None:
                    most[rest] = exact
        return least, most

    def exact(self, place: Floats) -> float:
        """Distance of a place (3,) from the nearest triangle, from whatever body it is."""
        triangles = self.surface.triangles
        some = (triangles[at : at + AT_ONCE] for at in range(0, len(triangles), AT_ONCE))
        return min(float(distances_to(place, few).min()) for few in some)

    def holds(self, places: Floats) -> NDArray[np.bool_]:
        """Whether places (n, 3) are inside, (n,); on the surface either answer may come."""
        if self._interior is None or not len(places):
            return np.zeros(len(places), dtype=bool)
        return self._interior.holds(np.ascontiguousarray(places))

    def is_thick(self, pieces: Cut, depth: float) -> bool:
        """Whether the ways from the middles of pieces into the solid, so deep, stay inside it."""
        some = slice(None, None, 1 + len(pieces.middles) // MOST_PROBED)
        middles, inward = pieces.middles[some], self.surface.normals[pieces.sources[some]]
        steps = depth / PROBES * np.arange(1, PROBES + 1)
        return all(bool(self.holds(middles + step * inward).all()) for step in steps)

    def _most(self, places: Floats) -> Floats:
        """Distances (n,) to a place of the border that is near."""
        if self._outer is not None:
            return np.asarray(self._outer.query(places)[0])
        which = np.asarray(self._tree.query(places)[1])
        return distances_to(places, self.pieces.triangles[which])

    def _least(self, places: Floats) -> tuple[Floats, Floats]:
        """Lower bounds (n,) of the distances to all triangles, and distances (n,) to near ones."""
        count = min(NEAREST, len(self.pieces.middles))
        far, which = (
            np.asarray(found).reshape(len(places), count)
            for found in self._tree.query(places, k=count)
        )
        exact = distances_to(places[:, None], self.pieces.triangles[which]).min(axis=1)
        if count == len(self.pieces.middles):
            return exact, exact
        others = np.maximum(far[:, -1] - self._radius, 0.0)  # the other pieces are so far
        return np.minimum(exact, others), exact


def distances_to(places: Floats, triangles: Floats) -> Floats:
    """Distances (...) of places (..., 3) to triangles (..., 3, 3): to the plane or to an edge."""
    a, b, c = triangles[..., 0, :], triangles[..., 1, :], triangles[..., 2, :]
    squares = np.minimum(
        np.minimum(_edge_squares(places, a, b), _edge_squares(places, b, c)),
        _edge_squares(places, c, a),
    )
    normals = np.cross(b - a, c - a)
    area = _dot(normals, normals)
    offset = places - a
    over = _dot(normals, offset)
    # shares of the corners at the place's image in the plane; all positive inside
    v = _dot(np.cross(offset, c - a), normals)
    w = _dot(np.cross(b - a, offset), normals)
    is_over = (v >= 0.0) & (w >= 0.0) & (v + w <= area) & (area > 0.0)
    planes = over * over / np.where(area > 0.0, area, 1.0)
    return np.sqrt(np.where(is_over, np.minimum(planes, squares), squares))


def _edge_squares(places: Floats, a: Floats, b: Floats) -> Floats:
    """Squares of the distances of places to the edges from a to b, all (..., 3)."""
    way, offset = b - a, places - a
    length = _dot(way, way)
    share = np.clip(_dot(offset, way) / np.where(length > 0.0, length, 1.0), 0.0, 1.0)
    rest = offset - share[..., None] * way
    return _dot(rest, rest)


def _dot(one: Floats, other: Floats) -> Floats:
    return np.asarray(np.einsum("...k,...k->...", *np.broadcast_arrays(one, other)))

"""Which pieces of closed bodies that overlap lie on the border of the solid that they make.

The solid is where more bodies hold a place than voids do. Every place of its border is on the
surface of some body, but where bodies overlap, the surface of one inside another is no border. A
piece lies in a ball. Four cases are told apart:

- No triangle of another body meets the ball. Then the number of other bodies around is the same in
  all of it. Across the piece only its own body begins, so all of the piece is border, or none.
- Other bodies meet the ball only in the plane of the piece, as where two boxes end flush. Then the
  number is the same on each side of the plane, and both sides are looked at.
- A solid body holds all of the ball, and there are no voids: none of the piece is border.
- Otherwise the piece is cut into halves, and is open when it is small.

So the border lies on the pieces that are border or open, and every place of a piece that is border
lies on it, or within `Border.unsure` of it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.surfaces import nearest, sides
from hapticdb.pointshell.coverage import Interior, halves
from hapticdb.pointshell.orientation import Surface
from hapticdb.sweeps.pieces import Cut, radii_of
from hapticdb.sweeps.result import STRETCH

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

FLAT = 1e-6
"""Distance, as a share of the bounding box's diagonal, up to which triangles count as lying in one
plane. Larger: flush faces are recognised in less exact files, and bounds are wider by as much."""
CLUSTER = 6.0
"""Greatest distance from other bodies that is looked for, in radii of the largest piece. Larger:
fewer places are asked how many bodies hold them, in longer searches."""
LINES = 8
"""Lines that vote at most whether a body holds a place. Larger: slower; one decides, if it meets no
edge."""
AT_ONCE = 1 << 17
"""Pieces looked at together. Larger: more memory."""


class _Border(NamedTuple):
    """Pieces of a surface that may be border of the solid, P of them.

    pieces : their middles, radii, triangles and sources; is_sure (P,): whether all of the piece is
    border; witnesses (W, 3): places of the surface within `unsure` of the border, on pieces that
    are open; unsure : metres.
    """

    pieces: Cut
    is_sure: Bools
    witnesses: Floats
    unsure: float


def border_of(
    surface: Surface, interior: Interior, pieces: Cut, finest: float, most: int
) -> _Border:
    """Border of the solid of several closed bodies.

    pieces : all of the surface; finest : metres, radius at which an open piece is not cut any more;
    most : pieces beyond which none is cut.
    """
    corners = surface.triangles.reshape(-1, 3)
    flat = FLAT * float(np.linalg.norm(np.ptp(corners, axis=0)))
    sorting = _Sorting(surface, interior, flat)
    done: list[Cut] = []
    sure: list[Bools] = []
    rest, count = pieces, 0
    while len(rest.middles):
        is_border, is_open = sorting.sorted(rest)
        is_fine = rest.radii <= max(finest, 8.0 * flat)
        if count + 2 * int(is_open.sum()) > most:
            is_fine[:] = True
        is_kept = is_border | (is_open & is_fine)
        done.append(_some(rest, is_kept))
        sure.append(is_border[is_kept])
        count += len(done[-1].middles)
        rest = _halved(_some(rest, is_open & ~is_fine))
    found = _joined(done)
    is_sure = np.concatenate(sure)
    unsure = max(0.01 * finest, 2.0 * flat)
    middles = found.middles[~is_sure]
    aside = unsure * surface.normals[found.sources[~is_sure]]
    # between a place inside and one outside there is a place of the border
    sides_of = [interior.bodies_around(middles + way, None, LINES) > 0 for way in (aside, -aside)]
    across = sides_of[0] != sides_of[1]
    return _Border(found, is_sure, middles[across], unsure)


def split_bodies(surface: Surface) -> Surface | None:
    """Make bodies that only meet in edges bodies of their own; None where that is not possible.

    `orient` takes faces that share an edge for one body. Where an edge has more than two faces,
    several bodies meet there, and their walls may coincide. Each of them is closed by itself then:
    what is connected by edges of two faces has an even number of faces at each of its edges.
    """
    from scipy.sparse import coo_array  # noqa: PLC0415 - a third of a second
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415 - likewise

    corners = np.unique(surface.triangles.reshape(-1, 3), axis=0, return_inverse=True)[1]
    tail, head = corners.reshape(-1), np.roll(corners.reshape(-1, 3), -1, axis=1).reshape(-1)
    ends = np.stack([np.minimum(tail, head), np.maximum(tail, head)], axis=1)
    edges, uses = np.unique(ends, axis=0, return_inverse=True, return_counts=True)[1:]
    edges = edges.reshape(-1)
    if uses.max() <= 2:
        return surface
    order = np.argsort(edges, kind="stable")
    pairs = np.stack([order[:-1], order[1:]], axis=1)
    pairs = pairs[(edges[pairs[:, 0]] == edges[pairs[:, 1]]) & (uses[edges[pairs[:, 0]]] == 2)] // 3
    count = len(surface.triangles)
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    part = connected_components(links, directed=False)[1]
    ours = np.stack([np.repeat(part, 3), edges], axis=1)
    if (np.unique(ours, axis=0, return_counts=True)[1] % 2).any():
        return None
    return surface._replace(bodies=part.astype(np.int64) + 1)


class _Sorting:
    """Tells which pieces are border, and which are open."""

    def __init__(self, surface: Surface, interior: Interior, flat: float) -> None:
        self._surface, self._interior, self._flat = surface, interior, flat
        self._tree = sides.triangle_tree(surface.triangles, surface.bodies)
        self._signs = np.zeros(int(surface.bodies.max()) + 1, dtype=np.int64)
        for body, sign in interior.bodies:
            self._signs[body] = sign
        # a place in a solid body is inside, whatever other bodies do there, if there are no voids
        self._alone: dict[int, sides.TriangleTree] = {}
        if (self._signs >= 0).all():
            for body, _ in interior.bodies:
                mine = surface.triangles[surface.bodies == body]
                numbers = np.zeros(len(mine), dtype=np.int64)
                self._alone[body] = sides.triangle_tree(mine, numbers)

    def sorted(self, pieces: Cut) -> tuple[Bools, Bools]:
        """Whether each piece (P,) is border, and whether it is open."""
        is_border = np.zeros(len(pieces.middles), dtype=bool)
        is_open = np.zeros(len(pieces.middles), dtype=bool)
        for at in range(0, len(is_border), AT_ONCE):
            some = slice(at, at + AT_ONCE)
            is_border[some], is_open[some] = self._sorted(_some(pieces, some))
        return is_border, is_open

    def _sorted(self, pieces: Cut) -> tuple[Bools, Bools]:
        own = self._surface.bodies[pieces.sources]
        normals = self._surface.normals[pieces.sources]
        reach = (1.0 + STRETCH) * pieces.radii + 2.0 * self._flat
        behind = np.zeros(len(own), dtype=np.int64)
        apart = self._apart(pieces.middles, own, normals, reach, -1.0)
        is_apart = apart > reach
        alone = np.flatnonzero(is_apart)
        behind[alone] = self._around(pieces.middles[alone], own[alone], apart[alone])
        ahead = behind.copy()
        flush = np.flatnonzero(~is_apart & (pieces.radii > 8.0 * self._flat))
        flush = flush[
            self._apart(pieces.middles[flush], own[flush], normals[flush], reach[flush], self._flat)
            > reach[flush]
        ]
        aside = 0.5 * pieces.radii[flush, None] * normals[flush]
        for counts, sign in ((ahead, 1.0), (behind, -1.0)):
            counts[flush] = self._interior.bodies_around(
                pieces.middles[flush] + sign * aside, own[flush], LINES
            )
        signs = self._signs[own]
        ahead += signs > 0  # normals point into the solid: out of a void
        behind -= signs < 0
        is_open = np.ones(len(own), dtype=bool)
        is_open[alone] = is_open[flush] = False
        is_border = ~is_open & ((ahead > 0) != (behind > 0))
        rest = np.flatnonzero(is_open)
        is_open[rest] = ~self._buried(pieces.middles[rest], own[rest], reach[rest])
        return is_border, is_open

    def _apart(
        self, middles: Floats, own: Ints, normals: Floats, reach: Floats, flat: float
    ) -> Floats:
        """Distances (P,) of middles (P, 3) from other bodies; beyond the reach (P,) maybe less."""
        far = CLUSTER * float(reach.max(initial=0.0))
        return nearest.distances_to_others(self._tree, middles, own, normals, flat, far)

    def _buried(self, middles: Floats, own: Ints, reach: Floats) -> Bools:
        """Whether balls of that reach (P,) lie wholly in a solid body other than their own."""
        found = np.zeros(len(middles), dtype=bool)
        far = 1.1 * float(reach.max(initial=0.0))
        for body, tree in self._alone.items():
            some = np.flatnonzero(~found & (own != body))
            some = some[self._interior.is_around(body, middles[some])]
            some = some[nearest.distances_to(tree, middles[some], 0.0, far) > reach[some]]
            found[some] = self._interior.holds_in(body, middles[some], LINES)
        return found

    def _around(self, middles: Floats, own: Ints, apart: Floats) -> Ints:
        """How many other bodies are around middles (P, 3) that are so far apart (P,) from them.

        It is the same at all middles in a ball that meets no other body: one of them is asked.
        """
        from scipy.spatial import cKDTree  # noqa: PLC0415 - a third of a second

        asked = np.full(len(middles), -1)
        for body in np.unique(own).tolist():
            mine = np.flatnonzero(own == body)
            tree = cKDTree(middles[mine])
            for one in mine[np.argsort(-apart[mine])].tolist():
                if asked[one] < 0:
                    near = mine[tree.query_ball_point(middles[one], (1.0 - STRETCH) * apart[one])]
                    asked[near[asked[near] < 0]] = one
        ones, which = np.unique(asked, return_inverse=True)
        return self._interior.bodies_around(middles[ones], own[ones], LINES)[which]


def _some(pieces: Cut, which: Bools | slice) -> Cut:
    middles, radii, triangles, sources = pieces
    return Cut(middles[which], radii[which], triangles[which], sources[which])


def _joined(some: list[Cut]) -> Cut:
    middles, radii, triangles, sources = zip(*some, strict=True)
    return Cut(
        np.concatenate(middles), np.concatenate(radii), np.concatenate(triangles),
        np.concatenate(sources),
    )  # fmt: skip


def _halved(pieces: Cut) -> Cut:
    triangles = halves(pieces.triangles)
    middles = triangles.mean(axis=1)
    return Cut(middles, radii_of(triangles, middles), triangles, np.tile(pieces.sources, 2))

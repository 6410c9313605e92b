"""How deep two surfaces overlap, open or closed: what gets through, and how far.

Where a surface goes through another one, the other parts it into pieces. A piece that stays within
some metres of the other surface is pushed through by no more than that, on whichever side it is: a
peg's end in a wall, the patch of a wall in a peg. So where surfaces cross, one gets through the
other by the lesser of the greatest distances of its two pieces there. Along one curve on which two
surfaces cross, the cut is the lesser of what either gets through the other: an edge that is stuck
through a sheet by little cuts by little, though it parts the sheet. The cut of the surfaces is the
greatest of all curves. No inside is needed.

Pieces are told by edges: those of the mesh, and in each triangle that is gone through, edges from
there to its corners, so that the inside of a large triangle is seen, too. An edge is parted where
it goes through the other surface. What is connected by edges without such a place is one piece.
Where both sides of a place are one piece, as where a sheet is stuck on the border of another, the
parts of the edge itself count. Beyond a thin piece the next one counts, so that a plate is gone
through though its inside is near both of its faces.

What this does not see: pieces that lie wholly inside one triangle beside the edges drawn;
connections of meshes whose triangles do not share corners, whose pieces count as smaller than they
are; how far a part gets through that is itself thinner than the cut.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.surfaces.sides import TriangleTree
from hapticdb.kernels.triangles.parting import components, depths_of, spots_of
from hapticdb.kernels.triangles.piercing import piercing

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]

JOIN = 1e-6
"""Share of a surface's diagonal up to which corners are one, and places of an edge, too."""
WAYS = np.array([(0.61, 0.53, 0.59), (-0.57, 0.62, -0.54), (0.52, -0.58, -0.63)])
"""Ways by which a surface is shifted, about 1 long and along no likely plane. More: flush surfaces
are told from cuts more often."""


class Mesh:
    """A surface with its corners joined.

    tree : its triangles; points (V, 3); edges (E, 2), faces (T, 3) : numbers of points, the faces
    in the order of the tree; point_order (V,), edge_order (E,) : so that near ones mostly follow
    one another; lows, highs (3, E) : boxes of the edges, in that order; near : length up to which
    places are one, metres.
    """

    def __init__(self, tree: TriangleTree) -> None:
        self.tree = tree
        corners = tree.corners.reshape(-1, 3)
        low = corners.min(axis=0)
        self.near = JOIN * float(np.linalg.norm(corners.max(axis=0) - low)) or 1.0
        cells = np.rint((corners - low) / self.near).astype(np.int64)  # below 2^20
        _, first, inverse = np.unique(
            cells @ np.array([1 << 42, 1 << 21, 1]), return_index=True, return_inverse=True
        )
        self.points = np.ascontiguousarray(corners[first])
        self.faces = inverse.reshape(-1, 3)
        self.point_order = np.argsort(first)  # the tree's
        sides = np.stack([self.faces, np.roll(self.faces, -1, axis=1)], axis=2).reshape(-1, 2)
        sides.sort(axis=1)
        keys, which = np.unique(sides @ np.array([len(first), 1]), return_inverse=True)
        self.edges = np.stack(np.divmod(keys, len(first)), axis=1)
        which = which.reshape(-1)
        order = np.argsort(which, kind="stable")
        self._faces_at = order // 3
        self._starts = np.searchsorted(which[order], np.arange(len(self.edges) + 1))
        self.edge_order = np.argsort(order[self._starts[:-1]])  # the tree's
        a, b = self.points.T[:, self.edges[self.edge_order].T].swapaxes(0, 1)
        self.lows, self.highs = np.minimum(a, b), np.maximum(a, b)

    def faces_of(self, edges: Ints) -> tuple[Ints, Ints]:
        """Faces (F,) at edges (n,), with the index (F,) of the edge that each is at."""
        counts = self._starts[edges + 1] - self._starts[edges]
        which = np.repeat(np.arange(len(edges)), counts)
        within = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
        return self._faces_at[self._starts[edges][which] + within], which


class Cut(NamedTuple):
    """The deepest cut: metres, and its place (3,) in the frame of the first surface."""

    depth: float
    place: Floats


NONE = Cut(0.0, np.zeros(3))


def cut(
    one: Mesh, other: Mesh, one_from_other: Floats, most: float, shift: float, enough: float,
    known: float = 0.0, floor: float = 0.0,
) -> Cut:  # fmt: skip
    """Greatest cut of two surfaces, up to `most` metres: deeper ones are told as `most`.

    one_from_other (4, 4) : rigid. It is the least one of `WAYS` by which the other surface is
    shifted, until one is `enough`: where surfaces coincide, rounding decides what goes through, and
    a shift of many times that makes it plain. So it is exact to `shift` metres. Of a cut of
    `known` or less, it is only told that it is no more; one below `floor` is told as `floor`.
    """
    found: Cut | None = None
    for way in WAYS:
        pose = one_from_other.copy()
        pose[:3, 3] += shift * way
        here = _cut(one, other, pose, most, known, floor)
        if found is None or here.depth < found.depth:
            found, most = here, min(most, here.depth)  # a deeper one does not matter
        if found.depth <= enough:
            break
    assert found is not None  # noqa: S101 - there are ways
    return found


def _cut(
    one: Mesh, other: Mesh, one_from_other: Floats, most: float, known: float, floor: float
) -> Cut:
    """Greatest cut without a shift."""
    other_from_one: Floats = np.asarray(np.linalg.inv(one_from_other), dtype=np.float64)
    mine, theirs = _Parted(one, other, other_from_one), _Parted(other, one, one_from_other)
    if not (len(mine.shares) or len(theirs.shares)):
        return NONE
    spots = mine.spots(), theirs.spots()
    mine.add(*spots[1], one_from_other)
    theirs.add(*spots[0], other_from_one)
    return _deepest(mine, theirs, one_from_other, most, known, floor)


def _deepest(
    mine: "_Parted", theirs: "_Parted", one_from_other: Floats, most: float, known: float,
    floor: float,
) -> Cut:  # fmt: skip
    """The deepest of all curves: at each the lesser of what either surface gets through.

    The smaller surface is measured first, the other one only where that gets farther than `known`.
    """
    own, at_own = mine.crossings()
    other, at_other = theirs.crossings()
    pairs = np.concatenate([own, other[:, ::-1]])  # triangles that cross: of one, of the other
    n_own, n_all = len(mine.shares), len(mine.shares) + len(theirs.shares)
    place = np.concatenate([at_own, n_own + at_other])
    _, pair = np.unique(pairs @ np.array([len(theirs.faces), 1]), return_inverse=True)
    pair = pair.reshape(-1)
    size = n_all + (int(pair.max()) + 1 if len(pair) else 0)
    links = np.stack([place, n_all + pair], axis=1)
    _, curve = np.unique(components(links, size), return_inverse=True)
    n_curves = int(curve.max()) + 1
    parted = (mine, curve[:n_own]), (theirs, curve[n_own:n_all])
    through, is_open = np.full((2, n_curves), -1.0), np.ones(n_curves, dtype=bool)
    for n in (0, 1) if mine.size <= theirs.size else (1, 0):
        surface, curves = parted[n]
        is_asked = is_open[curves]
        if is_asked.any():
            far = surface.depths(is_asked, floor, most)
            np.maximum.at(through[n], curves[is_asked], far[is_asked])
        is_open = (through[n] < 0.0) | (through[n] > known)
    lesser = np.where(
        through[0] < 0.0, through[1], np.where(through[1] < 0.0, through[0], np.minimum(*through))
    )
    best = int(np.argmax(lesser))
    depth = float(lesser[best])
    if through[0][best] >= 0.0:
        return Cut(depth, mine.places()[np.flatnonzero(curve[:n_own] == best)[0]])
    place_of = theirs.places()[np.flatnonzero(curve[n_own:n_all] == best)[0]]
    return Cut(depth, one_from_other[:3, :3] @ place_of + one_from_other[:3, 3])


class _Parted:
    """A surface and the places where its edges go through another one.

    edges (P,), shares (P,) : edge of each place, and the share of the edge; ascending by both.
    """

    def __init__(self, mesh: Mesh, other: Mesh, other_from_mesh: Floats) -> None:
        self._mesh, self._other, self._pose = mesh, other, other_from_mesh
        self._points, self._edges = mesh.points, mesh.edges
        self._spotted: Ints = np.empty(0, dtype=np.int64)
        self.edges, self.shares = np.empty(0, dtype=np.int64), np.empty(0)
        self._triangles, self._place_of = self.edges, self.edges  # what goes through, its place
        middle, half = (
            0.5 * other.tree.boxes[0].sum(axis=0),
            0.5 * np.ptp(other.tree.boxes[0], axis=0),
        )
        back = np.linalg.inv(other_from_mesh)
        middle, half = back[:3, :3] @ middle + back[:3, 3], np.abs(back[:3, :3]) @ half + mesh.near
        is_near = np.ones(len(mesh.edges), dtype=np.bool_)
        for axis in range(3):
            is_near &= mesh.lows[axis] <= middle[axis] + half[axis]
            is_near &= mesh.highs[axis] >= middle[axis] - half[axis]
        near = mesh.edge_order[is_near]
        self._pierce(mesh.edges[near], near)

    def _pierce(self, edges: Ints, numbers: Ints) -> None:
        """Add places of edges (n, 2), whose numbers are (n,); what is at one place is one."""
        ends = np.ascontiguousarray(self._points[edges].reshape(-1, 2, 3))
        which, triangles, shares = piercing(ends, self._other.tree, self._pose)
        order = np.lexsort((shares, numbers[which]))
        which, triangles, shares = which[order], triangles[order], shares[order]
        lengths = np.linalg.norm(ends[which, 1] - ends[which, 0], axis=1)
        is_next = (np.diff(which, prepend=-1) != 0) | (
            np.diff(shares, prepend=0.0) * lengths > self._mesh.near
        )
        place_of = len(self.shares) + np.cumsum(is_next) - 1
        self.edges = np.concatenate([self.edges, numbers[which[is_next]]])
        self.shares = np.concatenate([self.shares, shares[is_next]])
        self._triangles = np.concatenate([self._triangles, triangles])
        self._place_of = np.concatenate([self._place_of, place_of])

    @property
    def faces(self) -> Ints:
        """Triangles, without those that were added."""
        return self._mesh.faces

    @property
    def size(self) -> int:
        """Number of points."""
        return len(self._points)

    def places(self) -> Floats:
        """The places (P, 3)."""
        ends = self._points[self._edges[self.edges]]
        return np.asarray(ends[:, 0] + self.shares[:, None] * (ends[:, 1] - ends[:, 0]))

    def spots(self) -> tuple[Ints, Floats]:
        """Triangles (S,) of the other surface that are gone through, and a spot (S, 3) in each.

        It is between places of the triangle, as far from this surface as such places are found.
        """
        order = np.argsort(self._triangles, kind="stable")
        triangles, first = np.unique(self._triangles[order], return_index=True)
        places, starts = self.places()[self._place_of[order]], np.append(first, len(order))
        return triangles, spots_of(self._mesh.tree, places, starts, 2.0 * self._mesh.near)

    def add(self, triangles: Ints, spots: Floats, mesh_from_other: Floats) -> None:
        """Add edges from spots (S, 3), other frame, on triangles (S,) to their corners."""
        numbers = np.repeat(len(self._points) + np.arange(len(spots)), 3)
        more = np.stack([numbers, self._mesh.faces[triangles].reshape(-1)], axis=1)
        spots = spots @ mesh_from_other[:3, :3].T + mesh_from_other[:3, 3]
        self._points = np.concatenate([self._points, spots])
        self._pierce(more, len(self._edges) + np.arange(len(more)))
        self._edges = np.concatenate([self._edges, more])
        self._spotted = np.repeat(triangles, 3)

    def crossings(self) -> tuple[Ints, Ints]:
        """Triangles that cross (C, 2), own and other, with the number (C,) of the place of each."""
        n_edges = len(self._mesh.edges)
        edges = self.edges[self._place_of]
        own, spots = np.flatnonzero(edges < n_edges), np.flatnonzero(edges >= n_edges)
        faces, which = self._mesh.faces_of(edges[own])
        at = np.concatenate([own[which], spots])
        mine = np.concatenate([faces, self._spotted[edges[spots] - n_edges]])
        return np.stack([mine, self._triangles[at]], axis=1), self._place_of[at]

    def depths(self, is_asked: Flags, floor: float, most: float) -> Floats:
        """How far (P,) the surface gets through at each place that is asked (P,)."""
        n_asked = np.bincount(self.edges, is_asked, len(self._edges))
        added = np.arange(len(self._mesh.points), len(self._points))
        order = np.concatenate([self._mesh.point_order, added])
        return depths_of(
            self._points, order, self._edges, self.edges, self.shares, n_asked[self.edges] > 0.0,
            self._other.tree, self._pose, floor, most,
        )  # fmt: skip

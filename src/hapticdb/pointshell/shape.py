"""A surface for exact queries: its BVH, and on demand its inside, connected pieces and normals."""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import UsageError
from hapticdb.kernels.surfaces.triangle_bvh import TriangleBVH, normals_of, triangle_bvh
from hapticdb.kernels.triangles.offsets import FLAT
from hapticdb.pointshell.coverage import Interior, winding_numbers
from hapticdb.pointshell.orientation import Surface, components, faces_of, orient

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

FLATS, PARALLEL = 3, 0.999
"""Flat faces whose normals are axes, and the cosine from which two of them are parallel."""
ALIKE, CELLS = 1e-3, np.array([1, 1 << 12, 1 << 24])
"""Length of cells of normals that are those of one face, and the steps of their numbers."""
LEAK = 0.01
"""Share of the directions that may lead out of an open surface around a place. Larger: boxes that
lack a lid count."""
ASKEW = np.array([0.62, 0.54, 0.57])
"""Vector in no likely plane: it chooses one of two opposite normals."""


class CollisionShape:
    """Triangles (T, 3, 3) of one surface, or of a ball: its centre, without area.

    tree : BVH, whose order all arrays below have; box (2, 3) : corners; radius : of the ball, 0 of
    a surface, metres; is_cloud : whether the triangles are points, which enclose nothing; chord :
    chord error, metres: no place of the true surface is farther from the triangles.
    """

    def __init__(
        self, triangles: Floats, surface: Surface | None = None, *, radius: float = 0.0,
        is_cloud: bool = False, chord: float = 0.0, index: Ints | None = None,
    ) -> None:  # fmt: skip
        """Build the tree.

        surface : the same triangles, if `orient` has seen them; index (T, 3) : as for `faces_of`.
        """
        self.tree = bvh_of(triangles)
        low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
        self.box = np.stack([low - radius, high + radius])
        self.radius, self.is_cloud, self.chord = radius, is_cloud, chord
        self._given, self._index = surface, index

    @cached_property
    def _oriented(self) -> tuple[Surface, Ints] | None:
        """Surface with its inner side, and the tree's number of each of its triangles (F,)."""
        if self._given is not None:
            return self._given, np.argsort(self.tree.faces)
        if self.is_cloud or self.radius:
            return None
        try:
            surface = orient(self.tree.corners, self._corners)
        except UsageError:  # no area
            return None
        return surface, surface.faces

    @cached_property
    def interior(self) -> Interior | None:
        """Its inside; None where it has no closed body."""
        return (Interior(self._oriented[0]) or None) if self._oriented else None

    def almost_encloses(self, positions: Floats, by: Floats | None = None) -> NDArray[np.bool_]:
        """Whether its open surfaces, not watertight, go round positions (Q, 3): (Q,).

        By winding numbers near to a whole one, of all its open surfaces together, which cracks may
        part, or of one alone, which others may stand beside: a measurement, no proof. by : as for
        `moved_interior`.
        """
        triangles, parts, numbers, order = self._open
        if by is not None:
            triangles = triangles + np.take_along_axis(by[numbers], order, axis=1)
        turns = winding_numbers(triangles, parts, positions)
        whole, total = np.rint(turns), turns.sum(axis=1)
        # a wall of a void, open or not, takes off what the wall around it counts
        is_one = (whole * (np.abs(turns - whole) < LEAK)).any(axis=1) & (whole.sum(axis=1) != 0.0)
        is_all = (np.abs(total) > 0.5) & (np.abs(total - np.rint(total)) < LEAK)
        return np.asarray(is_one | is_all)

    @cached_property
    def has_open(self) -> bool:
        """Whether some of its surfaces are open."""
        return self._oriented is not None and not self._oriented[0].bodies.all()

    @cached_property
    def _open(self) -> tuple[Floats, Ints, Ints, Ints]:
        """Triangles (F, 3, 3) of its open surfaces, of one winding inwards.

        Then the connected part (F,) and the tree's number (F,) of each, and the order (F, 3, 1) of
        its corners.
        """
        if self._oriented is None:
            none = np.empty(0, np.int64)
            return self.tree.corners[:0], none, none, none.reshape(0, 1, 1)
        surface, numbers = self._oriented
        is_open = surface.bodies == 0
        found, inward = surface.triangles[is_open], surface.normals[is_open]
        is_outward = (normals_of(found)[0] * inward).sum(axis=1) < 0.0
        order = np.where(is_outward[:, None], [2, 1, 0], [0, 1, 2])[:, :, None]
        faces = self._corners[numbers[is_open]]
        links = np.concatenate([faces[:, :2], faces[:, 1:]])
        part = components(links, int(faces.max(initial=-1)) + 1)[faces[:, 0]]
        part = np.unique(part, return_inverse=True)[1]
        return np.take_along_axis(found, order, axis=1), part, numbers[is_open], order

    def moved_interior(self, by: Floats | None) -> Interior | None:
        """The inside after the tree's corners have moved by (T, 3, 3) metres, if they have."""
        if by is None or self.interior is None or self._oriented is None:
            return self.interior
        return self.interior.moved(by[self._oriented[1]])

    @cached_property
    def _corners(self) -> Ints:
        """Number (T, 3) of each corner; corners that coincide have the same."""
        return faces_of(
            self.tree.corners, None if self._index is None else self._index[self.tree.faces]
        )

    @cached_property
    def points(self) -> Ints:
        """Number (V,) among all corners (3 T,) of one at each place, ascending by `_corners`."""
        return _firsts(self._corners.reshape(-1))

    @cached_property
    def pieces(self) -> Ints:
        """Connected piece (V,) of each of `points`, 0, 1, ..."""
        faces = self._corners
        links = np.concatenate([faces[:, :2], faces[:, 1:]])
        return components(links, int(faces.max()) + 1)

    @cached_property
    def starts(self) -> Ints:
        """Number (P,) of one of `points` in each piece."""
        return _firsts(self.pieces)

    @cached_property
    def _face_normals(self) -> Floats:
        """Inward unit normals (T, 3); zeros without area."""
        found = np.zeros_like(self.tree.corners[:, 0])
        if self._oriented is not None:
            surface, numbers = self._oriented
            found[numbers] = surface.normals
        return found

    @cached_property
    def axes(self) -> Floats:
        """Unit vectors (N, 3) across which or along which it is alike: `FLATS` + 3 at most.

        Normals of its largest flat faces, and principal axes of all normals: a peg's own axis.
        """
        if self._oriented is None:
            return np.empty((0, 3))
        normals, areas = self._face_normals, normals_of(self.tree.corners)[1]
        side = np.sign(normals @ ASKEW)
        cells = np.rint(normals * side[:, None] / ALIKE).astype(np.int64) @ CELLS
        _, first, face = np.unique(cells, return_index=True, return_inverse=True)
        largest = np.argsort(-np.bincount(face.reshape(-1), areas), kind="stable")[:FLATS]
        principal = np.linalg.eigh((normals.T * areas) @ normals)[1].T
        found = np.zeros((0, 3))
        for axis in np.concatenate([normals[first[largest]], principal]):
            if axis.any() and not (np.abs(found @ axis) > PARALLEL).any():
                found = np.concatenate([found, axis[None]])
        return found

    @cached_property
    def normals(self) -> Floats:
        """Inward unit normals (T, 3, 3) at the corners, weighted by angle; zeros where none is."""
        found = self._face_normals[:, None] * _angles(self.tree.corners)[:, :, None]
        corners = self._corners.reshape(-1)
        sums = [np.bincount(corners, found[..., k].reshape(-1)) for k in range(3)]
        vectors = np.array(sums, dtype=np.float64).T
        lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
        units = vectors / np.where(lengths > FLAT, lengths, np.inf)
        return np.asarray(units[corners].reshape(-1, 3, 3), dtype=np.float64)


def _firsts(numbers: Ints) -> Ints:
    """Where each of the numbers 0, 1, ..., of which none is left out, comes first."""
    found = np.empty(int(numbers.max()) + 1, dtype=np.int64)
    found[numbers[::-1]] = np.arange(len(numbers))[::-1]
    return found


def _angles(triangles: Floats) -> Floats:
    """Angles (T, 3), radians, at the corners of triangles (T, 3, 3); 0 or pi without area."""
    ahead = np.roll(triangles, -1, axis=1) - triangles
    back = np.roll(triangles, 1, axis=1) - triangles
    across = np.linalg.norm(np.cross(ahead, back), axis=2)
    return np.asarray(np.arctan2(across, (ahead * back).sum(axis=2)))


def bvh_of(triangles: Floats) -> TriangleBVH:
    """BVH over triangles (T, 3, 3) of one surface."""
    return triangle_bvh(triangles, np.zeros(len(triangles), dtype=np.int64))

"""Distinct shapes of the scene: display geometry and ray target."""

from collections.abc import Iterable
from functools import cache, cached_property
from itertools import count
from typing import NamedTuple, cast

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore import EmbreeDevice
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from hapticdb.page.colours import Rgba, few
from hapticdb.page.scene.facets import Facets, sharpened

_EMBREE_SIZE = 100.0
"""Size to which a shape is scaled for Embree, whose tolerances are absolute, while parts are
millimetres or kilometres."""

_SERIALS = count()


class Piece(NamedTuple):
    """Triangles of one colour; None for the object's colour."""

    colour: Rgba | None
    facets: Facets


class Dots(NamedTuple):
    """Points (n, 3) of a cloud about its centre, metres; colours (n, 3) sRGB; size, metres."""

    points: NDArray[np.float32]
    colours: NDArray[np.uint8]
    size: float


class PartShape:
    """Triangles of one or more objects, metres, about their own centre.

    colours (F, 4) uint8 : of the triangles, from the file. A cloud is drawn as `dots`; its
    triangles are cubes around its points, as ray target.
    """

    def __init__(self, facets: Facets, colours: NDArray[np.uint8] | None = None) -> None:
        self.serial = next(_SERIALS)
        """Unique number in this process."""
        low, high = facets.vertices.min(axis=0), facets.vertices.max(axis=0)
        self.center: NDArray[np.float64] = (low + high) / 2
        """The frame's origin in the part frame, metres."""
        self.half: NDArray[np.float64] = (high - low) / 2
        """Half the edges of its AABB (3,), metres."""
        self.facets = Facets(facets.vertices - self.center, facets.faces)
        self.split: Facets | None = None
        """Cache of `drawn`."""
        self.dots: Dots | None = None
        self._palette, self._number = few(colours)

    @property
    def n_triangles(self) -> int:
        """Number of triangles."""
        return len(self.facets.faces)

    @property
    def radius(self) -> float:
        """Radius of the bounding sphere, metres."""
        return float(np.linalg.norm(self.half))

    @property
    def drawn(self) -> Facets:
        """Triangles in their order, with vertices split at sharp edges; float32 and uint32."""
        if self.split is None:
            draw_each([self])
        return cast("Facets", self.split)

    @property
    def colour(self) -> Rgba | None:
        """Colour of most triangles in the file; None without colours."""
        if not self._palette:
            return None
        return self._palette[int(np.bincount(self._number).argmax())]

    @cached_property
    def pieces(self) -> list[Piece]:
        """Display triangles by colour."""
        if len(self._palette) <= 1:
            return [Piece(self.colour, self.drawn)]
        vertices, faces = self.drawn
        found = []
        for number, colour in enumerate(self._palette):
            # the vertices of this colour alone, renumbered
            used, corners = np.unique(faces[self._number == number], return_inverse=True)
            own = corners.reshape(-1, 3).astype(np.uint32)
            found.append(Piece(colour, Facets(vertices[used], own)))
        return found

    def bounds(self, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """AABB (2, 3) of the turned bounding box at a pose (4, 4), metres, world frame."""
        # |R| h: half the edges of a turned box's AABB
        reach = np.abs(pose[:3, :3]) @ self.half
        return np.stack([pose[:3, 3] - reach, pose[:3, 3] + reach])

    @cached_property
    def _embree(self) -> tuple[object, float]:
        """Embree's scene of the triangles, and its scale, 1/m."""
        scale = _EMBREE_SIZE / max(self.radius, 1e-12)
        scene = EmbreeScene(_device())
        vertices = (self.facets.vertices * scale).astype(np.float32)
        TriangleMesh(scene, vertices, self.facets.faces.astype(np.int32))
        return scene, scale

    def first_hit(
        self, origin: NDArray[np.float64], direction: NDArray[np.float64]
    ) -> float | None:
        """Distance along a ray to the nearest triangle, metres, two-sided; None without a hit.

        origin (3,), direction (3,), a unit vector : in the shape's frame. Embree selects the
        triangle; the distance is computed in 64 bits from the triangle's plane.
        """
        scene, scale = self._embree
        # start near the shape: float32 resolves its triangles for any distance of the eye
        skipped = max(float(-(origin @ direction)) - 2 * self.radius, 0.0)
        start = (origin + skipped * direction) * scale
        found = scene.run(  # type: ignore[attr-defined]
            start[None].astype(np.float32),
            direction[None].astype(np.float32),
            query="INTERSECT",
            output=True,
        )
        face = int(found["primID"][0])
        if face < 0:
            return None
        a, b, c = self.facets.vertices[self.facets.faces[face]]
        normal = np.cross(b - a, c - a)
        across = float(normal @ direction)
        if across != 0.0:
            distance = float(normal @ (a - origin)) / across
            # a plane nearly along the ray gives any distance: then Embree's own is taken
            if abs(distance - skipped - float(found["tfar"][0]) / scale) < 1e-3 * self.radius:
                return distance
        return skipped + float(found["tfar"][0]) / scale


def draw_each(shapes: Iterable[PartShape]) -> None:
    """Make `PartShape.drawn` of several shapes in one call of `sharpened`, which is faster."""
    missing = [shape for shape in shapes if shape.split is None]
    if not missing:
        return
    split = sharpened([shape.facets for shape in missing])
    for shape, (vertices, faces) in zip(missing, split, strict=True):
        shape.split = Facets(vertices.astype(np.float32), faces.astype(np.uint32))


@cache
def _device() -> object:
    """Embree's only device: it crashes after thousands of them."""
    return EmbreeDevice()

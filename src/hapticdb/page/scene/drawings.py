"""What a node of the browser's scene shows, and the nodes of one audience kept in step with it.

Triangles are batches: one geometry at one or more places, each with a colour and a size. An
audience is all browsers together or one of them; a node of one browser hides the shared node of its
name there.
"""

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from hapticdb.page.colours import Colour, sent
from hapticdb.page.scene.facets import Facets
from hapticdb.page.scene.shapes import Dots

if TYPE_CHECKING:
    from viser import BatchedMeshHandle, PointCloudHandle, SceneApi, SceneNodeHandle

LEAST_SIMPLIFIED = 64
"""Vertices from which the browser makes coarser copies of a shape for a distant eye."""
COARSER = ((14.0, 0.4), (45.0, 0.1))
"""Distances, in radii of a shape, from which the browser draws a share of its triangles. At 14
radii a shape fills a fifth of the picture's height."""


@dataclass(frozen=True, eq=False)
class Geometry:
    """Triangles of a node, made when they are sent.

    key : equal for equal triangles; make : gives vertices (V, 3) float32 and faces (F, 3) uint32;
    radius : of its bounding box, metres; opacity : below 1 for what one sees through.
    """

    key: Hashable
    make: Callable[[], Facets]
    radius: float
    opacity: float | None = None

    def coarser(self, n_vertices: int) -> tuple[tuple[float, float], ...] | str:
        """Distances and shares of triangles of the browser's coarser copies."""
        if n_vertices < LEAST_SIMPLIFIED:
            return "off"
        return tuple((ratio * self.radius, share) for ratio, share in COARSER)


@dataclass(frozen=True, eq=False)
class Drawing:
    """A node: a geometry at N places.

    wxyzs (N, 4), positions (N, 3) metres, sizes (N,) or (N, 3): factors, 0 for what is hidden;
    colours (N, 3) uint8, sRGB.
    """

    geometry: Geometry
    wxyzs: NDArray[np.float64]
    positions: NDArray[np.float64]
    sizes: NDArray[np.float64]
    colours: NDArray[np.uint8]

    @property
    def key(self) -> Hashable:
        """Equal for equal triangles."""
        return self.geometry.key

    def equals(self, other: "Drawing | Sprinkle") -> bool:
        """Whether both show the same."""
        return (
            isinstance(other, Drawing)
            and self.key == other.key
            and all(
                np.array_equal(a, b)
                for a, b in (
                    (self.sizes, other.sizes),
                    (self.colours, other.colours),
                    (self.positions, other.positions),
                    (self.wxyzs, other.wxyzs),
                )
            )
        )


@dataclass(frozen=True, eq=False)
class Sprinkle:
    """A node of points: wxyz (4,), position (3,) metres; colour : of all, None for their own."""

    key: Hashable
    dots: Dots
    wxyz: NDArray[np.float64]
    position: NDArray[np.float64]
    colour: Colour | None

    def equals(self, other: "Drawing | Sprinkle") -> bool:
        """Whether both show the same."""
        return (
            isinstance(other, Sprinkle)
            and (self.key, self.colour) == (other.key, other.colour)
            and np.array_equal(self.position, other.position)
            and np.array_equal(self.wxyz, other.wxyz)
        )


class Audience:
    """Nodes of all browsers (`server.scene`) or of one (`client.scene`)."""

    def __init__(self, scene: "SceneApi") -> None:
        self._scene = scene
        self._meshes: dict[str, tuple[Hashable, BatchedMeshHandle | PointCloudHandle]] = {}
        self._blanks: dict[str, SceneNodeHandle] = {}

    @property
    def names(self) -> set[str]:
        """Names of its nodes."""
        return self._meshes.keys() | self._blanks.keys()

    def put(self, name: str, drawing: Drawing | Sprinkle) -> None:
        """Make a node show a drawing; triangles or points are sent only if they are others."""
        blank = self._blanks.pop(name, None)
        if blank is not None:
            blank.remove()
        there = self._meshes.get(name)
        if there is None or there[0] != drawing.key:
            self._meshes[name] = (drawing.key, self._added(name, drawing))
            return
        mesh = there[1]
        if isinstance(drawing, Sprinkle):
            mesh.wxyz, mesh.position = drawing.wxyz, drawing.position
            shades = drawing.dots.colours if drawing.colour is None else np.array(drawing.colour)
            cast("PointCloudHandle", mesh).colors = shades.astype(np.uint8)
            return
        colours = sent(drawing.colours)
        for prop, value in (
            ("batched_positions", (drawing.positions - mesh.position).astype(np.float32)),
            ("batched_wxyzs", drawing.wxyzs.astype(np.float32)),
            ("batched_scales", drawing.sizes.astype(np.float32)),
            ("batched_colors", colours),
        ):
            if not np.array_equal(getattr(mesh, prop), value):
                setattr(mesh, prop, value)

    def _added(
        self, name: str, drawing: Drawing | Sprinkle
    ) -> "BatchedMeshHandle | PointCloudHandle":
        if isinstance(drawing, Sprinkle):
            return self._sprinkled(name, drawing)
        vertices, faces = drawing.geometry.make()
        middle = drawing.positions.mean(axis=0)  # a browser has places in float32
        return self._scene.add_batched_meshes_simple(
            name,
            vertices,
            faces,
            drawing.wxyzs,
            drawing.positions - middle,
            batched_scales=drawing.sizes,
            batched_colors=sent(drawing.colours),
            lod=drawing.geometry.coarser(len(vertices)),  # type: ignore[arg-type]
            opacity=drawing.geometry.opacity,
            side="double",
            cast_shadow=False,
            receive_shadow=False,
            position=middle,
        )

    def _sprinkled(self, name: str, drawing: Sprinkle) -> "PointCloudHandle":
        points, colours, size = drawing.dots
        return self._scene.add_point_cloud(
            name,
            points,
            colours if drawing.colour is None else drawing.colour,
            point_size=size,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
            wxyz=drawing.wxyz,
            position=drawing.position,
        )

    def blank(self, name: str) -> None:
        """Make a node show nothing, also where the shared node of this name shows something."""
        if name in self._blanks:
            return
        there = self._meshes.pop(name, None)
        if there is not None:
            there[1].remove()
        self._blanks[name] = self._scene.add_frame(name, show_axes=False, visible=False)

    def drop(self, name: str) -> None:
        """Remove a node, if there is one; a browser then shows the shared node again."""
        there = self._meshes.pop(name, None)
        if there is not None:
            there[1].remove()
        blank = self._blanks.pop(name, None)
        if blank is not None:
            blank.remove()

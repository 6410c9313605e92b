"""Scene nodes in viser, and their updates for one audience.

Triangles are instanced: one geometry at N poses, each with a colour and a size. An audience is all
browsers together or one browser; in a browser its own node replaces the shared node of the same
name.
"""

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from viser import BatchedMeshHandle, PointCloudHandle, SceneApi, SceneNodeHandle

from hapticdb.page.colours import Colour, sent
from hapticdb.page.scene.facets import Facets
from hapticdb.page.scene.shapes import Dots

COARSER = ((14.0, 0.4), (45.0, 0.1))
"""Levels of detail: distance of the eye, in radii of the shape, and share of the triangles. At 14
radii a shape fills a fifth of the picture's height."""


@dataclass(frozen=True, eq=False)
class Geometry:
    """Triangles of a node, made when they are sent.

    key : equal for equal triangles; make : vertices (V, 3) float32 and faces (F, 3) uint32; radius
    : of the bounding sphere, metres; opacity : below 1 if transparent.
    """

    key: Hashable
    make: Callable[[], Facets]
    radius: float
    opacity: float | None = None


@dataclass(frozen=True, eq=False)
class Drawing:
    """A node of N instances of a geometry.

    wxyzs (N, 4) : unit quaternions; positions (N, 3) : metres; sizes (N,) or (N, 3) : factors, 0 if
    hidden; colours (N, 3) : uint8, sRGB.
    """

    geometry: Geometry
    wxyzs: NDArray[np.float64]
    positions: NDArray[np.float64]
    sizes: NDArray[np.float64]
    colours: NDArray[np.uint8]

    @property
    def key(self) -> Hashable:
        """Key of the geometry."""
        return self.geometry.key

    def equals(self, other: "Drawing | PointDrawing") -> bool:
        """Whether both are equal in the scene."""
        arrays = ("sizes", "colours", "positions", "wxyzs")
        return (
            isinstance(other, Drawing)
            and self.key == other.key
            and all(np.array_equal(getattr(self, one), getattr(other, one)) for one in arrays)
        )


@dataclass(frozen=True, eq=False)
class PointDrawing:
    """A node of points: wxyz (4,), position (3,), metres; colour : None for the points' own."""

    key: Hashable
    dots: Dots
    wxyz: NDArray[np.float64]
    position: NDArray[np.float64]
    colour: Colour | None

    def equals(self, other: "Drawing | PointDrawing") -> bool:
        """Whether both are equal in the scene."""
        return (
            isinstance(other, PointDrawing)
            and (self.key, self.colour) == (other.key, other.colour)
            and np.array_equal(self.position, other.position)
            and np.array_equal(self.wxyz, other.wxyz)
        )


class Audience:
    """Scene nodes of all browsers (`server.scene`) or of one (`client.scene`)."""

    def __init__(self, scene: SceneApi) -> None:
        self._scene = scene
        self._meshes: dict[str, tuple[Hashable, BatchedMeshHandle | PointCloudHandle]] = {}
        self._blanks: dict[str, SceneNodeHandle] = {}

    @property
    def names(self) -> set[str]:
        """Names of the nodes."""
        return self._meshes.keys() | self._blanks.keys()

    def put(self, name: str, drawing: Drawing | PointDrawing) -> None:
        """Set a node's drawing; geometry is sent only if its key changes."""
        blank = self._blanks.pop(name, None)
        if blank is not None:
            blank.remove()
        there = self._meshes.get(name)
        if there is None or there[0] != drawing.key:
            self._meshes[name] = (drawing.key, self._added(name, drawing))
            return
        mesh = there[1]
        if isinstance(drawing, PointDrawing):
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
        self, name: str, drawing: Drawing | PointDrawing
    ) -> BatchedMeshHandle | PointCloudHandle:
        if isinstance(drawing, PointDrawing):
            points, colours, size = drawing.dots
            return self._scene.add_point_cloud(
                name, points, colours if drawing.colour is None else drawing.colour,
                point_size=size, point_shape="circle", point_shading="flat", precision="float32",
                wxyz=drawing.wxyz, position=drawing.position,
            )  # fmt: skip
        vertices, faces = drawing.geometry.make()
        middle = drawing.positions.mean(axis=0)  # viser sends float32
        levels = tuple((ratio * drawing.geometry.radius, share) for ratio, share in COARSER)
        return self._scene.add_batched_meshes_simple(
            name, vertices, faces, drawing.wxyzs, drawing.positions - middle,
            batched_scales=drawing.sizes, batched_colors=sent(drawing.colours),
            lod="off" if len(vertices) < 64 else levels,
            opacity=drawing.geometry.opacity, side="double", cast_shadow=False,
            receive_shadow=False, position=middle,
        )  # fmt: skip

    def blank(self, name: str) -> None:
        """Make a node empty, so that it hides the shared node of this name."""
        if name not in self._blanks:
            self.drop(name)
            self._blanks[name] = self._scene.add_frame(name, show_axes=False, visible=False)

    def drop(self, name: str) -> None:
        """Remove a node, if present; the shared node of this name shows again."""
        there = self._meshes.pop(name, None)
        if there is not None:
            there[1].remove()
        blank = self._blanks.pop(name, None)
        if blank is not None:
            blank.remove()

"""Reader of the objects' shapes, in a thread of its own."""

from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from queue import SimpleQueue
from threading import Event, Thread
from time import monotonic

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import HapticDBError
from hapticdb.ingest.geometry import parts_of
from hapticdb.mesh import Part
from hapticdb.page.colours import by_height
from hapticdb.page.scene.facets import Facets, block_facets, coarsened
from hapticdb.page.scene.polar_decomposition import decompose
from hapticdb.page.scene.shapes import Dots, PartShape, draw_each
from hapticdb.store.attributes import up_axis
from hapticdb.store.base import Object
from hapticdb.store.connect import open_store

ShapedObject = tuple[Object, PartShape, NDArray[np.float64]]
"""Object, its shape, and the shape's pose (4, 4), world_from_shape."""
MOST_DOTS = 600_000
"""Greatest number of drawn points of a cloud, 15 bytes each."""
CUBES = 1024
"""Cubes along a cloud's longest edge as its ray target, before `MOST_BLOCKS`."""
MOST_BLOCKS = 6_000
"""Greatest number of cubes of an object without a surface, and of a cloud's ray target."""


class ShapeReader:
    """Thread that reads shapes: `show` receives them, `lost` the objects without triangles."""

    def __init__(
        self,
        url: str,
        show: Callable[[Sequence[ShapedObject]], None],
        lost: Callable[[Sequence[Object]], None],
    ) -> None:
        self._url = url
        self._show = show
        self._lost = lost
        self._wanted: SimpleQueue[Sequence[Object] | None] = SimpleQueue()
        self._ended = Event()
        self._shapes: dict[tuple[str, bytes], PartShape] = {}
        self.thread = Thread(target=self._run, name="shapes", daemon=True)
        self.thread.start()

    def read(self, objects: Sequence[Object]) -> None:
        """Queue objects."""
        self._wanted.put(objects)

    def close(self) -> None:
        """End the thread after its current surface."""
        self._ended.set()
        self._wanted.put(None)

    def _run(self) -> None:
        while (objects := self._wanted.get()) is not None and not self._ended.is_set():
            self._read(objects)

    def _read(self, objects: Sequence[Object]) -> None:
        # by digest: equal parts are shown together, instanced
        ordered = sorted(objects, key=lambda obj: obj.digest)
        left = {obj.id: obj for obj in objects}
        ready: list[ShapedObject] = []
        # database unreachable or damaged: voxels for the others
        with suppress(HapticDBError), closing(open_store(self._url, read_only=True)) as store:
            shown, n_triangles, digest = monotonic(), 0, ""
            for obj, part in parts_of(store, ordered):
                if self._ended.is_set():
                    return
                # never between equal parts, which are instances of one node
                is_due = n_triangles > 1_000_000 or monotonic() - shown > 0.5
                if obj.digest != digest and is_due:
                    self._show_drawn(ready)
                    ready, shown, n_triangles = [], monotonic(), 0
                digest = obj.digest
                ready.append(self._shaped(obj, part))
                n_triangles += ready[-1][1].n_triangles
                del left[obj.id]
        self._show_drawn(ready)
        self._lost(list(left.values()))

    def _show_drawn(self, ready: Sequence[ShapedObject]) -> None:
        draw_each({shape.serial: shape for _, shape, _ in ready if not shape.dots}.values())
        self._show(ready)

    def _shaped(self, obj: Object, part: Part) -> ShapedObject:
        """Object, shape and pose; equal parts of equal stretch share a shape."""
        placed = decompose(obj.transform)
        if part.faces is None:
            cloud = _cloud(obj, part)
            return obj, cloud, centred(np.eye(4), cloud)
        key = (obj.digest, placed.key)
        shape = self._shapes.get(key)
        if shape is None:
            faces = part.faces
            # a mirrored part: reversed, so that normals still point outward
            if np.linalg.det(placed.stretch) < 0:
                faces = faces[:, ::-1]
            shape = PartShape(Facets(part.vertices @ placed.stretch.T, faces), part.colours)
            self._shapes[key] = shape
        return obj, shape, centred(placed.pose, shape)


def _cloud(obj: Object, part: Part) -> PartShape:
    """At most `MOST_DOTS` points of a cloud, world frame, in its colours or coloured by height."""
    points, colours = part.world_points(), part.colours
    if len(points) > MOST_DOTS:
        # a random choice thins all places alike; with a fixed seed, in each session
        some = np.random.default_rng(0).permutation(len(points))[:MOST_DOTS]
        points, colours = points[some], None if colours is None else colours[some]
    low, size = points.min(axis=0), max(float(np.ptp(points, axis=0).max()), 1e-9)
    steps = np.unique(np.floor((points - low) * (CUBES / size)).astype(np.int64), axis=0)
    vertices, faces = block_facets(*coarsened(steps, MOST_BLOCKS))
    shape = PartShape(Facets(vertices * (size / CUBES) + low, faces))
    edges = np.sort(np.ptp(points, axis=0))
    shape.dots = Dots(
        (points - shape.center).astype(np.float32),
        by_height(points[:, up_axis([obj])]) if colours is None else colours[:, :3],
        # mean spacing on the two longest edges, the second taken as a hundredth at least
        float(np.sqrt(edges[2] * max(edges[1], edges[2] / 100) / len(points))),
    )
    return shape


def centred(pose: NDArray[np.float64], shape: PartShape) -> NDArray[np.float64]:
    """World_from_shape (4, 4) from world_from_part: a shape's origin is its centre."""
    moved = pose.copy()
    moved[:3, 3] += pose[:3, :3] @ shape.center
    return moved

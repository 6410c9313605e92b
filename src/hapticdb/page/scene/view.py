"""The scene shared by all browsers, updated after each commit to the environment."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from threading import Event

import numpy as np
from numpy.typing import ArrayLike, NDArray
from viser import ViserServer

from hapticdb.environment import open as open_environment
from hapticdb.errors import HapticDBError
from hapticdb.grid import Grid
from hapticdb.page.scene.commit_follower import Follower
from hapticdb.page.scene.contents import Contents, is_same_shape
from hapticdb.page.scene.drawings import Audience
from hapticdb.page.scene.facets import Facets, block_facets, coarsened
from hapticdb.page.scene.reading import MOST_BLOCKS, ShapedObject, ShapeReader, centred
from hapticdb.page.scene.shapes import PartShape
from hapticdb.page.scene.surroundings import add_surroundings
from hapticdb.store.attributes import up_axis
from hapticdb.store.base import Object


class SceneView:
    """Display of an environment's objects in all browsers of a viser server.

    AABBs show at once, then surfaces and points as they are read, then blocks of voxels for objects
    without a surface in the database. All methods are thread-safe.

    The view owns the server's scene below ``/parts``, its ground, light, background and first view.
    HapticDBError if the environment cannot be opened or read.
    """

    def __init__(self, server: ViserServer, url: str) -> None:
        self._server, self._url = server, url
        self.contents = Contents(Audience(server.scene))
        """Objects, nodes, and the view of each browser."""
        self.on_edit: Callable[[], None] | None = None
        """Called in a thread of the view after each commit shown, its own or another's."""
        self._is_closed = Event()
        self._is_surrounded = False
        self.up = 2
        """Vertical axis: 0 for x, 1 for y, 2 for z."""
        self.revision = -1
        """Revision of the environment on display."""
        self._reader = ShapeReader(url, self._show_shapes, self._show_voxels)
        self._follower = Follower(url, self._follow)
        try:
            self._follower.start()
        except BaseException:
            self._reader.close()
            raise

    def close(self) -> None:
        """End the threads and close the connection; the browsers' scenes stay."""
        self._is_closed.set()
        self._reader.close()
        self._follower.close()
        self._reader.thread.join(10.0)

    @property
    def grid(self) -> Grid:
        """The environment's grid."""
        return self._follower.grid

    @property
    def objects(self) -> Mapping[int, Object]:
        """Copy of all objects by id, as of `revision`."""
        with self.contents.lock:
            return dict(self.contents.records)

    def move(self, object_id: int, transform: ArrayLike) -> bool:
        """Preview an object at a placement in all browsers, before the commit; False if unknown.

        transform (4, 4) : world_from_part, metres, with the present scale. The next commit of the
        object replaces the preview; `put_back` reverts it.
        """
        with self._server.atomic():
            moved = self.contents.move(object_id, transform)
            self.contents.refresh()
        return moved

    def put_back(self, object_id: int) -> None:
        """Revert a preview to the committed placement."""
        with self.contents.lock:
            obj = self.contents.records.get(object_id)
            if obj is not None:
                self.move(object_id, obj.transform)

    def _follow(self, written: list[Object], removed: list[int], revision: int) -> None:
        """Show a commit, at first all objects."""
        with self.contents.lock, self._server.atomic():
            self.contents.remove(removed)
            anew = []
            for obj in written:
                known = self.contents.records.get(obj.id)
                if known is not None and is_same_shape(known, obj):
                    self.contents.move(obj.id, obj.transform, obj)
                else:
                    anew.append(obj)
            self.contents.add(anew)
            self.revision = revision
            objects, box = self.contents.records.values(), self.contents.box()
            if not self._is_surrounded and box is not None:
                self._is_surrounded = True
                self.up = up_axis(objects)
                add_surroundings(self._server, box, self.up)
        if anew:
            self._reader.read(anew)
        if self.on_edit is not None:
            self.on_edit()

    def _show_shapes(self, found: Sequence[ShapedObject]) -> None:
        with self._server.atomic():
            self.contents.shape(found)

    def _show_voxels(self, objects: Sequence[Object]) -> None:
        """Show objects without triangles as blocks of voxels."""
        if not objects:
            return
        with suppress(HapticDBError), open_environment(self._url, read_only=True) as env:
            for obj in objects:
                if self._is_closed.is_set():
                    return
                with suppress(HapticDBError):  # removed, or database unreachable
                    voxels = env.voxels(obj.id)
                    if len(voxels):
                        self._show_shapes([_blocks(obj, voxels, self.grid)])


def _blocks(obj: Object, voxels: NDArray[np.int64], grid: Grid) -> ShapedObject:
    """Shape of an object's voxels, as blocks in the world frame."""
    vertices, faces = block_facets(*coarsened(voxels, MOST_BLOCKS))
    shape = PartShape(Facets(vertices * grid.voxel_size + np.array(grid.origin), faces))
    return obj, shape, centred(np.eye(4), shape)

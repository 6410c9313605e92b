"""The scene that all browsers see: objects of an environment, followed as others edit them."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Condition
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.errors import HapticDBError
from hapticdb.grid import Grid
from hapticdb.page.scene.browser import BrowserScene, Picked, picked
from hapticdb.page.scene.colours import Rgb
from hapticdb.page.scene.contents import Contents, is_same_shape
from hapticdb.page.scene.drawings import Audience
from hapticdb.page.scene.facets import Facets, block_facets, coarsened
from hapticdb.page.scene.following import Followed, Follower
from hapticdb.page.scene.names import Branch, found_ids, tree_of
from hapticdb.page.scene.reading import MayRead, ShapedObject, ShapeReader, centred
from hapticdb.page.scene.shapes import PartShape
from hapticdb.page.scene.stage import View, framing, set_stage
from hapticdb.store.attributes import up_axis
from hapticdb.store.base import Object

if TYPE_CHECKING:
    from viser import ClientHandle, ViserServer

MOST_BLOCKS = 6_000
"""Cubes that stand for an object whose file cannot be read; more voxels are drawn as larger cubes.
A larger value shows more detail, and sends about 100 bytes more for each cube."""
ENDS_WITHIN_S = 10.0
"""Seconds that `SceneView.close` waits for each of its threads."""


@dataclass(frozen=True)
class SceneEdit:
    """What a commit, the view's own or another's, has changed.

    revision : of the environment; written : ids of objects that were added, moved or replaced;
    removed : ids of objects that are gone.
    """

    revision: int
    written: tuple[int, ...]
    removed: tuple[int, ...]


def anywhere(_path: Path) -> bool:
    """Let the page read every file that the process may read."""
    return True


class SceneView:
    """Shows the objects of an environment in all browsers of a viser server, and follows edits.

    Boxes are shown at once, then shapes from the objects' files as they are read, then the voxels,
    as blocks, of objects whose file is gone, has changed or must not be read. All methods may be
    called from any thread. It is a context manager, which closes it.

    Parameters
    ----------
    server : viser.ViserServer
        The server; its scene below ``/parts``, its ground, light, background and first view are
        this view's.
    url : str
        The environment; it is opened to read, by a thread of the view's own.
    may_read : callable
        Takes the resolved path of a file, and says whether the page may read it. By default every
        file.

    Raises
    ------
    HapticDBError
        If the environment cannot be opened or read.
    """

    def __init__(self, server: "ViserServer", url: str, *, may_read: MayRead = anywhere) -> None:
        self._server = server
        self._contents = Contents(Audience(server.scene))
        self._listeners: list[Callable[[SceneEdit], None]] = []
        self._browsers: dict[int, BrowserScene] = {}
        self._folded: list[tuple[int, str]] | None = None
        self._tree: Branch | None = None
        self._settled = Condition()
        self._staged = False
        self.up = 2
        """Number of the axis that points up: 0 for x, 1 for y, 2 for z."""
        self.revision = -1
        """Revision of the environment that is shown."""
        self._reader = ShapeReader(may_read, self._show_shapes, self._show_voxels)
        self._follower = Follower(url, self._follow)
        try:
            self._follower.start()
        except BaseException:
            self._reader.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the view's threads and its connection. The browsers keep what they show."""
        self._reader.close()
        self._follower.close()
        self._follower.join(ENDS_WITHIN_S)
        self._reader.join(ENDS_WITHIN_S)

    # -- what there is -----------------------------------------------------------------------

    @property
    def grid(self) -> Grid:
        """The environment's grid."""
        return self._follower.grid

    @property
    def objects(self) -> Mapping[int, Object]:
        """All objects by id, as of `revision`: a copy."""
        with self._contents.lock:
            return dict(self._contents.records)

    @property
    def n_waiting(self) -> int:
        """Number of objects that are still shown as boxes."""
        return self._contents.waiting()

    @property
    def n_nodes(self) -> int:
        """Nodes of the browser's scene that draw the objects."""
        return self._contents.n_nodes

    @property
    def n_triangles(self) -> int:
        """Triangles of all objects that have their shape."""
        return self._contents.n_triangles

    @property
    def bytes_sent(self) -> int:
        """Bytes of triangles, places and colours sent to each browser, before compression."""
        return self._contents.bytes_sent

    def wait_until_shown(self, timeout: float) -> bool:
        """Wait until no object is a box; False if that took longer than `timeout` seconds."""
        with self._settled:
            return self._settled.wait_for(lambda: self.n_waiting == 0, timeout)

    def tree(self) -> Branch:
        """All objects as sub-assemblies, by the elements of their names, with counts.

        The same object, which nobody may change, until objects come, go or get other names.
        """
        with self._contents.lock:
            if self._tree is None:
                self._tree = tree_of({i: obj.name for i, obj in self._contents.records.items()})
            return self._tree

    def search(self, text: str) -> list[int]:
        """Ids of the objects whose name holds each word of a text, in any case; best first."""
        with self._contents.lock:
            if self._folded is None:
                records = self._contents.records.items()
                self._folded = [(i, obj.name.casefold()) for i, obj in records]
            folded = self._folded
        return found_ids(folded, text)

    def colour_of(self, object_id: int) -> Rgb | None:
        """An object's own colour, sRGB 0 to 255; None if there is none."""
        return self._contents.colours().get(object_id)

    def box(self, ids: Iterable[int] | None = None) -> NDArray[np.float64] | None:
        """Lower and upper corner (2, 3) of objects, metres; of all without ids."""
        return self._contents.box(ids)

    def placement(self, object_id: int) -> NDArray[np.float64]:
        """World_from_part (4, 4) at which an object is shown now, previews included.

        Raises
        ------
        KeyError
            If there is no such object.
        """
        return self._contents.placement(object_id)

    def framing(self, ids: Iterable[int] | None = None) -> View | None:
        """A view that shows objects whole, all without ids; None if there are none."""
        box = self.box(ids)
        return None if box is None else framing(box, self.up)

    # -- browsers ----------------------------------------------------------------------------

    def browser(self, client: "ClientHandle") -> BrowserScene:
        """The scene as one browser sees it: the same object at each call, until `forget`."""
        with self._contents.lock:
            known = self._browsers.get(client.client_id)
            if known is None:
                known = BrowserScene(client, self._contents)
                self._browsers[client.client_id] = known
            return known

    def forget(self, client: "ClientHandle") -> None:
        """Forget a browser that has disconnected."""
        with self._contents.lock:
            known = self._browsers.pop(client.client_id, None)
        if known is not None:
            known.close()

    def pick(self, origin: ArrayLike, direction: ArrayLike) -> Picked | None:
        """The part that a ray meets first, whatever browsers have hidden."""
        struck = self._contents.pick(origin, direction, lambda _: True)
        return None if struck is None else picked(struck, self._contents)

    # -- edits -------------------------------------------------------------------------------

    def move(self, object_id: int, transform: ArrayLike) -> bool:
        """Show an object at a new placement at once, in all browsers, before it is committed.

        The next commit that writes the object replaces the preview; `put_back` takes it back.

        Parameters
        ----------
        transform : (4, 4) array
            world_from_part, metres; the present one's scale.

        Returns
        -------
        bool
            False if there is no such object.
        """
        with self._server.atomic():
            moved = self._contents.move(object_id, transform)
            self._contents.refresh()
        return moved

    def put_back(self, object_id: int) -> None:
        """Show an object where the database has it."""
        with self._contents.lock:
            obj = self._contents.records.get(object_id)
            if obj is not None:
                self.move(object_id, obj.transform)

    def on_edit(self, tell: Callable[[SceneEdit], None]) -> None:
        """Let a function know of each commit after it is shown; it is called from a thread."""
        self._listeners.append(tell)

    def _follow(self, followed: Followed) -> None:
        """Show what was committed: the first time, all objects."""
        with self._contents.lock, self._server.atomic():
            if self._has_other_names(followed):
                self._folded = self._tree = None
            self._contents.remove(followed.removed)
            anew = []
            for obj in followed.written:
                known = self._contents.records.get(obj.id)
                if known is not None and is_same_shape(known, obj):
                    self._contents.move(obj.id, obj.transform, obj)
                else:
                    anew.append(obj)
            self._contents.add(anew)
            self.revision = followed.revision
            self._set_stage()
        if anew:
            self._reader.read(anew)
        edit = SceneEdit(
            followed.revision,
            tuple(obj.id for obj in followed.written),
            tuple(followed.removed),
        )
        for tell in list(self._listeners):
            tell(edit)
        self._tell_settled()

    def _has_other_names(self, followed: Followed) -> bool:
        """Whether the names of the objects are others after a commit; a move leaves them."""
        known = self._contents.records
        return bool(followed.removed) or any(
            obj.id not in known or known[obj.id].name != obj.name for obj in followed.written
        )

    def _set_stage(self) -> None:
        box = self._contents.box()
        if not self._staged and box is not None:
            self._staged = True
            self.up = up_axis(self._contents.records.values())
            set_stage(self._server, box, self.up)

    def _show_shapes(self, found: Sequence[ShapedObject]) -> None:
        with self._server.atomic():
            self._contents.shape(found)
        self._tell_settled()

    def _show_voxels(self, objects: Sequence[Object]) -> None:
        """Show objects without a readable file as blocks of their voxels."""
        for obj in objects:
            with suppress(HapticDBError, CancelledError):  # removed, or the database is away
                voxels = self._follower.voxels(obj.id, None).result()
                if len(voxels):
                    self._show_shapes([_blocks(obj, voxels, self.grid)])

    def _tell_settled(self) -> None:
        with self._settled:
            self._settled.notify_all()


def _blocks(obj: Object, voxels: NDArray[np.int64], grid: Grid) -> ShapedObject:
    """Blocks of an object's voxels, in the world frame, as its shape."""
    vertices, faces = block_facets(coarsened(voxels, MOST_BLOCKS))
    shape = PartShape(Facets(vertices * grid.voxel_size + np.array(grid.origin), faces))
    return obj, shape, centred(np.eye(4), shape)

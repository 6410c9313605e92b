"""Reads the shapes of objects again from their files, off the page's thread, a few at a time."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue
from threading import Event, Thread
from time import monotonic

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import FileError
from hapticdb.ingest.originals import found_parts
from hapticdb.mesh import Part
from hapticdb.page.folders import AllowedFolders
from hapticdb.page.scene.facets import Facets
from hapticdb.page.scene.rigid import taken_apart
from hapticdb.page.scene.shapes import PartShape, draw_each
from hapticdb.store.base import Object

ShapedObject = tuple[Object, PartShape, NDArray[np.float64]]
"""An object, its shape, and the shape's pose (4, 4), world_from_shape."""
READERS = 2
"""Files that are read at once, each by a process of its own. More open faster on a machine with
processors to spare, and take more memory."""
SHOW_EVERY_S = 0.5
"""Seconds after which the shapes read so far are shown. A larger value merges more of the parts of
many small files, and shows them later."""
SHOW_TRIANGLES = 1_000_000
"""Triangles after which the shapes read so far are shown."""


class ShapeReader:
    """A thread that reads the shapes of objects which it is given, in order.

    show : called from the thread with objects and their shapes, as they become known; lost : with
    objects whose file is gone, changed or must not be read.
    """

    def __init__(
        self,
        folders: AllowedFolders,
        show: Callable[[Sequence[ShapedObject]], None],
        lost: Callable[[Sequence[Object]], None],
    ) -> None:
        self._folders = folders
        self._show = show
        self._lost = lost
        self._wanted: SimpleQueue[Sequence[Object] | None] = SimpleQueue()
        self._ended = Event()
        self._shapes: dict[tuple[str, bytes], PartShape] = {}
        self._thread = Thread(target=self._run, name="shapes", daemon=True)
        self._thread.start()

    def read(self, objects: Sequence[Object]) -> None:
        """Read the shapes of objects after those that wait already."""
        self._wanted.put(objects)

    def close(self) -> None:
        """End the thread; it ends after the file that it reads."""
        self._ended.set()
        self._wanted.put(None)

    def join(self, timeout: float) -> None:
        """Wait until the thread has ended."""
        self._thread.join(timeout)

    def _run(self) -> None:
        with ThreadPoolExecutor(READERS, "files") as pool:
            while (objects := self._wanted.get()) is not None and not self._ended.is_set():
                self._read(objects, pool)

    def _read(self, objects: Sequence[Object], pool: ThreadPoolExecutor) -> None:
        allowed: list[Object] = []
        lost: list[Object] = []
        paths: dict[str, Path | None] = {}
        for obj in objects:
            if obj.link not in paths:
                paths[obj.link] = _readable(obj.link, self._folders)
            (lost if paths[obj.link] is None else allowed).append(obj)
        self._lost(lost)
        ready: list[ShapedObject] = []
        shown, n_triangles = monotonic(), 0
        for some, parts in _files(allowed, paths, pool, self._ended):
            missing, digest = [], ""
            # by digest: a batch of equal parts is complete when it is shown
            for obj, part in sorted(zip(some, parts, strict=True), key=lambda both: both[0].digest):
                if self._ended.is_set():
                    return
                if obj.digest != digest and (
                    n_triangles > SHOW_TRIANGLES or monotonic() - shown > SHOW_EVERY_S
                ):
                    self._show_drawn(ready)
                    ready, shown, n_triangles = [], monotonic(), 0
                digest = obj.digest
                if part is None or part.faces is None:
                    missing.append(obj)
                    continue
                ready.append(self._shaped(obj, part))
                n_triangles += ready[-1][1].n_triangles
            self._lost(missing)
        self._show_drawn(ready)

    def _show_drawn(self, ready: Sequence[ShapedObject]) -> None:
        draw_each({shape.serial: shape for _, shape, _ in ready}.values())
        self._show(ready)

    def _shaped(self, obj: Object, part: Part) -> ShapedObject:
        """The object's shape, which equal parts of equal stretch share, and its pose."""
        placed = taken_apart(obj.transform)
        key = (obj.digest, placed.key)
        shape = self._shapes.get(key)
        if shape is None:
            faces = part.faces if part.faces is not None else np.empty((0, 3), dtype=np.int64)
            if np.linalg.det(placed.stretch) < 0:
                faces = faces[:, ::-1]
            shape = PartShape(Facets(part.vertices @ placed.stretch.T, faces))
            self._shapes[key] = shape
        return obj, shape, centred(placed.pose, shape)


def centred(pose: NDArray[np.float64], shape: PartShape) -> NDArray[np.float64]:
    """World_from_shape (4, 4) from world_from_part: the shape's frame is about its centre."""
    moved = pose.copy()
    moved[:3, 3] += pose[:3, :3] @ shape.center
    return moved


def _readable(link: str, folders: AllowedFolders) -> Path | None:
    """The file behind a link, without symbolic links; None if it is gone or must not be read."""
    try:
        path = folders.checked(link)
    except FileError:
        return None
    return path if os.access(path, os.R_OK) else None


def _files(
    objects: Sequence[Object],
    paths: Mapping[str, Path | None],
    pool: ThreadPoolExecutor,
    ended: Event,
) -> Iterator[tuple[list[Object], list[Part | None]]]:
    """Objects of a file with their parts, None where there is none, as they are read.

    At most `READERS` files are in memory and not yet taken.
    """
    of_file: dict[tuple[str, object], list[Object]] = {}
    for obj in objects:
        of_file.setdefault((obj.link, obj.attributes.get("unit")), []).append(obj)
    waiting = list(of_file.values())[::-1]
    running: set[Future[tuple[list[Object], list[Part | None]]]] = set()
    while (waiting or running) and not ended.is_set():
        while waiting and len(running) < READERS:
            some = waiting.pop()
            running.add(pool.submit(_parts, some, str(paths[some[0].link])))
        done, running = wait(running, return_when=FIRST_COMPLETED)
        for future in done:
            yield future.result()


def _parts(objects: list[Object], path: str) -> tuple[list[Object], list[Part | None]]:
    """Objects of one file with their parts; the file is opened by the path that was judged."""
    found: dict[int, Part] = {}
    linked = [replace(obj, link=path) for obj in objects]
    for some, part in found_parts(linked, "shown", "import it again"):
        if isinstance(part, Part):
            found[some[0].id] = part
    return objects, [found.get(obj.id) for obj in objects]

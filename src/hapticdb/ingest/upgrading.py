"""Gives surfaces and distances to objects that were imported without: one transaction each.

Surfaces come from the objects' files, distances from the surfaces. An upgrade that was interrupted,
or left objects out, is run again and goes on with what is missing.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

import numpy as np

from hapticdb.errors import ConflictError, FileError, HapticDBError, ObjectNotFoundError, UsageError
from hapticdb.ingest.files import ImportCallback, ImportProgress
from hapticdb.ingest.geometry import found_parts, packed_surface, rows_of_object
from hapticdb.ingest.voxelizing import ShareCallback, in_threads, rows_of_part
from hapticdb.mesh import Part, read_file
from hapticdb.mesh.chord import MARGIN
from hapticdb.paper.quantiles import DEFAULT_RESOLUTION, QuantileVector
from hapticdb.store.base import Object, Rows, Store, joined
from hapticdb.store.connect import open_store
from hapticdb.store.covering import covering

_EARLIER = 1e-5 * MARGIN
"""Chord error, metres, with which STEP files become the triangles of versions without one."""


class LeftOut(NamedTuple):
    """Objects that stay without surface or distances for the same reason."""

    objects: tuple[Object, ...]
    error: HapticDBError


@dataclass(frozen=True)
class UpgradeReport:
    """Result of `upgrade_environment`: numbers of objects, and of voxels."""

    url: str
    surfaces: int
    """Objects that had no surface and have one now."""
    upgraded: int
    """Objects that had no distances and have some now."""
    present: int
    """Objects that lacked nothing."""
    voxels: int
    """Voxels of the objects that were given distances."""
    left_out: tuple[LeftOut, ...]
    """Objects that still lack something, and why."""

    @property
    def is_complete(self) -> bool:
        """Whether no object lacks anything now."""
        return not self.left_out


def upgrade_environment(
    url: str | os.PathLike[str], *, jobs: int | None = None, progress: ImportCallback | None = None
) -> UpgradeReport:
    """Give each object its surface and, in the layout brick, distances to it.

    A missing surface is read from the object's file. Voxels stay as they are. An object is left out
    if its file is gone or has another geometry, or if its voxels are not those that this version
    makes of its surface. Run again, an upgrade goes on with what is left. Parts that are imported
    later get distances, too.

    Parameters
    ----------
    url : str or path
        An environment, which is opened to write.
    jobs : int or None
        Threads that compute distances; one for each processor unless given.
    progress : callable or None
        Called with an `ImportProgress`, which counts each surface and each object's distances.

    Raises
    ------
    DatabaseError
        If the environment cannot be opened or written.
    """
    if jobs is not None and jobs < 1:
        raise UsageError(f"{jobs} jobs: give 1 or more")
    with closing(open_store(url)) as store:
        is_brick = store.layout == "brick"
        if is_brick and not store.wants_distances:
            store.want_distances()
        objects, there = store.objects(), store.surface_digests()
        bare = [obj for obj in objects if obj.digest not in there]
        flat = [obj for obj in objects if is_brick and not obj.has_distances]
        run = _Run(store, len(bare) + len(flat), progress)
        run.give_surfaces(bare)
        if flat:
            with store.loading():
                run.give_distances(flat, jobs or os.cpu_count() or 1)
        if run.n_upgraded:
            store.analyze(DEFAULT_RESOLUTION)
        return UpgradeReport(
            store.url,
            run.n_surfaces,
            run.n_upgraded,
            len(objects) - len({obj.id for obj in bare + flat}),
            run.voxels,
            tuple(run.left_out),
        )


class _Run:
    """An upgrade under way: what was done, and what was left out."""

    def __init__(self, store: Store, n_steps: int, progress: ImportCallback | None) -> None:
        self._store, self._n_steps, self._progress = store, n_steps, progress
        self._link = ""
        self.n_surfaces = self.n_upgraded = self.voxels = self._n_done = 0
        self.left_out: list[LeftOut] = []

    def give_surfaces(self, objects: Sequence[Object]) -> None:
        """Write the surfaces of objects from their files; any file that holds a shape will do."""
        written: set[str] = set()
        failed: list[LeftOut] = []
        for some, part in _parts_in_files(objects):
            self._link = some[0].link
            if isinstance(part, HapticDBError):
                failed.append(LeftOut(some, part))
                continue
            try:
                if part.digest not in written:
                    self._store.add_surface(part.digest, packed_surface(part))
            except FileError as error:  # too large
                failed.append(LeftOut(some, error))
                continue
            written.add(part.digest)
            self._advance(1)
        for left in failed:
            lacking = tuple(obj for obj in left.objects if obj.digest not in written)
            self._advance(len(left.objects) - len(lacking))
            if lacking:
                self._leave_out(lacking, left.error)
        self.n_surfaces = sum(obj.digest in written for obj in objects)

    def give_distances(self, objects: Sequence[Object], jobs: int) -> None:
        """Write the distances of objects."""
        grid = self._store.grid
        self._quantiles = QuantileVector.of(self._store)

        def measured(
            pair: tuple[Object, Part], share: ShareCallback
        ) -> tuple[Object, Rows | HapticDBError]:
            obj, part = pair
            try:
                return obj, rows_of_part(
                    part, grid, "brick", obj.transform, progress=share, distances=True
                )[0]
            except FileError as error:  # too large for the memory that is left
                return obj, error

        with closing(in_threads(self._found(objects), measured, jobs)) as done:
            for one in done:
                if isinstance(one, float):
                    self._tell(one)
                    continue
                obj, found = one
                self._link = obj.link
                error = found if isinstance(found, HapticDBError) else self._write(obj, found)
                if error is not None:
                    self._leave_out((obj,), error)
                    continue
                self.n_upgraded += 1
                self.voxels += obj.voxels
                self._advance(1)

    def _found(self, objects: Sequence[Object]) -> Iterator[tuple[Object, Part]]:
        """Objects with their parts; those without a surface are left out already."""
        for obj, part in found_parts(self._store, objects):
            if part is None:
                self._advance(1)
            else:
                yield obj, part

    def _write(self, obj: Object, rows: Rows) -> HapticDBError | None:
        """Write the distances of an object, unless its voxels are not those that are stored."""
        try:
            if not _is_as_stored(self._store, obj, rows, self._quantiles):
                return FileError(
                    f"object {obj.id} ({obj.name}) cannot be upgraded: its voxels are not those "
                    f"that its surface gives now; 'hapticdb remove' it and import {obj.link} again"
                )
            self._store.replace(obj, rows, covering(self._store))
        except (ConflictError, ObjectNotFoundError) as error:
            return error
        return None

    def _leave_out(self, objects: tuple[Object, ...], error: HapticDBError) -> None:
        self.left_out.append(LeftOut(objects, error))
        self._advance(len(objects))

    def _advance(self, n_steps: int) -> None:
        self._n_done += n_steps
        self._tell(0.0)

    def _tell(self, share: float) -> None:
        if self._progress is not None:
            done = ImportProgress(self._link, self._n_done, self._n_steps, self.voxels, share)
            self._progress(done)


def _parts_in_files(
    objects: Sequence[Object],
) -> Iterator[tuple[tuple[Object, ...], Part | HapticDBError]]:
    """Yield objects with the geometry that was imported, ordered by file, or with an error.

    Reads each file once. A geometry comes with one object, an error with all objects that it means.
    """
    of_file: dict[tuple[str, str | None], list[Object]] = {}
    for obj in objects:
        unit = obj.attributes.get("unit")
        of_file.setdefault((obj.link, unit if isinstance(unit, str) else None), []).append(obj)
    for (link, unit), some in of_file.items():
        first = f"object {some[0].id} ({some[0].name})"
        if len(some) > 1:
            first += f" and {len(some) - 1} of the same file"
        try:
            found = read_file(link, unit=unit, chord=_EARLIER).parts
        except HapticDBError as error:
            unread = FileError(f"{first} cannot be upgraded, its file cannot be read: {error}")
            yield tuple(some), unread
            continue
        all_forms = chain(found, *(part.before for part in found))
        parts = {(part.name, part.digest): part for part in all_forms}
        for obj in some:
            part = parts.get((obj.name, obj.digest))
            yield (
                (obj,),
                part
                or FileError(
                    f"object {obj.id} ({obj.name}) cannot be upgraded: {link} no longer holds the "
                    "geometry that was imported; restore the file, and run this again"
                ),
            )


def _is_as_stored(store: Store, obj: Object, rows: Rows, quantiles: QuantileVector) -> bool:
    """Whether the stored bricks of an object are those of its new rows, bit for bit."""
    new = rows.occupied()
    stored = joined(list(rows_of_object(store, obj, quantiles)), distances=False)
    is_same = np.array_equal(stored.keys, new.keys)
    return is_same and np.array_equal(stored.occupancy, new.occupancy)

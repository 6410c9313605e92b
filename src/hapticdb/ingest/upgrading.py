"""Gives distances to objects that were imported without: one transaction an object.

Each object's file is read again. An upgrade that was interrupted, or left objects out, is run again
and goes on with the objects that have no distances yet.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hapticdb.errors import ConflictError, FileError, HapticDBError, ObjectNotFoundError, UsageError
from hapticdb.ingest.files import ImportCallback, ImportProgress
from hapticdb.ingest.known_parts import covering
from hapticdb.ingest.originals import found_parts
from hapticdb.ingest.voxelizing import ShareCallback, in_threads, rows_of_part
from hapticdb.mesh import Part
from hapticdb.query.grouping import object_ranges
from hapticdb.query.quantiles import DEFAULT_RESOLUTION
from hapticdb.store.base import Object, Rows, Store
from hapticdb.store.connect import open_store

ROWS_AT_ONCE = 1 << 18
"""Rows that are read at a time, to compare them. A larger value takes more memory."""
KEY_END = (1 << 63) - 1
"""A key above all others."""


class LeftOut(NamedTuple):
    """Objects that stay without distances for the same reason."""

    objects: tuple[Object, ...]
    error: HapticDBError


@dataclass(frozen=True)
class UpgradeReport:
    """Result of `upgrade_environment`: numbers of objects, and of the upgraded ones' voxels."""

    url: str
    upgraded: int
    present: int
    """Objects that had distances already."""
    voxels: int
    left_out: tuple[LeftOut, ...]
    """Objects that stay without, and why."""

    @property
    def is_complete(self) -> bool:
        """Whether every object has distances."""
        return not self.left_out


def upgrade_environment(
    url: str | os.PathLike[str], *, jobs: int | None = None, progress: ImportCallback | None = None
) -> UpgradeReport:
    """Give distances to each object that has none; parts that are imported later get them, too.

    The file of each object is read again, at the object's place. Its voxels stay as they are. An
    object is left out if its file is gone or has another geometry, or if its voxels are not those
    that this version makes of the file. Run again, an upgrade goes on with what is left.

    Parameters
    ----------
    url : str or path
        An environment with the layout brick, which is opened to write.
    jobs : int or None
        Threads that compute distances; one for each processor unless given.
    progress : callable or None
        Called with an `ImportProgress`.

    Raises
    ------
    UsageError
        If the layout is voxel, which has no distances.
    DatabaseError
        If the environment cannot be opened or written.
    """
    if jobs is not None and jobs < 1:
        raise UsageError(f"{jobs} jobs: give 1 or more")
    with closing(open_store(url)) as store:
        if store.layout == "voxel":
            raise UsageError(
                f"{store.url} has the layout voxel, which has no distances: "
                "'hapticdb copy URL NEW --layout brick', then upgrade that"
            )
        if not store.wants_distances:
            store.want_distances()
        objects = store.objects()
        missing = [obj for obj in objects if not obj.has_distances]
        run = _Run(store, len(missing), progress)
        if missing:
            with store.loading():
                run.upgrade(missing, jobs or os.cpu_count() or 1)
        if run.n_upgraded:
            store.analyze(DEFAULT_RESOLUTION)
        return UpgradeReport(
            store.url,
            run.n_upgraded,
            len(objects) - len(missing),
            run.voxels,
            tuple(run.left_out),
        )


class _Run:
    """An upgrade under way: what was done, and what was left out."""

    def __init__(self, store: Store, n_objects: int, progress: ImportCallback | None) -> None:
        self._store, self._n_objects, self._progress = store, n_objects, progress
        self._link = ""
        self.n_upgraded = self.voxels = self._n_done = 0
        self.left_out: list[LeftOut] = []

    def upgrade(self, objects: Sequence[Object], jobs: int) -> None:
        """Give distances to objects, in the order of their files."""
        grid = self._store.grid

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

        with closing(in_threads(self._found(objects), measured, jobs, self._tell)) as done:
            for obj, found in done:
                self._link = obj.link
                error = found if isinstance(found, HapticDBError) else self._write(obj, found)
                if error is not None:
                    self._leave_out((obj,), error)
                    continue
                self.n_upgraded += 1
                self.voxels += obj.voxels
                self._advance(1)

    def _found(self, objects: Sequence[Object]) -> Iterator[tuple[Object, Part]]:
        """Objects with their parts; objects whose part is not found are left out."""
        for some, part in found_parts(objects, "upgraded", "restore the file, and run this again"):
            if isinstance(part, Part):
                yield some[0], part
            else:
                self._leave_out(some, part)

    def _write(self, obj: Object, rows: Rows) -> HapticDBError | None:
        """Write the distances of an object, unless its voxels are not those that are stored."""
        try:
            if not is_as_stored(self._store, obj, rows):
                return FileError(
                    f"object {obj.id} ({obj.name}) cannot be upgraded: its voxels are not those "
                    f"that its file gives now; 'hapticdb remove' it and import {obj.link} again"
                )
            self._store.replace(obj, rows, covering(self._store))
        except (ConflictError, ObjectNotFoundError) as error:
            return error
        return None

    def _leave_out(self, objects: tuple[Object, ...], error: HapticDBError) -> None:
        self.left_out.append(LeftOut(objects, error))
        self._advance(len(objects))

    def _advance(self, n_objects: int) -> None:
        self._n_done += n_objects
        self._tell(0.0)

    def _tell(self, share: float) -> None:
        if self._progress is not None:
            done = ImportProgress(self._link, self._n_done, self._n_objects, self.voxels, share)
            self._progress(done)


def is_as_stored(store: Store, obj: Object, rows: Rows) -> bool:
    """Whether the stored bricks of an object are those of its new rows, bit for bit."""
    new = rows.occupied()
    lows, highs = object_ranges(store.grid, store.layout, obj)
    for at in range(0, max(len(new), 1), ROWS_AT_ONCE):
        part, end = new.part(at, at + ROWS_AT_ONCE), at + ROWS_AT_ONCE
        first = int(part.keys[0]) if at else 0
        last = int(new.keys[end]) - 1 if end < len(new) else KEY_END
        inside = (highs >= first) & (lows <= last)
        ranges = np.maximum(lows[inside], first), np.minimum(highs[inside], last)
        stored = store.rows_of(obj.id, *ranges)
        if not (
            np.array_equal(stored.keys, part.keys)
            and np.array_equal(stored.occupancy, part.occupancy)
        ):
            return False
    return True

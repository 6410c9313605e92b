"""What an import writes: a file compared with the parts that an environment has of it."""

import contextlib
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from hapticdb.errors import EnvironmentExistsError, GeometryChangedError, ObjectNotFoundError
from hapticdb.grid import Grid
from hapticdb.ingest.checking import check_inside
from hapticdb.mesh import MeshFile, Part
from hapticdb.store.base import Object, Rows, Store

MOST_ATTEMPTS = 100
"""Attempts to add a part that other processes add and remove meanwhile; then an error is raised."""


class KnownParts:
    """Parts of a file that an environment has, updated from the environment's log of changes.

    by_name : the objects, by the names of the parts, in the order of their ids at first.

    Measured with two imports of one file of 1,500 parts at once: the second took 4.6 s, but 33 s
    if it listed all objects again for each part that the other had added.
    """

    def __init__(self, store: Store, link: str) -> None:
        self._store, self._link = store, link
        # Read before the objects, so that a write between the two is seen by `refresh`.
        self._revision = store.revision()
        self._name_of: dict[int, str] = {}
        self.by_name: dict[str, Object] = {}
        for obj in store.objects():
            self._enter(obj)

    def has(self, part: Part | Object) -> bool:
        """Whether the environment has the part with the same geometry."""
        known = self.by_name.get(part.name)
        return known is not None and known.digest == part.digest

    def refresh(self) -> None:
        """Update from the writes since the last call."""
        changes = list(self._store.changes(self._revision))
        for object_id in {change.id for change in changes}:
            self.by_name.pop(self._name_of.pop(object_id, ""), None)
            with contextlib.suppress(ObjectNotFoundError):
                self._enter(self._store.object(object_id))
        if changes:
            self._revision = changes[-1].revision

    def _enter(self, obj: Object) -> None:
        if obj.link == self._link:
            self._name_of[obj.id] = obj.name
            self.by_name[obj.name] = obj


def added_or_present(
    store: Store, part: Object, rows: Rows, surface: bytes, known: KnownParts
) -> list[int]:
    """Add a part; returns its id, or nothing if another process has added the same part meanwhile.

    Raises `EnvironmentExistsError` if there is a part of that name with another geometry.
    """
    for attempt in range(MOST_ATTEMPTS):
        try:
            return [store.add(part, rows, surface)]
        except EnvironmentExistsError:
            known.refresh()
            if known.has(part):
                return []
            if part.name in known.by_name or attempt == MOST_ATTEMPTS - 1:
                raise
            # Another process has removed it since, so its name is free again.
    raise AssertionError  # the last attempt returns or raises


class Plan(NamedTuple):
    """What an import writes, in this order.

    replaced : parts that exchange an object, in the file's order, with the object's id; added :
    parts that the environment lacks, in the file's order; dropped : ids of objects whose parts the
    file lacks; removed : names of the file's parts that were removed from the environment before.
    """

    replaced: list[tuple[Part, int]]
    added: list[Part]
    dropped: list[int]
    removed: set[str]


def planned(
    file: MeshFile,
    unit: str | None,
    grid: Grid,
    known: Mapping[str, Object],
    removed: set[str],
    *,
    replace: bool,
    keep_removed: bool,
) -> Plan:
    """Compare a file with an environment; nothing is read or written.

    Parameters
    ----------
    file, unit
        The file's parts, and the unit in which it was read.
    grid
        The environment's.
    known : mapping
        The environment's objects of this file, by the names of their parts.
    removed : set of str
        Names of parts that were removed from the environment.
    replace, keep_removed
        As in `hapticdb.ingest.files.ImportOptions`.

    Raises
    ------
    OutsideGridError
        If a part that is to be written leaves the grid.
    GeometryChangedError
        If a part has another geometry than the object of its name, which is not to be replaced.
    """
    missing = [part for part in file.parts if part.name not in known]
    there = [(part, known[part.name]) for part in file.parts if part.name in known]
    for part, obj in there:
        if obj.digest != part.digest and not replace:
            raise GeometryChangedError(
                f"{file.link}: part {part.name!r} has changed since it was imported, or was "
                "read with another --unit; --replace puts the file's in its place"
            )
    removed = {part.name for part in missing} & removed
    added = [part for part in missing if not (keep_removed and part.name in removed)]
    replaced = [(part, obj.id) for part, obj in there if replace and _differs(part, obj, unit)]
    check_inside([*added, *(part for part, _ in replaced)], file.link, grid)
    names = {part.name for part in file.parts}
    dropped = [obj.id for obj in known.values() if replace and obj.name not in names]
    return Plan(replaced, added, dropped, removed)


def _differs(part: Part, obj: Object, unit: str | None) -> bool:
    """Whether geometry, placement, or the unit that the file was read in are others."""
    return (
        obj.digest != part.digest
        or obj.attributes.get("unit") != unit
        or not np.array_equal(obj.transform, part.world_from_part)
    )

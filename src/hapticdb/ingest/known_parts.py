"""Parts of a file that an environment already has; adds and replaces parts beside other writers."""

import contextlib
import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np

from hapticdb.errors import EnvironmentExistsError, ObjectNotFoundError
from hapticdb.mesh import MeshFile, Part
from hapticdb.query.grouping import object_ranges
from hapticdb.store.base import Covering, Object, Rows, Store

MOST_ATTEMPTS = 100
"""Attempts to add a part that other processes add and remove meanwhile; then an error is raised."""


class KnownParts:
    """Parts of a file that an environment has, updated from the environment's log of changes.

    Measured with two imports of one file of 1,500 parts at once: the second took 4.6 s, but 33 s
    if it listed all objects again for each part that the other had added.
    """

    def __init__(self, store: Store, link: str) -> None:
        self._store, self._link = store, link
        # Read before the objects, so that a write between the two is seen by `refresh`.
        self._revision = store.revision()
        self._name_of: dict[int, str] = {}
        self._digest_of: dict[str, str] = {}
        for obj in store.objects():
            self._enter(obj)

    def digest_of(self, name: str) -> str | None:
        """Digest of the part's geometry, or None if the environment lacks that part."""
        return self._digest_of.get(name)

    def changed(self, parts: Sequence[Part], unit: str | None) -> dict[int, Part]:
        """Parts that differ from the objects of the same names, by the ids of the objects.

        They differ in geometry, in placement, or in the unit that the file was read in.
        """
        ids = {name: object_id for object_id, name in self._name_of.items()}
        objects = {obj.id: obj for obj in self._store.objects()}
        found = {}
        for part in parts:
            obj = objects.get(ids.get(part.name, 0))
            if obj is not None and (
                obj.digest != part.digest
                or obj.attributes.get("unit") != unit
                or not np.array_equal(obj.transform, part.world_from_part)
            ):
                found[obj.id] = part
        return found

    def refresh(self) -> None:
        """Update from the writes since the last call."""
        changes = list(self._store.changes(self._revision))
        for object_id in {change.id for change in changes}:
            self._digest_of.pop(self._name_of.pop(object_id, ""), None)
            with contextlib.suppress(ObjectNotFoundError):
                self._enter(self._store.object(object_id))
        if changes:
            self._revision = changes[-1].revision

    def _enter(self, obj: Object) -> None:
        if obj.link == self._link:
            self._name_of[obj.id] = obj.name
            self._digest_of[obj.name] = obj.digest


def added_or_present(
    store: Store, part: Object, rows: Rows, surface: bytes, known: KnownParts
) -> int | None:
    """Add a part; returns its id, or None if another process has added the same part meanwhile.

    Raises `EnvironmentExistsError` if there is a part of that name with another geometry.
    """
    for attempt in range(MOST_ATTEMPTS):
        try:
            return store.add(part, rows, surface)
        except EnvironmentExistsError:
            known.refresh()
            digest = known.digest_of(part.name)
            if digest == part.digest:
                return None
            if digest is not None or attempt == MOST_ATTEMPTS - 1:
                raise
            # Another process has removed it since, so its name is free again.
    raise AssertionError  # the last attempt returns or raises


def replace_changed(
    store: Store, anew: Iterable[tuple[Object, Rows, bytes]], id_of: dict[str, int]
) -> int:
    """Replace the objects with the parts' names, one transaction each; returns their number."""
    n_replaced = 0
    for part, rows, surface in anew:
        new = dataclasses.replace(part, id=id_of[part.name])
        with contextlib.suppress(ObjectNotFoundError):  # another process has removed it
            store.replace(new, rows, covering(store), surface)
            n_replaced += 1
    return n_replaced


def drop_others(store: Store, mesh_file: MeshFile) -> int:
    """Remove objects whose parts the file lacks now, one transaction each; returns the count."""
    names = {part.name for part in mesh_file.parts}
    n_dropped = 0
    for obj in store.objects():
        if obj.link == mesh_file.link and obj.name not in names:
            with contextlib.suppress(ObjectNotFoundError):
                store.remove(obj.id, covering(store))
                n_dropped += 1
    return n_dropped


def covering(store: Store) -> Covering:
    """Ranges of keys that cover an object of a store."""

    def ranges(obj: Object) -> Iterable[tuple[int, int]]:
        lows, highs = object_ranges(store.grid, store.layout, obj)
        return zip(lows.tolist(), highs.tolist(), strict=True)

    return ranges

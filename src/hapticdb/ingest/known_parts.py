"""Parts of a file that an environment already has; adds parts beside other writers."""

import contextlib

from hapticdb.errors import EnvironmentExistsError, ObjectNotFoundError
from hapticdb.mesh import Part
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

"""Cache of the objects, by id, at the revision of the last frame."""

import contextlib

import numpy as np

from hapticdb.errors import ObjectNotFoundError, UsageError
from hapticdb.kernels import force_law as laws
from hapticdb.query.law import DISTANCE, PLANE, ForceLaw
from hapticdb.store.base import Change, Keys, Object, Store
from hapticdb.store.filtering import ExcludedObjects, Filter, cache_last

MOST_READ = 16
"""Writes since the last listing after which all objects are listed, not one by one."""


class ObjectCache:
    """Objects of a store at one revision, so that a frame need not query them.

    by_id : the objects; replaced as a whole, never changed
    have_distances : whether there is an object, and every object has distances
    own_law : default law of a frame: the distance law if they have distances, else tangent-plane
    version : the store's version at the listing, or None
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self.by_id: dict[int, Object] = {}
        self.have_distances = False
        self.own_law: ForceLaw = PLANE
        self.version: int | None = None
        self._exclusions: dict[Filter, ExcludedObjects] = {}
        self._last: Change | None = None

    def newest(self) -> list[Object]:
        """All objects, ordered by id; only those written since the last listing are read."""
        self.invalidate()
        self.refresh()  # outside a snapshot, so PostgreSQL is queried again
        return [*self.by_id.values()]

    def law_of_newest(self, law: ForceLaw | None) -> ForceLaw:
        """Law of a frame in this snapshot: the given one, or the objects' default.

        Raises `UsageError` if the law reads distances, and an object has none.
        """
        self.refresh()
        if law is not None and not self.fits(law):
            self._check_distances()
        return law or self.own_law

    def refresh(self) -> None:
        """List the objects, unless this revision is cached already."""
        revision = self._store.revision()  # `version` is then the version of this read
        version = self._store.version()  # before the read, because of concurrent writes
        if version != self.version:
            self._list(revision)
            self.version = version

    def _list(self, revision: int) -> None:
        """Read the objects written since the last listing; all of them if the log is no guide."""
        log, last = self._writes_since(revision)
        if log == []:
            return
        if log is None:
            self.by_id = {obj.id: obj for obj in self._store.objects()}
        else:
            found = self.by_id.copy()
            for object_id in {change.id for change in log}:
                found.pop(object_id, None)
                with contextlib.suppress(ObjectNotFoundError):
                    found[object_id] = self._store.object(object_id)
            self.by_id = dict(sorted(found.items()))
        self._last = last  # last, since a read may fail
        self._exclusions = {}
        objects = self.by_id.values()
        self.have_distances = bool(objects) and all(obj.has_distances for obj in objects)
        self.own_law = DISTANCE if self.have_distances else PLANE

    def _writes_since(self, revision: int) -> tuple[list[Change] | None, Change | None]:
        """Writes since the last listing, and the last of all; revision : the newest, or an older.

        None for too many writes, or another log than at the last listing.
        """
        known = self._last
        is_near = known is not None and 0 <= revision - known.revision <= MOST_READ
        first = known.revision if known is not None and is_near else revision
        log = list(self._store.changes(first - 1))
        is_same = known is not None and bool(log) and _are_equal(log[0], known)
        return (log[1:] if is_same else None), (log[-1] if log else None)

    def invalidate(self) -> None:
        """Invalidate the cache."""
        self.version = None

    def excluded(self, selection: Filter) -> Keys:
        """Ids (E,) of the cached objects excluded by a filter, ascending."""
        return selection.fixed_ids if selection.is_fixed else self._excluded_by(selection).ids

    def check_words(self, selection: Filter) -> None:
        """Raise `ObjectNotFoundError` for the first word of a filter without an object."""
        if not self._excluded_by(selection).missing:
            return
        self._list(self._store.revision())  # frames without a query did not refresh it
        for error in self._excluded_by(selection).missing:
            raise error

    def _excluded_by(self, selection: Filter) -> ExcludedObjects:
        """Exclusions of a filter, cached until the objects change."""
        found = self._exclusions.get(selection)
        if found is None:
            found = selection.excluded([*self.by_id.values()], self._store.url)
            cache_last(self._exclusions, selection, found)
        return found

    def fits(self, law: ForceLaw) -> bool:
        """Whether the objects have the data of the law."""
        return self.have_distances or not laws.reads_distances(law.for_kernels)

    def _check_distances(self) -> None:
        """Refuse a law that reads distances if an object has none."""
        url, layout = self._store.url, self._store.layout
        if layout != "brick":
            raise UsageError(
                f"{url} has the layout {layout}, which stores no distances to surfaces: give the "
                "law 'plane', or import into the layout brick"
            )
        lacking = [obj.name for obj in self.by_id.values() if not obj.has_distances]
        if lacking:
            raise UsageError(
                f"{len(lacking)} of {len(self.by_id)} objects of {url} have no distances to their "
                f"surfaces ({lacking[0]}): give the law 'plane', or import with distances into "
                "another environment"
            )


def _are_equal(one: Change, other: Change) -> bool:
    """Whether two rows of the log are equal: a server rewrites revisions after losing commits."""
    same = (one.revision, one.action, one.id) == (other.revision, other.action, other.id)
    return same and np.array_equal(one.ranges, other.ranges)

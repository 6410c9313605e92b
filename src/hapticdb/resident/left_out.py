"""Which objects are left out of resident cells, as the writes of others go on."""

from collections.abc import Sequence

import numpy as np

from hapticdb.store.base import NO_KEYS, Change, Keys, Object, Store
from hapticdb.store.filtering import Filter


class LeftOutObjects:
    """Ids of the objects that a filter leaves out, of the revision that was followed last.

    Attributes
    ----------
    felt : Filter
        Its words are read again when an object is added or removed, or has another name or other
        attributes. A word that chooses nothing any more chooses nothing.
    ids : (E,) int64
        Ascending and distinct.
    """

    def __init__(self, felt: Filter) -> None:
        self.felt = felt
        self.ids: Keys = felt.fixed_ids if felt.is_fixed else NO_KEYS
        self._objects: dict[int, Object] = {}

    def follow(self, store: Store, changes: Sequence[Change] | None) -> bool:
        """Follow writes in a snapshot of the store; None if they cannot be listed.

        Returns whether only written objects are felt now and were not before, or the reverse.
        """
        if self.felt.is_fixed:
            return True
        if changes is None:
            self._objects = {obj.id: obj for obj in store.objects()}
        elif not self._read_again(store, {change.id for change in changes}):
            return True
        objects = [self._objects[i] for i in sorted(self._objects)]
        before, self.ids = self.ids, self.felt.left_out(objects, store.url).ids
        written = np.array([change.id for change in changes or ()], dtype=np.int64)
        return bool(np.isin(np.setxor1d(before, self.ids), written).all())

    def _read_again(self, store: Store, ids: set[int]) -> bool:
        """Read written objects; returns whether the words may choose otherwise now."""
        before = {i: self._objects.pop(i, None) for i in ids}
        now = {obj.id: obj for obj in store.objects(ids)}
        self._objects.update(now)
        return any(_read_by_words(before[i]) != _read_by_words(now.get(i)) for i in ids)


def _read_by_words(obj: Object | None) -> object:
    """What words read of an object."""
    return None if obj is None else (obj.name, dict(obj.attributes))

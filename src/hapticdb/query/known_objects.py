"""The objects of the revision that frames have seen, by id."""

from collections.abc import Iterable

from hapticdb.store.base import Keys, Object, Store, unknown_exclusion
from hapticdb.store.believed import damaged


class KnownObjects:
    """Objects of a store as of one revision, so that a frame need not ask for them.

    Attributes
    ----------
    by_id : dict
        The objects; replaced as a whole, so that a result that holds it does not change.
    version : int or None
        The store's version when they were listed; None before, and after an edit of our own.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self.by_id: dict[int, Object] = {}
        self.version: int | None = None

    def learn(self) -> bool:
        """List the objects of the revision that this snapshot sees; whether it is another one."""
        if self._store.version() == self.version:
            return False
        self.by_id = {obj.id: obj for obj in self._store.objects()}
        self.version = self._store.version()
        return True

    def forget(self) -> None:
        """List them again at the next frame."""
        self.version = None

    def check_answer(self, ids: Iterable[int]) -> None:
        """Refuse ids in rows that no object has.

        Raises
        ------
        DamagedError
            When there is one.
        """
        for object_id in ids:
            if object_id not in self.by_id:
                raise damaged(self._store.url, f"rows of object {object_id}, which is not there")

    def check_excluded(self, ids: Keys) -> None:
        """Refuse exclusions of objects that do not exist.

        Raises
        ------
        ObjectNotFoundError
            When there is one.
        """
        wanted = ids.tolist()
        if not set(wanted) <= set(self.by_id):  # a frame that asked nothing saw nothing new
            self.by_id = {obj.id: obj for obj in self._store.objects()}
        for object_id in wanted:
            if object_id not in self.by_id:
                raise unknown_exclusion(object_id, self._store.url)

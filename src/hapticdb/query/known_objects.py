"""The objects, by id, of the revision that the last frame read."""

from collections.abc import Iterable

from hapticdb.store.base import Keys, Object, Store
from hapticdb.store.believed import damaged
from hapticdb.store.refusals import unknown_exclusion


class KnownObjects:
    """Objects of a store at one revision, kept so that a frame need not ask the database for them.

    Attributes
    ----------
    by_id : dict
        The objects; replaced as a whole, so that a result that holds it does not change.
    have_distances : bool
        Whether there is an object, and every object has distances.
    version : int or None
        The store's version when the objects were listed; None before that, and after an edit
        through the same environment.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self.by_id: dict[int, Object] = {}
        self.have_distances = False
        self.version: int | None = None

    def learn(self) -> bool:
        """List the objects if the snapshot's revision is new; returns whether it is new."""
        if self._store.version() == self.version:
            return False
        self._list()
        self.version = self._store.version()
        return True

    def _list(self) -> None:
        objects = self._store.objects()
        self.by_id = {obj.id: obj for obj in objects}
        self.have_distances = bool(objects) and all(obj.has_distances for obj in objects)

    def forget(self) -> None:
        """Make the next frame list the objects again."""
        self.version = None

    def check_answer(self, ids: Iterable[int]) -> None:
        """Refuse ids of rows if no object has such an id.

        Raises
        ------
        DamagedError
            When a row has an id without an object.
        """
        for object_id in ids:
            if object_id not in self.by_id:
                raise damaged(self._store.url, f"rows of object {object_id}, which is not there")

    def check_excluded(self, ids: Keys) -> None:
        """Refuse exclusions of objects that do not exist.

        Raises
        ------
        ObjectNotFoundError
            When no object has one of the ids.
        """
        wanted = ids.tolist()
        if not set(wanted) <= set(self.by_id):  # frames without a query learn nothing
            self._list()
        for object_id in wanted:
            if object_id not in self.by_id:
                raise unknown_exclusion(object_id, self._store.url)

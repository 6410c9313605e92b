"""Address and identity of an environment for workers on other machines."""

from typing import NamedTuple

from hapticdb.errors import ClusterError, DatabaseError
from hapticdb.store.base import Store
from hapticdb.store.connect import open_store


class EnvironmentAddress(NamedTuple):
    """URL of an environment, for workers; its revision and last write identify it."""

    url: str
    revision: int
    write: tuple[object, ...]

    @classmethod
    def of(cls, store: Store, url: str) -> "EnvironmentAddress":
        """Address of an opened environment."""
        revision = store.revision()
        return cls(url, revision, _write(store, revision))

    def open(self) -> Store:
        """Open it read-only in a worker; ClusterError for a missing or another environment."""
        try:
            store = open_store(self.url, read_only=True)
        except DatabaseError as error:
            raise ClusterError(
                f"a worker does not reach the environment: {error}; name it so that every worker "
                "reaches it, on a server or by a path on one machine"
            ) from None
        if store.revision() < self.revision or _write(store, self.revision) != self.write:
            store.close()
            raise ClusterError(f"a worker finds another environment at {store.url}")
        return store


def _write(store: Store, revision: int) -> tuple[object, ...]:
    for change in store.changes(revision - 1):
        return change.action, change.id, change.ranges.tobytes()
    return ()

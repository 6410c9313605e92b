"""A store that writes to an environment itself and reads it through a server."""

from typing import Any

from hapticdb.store.base import Store
from hapticdb.store.connect import open_store

OF_THE_WRITER = frozenset(
    {
        *("add", "replace", "add_distances", "remove", "want_distances", "loading", "analyze"),
        *("save_costs", "costs", "removed", "checker", "wants_distances"),
    }
)
"""What a client of a server does not do, or answers otherwise: tests of its own are beside."""


class WrittenHereReadThere:
    """Passes what a client can do to a remote store, and the rest to the environment's own."""

    def __init__(self, own: Store, url: str) -> None:
        self.own = own
        self.remote = open_store(url)
        self.remote_url = url

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - of either store
        return getattr(self.own if name in OF_THE_WRITER else self.remote, name)

    def close(self) -> None:
        self.remote.close()
        self.own.close()

    def give_to(self, thread: int) -> None:
        self.own.give_to(thread)
        self.remote.give_to(thread)

    def discard(self) -> None:
        self.remote.close()
        self.own.discard()

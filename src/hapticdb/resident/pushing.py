"""What an engine can do whose server sends of its own accord what has changed."""

from typing import Protocol, runtime_checkable

from hapticdb.store.base import Keys, Rows


@runtime_checkable
class SupportsPush(Protocol):
    """An engine whose server sends of its own accord what has changed.

    What it has sent counts in the snapshot that is entered next, of the newest revision. All reads
    there are of that revision. One that needs the server raises OutdatedError if there is a newer
    revision by then; what was sent is forgotten, so the same reads in a new snapshot succeed.
    """

    def is_beating(self) -> bool:
        """Whether the server has said lately that its database answers. Never waits."""

    def pushed_rows(self, cells: Keys, *, distances: bool) -> Rows | None:
        """Rows of cells (n,), keys on the curve, ascending, if all of them were sent; else None."""

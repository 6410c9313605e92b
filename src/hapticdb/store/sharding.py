"""What an engine does for an environment whose rows lie on several servers, its shards."""

from typing import NamedTuple, Protocol, runtime_checkable

from hapticdb.store.base import Keys


class Shard(NamedTuple):
    """One of the servers that hold an environment's rows.

    name : its number and host, as messages name it; rows : how many it has, as the server last
    estimated it; bytes : of its tables and indexes; trouble : why it does not answer, empty if it
    does; rows and bytes are None then.
    """

    name: str
    rows: int | None
    bytes: int | None
    trouble: str = ""


@runtime_checkable
class SupportsShards(Protocol):
    """An opened environment whose rows lie on several servers."""

    def shards(self) -> list[Shard]:
        """All shards in the order of their keys; those that are away, too."""

    def spread(self, bounds: Keys) -> None:
        """Place the borders for rows that are to be written; nothing if any were written before.

        bounds (R + 1,) int64: equi-count histogram of the keys of these rows.
        """

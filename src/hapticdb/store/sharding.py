"""What an engine does for an environment whose rows lie on several servers, its shards."""

from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

from hapticdb.store.base import Keys


class Shard(NamedTuple):
    """One of the servers that hold an environment's rows.

    name : its number and host, as messages name it; rows : how many it has, as the server last
    estimated it; bytes : of its tables and indexes; trouble : why it does not answer, empty if it
    does; rows and bytes are None then; behind : writes that the standby which answers has not
    replayed, None where no standby answers.
    """

    name: str
    rows: int | None
    bytes: int | None
    trouble: str = ""
    behind: int | None = None


class RebalanceProgress(NamedTuple):
    """Rows that have moved so far, and rows that have to."""

    rows_done: int
    rows_total: int


RebalanceCallback = Callable[[RebalanceProgress], object]


class Rebalanced(NamedTuple):
    """Result of a rebalance.

    environment : as messages name it; moved_rows : rows of the index table that went to another
    shard, with those that wait to be swept; moved_bytes : of these rows and their distances;
    shards : names of all shards; rows_before, rows_after : rows of the index table on each.
    """

    environment: str
    moved_rows: int
    moved_bytes: int
    shards: tuple[str, ...]
    rows_before: tuple[int, ...]
    rows_after: tuple[int, ...]


@runtime_checkable
class SupportsShards(Protocol):
    """An opened environment whose rows lie on several servers."""

    def shards(self) -> list[Shard]:
        """All shards in the order of their keys; those that are away, too."""

    def spread(self, bounds: Keys) -> None:
        """Place the borders for rows that are to be written; nothing if any were written before.

        bounds (R + 1,) int64: equi-count histogram of the keys of these rows.
        """

    def rebalance(self, progress: RebalanceCallback | None = None) -> Rebalanced:
        """Move the borders to where each shard holds equally many rows; others go on meanwhile.

        What was interrupted is taken up where it ended.

        Raises
        ------
        AccessError
            When the user does not own the environment.
        BusyError
            When another rebalances it, or imports into it while it is empty.
        ShardAwayError
            When a shard cannot be reached. What has moved is moved.
        """

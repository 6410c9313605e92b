"""Checks of an environment on several servers for `hapticdb check`, beside those of every store."""

from collections.abc import Iterator

from hapticdb.errors import ShardAwayError
from hapticdb.store.base import Rows
from hapticdb.store.postgres.checking import PostgresChecker
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.shards.connecting.links import (
    ShardConnection,
    Shards,
    lost_writes,
    older_coordinator,
)
from hapticdb.store.postgres.shards.reading import ShardedReader

REVISION = "SELECT revision FROM environment WHERE id = 1"
WRITES = "SELECT writes FROM shard ORDER BY number"


class ShardedChecker:
    """Checks the coordinator and all shards."""

    def __init__(self, coordinator: PostgresChecker, shards: Shards, reader: ShardedReader) -> None:
        self._coordinator = coordinator
        self._shards = shards
        self._reader = reader

    def findings(self) -> Iterator[str]:
        """What is wrong with kept statistics, and with whole shards, a line each.

        Raises
        ------
        DamagedError
            When the coordinator is older than its shards, so that no snapshot can be read.
        """
        yield from self._coordinator.findings()
        published = [int(row[0]) for row in self._shards.coordinator.rows(WRITES)]
        for shard, least in enumerate(published):
            name = self._shards.name(shard)
            try:
                ((writes, swept),) = self._shards.each(_mark_of, [shard])
            except ShardAwayError as error:
                yield f"{name} does not answer: {error}"
                continue
            if writes < least:
                yield str(lost_writes(name, writes, least))
            if not self._is_reached(swept):
                raise older_coordinator("the coordinator")

    def _is_reached(self, revision: int) -> bool:
        """Whether the coordinator has that revision; a snapshot of the store may see an older one.

        A standby may be behind.
        """
        known = self._shards.coordinator
        with ServerConnection(known.address, known.conninfo, read_only=True) as other:
            return other.is_standby or int(other.rows(REVISION)[0][0]) >= revision

    def rows_after(self, key: int, object_id: int, limit: int, *, distances: bool = False) -> Rows:
        """At most that many rows after (key, id), ascending by both."""
        return self._reader.rows_after(key, object_id, limit, distances=distances)


def _mark_of(_: int, shard: ShardConnection) -> tuple[int, int]:
    ((writes, swept),) = shard.rows("SELECT writes, swept FROM mark")
    return int(writes), int(swept)

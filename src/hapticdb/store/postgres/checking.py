"""Checks of a server for `hapticdb check`, beside the checks of every store."""

from collections.abc import Iterator

from hapticdb.store import believed
from hapticdb.store.base import Layout, Rows
from hapticdb.store.batches import NO_DISTANCES
from hapticdb.store.postgres.connecting import wire
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.tables import statements
from hapticdb.store.postgres.tables.reading import PostgresReader


class PostgresChecker:
    """Checks a server. The server itself compares its pages' checksums, if they have any."""

    def __init__(
        self,
        connection: ServerConnection,
        layout: Layout,
        reader: PostgresReader,
    ) -> None:
        self._connection = connection
        self._layout = layout
        self._reader = reader

    def findings(self) -> Iterator[str]:
        """What is wrong with kept statistics, a line each."""
        kept = self._connection.rows("SELECT bounds, n_rows FROM quantile WHERE bounds IS NOT NULL")
        costs = self._connection.rows("SELECT figures::text FROM cost")
        yield from believed.findings_of_kept(self._connection.shown, kept, costs)

    def rows_after(self, key: int, object_id: int, limit: int, *, distances: bool = False) -> Rows:
        """At most that many rows after (key, id), ascending by both."""
        if distances and not self._reader.has_band():
            return NO_DISTANCES
        place = wire.int8(key), wire.int8(object_id), wire.int8(limit)
        text = statements.AFTER["band" if distances else self._layout]
        return self._reader.unpacked(self._connection.fetch(text, *place), distances=distances)

"""An environment on several servers: objects at the coordinator, their rows on shards."""

import contextlib

from hapticdb.grid import Grid
from hapticdb.store.base import Keys, Layout, row_shift
from hapticdb.store.postgres import schema_of
from hapticdb.store.postgres.checking import PostgresChecker
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.shards import foreign, making
from hapticdb.store.postgres.shards.borders.rebalancing import (
    COUNT_EPOCH,
    MOVE_BORDERS,
    Rebalancer,
)
from hapticdb.store.postgres.shards.checking import ShardedChecker
from hapticdb.store.postgres.shards.connecting.links import ShardConnection
from hapticdb.store.postgres.shards.loading import IndexesOnShards
from hapticdb.store.postgres.shards.pieces import borders_by_rows
from hapticdb.store.postgres.shards.placing import RowsOnShards
from hapticdb.store.postgres.shards.reading import ShardedReader
from hapticdb.store.postgres.shards.statistics import ShardedStatistics
from hapticdb.store.postgres.shards.sweeping import LOCK, Sweeper, SweptVersions
from hapticdb.store.postgres.store import ServerStore
from hapticdb.store.postgres.tables.loading import TABLES
from hapticdb.store.sharding import RebalanceCallback, Rebalanced


class ShardedStore(ServerStore):
    """An environment whose rows lie on several PostgreSQL servers, its shards.

    The client asks the shards itself, all at once. Open with `open`, make with `create`.
    """

    def __init__(self, connection: ServerConnection) -> None:
        super().__init__(connection)
        shards = self._shards = making.shards_of(connection)
        self.engine = f"{self.engine} on {len(shards)} shards"
        rows = self._rows = ShardedReader(connection, shards, self.layout, self._reader)
        self.lookup, self.lookup_each = rows.lookup, rows.lookup_each
        self.scan, self.count, self.rows_of = rows.scan, rows.count, rows.rows_of
        self.scan_partly, self.shards_away = rows.scan_partly, rows.away.names
        self._sweeper = Sweeper(connection, shards, self.layout)
        known = ShardedStatistics(
            connection, self.layout, self._reader, rows, shards, self._sweeper
        )
        self.shards = known.shards
        self._rebalancer = Rebalancer(connection, shards, self.layout, known)
        try:
            self._take_over(
                IndexesOnShards(shards, self.layout),
                RowsOnShards(connection, shards, self._sweeper, (self.grid, self.layout)),
                known,
            )
        except BaseException:
            self.close()
            raise

    @classmethod
    def open(cls, url: str, *, read_only: bool = False) -> "ShardedStore":
        """Open an existing environment."""
        return cls(schema_of.opened(url, read_only=read_only))

    @classmethod
    def create(
        cls, url: str, grid: Grid, layout: Layout = "brick", *, distances: bool = False
    ) -> "ShardedStore":
        """Make a new environment with its grid on the shards that the URL names."""
        making.created(url, grid, layout, distances=distances)
        return cls.open(url)

    def close(self) -> None:
        """Close all connections."""
        self._rows.away.close()
        self._shards.close()
        super().close()

    def discard(self) -> None:
        """Close and delete an environment without any write, unless another writes to it."""
        if self._loading.drop_unused(lambda: foreign.withdraw(self._connection)):
            making.drop_shards(self._shards)
        self.close()

    def snapshot(self) -> contextlib.AbstractContextManager[None]:
        """All reads inside see one committed revision. May be nested."""
        return self._rows.snapshot()

    def spread(self, bounds: Keys) -> None:
        """Place the borders so that the shards get equally many rows; only before the first write.

        bounds (R + 1,) int64: equi-count histogram of the row keys that are to be written.
        """
        borders = borders_by_rows(bounds, row_shift(self.layout), len(self._shards))

        def work() -> None:
            ((revision,),) = self._connection.execute(LOCK).fetchall()
            if not revision:
                self._connection.execute(MOVE_BORDERS, (borders.tolist(),))
                self._connection.execute(COUNT_EPOCH)

        self._connection.write(work)

    def rebalance(self, progress: RebalanceCallback | None = None) -> Rebalanced:
        """Move the borders to where each shard holds equally many rows; others go on meanwhile."""
        return self._rebalancer.rebalance(progress)

    def offer_sql(self) -> None:
        """Make tables at the coordinator that read the rows of all shards, for use in SQL.

        They are `brick_live`, `band_live` or `voxel_live` (docs/postgresql.md, In SQL). Those that
        are there are renewed; a rebalance removes them.

        Raises
        ------
        AccessError
            When the user may not make tables of other servers.
        DatabaseError
            When the coordinator has no postgres_fdw.
        """
        texts = [text for table in TABLES[self.layout] for text in foreign.SHARD_VIEWS[table]]

        def prepare(_: int, shard: ShardConnection) -> None:
            shard.write(lambda: [shard.execute(text) for text in texts])

        self._shards.each(prepare)
        places = {place.number: foreign.place_of(place.conninfo) for place in self._shards.places}
        connection = self._connection
        connection.write(lambda: foreign.align(connection, self.layout, places))

    def sweep(self) -> SweptVersions:
        """Delete rows on the shards that no reader needs any more."""
        return self._sweeper.sweep()

    def checker(self) -> ShardedChecker:
        """Answers of this engine for `hapticdb check`."""
        coordinator = PostgresChecker(self._connection, self.layout, self._reader)
        return ShardedChecker(coordinator, self._shards, self._rows)

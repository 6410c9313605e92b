"""An environment in a schema of a PostgreSQL database."""

import contextlib
from collections.abc import Iterator

from hapticdb.grid import Grid
from hapticdb.store.base import Layout
from hapticdb.store.engines import Lag
from hapticdb.store.postgres import schema_of
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.tables.loading import Loading
from hapticdb.store.postgres.tables.pairs import PostgresPairs
from hapticdb.store.postgres.tables.reading import PostgresReader
from hapticdb.store.postgres.tables.statistics import SIZE_OF_PARTITIONS, PostgresStatistics
from hapticdb.store.postgres.tables.writing import PostgresWriter
from hapticdb.store.postgres.watching import Watch
from hapticdb.store.refusals import check_distances

GROUPS_KEYS_ITSELF = 170_000
"""Server version, as libpq numbers it, from which `= ANY` reads each leaf page once."""
GROUPING_THRESHOLD = 256
"""Least number of distinct keys that `auto` groups on older servers: docs/decisions/0014."""


REPLAYED = """
SELECT pg_last_wal_replay_lsn()::text,
       extract(epoch FROM clock_timestamp() - pg_last_xact_replay_timestamp())::float8
 WHERE pg_is_in_recovery()"""


class PostgresStore:
    """An environment on a PostgreSQL server. Open with `open`, make with `create`.

    Reading, writing, statistics and watching are classes of their own. The store takes over their
    methods.
    """

    def __init__(self, connection: ServerConnection) -> None:
        self._connection = connection
        self.url = connection.shown
        self.name = connection.address.environment
        self.engine = "PostgreSQL {}.{}".format(*divmod(connection.server_version, 10_000))
        groups_keys_itself = connection.server_version >= GROUPS_KEYS_ITSELF
        self.grouping_threshold = None if groups_keys_itself else GROUPING_THRESHOLD
        self.is_read_only = connection.is_read_only
        try:
            made = schema_of.read_environment(connection)
        except BaseException:
            connection.close()
            raise
        self.grid, self.layout, self.wants_distances, self.identity, is_spread = made
        self._is_spread = is_spread
        reader = PostgresReader(connection, self.layout, is_spread=is_spread)
        self.lookup, self.lookup_each = reader.lookup, reader.lookup_each
        self.scan, self.count, self.rows_of = reader.scan, reader.count, reader.rows_of
        self.rows_after = reader.rows_after
        self.statement, self.statement_hits = reader.statement, reader.statement_hits
        self.version, self.revision = reader.version, reader.revision
        self.objects, self.object = reader.objects, reader.object
        self.outlines = reader.outlines
        self.removed, self.changes = reader.removed, reader.changes
        self.surfaces, self.surface_digests = reader.surfaces, reader.surface_digests
        watch = Watch(connection, self.identity)
        self.watch, self.has_changed = watch.begin, watch.has_changed
        loading = self._loading = Loading(connection, self.layout, is_spread=is_spread)
        writer = PostgresWriter(
            connection, self.grid, self.layout, reader, loading, is_spread=is_spread
        )
        self.add, self.replace, self.remove = writer.add, writer.replace, writer.remove
        self.drop_rows = writer.drop_rows
        self.add_surface, self._write_wish = writer.add_surface, writer.want_distances
        kept = PostgresPairs(connection, reader)
        self.pairs, self.put_pairs = kept.pairs, kept.put_pairs
        self.accept_pair = kept.accept_pair
        known = PostgresStatistics(connection, self.layout, reader, is_spread=is_spread)
        self.size, self.quantiles, self.freshness = known.size, known.quantiles, known.freshness
        self.analyze, self.costs, self.save_costs = known.analyze, known.costs, known.save_costs
        self.findings = known.findings
        if not self.is_read_only:
            loading.mend()

    @classmethod
    def open(cls, url: str, *, read_only: bool = False) -> "PostgresStore":
        """Open an existing environment."""
        return cls(schema_of.opened(url, read_only=read_only))

    @classmethod
    def create(
        cls, url: str, grid: Grid, layout: Layout = "brick", *, distances: bool = False
    ) -> "PostgresStore":
        """Make a new environment with its grid: a schema that appears whole or not at all."""
        schema_of.created(url, grid, layout, distances=distances)
        return cls.open(url)

    @property
    def connection(self) -> ServerConnection:
        """The connection, for features that only this engine has."""
        return self._connection

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    @property
    def is_closed(self) -> bool:
        """Whether `close` was called."""
        return self._connection.is_closed

    def give_to(self, thread: int) -> None:
        """Give the store to another thread, or to none (0); only while nobody uses it."""
        self._connection.give_to(thread)

    def discard(self) -> None:
        """Close and delete an environment without any write, unless another writes to it."""
        self._loading.drop_unused()
        self.close()

    def loading(self) -> contextlib.AbstractContextManager[None]:
        """Inside, an empty table may have no index; the index is made at the end."""
        return self._loading

    def want_distances(self) -> None:
        """Note that parts get distances when they are imported."""
        check_distances(self.layout, distances=True)
        self._write_wish()
        self.wants_distances = True

    @contextlib.contextmanager
    def snapshot(self) -> Iterator[None]:
        """All reads inside see one committed revision. May be nested.

        Partitions have snapshots of their own, taken one after the other when it begins.
        """
        with self._connection.snapshot():
            if self._is_spread:
                self._connection.rows(SIZE_OF_PARTITIONS)
            yield

    def lag(self) -> Lag | None:
        """How far the server that answers is behind its primary; None if it is no standby."""
        if not self._connection.is_standby:
            return None
        found = self._connection.rows(REPLAYED)
        return Lag(*found[0]) if found else None

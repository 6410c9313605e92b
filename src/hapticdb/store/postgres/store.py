"""An environment in a schema of a PostgreSQL database."""

import contextlib
from collections.abc import Iterator

from hapticdb.grid import Grid
from hapticdb.store.base import Layout
from hapticdb.store.engines import Lag
from hapticdb.store.postgres import schema_of
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.tables.reading import PostgresReader
from hapticdb.store.postgres.tables.server_tables import SIZE_OF_PARTITIONS
from hapticdb.store.postgres.watching import Watch

GROUPS_KEYS_ITSELF = 170_000
"""Server version, as libpq numbers it, from which `= ANY` reads each leaf page once."""
GROUPING_THRESHOLD = 256
"""Least number of distinct keys that `auto` groups on older servers: docs/decisions/0014."""


REPLAYED = """
SELECT pg_last_wal_replay_lsn()::text,
       extract(epoch FROM clock_timestamp() - pg_last_xact_replay_timestamp())::float8
 WHERE pg_is_in_recovery()"""


class PostgresStore(PostgresReader):
    """An environment on a PostgreSQL server. Open with `open`, make with `create`."""

    def __init__(self, connection: ServerConnection) -> None:
        super().__init__(connection)
        self.name = connection.address.environment
        self.engine = "PostgreSQL {}.{}".format(*divmod(connection.server_version, 10_000))
        groups_keys_itself = connection.server_version >= GROUPS_KEYS_ITSELF
        self.grouping_threshold = None if groups_keys_itself else GROUPING_THRESHOLD
        watch = Watch(connection, self.identity)
        self.watch, self.has_changed = watch.begin, watch.has_changed
        if not self.is_read_only:
            self._loading.mend()

    @classmethod
    def open(cls, url: str, *, read_only: bool = False) -> "PostgresStore":
        """Open an existing environment."""
        connection = schema_of.opened(url, read_only=read_only)
        try:
            return cls(connection)
        except BaseException:
            connection.close()
            raise

    @classmethod
    def create(
        cls, url: str, grid: Grid, layout: Layout = "brick", *, distances: bool = False
    ) -> "PostgresStore":
        """Make a new environment with its grid: a schema that appears whole or not at all."""
        schema_of.created(url, grid, layout, distances=distances)
        return cls.open(url)

    def discard(self) -> None:
        """Close and delete an environment without any write, unless another writes to it."""
        self._loading.drop_unused()
        self.close()

    def loading(self) -> contextlib.AbstractContextManager[None]:
        """Inside, an empty table may have no index; the index is made at the end."""
        return self._loading

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

"""Bulk loading of objects into an empty environment, with its index built at the end.

Measured on 15 million voxel rows: COPY and then the index take 21 s. COPY into an index takes 57 s,
and this index is half as large again. After a killed loader there is no index; the next user to
open the environment for writing builds it. Every commit waits for the disk, a millisecond each, so
reported objects survive a crash, and an import can be resumed.
"""

import contextlib
from collections.abc import Iterator
from types import TracebackType

import psycopg

from hapticdb.errors import ConnectionLostError, ReadOnlyError
from hapticdb.store.base import Layout
from hapticdb.store.postgres import environment_schema
from hapticdb.store.postgres.connecting.server_connection import ServerConnection

# Advisory locks of an environment: one for its loaders, one for the builder of the index. The key
# is the oid of a table of the environment. An oid has 32 unsigned bits, a key 32 signed bits.
LOADERS, MAKERS = 0x48415054, 0x48415055
KEY = "%s, ('environment'::regclass::oid::bigint - 2147483648)::int"


class Loading:
    """Context for the writes of many objects by one connection.

    table : of the rows; None for rows on partitions, which keep their indexes.
    """

    def __init__(self, connection: ServerConnection, table: Layout | None) -> None:
        self._connection, self._table = connection, table
        self._depth = 0
        self._is_owner = False
        self._has_written = False

    def __enter__(self) -> None:
        if not self._depth:
            self._begin()
        self._depth += 1
        self._connection.is_loading = True

    def _begin(self) -> None:
        connection = self._connection
        # now, before minutes of reading files
        text = "SELECT has_column_privilege('environment', 'revision', 'UPDATE')"
        if connection.rows(text) != [(True,)]:
            raise ReadOnlyError(
                f"{connection.shown}: this user may not change objects; its owner can allow it "
                "with 'hapticdb grant URL ROLE --as editor'"
            )
        self._has_written = False
        with connection.without_limit("statement_timeout", "lock_timeout"):
            # shared: several loaders at a time
            connection.execute(f"SELECT pg_advisory_lock_shared({KEY})", (LOADERS,))
            try:
                self._is_owner = connection.is_owner()
                if self._is_owner and self._table is not None:
                    text = f"SELECT EXISTS (SELECT 1 FROM {self._table})"
                    if connection.rows(text) == [(False,)]:
                        self._drop_index()
            except BaseException:
                self._unlock("_shared", LOADERS)
                raise

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._depth -= 1
        self._connection.is_loading = self._depth > 0
        if self._depth or isinstance(error, ConnectionLostError):
            return  # the next user to open the environment for writing builds the index
        connection = self._connection
        if connection.driver.closed:  # Ctrl-C in the middle of a statement
            try:
                connection.connect()
            except ConnectionLostError:
                return
        with connection.without_limit("statement_timeout", "lock_timeout"):
            try:
                if self._is_owner and self._table is not None:
                    self._make_index()
                    if self._has_written:  # visibility map, for frames by index-only scans
                        connection.command(f"VACUUM {self._table}")
            finally:
                self._unlock("_shared", LOADERS)

    def note(self) -> None:
        """Note a write inside the context."""
        self._has_written = True

    def build_missing_index(self) -> None:
        """Build the index missing after a killed loader, unless somebody is loading now."""
        connection = self._connection
        if self._table is None or not connection.is_owner():
            return
        if connection.rows("SELECT to_regclass(%s) IS NOT NULL", (f"{self._table}_key",))[0][0]:
            return
        with (
            connection.without_limit("statement_timeout", "lock_timeout"),
            self._alone() as is_alone,
        ):
            if is_alone:
                self._make_index()

    def drop_unused(self) -> None:
        """Delete the environment if it has no commit and nobody is loading."""
        connection = self._connection
        with self._alone() as is_alone:
            if is_alone and not connection.rows("SELECT 1 FROM environment WHERE revision > 0"):
                environment_schema.drop(connection)

    @contextlib.contextmanager
    def _alone(self) -> Iterator[bool]:
        """Whether nobody else is loading. Inside, no loader can begin."""
        found = self._connection.rows(f"SELECT pg_try_advisory_lock({KEY})", (LOADERS,))
        try:
            yield bool(found[0][0])
        finally:
            if found[0][0]:
                self._unlock("", LOADERS)

    def _unlock(self, kind: str, lock: int) -> None:
        """Release a lock, unless it was lost with the connection."""
        if not self._connection.driver.closed:
            with contextlib.suppress(psycopg.Error):  # the environment itself may be deleted
                self._connection.execute(f"SELECT pg_advisory_unlock{kind}({KEY})", (lock,))

    def _drop_index(self) -> None:
        """Drop the index; while others read, it stays, after 50 ms."""
        connection = self._connection
        with contextlib.suppress(psycopg.errors.LockNotAvailable):
            try:
                connection.begin("lock_timeout = '50ms'")
                connection.command(f"DROP INDEX IF EXISTS {self._table}_key")
                connection.command("COMMIT")
            except BaseException:
                if not connection.driver.closed:
                    connection.command("ROLLBACK")
                raise

    def _make_index(self) -> None:
        """Build the missing index, while readers go on and writers wait.

        One connection at a time: IF NOT EXISTS alone would let two begin.
        """
        connection = self._connection
        connection.execute(f"SELECT pg_advisory_lock({KEY})", (MAKERS,))
        try:
            connection.command("SET maintenance_work_mem = '256MB'")
            connection.command(
                f"CREATE UNIQUE INDEX IF NOT EXISTS {self._table}_key ON {self._table} (z_val, id)"
            )
            connection.command("RESET maintenance_work_mem")
        finally:
            self._unlock("", MAKERS)

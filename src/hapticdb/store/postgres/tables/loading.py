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

from hapticdb.errors import ConnectionLostError
from hapticdb.store.base import Layout
from hapticdb.store.postgres import environment_schema
from hapticdb.store.postgres.connecting import failures
from hapticdb.store.postgres.connecting.server_connection import ServerConnection

# Advisory locks of an environment: one for its loaders, one for the builder of the index. The key
# is the oid of a table of the environment. An oid has 32 unsigned bits, a key 32 signed bits.
LOADERS, MAKERS = 0x48415054, 0x48415055
KEY = "%s, ('environment'::regclass::oid::bigint - 2147483648)::int"


class _Index:
    """Index of an environment's rows, and their table; table None for rows on partitions."""

    def __init__(self, connection: ServerConnection, table: Layout | None) -> None:
        self._connection = connection
        self.table = table

    def is_there(self) -> bool:
        """Whether the index exists, or is not needed here."""
        text = "SELECT to_regclass(%s) IS NOT NULL"
        return self.table is None or self._connection.rows(text, (f"{self.table}_key",))[0][0]

    def has_no_rows(self) -> bool:
        """Whether the table exists, and is empty."""
        text = f"SELECT EXISTS (SELECT 1 FROM {self.table})"
        return self.table is not None and self._connection.rows(text) == [(False,)]

    def drop(self) -> None:
        """Drop the index; while others read, it stays, after 50 ms."""
        connection = self._connection
        with contextlib.suppress(psycopg.errors.LockNotAvailable):
            try:
                connection.begin("lock_timeout = '50ms'")
                connection.command(f"DROP INDEX IF EXISTS {self.table}_key")
                connection.command("COMMIT")
            except BaseException:
                if not connection.driver.closed:
                    connection.command("ROLLBACK")
                raise

    def make(self) -> None:
        """Build the missing index, while readers go on and writers wait."""
        connection = self._connection
        connection.command("SET maintenance_work_mem = '256MB'")
        connection.command(
            f"CREATE UNIQUE INDEX IF NOT EXISTS {self.table}_key ON {self.table} (z_val, id)"
        )
        connection.command("RESET maintenance_work_mem")

    def vacuum(self) -> None:
        """Update the visibility map, for frames by index-only scans."""
        self._connection.command(f"VACUUM {self.table}")


class Loading:
    """Context for the writes of many objects by one connection; partitions keep their indexes."""

    def __init__(
        self, connection: ServerConnection, layout: Layout, *, is_partitioned: bool
    ) -> None:
        self._connection = connection
        self._index = _Index(connection, None if is_partitioned else layout)
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
        self._check_editor()
        self._has_written = False
        with connection.without_limit("statement_timeout", "lock_timeout"):
            # shared: several loaders at a time
            connection.execute(f"SELECT pg_advisory_lock_shared({KEY})", (LOADERS,))
            try:
                self._is_owner = connection.is_owner()
                if self._is_owner and self._index.has_no_rows():
                    self._index.drop()
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
                if self._is_owner and self._index.table is not None:
                    self._make_index()
                    if self._has_written:  # for frames by index-only scans
                        self._index.vacuum()
            finally:
                self._unlock("_shared", LOADERS)

    def _check_editor(self) -> None:
        """Refuse a user without the right to edit objects, before minutes of reading files."""
        ((may_edit,),) = self._connection.rows(
            "SELECT has_column_privilege('environment', 'revision', 'UPDATE')"
        )
        if not may_edit:
            raise failures.no_editor(self._connection.shown)

    def note(self) -> None:
        """Note a write inside the context."""
        self._has_written = True

    def build_missing_index(self) -> None:
        """Build the index missing after a killed loader, unless somebody is loading now."""
        connection = self._connection
        if not connection.is_owner() or self._index.is_there():
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

    def _make_index(self) -> None:
        """Build the index, one connection at a time: IF NOT EXISTS alone would let two begin."""
        connection = self._connection
        connection.execute(f"SELECT pg_advisory_lock({KEY})", (MAKERS,))
        try:
            self._index.make()
        finally:
            self._unlock("", MAKERS)

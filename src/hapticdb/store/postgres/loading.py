"""Loading: many objects at once into an empty environment, its index and statistics afterwards.

Measured on 15 million voxel rows: COPY and then the index take 21 s, COPY into the index 57 s, and
the index is half as large again. A loader that was killed leaves no index; whoever opens the
environment to write next makes it.
"""

import contextlib
from types import TracebackType

import psycopg

from hapticdb.errors import ConnectionLostError
from hapticdb.store.base import Layout
from hapticdb.store.postgres.session import Session

# one key for all environments of a database: a loader elsewhere only puts the mending off
LOADERS = 0x4841505449434442
IS_EMPTY = {layout: f"SELECT NOT EXISTS (SELECT 1 FROM {layout})" for layout in ("voxel", "brick")}


class Loading:
    """The context in which a session loads. May be nested."""

    def __init__(self, session: Session, layout: Layout) -> None:
        self._session = session
        self._layout = layout
        self._depth = 0
        self._is_owner = False
        self._written = 0

    def __enter__(self) -> None:
        self._depth += 1
        if self._depth > 1:
            return
        session = self._session
        self._written = 0
        with session.without_limit("statement_timeout"):
            # shared: several loaders at a time
            session.execute("SELECT pg_advisory_lock_shared(%s)", (LOADERS,))
            self._is_owner = session.is_owner()
            # a commit that waits for no disk; the last one below waits for all of them
            session.command("SET synchronous_commit = off")
            if self._is_owner and self._is_empty():
                self._drop_index()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._depth -= 1
        if self._depth:
            return
        if isinstance(error, ConnectionLostError):
            return  # the next one to open it mends it
        session = self._session
        if session.connection.closed:
            session.again(lambda: None)  # Ctrl-C in the middle of a statement gave it up
        with session.without_limit("statement_timeout", "lock_timeout"):
            session.command("SET synchronous_commit = on")
            if self._written:
                session.execute("UPDATE environment SET revision = revision WHERE id = 1")
            if self._is_owner:
                self._make_index()
                if self._written:  # so that frames are read from the index alone
                    session.command(f"VACUUM {self._layout}")
            session.execute("SELECT pg_advisory_unlock_shared(%s)", (LOADERS,))

    def check(self, revision: int) -> None:
        """Refuse to go on when commits of this loading were lost with the server.

        A commit that did not wait for the disk may be gone after a crash. Revisions are written in
        order, so that the next one tells.
        """
        if self._depth and revision <= self._written:
            raise ConnectionLostError(
                f"{self._session.shown}: the server went away and its last writes with it; "
                "run the same again, and it goes on from what is there"
            )

    def note(self, revision: int) -> None:
        """Remember what has been committed inside."""
        if self._depth:
            self._written = revision

    def mend(self) -> None:
        """Make the index that a killed loader has left out, unless one is loading now."""
        session = self._session
        if not session.is_owner() or self._has_index():
            return
        with session.without_limit("statement_timeout", "lock_timeout"):
            row = session.execute("SELECT pg_try_advisory_lock(%s)", (LOADERS,)).fetchone()
            if row is not None and row[0]:
                try:
                    self._make_index()
                finally:
                    session.execute("SELECT pg_advisory_unlock(%s)", (LOADERS,))

    def _has_index(self) -> bool:
        found = self._session.rows("SELECT to_regclass(%s) IS NOT NULL", (f"{self._layout}_key",))
        return bool(found[0][0])

    def _is_empty(self) -> bool:
        return bool(self._session.rows(IS_EMPTY[self._layout])[0][0])

    def _drop_index(self) -> None:
        """Leave the index out, if nobody is reading; nobody is made to wait."""
        session = self._session
        with contextlib.suppress(psycopg.errors.LockNotAvailable):
            session.command("BEGIN")
            try:
                session.command("SET LOCAL lock_timeout = '50ms'")
                session.command(f"DROP INDEX IF EXISTS {self._layout}_key")
                session.command("COMMIT")
            except BaseException:
                session.command("ROLLBACK")
                raise

    def _make_index(self) -> None:
        """Readers go on meanwhile; writers wait."""
        session, layout = self._session, self._layout
        session.command("SET maintenance_work_mem = '256MB'")
        session.command(f"CREATE UNIQUE INDEX IF NOT EXISTS {layout}_key ON {layout} (z_val, id)")
        session.command("RESET maintenance_work_mem")

"""Loading: many objects at once into an empty environment, its index and statistics afterwards.

Measured on 15 million voxel rows: COPY and then the index take 21 s, COPY into the index 57 s, and
the index is half as large again. A loader that was killed leaves no index; whoever opens the
environment to write next makes it. Commits wait for the disk all the same, a millisecond each: what
was reported as written is there after a crash, and an import may go on from it.
"""

import contextlib
from collections.abc import Iterator
from types import TracebackType

import psycopg

from hapticdb.errors import ConnectionLostError
from hapticdb.store.base import LAYOUTS, Layout
from hapticdb.store.postgres import failures, schema_of
from hapticdb.store.postgres.session import Session

IS_EMPTY = {layout: f"SELECT NOT EXISTS (SELECT 1 FROM {layout})" for layout in LAYOUTS}
# advisory locks of an environment, by the number of one of its tables: who loads, and who makes the
# index. An oid has 32 bits without a sign, the key of a lock 32 bits with one
LOADERS, MAKERS = 0x48415054, 0x48415055
KEY = "%s, ('environment'::regclass::oid::bigint - 2147483648)::int"


class Loading:
    """The context in which a session loads. May be nested."""

    def __init__(self, session: Session, layout: Layout) -> None:
        self._session = session
        self._layout = layout
        self._depth = 0
        self._is_owner = False
        self._has_written = False

    def __enter__(self) -> None:
        if not self._depth:
            self._begin()
        self._depth += 1
        self._session.is_loading = True

    def _begin(self) -> None:
        session = self._session
        self._check_editor()
        self._has_written = False
        with session.without_limit("statement_timeout", "lock_timeout"):
            # shared: several loaders at a time
            session.execute(f"SELECT pg_advisory_lock_shared({KEY})", (LOADERS,))
            try:
                self._is_owner = session.is_owner()
                if self._is_owner and self._is_empty():
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
        self._session.is_loading = self._depth > 0
        if self._depth or isinstance(error, ConnectionLostError):
            return  # the next one to open it mends it
        session = self._session
        if session.connection.closed:  # Ctrl-C in the middle of a statement gave it up
            try:
                session.connect()
            except ConnectionLostError:
                return
        with session.without_limit("statement_timeout", "lock_timeout"):
            try:
                if self._is_owner:
                    self._make_index()
                    if self._has_written:  # so that frames are read from the index alone
                        session.command(f"VACUUM {self._layout}")
            finally:
                self._unlock("_shared", LOADERS)

    def _check_editor(self) -> None:
        """Tell a toucher at once, and not after a minute's reading."""
        ((may_edit,),) = self._session.rows(
            "SELECT has_column_privilege('environment', 'revision', 'UPDATE')"
        )
        if not may_edit:
            raise failures.no_editor(self._session.shown)

    def note(self) -> None:
        """Remember that something was written inside."""
        self._has_written = True

    def mend(self) -> None:
        """Make the index that a killed loader has left out, unless one is loading now."""
        session = self._session
        if not session.is_owner() or self._has_index():
            return
        with (
            session.without_limit("statement_timeout", "lock_timeout"),
            self._alone() as is_alone,
        ):
            if is_alone:
                self._make_index()

    def drop_unused(self) -> None:
        """Delete the environment if nothing was ever written to it and nobody is about to."""
        session = self._session
        with self._alone() as is_alone:
            if is_alone and not session.rows("SELECT 1 FROM environment WHERE revision > 0"):
                schema_of.drop(session)

    @contextlib.contextmanager
    def _alone(self) -> Iterator[bool]:
        """Whether nobody else loads; none can begin while this lasts."""
        found = self._session.rows(f"SELECT pg_try_advisory_lock({KEY})", (LOADERS,))
        try:
            yield bool(found[0][0])
        finally:
            if found[0][0]:
                self._unlock("", LOADERS)

    def _unlock(self, kind: str, lock: int) -> None:
        """Give a lock back, where there is still one to give."""
        if not self._session.connection.closed:
            with contextlib.suppress(psycopg.Error):  # the environment itself may be gone
                self._session.execute(f"SELECT pg_advisory_unlock{kind}({KEY})", (lock,))

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
                if not session.connection.closed:
                    session.command("ROLLBACK")
                raise

    def _make_index(self) -> None:
        """Readers go on meanwhile; writers wait. One maker at a time: IF NOT EXISTS is no lock."""
        session, layout = self._session, self._layout
        session.execute(f"SELECT pg_advisory_lock({KEY})", (MAKERS,))
        try:
            session.command("SET maintenance_work_mem = '256MB'")
            session.command(
                f"CREATE UNIQUE INDEX IF NOT EXISTS {layout}_key ON {layout} (z_val, id)"
            )
            session.command("RESET maintenance_work_mem")
        finally:
            self._unlock("", MAKERS)

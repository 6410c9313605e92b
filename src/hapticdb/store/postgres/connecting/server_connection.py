"""Connection to one environment's schema: statements, transactions, reconnecting."""

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import psycopg
from psycopg import sql

from hapticdb.closing import Closes
from hapticdb.errors import ConnectionLostError, DatabaseError
from hapticdb.store.postgres.address import Address
from hapticdb.store.postgres.connecting import failures
from hapticdb.store.postgres.connecting.link import CONNECT_SECONDS, Link, SilentServerError
from hapticdb.store.postgres.connecting.wire import Parameter
from hapticdb.store.store_errors import check_outside
from hapticdb.store.threads import check_thread, this_thread

Result = TypeVar("Result")

RECONNECT_SECONDS = 15.0
"""Seconds of attempts to reach a lost server, before a read raises its error."""
FIRST_PAUSE_SECONDS = 0.05
"""Pause between the first two attempts to reconnect; doubled after each."""
MOST_PAUSE_SECONDS = 0.5
"""Longest pause between two attempts. Larger: fewer attempts at a struggling server."""
WRITE_TRIES = 3
"""Attempts at a write on losses of the server. Larger: survives more losses in a row."""


class ServerConnection(Link, Closes):
    """One connection to one environment's schema; only the thread that opened it may use it.

    is_loading : during `Loading`; is_closed : by `close`. A lost connection is replaced.
    """

    def __init__(self, address: Address, *, read_only: bool = False) -> None:
        self._thread = this_thread()
        self._depth = 0
        self.is_loading = False
        self.is_closed = False
        super().__init__(address, read_only=read_only)

    # -- the connection ----------------------------------------------------------------------

    def close(self) -> None:
        """Close the connection."""
        self.is_closed = True
        self.drop()

    def _reconnect(self) -> None:
        """Reconnect within `RECONNECT_SECONDS`, by several attempts; then raise the last error."""
        self.drop()
        deadline = time.monotonic() + RECONNECT_SECONDS
        pause = FIRST_PAUSE_SECONDS
        while True:
            left = max(deadline - time.monotonic(), FIRST_PAUSE_SECONDS)
            try:
                self.connect(min(left, CONNECT_SECONDS))
            except ConnectionLostError:
                if time.monotonic() + pause > deadline:
                    raise
                time.sleep(pause)
                pause = min(2 * pause, MOST_PAUSE_SECONDS)
            else:
                return

    def check_thread(self) -> None:
        """Refuse a call from any thread but the connection's own."""
        check_thread(self._thread, self.shown)

    @property
    def is_in_transaction(self) -> bool:
        """Whether a snapshot or a write is open."""
        return self._depth > 0

    def check_outside(self) -> None:
        """Refuse to query for commits of others inside a transaction."""
        check_outside(self._depth, self.shown)

    def again(self, read: Callable[[], Result]) -> Result:
        """Run a read; after a loss of the connection, reconnect and run it once more.

        Not inside a snapshot: its earlier reads saw the lost connection's revision. Not with
        `is_prompt`.
        """
        self.check_thread()
        if self.is_closed:
            raise DatabaseError(f"{self.shown} has been closed: open it again")
        # a loss noticed earlier: reconnecting now leaves both attempts for the read
        if self.is_lost and not self._depth:
            self._reconnect()
        try:
            with failures.named_errors(self.shown):
                return read()
        except ConnectionLostError:
            if self._depth or self.is_prompt:
                raise
        self._reconnect()
        with failures.named_errors(self.shown):
            return read()

    # -- statements --------------------------------------------------------------------------

    def fetch(self, text: str, *parameters: Parameter) -> list[bytes | None]:
        """First row of a prepared statement, in binary format."""

        def read() -> list[bytes | None]:
            result = self.run(text, parameters)
            return [result.get_value(0, column) for column in range(result.nfields)]

        return self.again(read)

    def rows(
        self, text: str, parameters: Sequence[Any] = (), *, binary: bool = False
    ) -> list[tuple[Any, ...]]:
        """All rows as Python values, outside frames; `binary` is faster for bytes and doubles."""
        return self.again(
            lambda: self.driver.execute(text, parameters or None, binary=binary).fetchall()
        )

    def execute(
        self, text: str | sql.Composed, parameters: Sequence[Any] = ()
    ) -> psycopg.Cursor[tuple[Any, ...]]:
        """One statement through psycopg, without a second attempt."""
        return self.driver.execute(text, parameters or None)

    # -- transactions ------------------------------------------------------------------------

    @contextlib.contextmanager
    def snapshot(self) -> Iterator[None]:
        """All reads inside see one committed revision: REPEATABLE READ. May be nested."""
        if self._depth == 0:
            self.again(lambda: self.command("BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY"))
        self._depth += 1
        try:
            yield
        finally:
            self._depth -= 1
            # the transaction of a lost connection has ended with it
            if self._depth == 0 and not self.is_lost:
                try:
                    with failures.named_errors(self.shown):
                        self.command("COMMIT")
                except ConnectionLostError:  # no error: the reads are complete
                    self.drop()

    def write(
        self, work: Callable[[], Result], is_committed: Callable[[], bool] | None = None
    ) -> Result:
        """Run `work` in one transaction, without a frame's time limit.

        When the connection is lost before the commit was sent, everything is repeated. When it is
        lost during the commit, `is_committed` decides on the new connection; without it, `work`
        must be idempotent.
        """
        self.check_thread()
        for tries_left in reversed(range(WRITE_TRIES)):
            if self.is_lost and not self.is_closed:
                self._reconnect()
            try:
                result, is_certain = self._write_once(work)
            except ConnectionLostError:
                self.drop()
                if not tries_left:
                    raise
            else:
                # unconfirmed and not found: the commit was not done, so the work is repeated
                if is_certain or (is_committed is not None and self._finds(is_committed)):
                    return result
        raise ConnectionLostError(
            f"{self.shown}: the server went away during each of {WRITE_TRIES} commits; nothing "
            "was written, so run the same again when it is back"
        )

    def _finds(self, is_committed: Callable[[], bool]) -> bool:
        """Whether an unconfirmed commit was done; ConnectionLostError if that stays unknown."""
        try:
            self._reconnect()
            return is_committed()
        except DatabaseError as error:
            raise ConnectionLostError(
                f"{self.shown}: the server went away during a commit, and whether that was done is "
                f"not known yet: look, then decide ({error})"
            ) from error

    def _write_once(self, work: Callable[[], Result]) -> tuple[Result, bool]:
        """Result of `work`, and whether the server confirmed the commit."""
        if self.is_closed:
            raise DatabaseError(f"{self.shown} has been closed: open it again")
        limits = ["statement_timeout", "idle_in_transaction_session_timeout"]
        if self.is_loading:  # another loader may be building the index
            limits.append("lock_timeout")
        with failures.named_errors(self.shown), self.without_time_limit():
            # from here `again` may not reconnect: the statements before would be missing
            self._depth += 1
            try:
                self.begin(*(f"{limit} = 0" for limit in limits))
                result = work()
            except BaseException:
                with contextlib.suppress(psycopg.Error):
                    if not self.is_lost:
                        self.command("ROLLBACK")
                raise
            finally:
                self._depth -= 1
            try:
                # outside the block above: a commit without an answer may be done, so it is not
                # rolled back; `write` looks it up on a new connection
                self.command("COMMIT")
            except SilentServerError:  # it may still be done when the server goes on
                return result, False
            except psycopg.Error as error:
                if not failures.is_lost(error):
                    raise
                return result, False
        return result, True

    def begin(self, *settings: str) -> None:
        """Begin a writing transaction with its own settings, in one round trip.

        Refuses a pooler in transaction mode: each transaction gets another server connection, and
        would write to another schema than that of the search path.
        """
        local = [f"SET LOCAL {setting}" for setting in settings]
        query = "SELECT current_setting('search_path')"
        found = self.command("; ".join(["BEGIN ISOLATION LEVEL READ COMMITTED", *local, query]))
        if found.get_value(0, 0) != self._search_path.encode():
            raise DatabaseError(
                f"{self.shown} seems to be behind a pooler in transaction mode, which may write to "
                "another schema: connect to the server itself, or use session pooling; nothing was "
                "written"
            )

    @contextlib.contextmanager
    def without_limit(self, *limits: str) -> Iterator[None]:
        """Suspend the named time limits inside; `statement_timeout` if none is named."""
        names = limits or ("statement_timeout",)
        before = [self.rows(f"SHOW {name}")[0][0] for name in names]
        with failures.named_errors(self.shown), self.without_time_limit():
            for name in names:
                self.command(f"SET {name} = 0")
            try:
                yield
            finally:
                if self.is_usable():
                    for name, value in zip(names, before, strict=True):
                        self.command(f"SET {name} = '{value}'")

    def is_owner(self) -> bool:
        """Whether this user owns the environment's tables, and so may create indexes and grant."""
        found = self.rows(
            "SELECT pg_has_role(relowner, 'USAGE') FROM pg_class"
            " WHERE oid = 'environment'::regclass"
        )
        return bool(found[0][0])

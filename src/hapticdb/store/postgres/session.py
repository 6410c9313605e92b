"""A connection with the settings that decide, prepared statements, and a way back after a loss.

The hot path goes to libpq's own calls (`psycopg.pq`): a cursor's `execute` costs 15 to 30 us more a
statement. It waits by polling the socket, so that Ctrl-C is heard and a server that has stopped
answering ends in an error instead of a hang.
"""

import contextlib
import re
import select
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import Any, Self, TypeVar, cast

import psycopg
from psycopg import pq, sql
from psycopg.errors import error_from_result

from hapticdb.errors import ConnectionLostError, DatabaseError, StuckError
from hapticdb.store.base import check_outside, check_thread, this_thread
from hapticdb.store.postgres import failures
from hapticdb.store.postgres.address import Address
from hapticdb.store.postgres.wire import Parameter

Result = TypeVar("Result")

SETTINGS = {
    # compiling a frame's plan takes longer than running it: 1.8 ms with, 0.3 without
    "jit": "off",
    # a custom plan reads 10,000 histogram bounds each time: 288 us instead of 84 for one range
    "plan_cache_mode": "force_generic_plan",
    # a frame reads a few dozen rows: starting a worker takes longer
    "max_parallel_workers_per_gather": "0",
    # a bitmap scan reads the heap and forgets the order of the keys; planned for ranges of which
    # the planner cannot know how short they are
    "enable_bitmapscan": "off",
    # a plan made while the table was small is kept, and must not be a scan of all of it
    "enable_seqscan": "off",
    # readers never wait for locks; a writer that does so is told after this
    "lock_timeout": "10s",
    # a frame that takes longer is stuck; writes, indexes and statistics lift it for themselves
    "statement_timeout": "10s",
    "client_min_messages": "warning",
}
RECONNECT_SECONDS = 15.0
FIRST_PAUSE_SECONDS = 0.05
MOST_PAUSE_SECONDS = 0.5
CONNECT_SECONDS = 10
WRITE_TRIES = 3
GRACE_MS = 3000
"""What the network and a busy server may add to the server's own time limit."""
NOBODY = 0
"""No thread has this number."""


class _Connection(psycopg.Connection[tuple[Any, ...]]):
    """psycopg's connection, which by itself waits for ever, with its session's patience."""

    session: "Session"

    def wait(self, gen: Generator[Any, Any, Result], *args: Any, **options: Any) -> Result:  # noqa: ANN401 - psycopg's own
        """Let a statement run to its end; the connection is given up when that does not come."""
        try:
            return super().wait(self.session.until_out_of_patience(gen), *args, **options)
        except StuckError:
            self.close()
            raise


class Session:
    """One connection to one environment's schema; belongs to the thread that opened it."""

    def __init__(self, address: Address, conninfo: str, *, read_only: bool = False) -> None:
        self.address = address
        self.shown = address.shown
        self.is_read_only = read_only
        self._conninfo = conninfo
        self._thread = this_thread()
        self._depth = 0
        self._leisure = 0
        self.is_loading = False
        self._is_closed = False
        self.connect()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- the connection ----------------------------------------------------------------------

    def connect(self) -> None:
        """Connect once, with our settings; what the URL's own `options` set stays."""
        try:
            self.connection = _Connection.connect(
                self._conninfo,
                autocommit=True,
                client_encoding="utf8",
                fallback_application_name="hapticdb",
                connect_timeout=None if "connect_timeout=" in self._conninfo else CONNECT_SECONDS,
            )
        # the engine's own words, in a traceback, too, may hold the password: from None
        except psycopg.OperationalError as error:
            raise failures.refused(error, self.shown) from None
        except psycopg.Error as error:
            raise failures.unusable(error, self.shown) from None
        self.connection.session = self
        self.connection.prepare_threshold = None
        self._prepared: dict[str, bytes] = {}
        self._pgconn = self.connection.pgconn
        self._limit_ms: int | None = 1000 * CONNECT_SECONDS
        self._poller = select.poll()
        self._poller.register(self._pgconn.socket, select.POLLIN | select.POLLERR | select.POLLHUP)
        try:
            with failures.named_errors(self.shown):
                self._settle()
        except BaseException:  # half settled is worse than none
            self.connection.close()
            raise

    def _settle(self) -> None:
        wanted = {
            **SETTINGS,
            "search_path": f"{_quoted(self.address.environment)}, pg_temp",
            "default_transaction_read_only": "on" if self.is_read_only else "off",
        }
        options = self.connection.info.options.lower().replace("-", "_")
        theirs = re.findall(r"(?:_c\s*|__)(\w+)=", options)
        ours = {name: value for name, value in wanted.items() if name not in theirs}
        ours["search_path"] = wanted["search_path"]
        known = self.connection.execute(
            "SELECT set_config(s.name, s.value, false)"
            "  FROM unnest(%s::text[], %s::text[]) AS s(name, value)",
            (list(ours), list(ours.values())),
        )
        known.fetchall()
        row = self.connection.execute(
            "SELECT setting::int FROM pg_settings WHERE name = 'statement_timeout'"
        ).fetchone()
        assert row is not None  # noqa: S101 - the server has this setting
        self._limit_ms = row[0] + GRACE_MS if row[0] else None

    @property
    def _patience_ms(self) -> int | None:
        """How long to wait for an answer; None while something is allowed to take its time."""
        return None if self._leisure else self._limit_ms

    @property
    def server_version(self) -> int:
        """As libpq counts: 150018 is 15.18."""
        return self._pgconn.server_version

    def close(self) -> None:
        """Give the connection back."""
        self._is_closed = True
        self.connection.close()

    def _reconnect(self) -> None:
        """Connect again, waiting longer each time; raises when the server stays away."""
        self.connection.close()
        deadline = time.monotonic() + RECONNECT_SECONDS
        pause = FIRST_PAUSE_SECONDS
        while True:
            try:
                self.connect()
            except ConnectionLostError:
                if time.monotonic() + pause > deadline:
                    raise
                time.sleep(pause)
                pause = min(2 * pause, MOST_PAUSE_SECONDS)
            else:
                return

    @property
    def is_closed(self) -> bool:
        """Whether `close` was called; a lost connection comes back by itself."""
        return self._is_closed

    def give_to(self, thread: int) -> None:
        """Belong to another thread from now on, or to NOBODY; only while nobody uses it."""
        self._thread = thread

    def check_thread(self) -> None:
        """Refuse a call from another thread than the one that this belongs to."""
        check_thread(self._thread, self.shown)

    def check_outside(self) -> None:
        """Refuse to look for the commits of others inside a transaction."""
        check_outside(self._depth, self.shown)

    def again(self, read: Callable[[], Result]) -> Result:
        """Run a read; when the connection is lost, connect again and run it once more.

        Inside a snapshot there is no second run: what came before was read from the lost one.
        """
        self.check_thread()
        if self._is_closed:
            raise DatabaseError(f"{self.shown} has been closed: open it again")
        try:
            if self.connection.closed and not self._depth:
                self._reconnect()
            with failures.named_errors(self.shown):
                return read()
        except ConnectionLostError:
            if self._depth:
                raise
        self._reconnect()
        with failures.named_errors(self.shown):
            return read()

    # -- statements --------------------------------------------------------------------------

    def fetch(self, text: str, *parameters: Parameter) -> list[bytes | None]:
        """First row of a prepared statement, every value in its binary form."""

        def read() -> list[bytes | None]:
            result = self._run(text, parameters)
            return [result.get_value(0, column) for column in range(result.nfields)]

        return self.again(read)

    def rows(self, text: str, parameters: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """All rows of a statement, as Python's own values: for what no frame waits on."""
        return self.again(lambda: self.execute(text, parameters).fetchall())

    def execute(
        self, text: str | sql.Composed, parameters: Sequence[Any] = ()
    ) -> psycopg.Cursor[tuple[Any, ...]]:
        """One statement through psycopg, without a second try."""
        return self.connection.execute(text, parameters or None)

    def command(self, text: str) -> None:
        """One statement without parameters or rows, through libpq."""
        self._pgconn.send_query(text.encode())
        self._result()

    def hear(self) -> None:
        """Hand what has come between statements to the connection's notify handlers; never waits.

        What came during one waits in libpq until then, or went there through psycopg.
        """
        self._pgconn.consume_input()
        while (notify := self._pgconn.notifies()) and self._pgconn.notify_handler:
            self._pgconn.notify_handler(notify)

    def _run(self, text: str, parameters: Sequence[Parameter]) -> pq.abc.PGresult:
        name = self._prepared.get(text)
        if name is None:
            name = f"hapticdb_{len(self._prepared)}".encode()
            oids = [parameter.oid for parameter in parameters]
            self._pgconn.send_prepare(name, text.encode(), oids)
            self._result()
            self._prepared[text] = name
        values = [parameter.value for parameter in parameters]
        self._pgconn.send_query_prepared(name, values, [1] * len(values), 1)
        return self._result()

    def _result(self) -> pq.abc.PGresult:
        """Result of what was sent; the connection is given up when it does not come."""
        try:
            return self._receive()
        except psycopg.Error as error:
            if failures.is_lost(error):
                self.connection.close()
            raise
        except BaseException:  # Ctrl-C, or out of patience: what comes now belongs to nobody
            self.connection.close()
            raise

    def _receive(self) -> pq.abc.PGresult:
        pgconn = self._pgconn
        while pgconn.flush():  # a shell of many points does not fit into the socket at once
            self._poller.modify(pgconn.socket, select.POLLIN | select.POLLOUT)
            self._wait()
            pgconn.consume_input()
        self._poller.modify(pgconn.socket, select.POLLIN)
        found: pq.abc.PGresult | None = None
        while True:
            while pgconn.is_busy():
                self._wait()
                pgconn.consume_input()
            result = pgconn.get_result()
            if result is None:
                break
            found = result
        if found is None:
            raise psycopg.OperationalError("the server closed the connection")
        if found.status not in _FINE:
            raise error_from_result(found, encoding="utf-8")
        return found

    def _wait(self) -> None:
        if not self._poller.poll(self._patience_ms):
            raise self._stuck()

    def until_out_of_patience(
        self, waiting: Generator[Any, Any, Result]
    ) -> Generator[Any, Any, Result]:
        """Pass on what one of psycopg's statements waits for, as long as there is time."""
        started = time.monotonic()
        try:
            wanted = next(waiting)
            while True:
                ready = yield wanted
                waited_ms = 1000 * (time.monotonic() - started)
                if not ready and self._patience_ms is not None and waited_ms > self._patience_ms:
                    raise self._stuck()
                wanted = waiting.send(ready)
        except StopIteration as end:
            return cast("Result", end.value)

    def _stuck(self) -> StuckError:
        return StuckError(
            f"{self.shown} did not answer within {self._patience_ms} ms: "
            "the server, or the way to it, hangs"
        )

    # -- transactions ------------------------------------------------------------------------

    @contextlib.contextmanager
    def snapshot(self) -> Iterator[None]:
        """All reads inside see one committed revision: REPEATABLE READ. May be nested."""
        if self._depth == 0:
            self.again(lambda: self.command(_SNAPSHOT))
        self._depth += 1
        try:
            yield
        finally:
            self._depth -= 1
            if self._depth == 0 and not self.connection.closed:
                self._end_snapshot()

    def write(
        self, work: Callable[[], Result], is_committed: Callable[[], bool] | None = None
    ) -> Result:
        """Run `work` in one transaction, without a frame's time limit.

        When the connection is lost before the commit was sent, the whole is done again; when it is
        lost during the commit, `is_committed` looks, on the new connection, whether it counts.
        Without `is_committed`, work is what may be done twice.
        """
        self.check_thread()
        for tries_left in reversed(range(WRITE_TRIES)):
            try:
                result, is_certain = self._write_once(work)
            except ConnectionLostError:
                if not tries_left:
                    raise
                self._reconnect()
            else:
                if is_certain or (is_committed is not None and self._finds(is_committed)):
                    return result
        raise ConnectionLostError(
            f"{self.shown}: the server went away during each of {WRITE_TRIES} commits; nothing "
            "was written, so run the same again when it is back"
        )

    def _finds(self, is_committed: Callable[[], bool]) -> bool:
        """Whether a write counts whose commit was sent and not answered; never guesses."""
        try:
            self._reconnect()
            return is_committed()
        except DatabaseError as error:
            raise ConnectionLostError(
                f"{self.shown}: the server went away during a commit, and whether that counts is "
                f"not known yet: look, then decide ({error})"
            ) from error

    def _write_once(self, work: Callable[[], Result]) -> tuple[Result, bool]:
        """Result of `work`, and whether the commit was answered."""
        if self._is_closed:
            raise DatabaseError(f"{self.shown} has been closed: open it again")
        if self.connection.closed:
            self._reconnect()
        with failures.named_errors(self.shown), self._unhurried():
            self.command("BEGIN ISOLATION LEVEL READ COMMITTED")
            self._depth += 1
            try:
                self.command("SET LOCAL statement_timeout = 0")
                if self.is_loading:  # another loader may be making its index
                    self.command("SET LOCAL lock_timeout = 0")
                result = work()
            except BaseException:
                self._roll_back()
                raise
            finally:
                self._depth -= 1
            try:
                self.command("COMMIT")
            except psycopg.Error as error:
                if not failures.is_lost(error):
                    raise
                return result, False
        return result, True

    def _end_snapshot(self) -> None:
        """Nothing is left to lose: all was read from one revision, though the server be gone."""
        try:
            with failures.named_errors(self.shown):
                self.command("COMMIT")
        except ConnectionLostError:
            self.connection.close()

    def _roll_back(self) -> None:
        with contextlib.suppress(psycopg.Error):
            if not self.connection.closed:
                self.command("ROLLBACK")

    @contextlib.contextmanager
    def _unhurried(self) -> Iterator[None]:
        """Wait without limit inside: for what is allowed to take its time."""
        self._leisure += 1
        try:
            yield
        finally:
            self._leisure -= 1

    @contextlib.contextmanager
    def without_limit(self, *limits: str) -> Iterator[None]:
        """Lift time limits inside, the statement's unless named: for indexes and statistics."""
        names = limits or ("statement_timeout",)
        with failures.named_errors(self.shown), self._unhurried():
            # the connection may have been lost since it was last used
            before = self.again(lambda: [self._shown_setting(name) for name in names])
            for name in names:
                self.command(f"SET {name} = 0")
            try:
                yield
            finally:
                if self._is_usable():
                    for name, value in zip(names, before, strict=True):
                        self.command(f"SET {name} = '{value}'")

    def _shown_setting(self, name: str) -> str:
        row = self.connection.execute(f"SHOW {name}").fetchone()
        return row[0] if row else "0"

    def _is_usable(self) -> bool:
        """Whether a statement can be sent: neither closed nor in a failed transaction."""
        state = self._pgconn.transaction_status
        return not self.connection.closed and state != pq.TransactionStatus.INERROR

    def is_owner(self) -> bool:
        """Whether this user owns the environment's tables: who may make indexes and grant."""
        found = self.rows(
            "SELECT pg_has_role(relowner, 'USAGE') FROM pg_class"
            " WHERE oid = 'environment'::regclass"
        )
        return bool(found[0][0])


_SNAPSHOT = "BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY"
_FINE = (pq.ExecStatus.TUPLES_OK, pq.ExecStatus.COMMAND_OK, pq.ExecStatus.EMPTY_QUERY)


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


def identifier(name: str) -> sql.Identifier:
    """Quote a name for a statement's text."""
    return sql.Identifier(name)

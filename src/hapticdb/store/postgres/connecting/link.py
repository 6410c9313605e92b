"""psycopg's connection with hapticdb's settings and time limits on every wait.

The hot path uses libpq's own calls (`psycopg.pq`): a cursor's `execute` costs 15 to 30 us more a
statement. Waits are short steps, so Ctrl-C interrupts them, and a hanging server causes an error,
also during long statements.

A server may be silent for minutes during a long statement. A working one still answers a new
client's SSLRequest ("SSL Session Encryption" in PostgreSQL's manual), without a password and
without using one of its connections; a hanging or disconnected one does not.
"""

import contextlib
import math
import os
import re
import socket
import struct
import time
from collections.abc import Generator, Iterator, Sequence
from typing import Any, NamedTuple, TypeVar, cast

import psycopg
from psycopg import generators, pq, waiting
from psycopg.errors import error_from_result

from hapticdb.errors import StuckError
from hapticdb.store.postgres.address import Address
from hapticdb.store.postgres.connecting import failures
from hapticdb.store.postgres.connecting.wire import Parameter

Result = TypeVar("Result")

SETTINGS = {
    # compiling a frame's plan takes longer than running it: 1.8 ms with, 0.3 without
    "jit": "off",
    # a custom plan reads 10,000 histogram bounds each time: 288 us instead of 84 for one range
    "plan_cache_mode": "force_generic_plan",
    # a frame reads a few dozen rows, which takes less time than starting a worker
    "max_parallel_workers_per_gather": "0",
    # the planner cannot estimate the short ranges and would choose a bitmap scan, which reads the
    # heap and loses the order of the keys
    "enable_bitmapscan": "off",
    # a plan made for a small table is cached: it must not scan the whole table
    "enable_seqscan": "off",
    # rows on partitions are counted there
    "enable_partitionwise_aggregate": "on",
    # readers never wait for locks; a writer that waits longer gets an error
    "lock_timeout": "10s",
    # a longer frame is stuck; writes, indexes and statistics lift this limit
    "statement_timeout": "10s",
    "client_min_messages": "warning",
}
CONNECT_SECONDS = 10
"""Seconds for a server to accept a connection, unless set in the URL."""
GRACE_MS = 3000
"""Milliseconds of network and busy server, added to the server's own time limit."""
STEP_S = 0.05
"""Seconds between two checks of a wait's limit. Larger: exceeds it by more."""
SILENCE_S, PROMPT_SILENCE_S = 5.0, 0.1
"""Seconds without a byte before a test of the server by a new client; the second value with
`is_prompt`. Smaller: more such tests during slow statements."""
ANSWER_S, PROMPT_ANSWER_S = 5.0, 0.15
"""Seconds for a server to accept such a test, and again to answer it; likewise. Smaller: a busy
server counts as hanging."""
SSL_REQUEST = struct.pack("!ii", 8, 80877103)
FINE = (pq.ExecStatus.TUPLES_OK, pq.ExecStatus.COMMAND_OK, pq.ExecStatus.EMPTY_QUERY)


class SilentServerError(StuckError):
    """A server silent beyond its time limit, or without an answer to a new client."""


class Peer(NamedTuple):
    """Socket address of a connected server, for `socket.connect`."""

    family: socket.AddressFamily
    address: str | tuple[str | int, ...]

    @classmethod
    def of(cls, pgconn: pq.abc.PGconn) -> "Peer | None":
        """The server of a connection; None for an unknown address."""
        try:
            with socket.socket(fileno=os.dup(pgconn.socket)) as connected:
                family = socket.AddressFamily(connected.family)
                if family != socket.AF_UNIX:
                    return cls(family, connected.getpeername())
        except OSError:
            return None
        # the server may know its socket by another path
        folder, port = pgconn.host.decode(), pgconn.port.decode()
        path = f"{folder}/.s.PGSQL.{port}"
        return cls(family, "\0" + path[1:] if path.startswith("@") else path)

    def answers(self, seconds: float) -> bool:
        """Whether the server answers a new client within so many seconds."""
        try:
            with socket.socket(self.family) as asking:
                asking.settimeout(seconds)
                asking.connect(self.address)
                asking.sendall(SSL_REQUEST)
                return bool(asking.recv(1))
        except OSError:
            return False


class _Connection(psycopg.Connection[tuple[Any, ...]]):
    """psycopg's connection with the time limit of its link; psycopg's own wait is unlimited."""

    link: "Link"

    def wait(self, gen: Generator[Any, Any, Result], *args: Any, **options: Any) -> Result:  # noqa: ANN401 - psycopg's own
        """Run a statement to its end. Closes the connection at the time limit."""
        if self.link.given_up is not None:  # the end of a COPY that was given up
            raise self.link.given_up
        try:
            return super().wait(self.link.until_timeout(gen), *args, **options)
        except SilentServerError as error:
            self.link.given_up = error
            self.close()
            raise


class Link:
    """One psycopg connection at a time; `connect` replaces it.

    shown : the redacted URL; driver : psycopg's connection, autocommit, for statements outside
    frames; given_up : the error of psycopg's abandoned wait, else None; is_prompt : report a lost
    or silent server within 0.4 s instead of waiting for it.
    """

    is_prompt = False

    def __init__(self, address: Address, *, read_only: bool) -> None:
        self.address = address
        self.shown = address.shown
        quoted = address.environment.replace('"', '""')
        self._search_path = f'"{quoted}", pg_temp'
        self.is_read_only = read_only
        self._leisure = 0
        self.given_up: SilentServerError | None = None
        self.connect()

    # -- connecting --------------------------------------------------------------------------

    def connect(self, seconds: float = CONNECT_SECONDS) -> None:
        """Connect once, with `SETTINGS`; settings in the URL's `options` override them.

        seconds : to accept the connection, unless the URL has `connect_timeout`.
        """
        given = "connect_timeout=" in self.address.conninfo
        try:
            made = _Connection.connect(
                self.address.conninfo,
                autocommit=True,
                client_encoding="utf8",
                fallback_application_name="hapticdb",
                connect_timeout=None if given else math.ceil(seconds),
            )
        # from None: a traceback would show psycopg's message, perhaps with the password
        except psycopg.OperationalError as error:
            raise failures.refused(error, self.shown) from None
        except psycopg.Error as error:
            raise failures.unusable(str(error), self.shown) from None
        made.link = self
        self.given_up = None
        self.driver: psycopg.Connection[tuple[Any, ...]] = made
        self.driver.prepare_threshold = None
        self._prepared: dict[str, bytes] = {}
        self._pgconn = made.pgconn
        self._limit_ms: int | None = 1000 * CONNECT_SECONDS
        self._peer = Peer.of(made.pgconn)
        try:
            with failures.named_errors(self.shown):
                self._settle()
        except BaseException:  # a connection without its settings must not be used
            self.driver.close()
            raise

    def _settle(self) -> None:
        wanted = {
            **SETTINGS,
            "search_path": self._search_path,
            "default_transaction_read_only": "on" if self.is_read_only else "off",
        }
        options = self.driver.info.options.lower().replace("-", "_")
        theirs = re.findall(r"(?:_c\s*|__)(\w+)=", options)
        ours = {name: value for name, value in wanted.items() if name not in theirs}
        ours["search_path"] = wanted["search_path"]
        known = self.driver.execute(
            "SELECT set_config(s.name, s.value, false)"
            "  FROM unnest(%s::text[], %s::text[]) AS s(name, value)",
            (list(ours), list(ours.values())),
        )
        known.fetchall()
        row = self.driver.execute(
            "SELECT setting::int, pg_is_in_recovery() FROM pg_settings"
            " WHERE name = 'statement_timeout'"
        ).fetchone()
        assert row is not None  # noqa: S101 - the server has this setting
        self._was_standby: bool = row[1]
        self._limit_ms = row[0] + GRACE_MS if row[0] else None

    @property
    def server_version(self) -> int:
        """In libpq's form: 150018 is 15.18."""
        return self._pgconn.server_version

    @property
    def is_standby(self) -> bool:
        """Whether the server is a standby; a promotion shows in the server's next answer."""
        return self._was_standby and self._pgconn.parameter_status(b"in_hot_standby") != b"off"

    def drop(self) -> None:
        """Close this connection; `connect` makes another."""
        self.driver.close()

    @property
    def is_lost(self) -> bool:
        """Whether the connection is closed, also after a loss or at a time limit."""
        return self.driver.closed

    def is_usable(self) -> bool:
        """Whether a statement can be sent: neither closed nor in a failed transaction."""
        state = self._pgconn.transaction_status
        return not self.driver.closed and state != pq.TransactionStatus.INERROR

    # -- statements --------------------------------------------------------------------------

    def command(self, text: str) -> pq.abc.PGresult:
        """Result of the last of several statements without parameters, in one round trip."""
        self._pgconn.send_query(text.encode())
        return self._result()

    def run(self, text: str, parameters: Sequence[Parameter]) -> pq.abc.PGresult:
        """Result of a statement, prepared at its first run."""
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

    def receive_notifications(self) -> None:
        """Pass received notifications to the notify handlers. Never waits.

        Those received during a statement stay in libpq until then, or psycopg passes them on.
        """
        self._pgconn.consume_input()
        while (notify := self._pgconn.notifies()) and self._pgconn.notify_handler:
            self._pgconn.notify_handler(notify)

    # -- waiting -----------------------------------------------------------------------------

    @contextlib.contextmanager
    def without_time_limit(self) -> Iterator[None]:
        """Wait inside as long as the server answers a new client: for long statements."""
        self._leisure += 1
        try:
            yield
        finally:
            self._leisure -= 1

    def _result(self) -> pq.abc.PGresult:
        """Result of the statement in flight. Closes the connection when no result comes."""
        try:
            # the driver's own wait would take 10 s to end after Ctrl-C while a server hangs
            answer = self.until_timeout(generators.execute(self._pgconn))
            found: pq.abc.PGresult = waiting.wait(answer, self._pgconn.socket, STEP_S)[-1]
            if found.status not in FINE:
                raise error_from_result(found, encoding="utf-8")  # noqa: TRY301 - may be a loss, too
        except psycopg.Error as error:
            if failures.is_lost(error):
                self.driver.close()
            raise
        except BaseException:  # Ctrl-C or a timeout: the next statement would get this result
            self.driver.close()
            raise
        return found

    def until_timeout(self, answer: Generator[Any, Any, Result]) -> Generator[Any, Any, Result]:
        """Run psycopg's generator of a wait; raise SilentServerError at the time limit."""
        started = heard = time.monotonic()
        try:
            wanted = next(answer)
            while True:
                ready = yield wanted
                # no limit inside `without_time_limit`
                now, most = time.monotonic(), None if self._leisure else self._limit_ms
                if ready:
                    heard = now
                elif most is not None and 1000 * (now - started) > most:
                    raise SilentServerError(
                        f"{self.shown} did not answer within {most} ms: the server, or the way to "
                        "it, hangs"
                    )
                elif now - heard > (PROMPT_SILENCE_S if self.is_prompt else SILENCE_S):
                    self._check_answers(PROMPT_ANSWER_S if self.is_prompt else ANSWER_S)
                    heard = time.monotonic()
                wanted = answer.send(ready)
        except StopIteration as end:
            return cast("Result", end.value)

    def _check_answers(self, seconds: float) -> None:
        """Raise SilentServerError without an answer to a new client within `seconds`."""
        if self._peer is not None and not self._peer.answers(seconds):
            raise SilentServerError(
                f"{self.shown} sends nothing and did not answer a new client within "
                f"{seconds:.3g} s: the server, or the way to it, hangs; try again when "
                "it answers"
            )

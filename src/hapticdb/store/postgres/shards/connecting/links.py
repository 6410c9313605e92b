"""Connections to the shards of an environment: all asked at once, each made when first used."""

import contextlib
import math
import select
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import NamedTuple, TypeVar

import psycopg

from hapticdb.errors import (
    ConnectionLostError,
    DamagedError,
    OutdatedError,
    ShardAwayError,
    StuckError,
)
from hapticdb.store.postgres.address import Address
from hapticdb.store.postgres.connecting import failures, wire
from hapticdb.store.postgres.connecting.answering import SilentServerError
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.connecting.link import CONNECT_SECONDS
from hapticdb.store.postgres.connecting.wire import Parameter
from hapticdb.store.postgres.standby.aiming import aimed, of_primary

Result = TypeVar("Result")
Answer = list[bytes | None]
MOST_THREADS = 16
"""Most shards that are written at the same time. A larger value keeps more shards busy."""
PARTING_S = 20.0
"""Seconds that Ctrl-C waits for threads that write to shards; then it gives their connections up.
A larger value gives a shard more time to answer."""
LEAST_MS = 100
"""Milliseconds that each further part of an answer may take, however late it begins. A larger value
bears servers that pause within an answer, and waits longer for one that hangs there."""
CATCH_UP_S = 0.05
"""Seconds that a read waits for a shard's standby to replay what the coordinator names. A larger
value leaves more reads to standbys; a session's cells wait as long. Then the primary is read."""
LOOK_EVERY_S = 0.002
"""Seconds between looks at the standby meanwhile."""
AT_PRIMARY_S = 30.0
"""Seconds until a shard whose standby was too far behind is read from the standby again."""
WRITES = "SELECT writes FROM mark"
TOKEN = "SELECT token::text FROM mark"  # noqa: S105 - which environment it is, no secret


class ShardPlace(NamedTuple):
    """Where a shard is: its number from 1, its host as the user wrote it, libpq's URL of it."""

    number: int
    host: str
    conninfo: str


class ShardQuery(NamedTuple):
    """A statement for one shard, whose place among the shards begins at 0."""

    shard: int
    text: str
    parameters: tuple[Parameter, ...]


class ShardConnection(ServerConnection):
    """A connection to one shard. Its threads are the store's business."""

    def __init__(
        self, place: ShardPlace, environment: Address, token: str, *, read_only: bool
    ) -> None:
        shown = f"shard {place.number} ({place.host}) of {environment.shown}"
        address = Address(place.conninfo, environment.environment, None, shown)
        self._token = token
        conninfo = aimed(place.conninfo, shown, read_only=read_only)
        super().__init__(address, conninfo, read_only=read_only)
        try:
            self._check_token()
        except BaseException:
            self.close()
            raise

    def check_thread(self) -> None:
        """Any thread may use it; `Shards` sees to it that one at a time does."""

    def connect(self, seconds: float = CONNECT_SECONDS) -> None:
        """Connect again, once; a server in the shard's place that is another one is refused."""
        super().connect(seconds)
        try:
            self._check_token()
        except BaseException:  # it must not be used for the next statement
            self._link.close()
            raise

    def _check_token(self) -> None:
        with failures.named_errors(self.shown):
            found = self.execute(TOKEN).fetchall()
        if found != [(self._token,)]:
            raise DamagedError(
                f"{self.shown} holds rows of another environment: give the server back that held "
                "these rows, or restore the copies of all servers that belong together"
            )


class Shards:
    """The shards of one opened environment."""

    def __init__(
        self, coordinator: ServerConnection, places: Sequence[ShardPlace], token: str
    ) -> None:
        self.coordinator = coordinator
        self.places = places
        self.token = token
        self._made: list[ShardConnection | None] = [None] * len(places)
        self._back_at: dict[int, float] = {}  # when to leave the primary of a shard again
        self._threads: ThreadPoolExecutor | None = None

    def __len__(self) -> int:
        return len(self.places)

    def name(self, shard: int) -> str:
        """Number and host of a shard, as messages name it."""
        place = self.places[shard]
        return f"shard {place.number} ({place.host})"

    def is_connected(self, shard: int) -> bool:
        """Whether there is a connection to a shard."""
        return self._made[shard] is not None

    def connection(self, shard: int) -> ShardConnection:
        """Connection to a shard, made when it is first asked for."""
        made = self._made[shard]
        if made is None:
            made = self._made[shard] = self.connected(shard)
        return made

    def connected(self, shard: int) -> ShardConnection:
        """A new connection to a shard."""
        coordinator, place = self.coordinator, self.places[shard]
        if shard in self._back_at:
            place = place._replace(conninfo=of_primary(place.conninfo))
        with named_away():
            return ShardConnection(
                place, coordinator.address, self.token, read_only=coordinator.is_read_only
            )

    def exchange(self, shard: int, connection: ShardConnection | None) -> None:
        """Close a connection and use another one from now on; None makes one when needed."""
        before, self._made[shard] = self._made[shard], connection
        if before is not None:
            before.close()

    def close(self) -> None:
        """Close all connections."""
        for shard in range(len(self)):
            self.exchange(shard, None)
        if self._threads is not None:
            self._threads.shutdown()
            self._threads = None

    @contextlib.contextmanager
    def unlimited(self) -> Iterator[None]:
        """Lift the time limits of statements on all shards inside."""
        with contextlib.ExitStack() as stack, named_away():
            for shard in range(len(self)):
                stack.enter_context(self.connection(shard).without_limit())
            yield

    # -- reading ---------------------------------------------------------------------------------

    def ask(
        self, asks: Sequence[ShardQuery], first: str | None = None
    ) -> tuple[Answer, list[Answer]]:
        """Answers of all shards, asked at the same time; before them that of the coordinator.

        A shard whose connection was lost is connected again and asked once more, as for a read on
        one server.

        Raises
        ------
        ShardAwayError
            When a shard cannot be reached.
        """
        for ask in asks:
            if self.is_to_leave_primary(ask.shard):
                self.exchange(ask.shard, None)
            self.connection(ask.shard)
        found, answers = self.ask_once(asks, first)
        known = []
        for ask, answer in zip(asks, answers, strict=True):
            with named_away():
                known.append(answer or self.connection(ask.shard).fetch(ask.text, *ask.parameters))
        return found, known

    def catch_up(self, shard: int, writes: int) -> None:
        """Have a shard whose standby was behind answer with so many writes at the next question."""
        if not self.has_replayed(shard, writes):
            self.turn_to_primary(shard)

    def has_replayed(self, shard: int, writes: int, patience_ms: int | None = None) -> bool:
        """Whether a shard's standby has replayed so many writes; waits for it for a moment.

        False if it is lost; patience_ms : see `ask_once`.
        """
        until = time.monotonic() + CATCH_UP_S
        while True:
            _, (answer,) = self.ask_once([ShardQuery(shard, WRITES, ())], None, patience_ms)
            if answer is None:
                return False
            if wire.read_int8(answer[0] or b"") >= writes:
                return True
            if time.monotonic() > until:
                return False
            time.sleep(LOOK_EVERY_S)

    def turn_to_primary(self, shard: int) -> None:
        """Read a shard from its primary from now on, for `AT_PRIMARY_S`."""
        self._back_at[shard] = time.monotonic() + AT_PRIMARY_S
        self.exchange(shard, None)

    def try_another_server(self, shard: int) -> None:
        """Connect to the primary of a shard with standbys next, or else where the URL says.

        One that hangs would hold up each try for as long as a server may take to answer.
        """
        if "|" in self.places[shard].host and self._back_at.pop(shard, None) is None:
            self._back_at[shard] = time.monotonic() + AT_PRIMARY_S

    def is_to_leave_primary(self, shard: int) -> bool:
        """Whether a shard is to be read from its standby again; said once."""
        if self._back_at.get(shard, math.inf) > time.monotonic():
            return False
        self._back_at.pop(shard, None)
        return True

    def ask_once(
        self, asks: Sequence[ShardQuery], first: str | None, patience_ms: int | None = None
    ) -> tuple[Answer, list[Answer | None]]:
        """Answers as of `ask`, without a second try: None for a shard whose connection is lost.

        patience_ms : how long the shards together may take; after that those that have sent nothing
        count as lost. None for the limit of each connection, after which ShardAwayError is raised.
        """
        self.coordinator.check_thread()
        waiting: list[ServerConnection] = []
        asked: dict[int, ShardConnection] = {}
        answers: list[Answer | None] = [None] * len(asks)
        found: Answer | None = None
        lost = (ConnectionLostError,) if patience_ms is None else (ConnectionLostError, StuckError)
        try:
            # all are sent before the first is taken
            if first is not None:
                with contextlib.suppress(ConnectionLostError):
                    self.coordinator.send(first)
                    waiting.append(self.coordinator)
            for at, ask in enumerate(asks):
                with named_away(), contextlib.suppress(*lost):
                    connection = self.connection(ask.shard)
                    with connection.patient_for(patience_ms):
                        connection.send(ask.text, *ask.parameters)
                    waiting.append(connection)
                    asked[at] = connection
            sent_at = time.monotonic()
            if first is not None and self.coordinator in waiting:
                with contextlib.suppress(ConnectionLostError):
                    found = self.coordinator.take()
                waiting.remove(self.coordinator)
            for at, left_ms in _as_they_come(asked, sent_at, patience_ms):
                with named_away(), contextlib.suppress(*lost):
                    answers[at] = asked[at].take(left_ms)
                waiting.remove(asked[at])
        except BaseException:
            for one in waiting:  # no later statement may get these answers
                one.driver.close()
            raise
        if first is not None and found is None:
            found = self.coordinator.fetch(first)
        return found or [], answers

    # -- writing ---------------------------------------------------------------------------------

    def each(
        self, work: Callable[[int, ShardConnection], Result], some: Sequence[int] | None = None
    ) -> list[Result]:
        """Results of `work` for shards, by default for all; at the same time, each in a thread.

        Raises the first error after all have ended.
        """
        done = self.outcomes(work, some)
        for one in done:
            if (error := one.exception()) is not None:
                raise error
        return [one.result() for one in done]

    def outcomes(
        self, work: Callable[[int, ShardConnection], Result], some: Sequence[int] | None = None
    ) -> list["Future[Result]"]:
        """Results or errors of `work` for shards, as of `each`; all have ended."""
        chosen = list(range(len(self)) if some is None else some)

        def one(shard: int) -> Result:
            with named_away():
                return work(shard, self.connection(shard))

        if len(chosen) == 1:
            return [_done(lambda: one(chosen[0]))]
        if self._threads is None:
            self._threads = ThreadPoolExecutor(min(len(self), MOST_THREADS), "hapticdb-shard")
        begun = [self._threads.submit(one, shard) for shard in chosen]
        try:
            wait(begun)
        except BaseException:  # Ctrl-C: no thread may use a connection after this call
            try:
                self._interrupt(chosen)
                wait(begun, PARTING_S)
            finally:
                self._give_up([n for n, w in zip(chosen, begun, strict=True) if not w.done()])
            raise
        return begun

    def _interrupt(self, chosen: Sequence[int]) -> None:
        """Cancel the statements that threads wait for."""
        for shard in chosen:
            if (connection := self._made[shard]) is not None:
                with contextlib.suppress(psycopg.Error):
                    connection.driver.cancel_safe(timeout=PARTING_S)

    def _give_up(self, late: Sequence[int]) -> None:
        """Leave the connections of shards to threads that have not ended, and end these threads."""
        for shard in late:
            before, self._made[shard] = self._made[shard], None
            if before is not None:
                before.close()
        if late and self._threads is not None:
            self._threads.shutdown(wait=False, cancel_futures=True)
            self._threads = None


def _done(work: Callable[[], Result]) -> "Future[Result]":
    """The outcome of work that is done now, in this thread."""
    done: Future[Result] = Future()
    try:
        done.set_result(work())
    except Exception as error:  # noqa: BLE001 - the caller raises it
        done.set_exception(error)
    return done


def _as_they_come(
    asked: dict[int, ShardConnection], sent_at: float, patience_ms: int | None
) -> Iterator[tuple[int, int | None]]:
    """Places of shards as their answers begin to come, and the patience for the rest of each.

    Shards that have sent nothing by the end of the patience come last, with a patience of 0. So
    several that hang take no longer than one, and no answer waits behind them.
    """
    if patience_ms is None:
        yield from ((at, None) for at in asked)
        return
    poller, left = select.poll(), {}
    for at, connection in asked.items():
        descriptor, events = connection.awaited
        poller.register(descriptor, events)
        left[descriptor] = at
    while left:
        left_ms = max(int(patience_ms - 1000 * (time.monotonic() - sent_at)), 0)
        ready = [descriptor for descriptor, _ in poller.poll(left_ms)]
        for descriptor in ready or list(left):
            poller.unregister(descriptor)
            yield left.pop(descriptor), max(left_ms, LEAST_MS) if ready else 0


@contextlib.contextmanager
def named_away() -> Iterator[None]:
    """Turn the loss or the silence of a shard's connection into `ShardAwayError`."""
    try:
        yield
    except (ShardAwayError, OutdatedError):
        raise
    except (ConnectionLostError, SilentServerError) as error:
        raise ShardAwayError(*error.args) from error


def lost_writes(name: str, found: int, least: int) -> DamagedError:
    """Error for a shard that has committed fewer writes than the coordinator knows of."""
    return DamagedError(
        f"{name} has lost writes: it has {found} of {least}; it was put back from a copy "
        "older than the coordinator's: put back its newest copy, or the copies of all servers that "
        "belong together"
    )


def older_coordinator(shown: str) -> DamagedError:
    """Error for a coordinator that is older than what its shards have deleted."""
    return DamagedError(
        f"{shown} is older than its shards, which have deleted rows that it still names: it was "
        "put back from an old copy; put back the copies of all servers that belong together"
    )

"""The prefetch process: fetches the cells ahead of the tools.

The process has a connection of its own and is the only writer of its table. Sessions report pose
and velocity of tool and hand. The process queries the database for the cells within reach, nearest
first, follows the writes of others, and names the objects in contact.
"""

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hapticdb.errors import GridError, HapticDBError, UsageError
from hapticdb.grid import Grid
from hapticdb.kernels.records.cells import PREFETCH_REQUEST
from hapticdb.resident.residency import BATCH, Loaded, Residency
from hapticdb.resident.table import FIRST_VERSION, CellTable
from hapticdb.session.prefetch.tracking import ObjectAnswers, PrefetchRequest, SessionTracker
from hapticdb.session.processes.process import MessageSender, parent_is_gone
from hapticdb.store.base import NO_KEYS, Store
from hapticdb.store.connect import open_store
from hapticdb.store.engines import MayLag
from hapticdb.store.filtering import ALL, Filter

LOOKAHEAD = 0.05
"""Least look-ahead time (s). Larger: fewer unknown cells, more cells fetched and never used."""
MOST_LOOKAHEAD = 0.5
"""Greatest look-ahead time (s), however slow the database is. Larger: a slower database can serve
the hand, more cells are fetched and never used."""
LATENCIES = 3.0
"""Least look-ahead time in latencies of the slowest recent batch. Larger: fewer unknown cells, more
cells never used."""
LATENCY_MARGIN = 0.02
"""Seconds added to this product, for the other work of a round."""
BATCHES_REMEMBERED = 32
"""Recent batches. Larger: a faster database shortens the look-ahead time later."""
IDLE = 1e-3
"""Seconds between rounds while no cell is missing. A larger value notices a moving hand later."""
MOST_IDLE = 1e-2
"""Greatest pause (s): a pause lasts as long as its round, within these bounds. Larger: with many
sessions loops get more of the processor, and a moving hand is noticed later."""
POLL_EVERY = 5e-3
"""Seconds between queries for the objects in contact. Larger: names come later."""
CONFIRM_EVERY = 0.05
"""Seconds between queries for the revision. A store reports commits without a round trip, so only a
query shows a lost database. Larger: its loss is reported later."""
RELEASE_EVERY = 1.0
"""Seconds between checks for sessions of dead processes, and between queries for a standby's lag.
Larger: rows stay longer, the reported lag is older."""
RETRY = (0.05, 0.5)
"""Seconds until a lost database is tried again: first and greatest delay; it doubles each time."""

Wrap = Callable[[Store], Store]
"""Store as opened -> store for use."""


@dataclass(frozen=True)
class FetchRequest:
    """Request to a prefetch process.

    url, grid : of the environment; filter : of the objects; wrap : a hook for tests.
    """

    url: str
    table: CellTable
    grid: Grid
    filter: Filter = ALL
    wrap: Wrap | None = None


class Fetcher:
    """Fills a table with the cells of sessions, round by round.

    clock : returns seconds, to time rounds and batches. Raises GridError if the environment has
    another grid than the request's.
    """

    def __init__(
        self, request: FetchRequest, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.request = request
        self.table = request.table
        self.tracker = SessionTracker(self.table, request.grid)
        self._clock = clock
        self._figures = self.table.queue.figures
        self._evicted_before = int(self._figures["evicted"])
        self._latencies: list[float] = [0.0]
        self.store = self._open()
        try:
            # if an earlier prefetch process has died, sessions already use the table
            self.tracker.read_queue(0.0, self.lookahead)
            self.residency = Residency(
                self.store, self.table, request.filter.exclude, where=request.filter.where,
                urgent=self.tracker.urgent_cells(), clock=clock,
            )  # fmt: skip
        except BaseException:
            self.store.close()
            raise
        self._answers = ObjectAnswers(self.table, self.residency)
        self._now = clock()
        self._queried_at = self._released_at = self._now
        self._confirmed_at = -np.inf
        self._is_confirmed = False
        self._version_seen = -1
        self._note_lag()

    def _open(self) -> Store:
        store = open_store(self.request.url, read_only=True)
        if store.grid != self.request.grid:
            store.close()
            raise GridError(
                f"{store.url} is another environment than before: start the session again"
            )
        if self.request.wrap:
            store = self.request.wrap(store)
        try:
            store.watch()
        except BaseException:
            store.close()
            raise
        return store

    def warm_up(self) -> None:
        """Run all steps of a round once, on one cell, so no later round compiles a kernel.

        Only from now on a slow answer of the server is a loss: a busy machine is slow at the start.
        """
        grid = self.request.grid
        record = np.zeros((), PREFETCH_REQUEST)
        record["tool"] = record["handle"] = grid.origin
        request = PrefetchRequest.of_record(grid, record, LOOKAHEAD, 0.0)
        assert request is not None  # noqa: S101 - the origin is finite
        self.residency.load(self.residency.missing(request.cells(grid)[0][:1]))
        self.residency.warm_up()
        self._answers.ids_of(self.store, np.zeros(1, dtype=np.int64))
        self.store.watch(is_prompt=True)

    @property
    def lookahead(self) -> float:
        """Look-ahead time, s; more than the database's latency."""
        needed = LATENCIES * max(self._latencies) + LATENCY_MARGIN
        return min(max(LOOKAHEAD, needed), MOST_LOOKAHEAD)

    def round(self) -> bool:
        """Follow writes, fetch a batch, name objects; returns whether any cell was fetched."""
        # `begun` is read before any query: the heartbeat must not be newer than its answer
        before, self._now = self._now, self._clock()
        begun = time.monotonic_ns()
        self._is_confirmed = False
        if self._has_changed():
            self.residency.refresh()
            self._is_confirmed = True
            self._answers.forget()
        # after the writes: `load` then seldom has to follow any itself
        is_busy = self._bring_in(self._now - before)
        if self._now - self._queried_at >= POLL_EVERY:
            self._queried_at = self._now
            self._answers.answer(self.store, self.tracker.sessions)
        if self._now - self._released_at >= RELEASE_EVERY:
            self._released_at = self._now
            self.table.release_dead()
            self._note_lag()
        # only here: the database has answered every query of this round
        if self._is_confirmed:
            self._confirmed_at = self._now
            control = self.table.cells.control
            control["is_lost"], control["heartbeat"] = 0, begun
        return is_busy

    def _note_lag(self) -> None:
        """Write to the request queue how far a standby is behind."""
        lag = self.store.lag() if isinstance(self.store, MayLag) else None
        self._figures["lag"] = np.nan if lag is None or lag.seconds is None else lag.seconds

    def _has_changed(self) -> bool:
        """Whether others have written; queries the database only as often as the engine needs."""
        if self.store.has_changed():
            return True
        # no notification is no proof of life: a lost server is silent, too
        if self._now - self._confirmed_at < CONFIRM_EVERY:
            return False
        self._is_confirmed = True
        return self.store.revision() != self.residency.revision

    def _bring_in(self, elapsed: float) -> bool:
        """Fetch the most urgent missing cells of all sessions; returns whether any was fetched."""
        has_moved = self.tracker.read_queue(elapsed, self.lookahead)
        missing = NO_KEYS
        has_new_cells = self._version_seen != self.table.version
        # at rest nothing is looked up: the last result still holds
        if has_moved or has_new_cells or self.tracker.has_unknown_cells():
            self._version_seen = self.table.version
            missing = self.tracker.missing_cells(self.residency)
        # also without a batch: a loop that waits for its cells reads this number
        self.tracker.report_missing()
        if not len(missing):
            return False
        # one batch a round: the order of urgency follows the hand, not an old request
        loaded = self.residency.load(missing[:BATCH])
        self._is_confirmed |= loaded.ranges > 0  # without room in the table, no query is sent
        self._record_figures(loaded)
        return loaded.cells > 0

    def _record_figures(self, loaded: Loaded) -> None:
        """Write the figures so far to the request queue."""
        self._latencies = [*self._latencies[1 - BATCHES_REMEMBERED :], loaded.elapsed]
        figures, writer = self._figures, self.residency.writer
        figures["loaded"] += loaded.cells
        figures["rows"] += loaded.rows
        figures["ranges"] += loaded.ranges
        figures["statements"] += 1
        figures["latency"] = np.median(self._latencies)
        figures["worst"] = max(float(figures["worst"]), loaded.elapsed)
        figures["evicted"] = self._evicted_before + writer.n_evicted
        figures["resident"] = writer.n_resident
        figures["empty"] = writer.n_empty

    def reopen(self) -> None:
        """Open the database again, and follow the writes made meanwhile."""
        opened = self._open()
        # Close only now: while the old file is open, no other file can have the same identity.
        self.close()
        self.store = opened
        # the next round queries the revision, so the mark of the loss goes at once
        self._confirmed_at = -np.inf
        self.residency.reopened(self.store)
        self.store.watch(is_prompt=True)
        self._version_seen = -1

    def close(self) -> None:
        """Close the connection."""
        with contextlib.suppress(HapticDBError, OSError):  # closing a broken connection may fail
            self.store.close()


def fetch(request: FetchRequest, sender: MessageSender) -> None:
    """Fetch until a stop is requested, even without a database; the work of the process.

    If the database cannot be opened, the process ends only if its table is new. With the table of
    an earlier process it tries again. Raises GridError if the environment was replaced by one with
    another grid, UsageError if the table has distances and an object was written that has none.
    """
    table = request.table
    # a table of an earlier process serves sessions already: then a lost database ends nothing
    is_first = table.version == FIRST_VERSION
    fetcher: Fetcher | None = None
    timeout, at_most = RETRY
    is_lost = is_ready = False
    while not table.cells.control["is_over"] and not parent_is_gone():
        try:
            if fetcher is None:
                fetcher = Fetcher(request)
            elif is_lost:
                fetcher.reopen()
            if not is_ready:
                fetcher.warm_up()
            begun = time.monotonic()
            is_busy = fetcher.round()
            took = time.monotonic() - begun
            if not is_ready:
                sender.send("ready", fetcher.store.engine)
            if not is_busy:
                # with many sessions a round takes long: half the processor is left to their loops
                time.sleep(max(IDLE, min(took, MOST_IDLE)))
            is_lost, is_ready, timeout = False, True, RETRY[0]
        except (GridError, UsageError):
            raise
        except (HapticDBError, OSError) as error:
            if is_first and fetcher is None:
                raise
            if not is_lost:
                sender.send("lost", str(error))  # first, so that who sees the mark finds the cause
                table.cells.control["is_lost"] = 1
                if fetcher is not None:
                    table.queue.figures["losses"] += 1
            is_lost = True
            time.sleep(timeout)
            # exponential back-off, reset by the first complete round
            timeout = min(2 * timeout, at_most)
    if fetcher is not None:
        fetcher.close()

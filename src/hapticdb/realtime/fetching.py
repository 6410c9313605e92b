"""The fetching process: brings in the cells that tools are heading for.

It has a connection of its own and is the only writer of its table. Sessions tell it where tool and
hand are and how they move; it asks the database for the cells within reach, nearest first, looks
for what others have written, and names the objects that tools touch.
"""

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import GridError, HapticDBError
from hapticdb.grid import Grid
from hapticdb.kernels.records import MOST_ASKED
from hapticdb.kernels.resident.cells import EMPTY_SLOT, UNKNOWN
from hapticdb.realtime.processes import Voice, parent_is_gone
from hapticdb.realtime.wishes import Motion, Wish
from hapticdb.resident.residency import BATCH, Loaded, Residency
from hapticdb.resident.table import (
    AWAY,
    FIRST_VERSION,
    HEARTBEAT,
    STOP,
    CellTable,
)
from hapticdb.store.base import NO_KEYS, Keys, Store, SupportsWatch
from hapticdb.store.connect import open_store
from hapticdb.store.objects_at import ids_of_voxels

LOOKAHEAD = 0.05
"""Seconds that cells are fetched ahead of the hand, at least."""
MOST_LOOKAHEAD = 0.5
LATENCIES = 3.0
"""And, at least, so many of the slowest of the last fetches."""
MEMORY = 0.7
"""Seconds until the speed that a hand has shown counts half."""
IDLE = 1e-3
"""Seconds between looks when nothing is missing."""
ASK_EVERY = 5e-3
"""Seconds between questions for the objects that a tool touches."""
POLL_EVERY = 0.02
"""Seconds between questions for the revision, where an engine cannot tell of commits."""
CONFIRM_EVERY = 0.1
"""Where it can, which may cost no round trip: seconds until it is asked whether it is there."""
RELEASE_EVERY = 1.0
"""Seconds between looks for sessions whose processes have ended."""
RETRY = (0.05, 0.5)
"""Seconds until a lost database is tried again: at first, and at most."""

Wrap = Callable[[Store], Store]
Clock = Callable[[], float]


@dataclass(frozen=True)
class FetchRequest:
    """What a fetching process is to do: see `hapticdb.realtime.session.Session`."""

    url: str
    descriptor: int
    n_slots: int
    grid: Grid
    exclude: tuple[int, ...] = ()
    wrap: Wrap | None = None


@dataclass
class _Heading:
    """What is known of one session."""

    sequence: int = 0
    wish: Wish | None = None
    cells: Keys = field(default_factory=lambda: NO_KEYS)
    urgency: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    speed: float = 0.0
    n_missing: int = 0
    asked: bytes = b""


class Fetching:
    """What a fetching process does, round by round.

    Raises
    ------
    GridError
        When the environment is another than the request's.
    DatabaseError
        When it cannot be opened.
    """

    def __init__(self, request: FetchRequest, *, clock: Clock = time.monotonic) -> None:
        self.request = request
        self.table = CellTable(request.descriptor, request.n_slots)
        self.clock = clock
        self.figures = self.table.desk.figures
        self._evicted_before = int(self.figures["evicted"])
        self._latencies: list[float] = [0.0]
        self._headings: dict[int, _Heading] = {}
        self._seen = -1
        self.store = self._open()
        try:
            self._read_desk(0.0)  # the first of them when a process has died
            urgent = _ranked([(h.cells, h.urgency) for h in self._headings.values()])
            self.residency = Residency(
                self.store, self.table, request.exclude, urgent=urgent, clock=clock
            )
        except BaseException:
            self.store.close()
            raise
        self._now = clock()
        self._asked_at = self._released_at = self._now
        self._confirmed_at = -np.inf
        self._is_confirmed = False

    def _open(self) -> Store:
        store = open_store(self.request.url, read_only=True)
        if store.grid != self.request.grid:
            store.close()
            raise GridError(
                f"{store.url} is another environment than before: start the session again"
            )
        if self.request.wrap:
            store = self.request.wrap(store)
        if isinstance(store, SupportsWatch):
            store.watch()
        return store

    def warm_up(self) -> None:
        """Do once, on one cell, all that rounds do: nothing is compiled after the first of them."""
        grid = self.request.grid
        wish = Wish.of_motion(grid, Motion.at_rest(np.array(grid.origin)), LOOKAHEAD, 0.0)
        assert wish is not None  # noqa: S101 - the origin is a place
        self.residency.load(self.residency.missing(wish.cells(grid)[0][:1]))
        self.residency.warm_up()
        ids_of_voxels(self.store, np.zeros(1, dtype=np.int64), self.residency.exclude)

    @property
    def lookahead(self) -> float:
        """Seconds: longer than the database takes."""
        return min(max(LOOKAHEAD, LATENCIES * max(self._latencies) + 0.02), MOST_LOOKAHEAD)

    def round(self) -> bool:
        """Look for writes, bring in a batch, name objects; whether any cell came."""
        before, self._now = self._now, self.clock()
        begun = time.monotonic_ns()
        self._is_confirmed = False
        if self._has_changed():
            self.residency.refresh()
            self._is_confirmed = True
            for heading in self._headings.values():
                heading.asked = b""
        is_busy = self._bring_in(self._now - before)
        if self._now - self._asked_at >= ASK_EVERY:
            self._asked_at = self._now
            self._name_objects()
        if self._now - self._released_at >= RELEASE_EVERY:
            self._released_at = self._now
            self.table.release_dead()
        if self._is_confirmed:
            # at the end: nothing that was asked went unanswered; all that is resident was true then
            self._confirmed_at = self._now
            self.table.cells.control[HEARTBEAT] = begun
            self.table.cells.control[AWAY] = 0
        return is_busy

    def _has_changed(self) -> bool:
        is_watched = isinstance(self.store, SupportsWatch)
        if isinstance(self.store, SupportsWatch) and self.store.has_changed():
            return True
        if self._now - self._confirmed_at < (CONFIRM_EVERY if is_watched else POLL_EVERY):
            return False
        self._is_confirmed = True
        return self.store.revision() != self.residency.revision

    # -- cells -------------------------------------------------------------------------------

    def _read_desk(self, elapsed: float) -> bool:
        """Learn where sessions are; whether any is elsewhere than before."""
        sessions = self.table.desk.sessions
        told = sessions["told"]
        active = set(np.flatnonzero(told["is_active"]).tolist())
        is_moved = active != set(self._headings)
        self._headings = {row: self._headings.get(row, _Heading()) for row in sorted(active)}
        for row, heading in self._headings.items():
            for _ in range(100):
                heading.sequence = int(sessions["sequence"][row])
                motion = Motion.of_told(told[row, ...].copy())
                if heading.sequence % 2 == 0 and heading.sequence == sessions["sequence"][row]:
                    break
            else:
                continue  # it died while it wrote
            speed = float(np.linalg.norm(motion.velocity))
            if np.isfinite(speed):
                heading.speed = max(speed, heading.speed * 0.5 ** (elapsed / MEMORY))
            grid = self.request.grid
            wish = Wish.of_motion(grid, motion, self.lookahead, heading.speed)
            if wish is None or (heading.wish is not None and wish.is_near(heading.wish)):
                continue
            heading.wish = wish
            heading.cells, heading.urgency = wish.cells(grid)
            is_moved = True
        return is_moved

    def _bring_in(self, elapsed: float) -> bool:
        """Fetch the most urgent missing cells of all sessions, a batch; whether any came."""
        residency, sessions = self.residency, self.table.desk.sessions
        is_moved = self._read_desk(elapsed)
        rows = list(self._headings)
        if is_moved or self._seen != self.table.version or sessions["n_missed"][rows].any():
            missing = self._missing()
        else:
            missing = NO_KEYS
        for row, heading in self._headings.items():
            sessions["n_missing"][row] = heading.n_missing
            sessions["heard"][row] = heading.sequence
        if not len(missing):
            return False
        loaded = residency.load(missing[:BATCH])
        self._is_confirmed |= loaded.ranges > 0  # none is asked where there is no room
        self._note(loaded)
        return loaded.cells > 0

    def _missing(self) -> Keys:
        """Unknown cells of all sessions' wishes, most urgent first; the others are kept."""
        residency = self.residency
        residency.begin_round()
        self._seen = self.table.version
        return residency.missing(
            _ranked([part for row in self._headings for part in self._wanted(row)])
        )

    def _wanted(self, row: int) -> Iterator[tuple[Keys, NDArray[np.float64]]]:
        """Cells of one session with their urgency: what its share of the table has room for."""
        residency, table, heading = self.residency, self.table, self._headings[row]
        share = 0.75 / len(self._headings)
        cells = heading.cells[: int(share * (table.capacity // 2 - table.n_slots))]
        slots = residency.slots_of(cells)
        # known to be empty takes no slot
        n_kept = np.searchsorted(np.cumsum(slots != EMPTY_SLOT), share * table.n_slots, "right")
        cells, slots = cells[:n_kept], slots[:n_kept]
        yield cells, heading.urgency[:n_kept]
        n_unknown = int(np.count_nonzero(slots == UNKNOWN))
        self.figures["wanted"] += len(cells)
        self.figures["granted"] += len(cells) - n_unknown
        heading.n_missing = n_unknown
        n_missed = int(table.desk.sessions["n_missed"][row])
        if n_missed:  # what a frame has met already comes before everything
            missed = np.unique(table.desk.sessions["missed"][row, :n_missed])
            heading.n_missing += int(np.count_nonzero(residency.slots_of(missed) == UNKNOWN))
            yield missed, np.full(len(missed), -1.0)

    def _note(self, loaded: Loaded) -> None:
        self._latencies = [*self._latencies[-31:], loaded.elapsed]
        figures, residency = self.figures, self.residency
        figures["cells"] += loaded.cells
        figures["rows"] += loaded.rows
        figures["ranges"] += loaded.ranges
        figures["batches"] += 1
        figures["median_latency"] = np.median(self._latencies)
        figures["worst_latency"] = max(float(figures["worst_latency"]), loaded.elapsed)
        figures["evicted"] = self._evicted_before + residency.writer.n_evicted
        figures["resident"] = residency.writer.n_resident
        figures["empty"] = residency.writer.n_empty

    # -- objects -----------------------------------------------------------------------------

    def _name_objects(self) -> None:
        """Answer which objects are in the voxels that each session's tool touches."""
        sessions = self.table.desk.sessions
        for row, heading in self._headings.items():
            n_asked = int(sessions["n_asked"][row])
            if n_asked <= 0:
                sessions["n_objects"][row] = 0
                heading.asked = b""
                continue
            keys = np.unique(sessions["asked"][row, :n_asked])
            if heading.asked == keys.tobytes():
                continue
            ids = ids_of_voxels(self.store, keys, self.residency.exclude)[:MOST_ASKED]
            sessions["objects"][row, : len(ids)] = ids
            sessions["n_objects"][row] = len(ids)
            heading.asked = keys.tobytes()

    # -- when the database is away -----------------------------------------------------------

    def lost(self) -> None:
        """Note that the database cannot be reached: sessions let their forces fall."""
        self.table.cells.control[AWAY] = 1
        self.figures["losses"] += 1

    def reopen(self) -> None:
        """Open the database anew and catch up with what was written meanwhile."""
        opened = self._open()
        self.close()  # not before: no other file can have the identity of one that is held open
        self.store = opened
        self._confirmed_at = -np.inf
        self.residency.reopened(self.store)
        self._seen = -1

    def close(self) -> None:
        """Give the connection back."""
        with contextlib.suppress(HapticDBError, OSError):  # a broken one may break in this, too
            self.store.close()


def _ranked(wanted: Sequence[tuple[Keys, NDArray[np.float64]]]) -> Keys:
    """Distinct cells of several wishes, each with its urgency, most urgent first."""
    if not wanted:
        return NO_KEYS
    cells = np.concatenate([cells for cells, _ in wanted])
    order = np.argsort(np.concatenate([urgency for _, urgency in wanted]), kind="stable")
    if len(wanted) > 1:
        _, first = np.unique(cells[order], return_index=True)
        order = order[np.sort(first)]
    return cells[order]


def fetch(request: FetchRequest, voice: Voice) -> None:
    """Fetch until told to stop, whatever happens to the database meanwhile.

    Only who fetches first fails when it cannot be opened; who goes on with the table of one that
    has ended tries again.

    Raises
    ------
    GridError
        When an environment of another grid has taken the place of the request's.
    """
    table = CellTable(request.descriptor, request.n_slots)
    is_first = table.version == FIRST_VERSION
    fetching: Fetching | None = None
    patience, at_most = RETRY
    is_lost = is_ready = False
    while not table.cells.control[STOP] and not parent_is_gone():
        try:
            if fetching is None:
                fetching = Fetching(request)
            elif is_lost:
                fetching.reopen()
            if not is_ready:
                fetching.warm_up()
            is_busy = fetching.round()
            if not is_ready:
                voice.say("ready", fetching.store.engine)
            if not is_busy:
                time.sleep(IDLE)
            is_lost, is_ready, patience = False, True, RETRY[0]
        except GridError:
            raise
        except (HapticDBError, OSError):
            if is_first and fetching is None:
                raise
            if fetching is not None and not is_lost:
                fetching.lost()
            is_lost = True
            time.sleep(patience)
            patience = min(2 * patience, at_most)
    if fetching is not None:
        fetching.close()

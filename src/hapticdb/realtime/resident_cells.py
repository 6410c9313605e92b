"""ResidentCells: a table of cells and the process that fills it, for one or several sessions."""

import os
import threading
import time
from collections.abc import Iterable
from contextlib import suppress
from typing import NamedTuple, Self

from hapticdb.errors import GridError, HapticDBError
from hapticdb.grid import Grid
from hapticdb.kernels.compiling import compile_missing, entries_for
from hapticdb.query.frame import as_ids
from hapticdb.realtime.fetching import FetchRequest, Wrap
from hapticdb.realtime.processes import Process
from hapticdb.resident.residency import check_cells
from hapticdb.resident.table import AWAY, DEFAULT_BUDGET, HEARTBEAT, STOP, CellTable
from hapticdb.store.connect import open_store

START_PATIENCE = 60.0
"""Seconds in which a fetching process must be ready. It may have to calibrate, which takes seconds.
A larger value keeps a caller waiting longer for a process that hangs."""
RESTART_EVERY = 1.0
"""Seconds between two starts, at least. A smaller value tries more often where none can live."""
SILENCE_NS = 1_000_000_000
"""Nanoseconds after which a database that was asked and has not answered counts as away."""


class CacheFigures(NamedTuple):
    """What a fetching process has done.

    budget_bytes : memory of the table, fixed; resident, empty : cells in memory, and known to be
    empty; loaded, evicted, rows, ranges, statements : so far; latency, worst : seconds that the
    database took for a batch, median of late and worst ever; hit_rate : share of the wanted cells
    that were there when they were looked for; losses : how often the database was lost; restarts :
    of the process itself.
    """

    budget_bytes: int
    resident: int
    empty: int
    loaded: int
    evicted: int
    rows: int
    ranges: int
    statements: int
    latency: float
    worst: float
    hit_rate: float
    losses: int
    restarts: int


def start_error(process: Process, name: str, seconds: float) -> HapticDBError:
    """End a process that was not ready in that time, and make the error that says why."""
    is_slow = process.is_alive
    process.end()
    if is_slow:
        return HapticDBError(
            f"the {name} process was not ready after {seconds:g} s: the database or this machine "
            "is too slow now; try again"
        )
    return HapticDBError(f"the {name} process did not start: its errors are above")


class ResidentCells:
    """Cells of an environment in memory, kept there by a process of their own.

    Sessions that leave out the same objects may share one. Also as a context manager.

    Parameters
    ----------
    url : str
        The environment, as `hapticdb.open` takes it.
    budget_bytes : int
        Memory for cells, never exceeded; 1 MiB at least.
    exclude : iterable of int
        Ids of objects that are not felt.
    wrap : callable or None
        Given the fetching process's store, returns the one that it uses; importable. For tests.

    Raises
    ------
    UsageError
        When the environment's curve has no cells, or the budget is too small.
    DatabaseError
        When it cannot be opened.
    """

    _pid = 0
    """Process id of the maker. In a process forked from it, `close` must not end anything."""

    def __init__(
        self,
        url: str,
        *,
        budget_bytes: int = DEFAULT_BUDGET,
        exclude: Iterable[int] = (),
        wrap: Wrap | None = None,
    ) -> None:
        self.url = url
        self.exclude: tuple[int, ...] = tuple(as_ids(exclude).tolist())
        self.grid = self._read_environment()
        compile_missing(entries_for("resident"))  # now: two processes would each compile them
        self.table = CellTable.create(budget_bytes)
        self.restarts = 0
        self._request = FetchRequest(
            url, self.table.descriptor, self.table.n_slots, self.grid, self.exclude, wrap
        )
        try:
            self._process = self._start_process()
        except BaseException:
            self.table.close()
            raise
        self._restarted_at = 0.0
        self._failure: GridError | None = None
        self._supervising = threading.Lock()
        self._pid = os.getpid()

    def _read_environment(self) -> Grid:
        """Grid of the environment. It must have cells, and the objects that are left out."""
        store = open_store(self.url, read_only=True)
        try:
            check_cells(store)
            self.first_objects = tuple(store.objects())
            for object_id in self.exclude:
                store.object(object_id)
            return store.grid
        finally:
            store.close()

    def _start_process(self) -> Process:
        process = Process(
            "hapticdb.realtime.fetching:fetch", self._request, [self.table.descriptor]
        )
        try:
            is_ready = process.receive(START_PATIENCE) is not None
        except BaseException:
            process.end()
            raise
        if not is_ready:
            raise start_error(process, "fetching", START_PATIENCE)
        return process

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        with suppress(Exception):
            self.close()

    @property
    def is_closed(self) -> bool:
        """Whether `close` was called."""
        return self.table.descriptor < 0

    @property
    def pid(self) -> int:
        """Process id of the fetching process."""
        return self._process.pid

    @property
    def is_away(self) -> bool:
        """Whether the database cannot be reached now, or does not answer."""
        control = self.table.cells.control
        return bool(control[AWAY]) or time.monotonic_ns() - int(control[HEARTBEAT]) > SILENCE_NS

    def supervise(self) -> None:
        """Start the fetching process again if it has ended. Sessions call it in `wait`.

        Raises
        ------
        GridError
            When an environment of another grid has taken the place of this one.
        """
        with self._supervising:
            if self._process.is_alive or self.table.cells.control[STOP]:
                return
            self._raise_fatal_error()
            now = time.monotonic()
            if now - self._restarted_at < RESTART_EVERY:
                return
            self._restarted_at = now
            self.restarts += 1
            ended = self._process
            # The table stays in use until the new process has read again: its version is whole.
            self._process = Process(
                "hapticdb.realtime.fetching:fetch", self._request, [self.table.descriptor]
            )
            ended.end()

    def _raise_fatal_error(self) -> None:
        """Raise the error that ended the process, if a new one would end with it, too."""
        try:
            while self._failure is None and self._process.receive(0.0):
                pass
        except GridError as error:
            self._failure = error
        except HapticDBError:
            return
        if self._failure is not None:
            raise self._failure

    def figures(self) -> CacheFigures:
        """What the fetching process has done so far."""
        counted = self.table.desk.figures
        wanted = float(counted["wanted"])
        return CacheFigures(
            budget_bytes=self.table.size_bytes,
            resident=int(counted["resident"]),
            empty=int(counted["empty"]),
            loaded=int(counted["cells"]),
            evicted=int(counted["evicted"]),
            rows=int(counted["rows"]),
            ranges=int(counted["ranges"]),
            statements=int(counted["batches"]),
            latency=float(counted["median_latency"]),
            worst=float(counted["worst_latency"]),
            hit_rate=float(counted["granted"]) / wanted if wanted else 1.0,
            losses=int(counted["losses"]),
            restarts=self.restarts,
        )

    def close(self) -> None:
        """End the fetching process and give the memory back; nothing in a forked copy."""
        if os.getpid() != self._pid:
            return
        self.table.cells.control[STOP] = 1
        with self._supervising:
            self._process.end()
            self.table.close()

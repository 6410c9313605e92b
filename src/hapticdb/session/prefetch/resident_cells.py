"""ResidentCells: a table of cells and its prefetch process, for one or several sessions."""

import math
import os
import threading
import time
from contextlib import suppress
from dataclasses import asdict
from typing import NamedTuple

from hapticdb.closing import Closes
from hapticdb.errors import GridError, HapticDBError, UsageError
from hapticdb.grid import Grid
from hapticdb.kernels.records.cells import FIGURES
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.law import ForceLaw
from hapticdb.recording.header import Header, Start
from hapticdb.resident.residency import check_cells, check_distances
from hapticdb.resident.table import DEFAULT_BUDGET, CellTable
from hapticdb.session.coupling import DirectRendering, SettledCoupling
from hapticdb.session.prefetch.fetching import FetchRequest, Wrap
from hapticdb.session.processes.fork_server import prepare
from hapticdb.session.processes.process import Process
from hapticdb.store.connect import open_store
from hapticdb.store.filtering import Filter
from hapticdb.store.finding import Words
from hapticdb.store.urls import redact

FETCH = "hapticdb.session.prefetch.fetching:fetch"
"""Function of a prefetch process."""
END_TIMEOUT = 0.5
"""Seconds until a prefetch process is killed at its end; a hung database may delay it. It only
reads, so it may be killed at any time."""
RESTART_EVERY = 1.0
"""Least time (s) between two starts of the process. Smaller: more attempts if each one fails."""
SILENCE_NS = 1_000_000_000
"""Longest silence (ns) before the database counts as lost."""


class CacheFigures(NamedTuple):
    """Figures of a prefetch process.

    budget_bytes : memory of the table, fixed; resident, empty : cells in memory, and empty cells;
    loaded, evicted, rows, ranges, statements : numbers so far; latency, worst : seconds of the
    database for a batch, median of recent batches and greatest; hit_rate : share of the requested
    cells with data at the time of the request; losses : of the database; restarts : of the process;
    lag : of a standby, seconds since its last replayed commit (`hapticdb.store.engines.Lag`).
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
    lag: float | None = None


def without_distances(url: str, instead: str) -> str:
    """Message for a coupling in an environment without distances; `instead` : a way on."""
    return (
        f"{redact(url)} has no distances to surfaces, which the coupling of hand and tool needs: "
        f"import with distances into another environment, or {instead}"
    )


class ResidentCells(Closes):
    """Cells of an environment in memory, fetched by a process of their own.

    Sessions with the same objects may share one. Also a context manager.

    Parameters
    ----------
    url : str
        URL of the environment, in the form of `hapticdb.open`.
    budget_bytes : int
        Memory for cells, never exceeded; 1 MiB at least.
    where, exclude : iterable of int or str
        Felt are the objects that `where` chooses, all if it is empty, without those of `exclude`;
        words as for `Environment.find`. They are read again as others write: an object that is
        added or renamed later is felt if the words choose it then.
    distances : bool or None
        Whether the cells have distances to surfaces, for the law distance: a tenth as many cells
        fit then. Every object that is felt must have distances. None: where they have them.
    wrap : callable or None
        Takes the prefetch process's store and returns the store to use; importable. For tests.

    Raises
    ------
    UsageError
        If the environment's curve has no cells, or the budget is too small; if cells with distances
        are asked for, and an object has none.
    ObjectNotFoundError
        If a word of `where` or `exclude` chooses no object now.
    DatabaseError
        If the environment cannot be opened.

    Attributes
    ----------
    filter : Filter
        The words of `where` and `exclude`.
    first_objects, excluded : tuple
        All objects when the cells were made, and the ids of those that were not felt.
    """

    _pid = 0
    """Id of the process of this object. In a forked copy `close` does nothing."""

    def __init__(
        self,
        url: str,
        *,
        budget_bytes: int = DEFAULT_BUDGET,
        where: Words = (),
        exclude: Words = (),
        distances: bool | None = None,
        wrap: Wrap | None = None,
    ) -> None:
        self.url = url
        self.filter = Filter(where, exclude)
        prepare(FETCH, with_kernels=True)  # while the environment is read
        self.grid, has_distances = self._read_environment(distances)
        # made here, not by the prefetch process: it survives that process's death
        self.table = CellTable.create(budget_bytes, distances=has_distances)
        self.restarts = 0
        self._request = FetchRequest(url, self.table, self.grid, self.filter, wrap)
        try:
            self._process = self._begun()
            self._process.await_ready("prefetch")
        except BaseException:
            self.table.close()
            raise
        self._restarted_at = 0.0
        self._failure: GridError | UsageError | None = None
        self._lost_by = ""
        self._supervising = threading.Lock()
        self._pid = os.getpid()

    @property
    def has_distances(self) -> bool:
        """Whether the cells have distances to surfaces."""
        return self.table.has_distances

    def _read_environment(
        self,
        distances: bool | None,  # noqa: FBT001 - as it was asked for
    ) -> tuple[Grid, bool]:
        """Check curve and objects; returns the grid and whether the cells have distances."""
        store = open_store(self.url, read_only=True)
        try:
            check_cells(store)
            self.first_objects = tuple(store.objects())
            excluded = self.filter.excluded(self.first_objects, store.url)
            for error in excluded.missing:
                raise error
            if distances:
                check_distances(store, excluded.ids)
            self.excluded: tuple[int, ...] = tuple(excluded.ids.tolist())
            ids = set(self.excluded)
            selected = [obj for obj in self.first_objects if obj.id not in ids]
            has_all = all(obj.has_distances for obj in selected)
            return store.grid, has_all if distances is None else distances
        finally:
            store.close()

    def _begun(self) -> Process:
        return Process(FETCH, self._request, [self.table.descriptor], with_kernels=True)

    def __del__(self) -> None:
        with suppress(Exception):
            self.close()

    @property
    def is_closed(self) -> bool:
        """Whether `close` was called."""
        return self.table.descriptor < 0

    @property
    def pid(self) -> int:
        """Process id of the prefetch process."""
        return self._process.pid

    @property
    def database_lost(self) -> str | None:
        """One line: why the database cannot be read now; None while it can."""
        control = self.table.cells.control
        if control["is_lost"]:
            with self._supervising, suppress(HapticDBError):
                self._take_messages()  # the cause was sent before the mark was set
            return self._lost_by or f"{redact(self.url)} does not answer"
        if time.monotonic_ns() - int(control["heartbeat"]) > SILENCE_NS:
            return f"{redact(self.url)} has not answered for {1e-9 * SILENCE_NS:g} s"
        return None

    def supervise(self) -> None:
        """Start the prefetch process again if it has ended.

        Raises GridError if the environment was replaced by one with another grid, UsageError if the
        cells have distances and an object was written that has none.
        """
        with self._supervising:
            # under the lock: `close` sets this before it takes the lock
            if self.table.cells.control["is_over"]:
                return
            is_alive = self._process.is_alive  # read first: its last message may come with its end
            self._take_messages()
            if is_alive:
                return
            now = time.monotonic()
            if now - self._restarted_at < RESTART_EVERY:
                return
            self._restarted_at = now
            self.restarts += 1
            ended = self._process
            # Sessions use the table meanwhile: its last published version is complete.
            self._process = self._begun()
            ended.end()

    def _take_messages(self) -> None:
        """Take the messages of the process; raises an error of every later process, too."""
        try:
            while self._failure is None and (message := self._process.receive(0.0)):
                if message.word == "lost":
                    self._lost_by = str(message.content)
        except (GridError, UsageError) as error:
            self._failure = error
        # any other error ended the process; `supervise` starts the next one
        except HapticDBError:
            return
        if self._failure is not None:
            raise self._failure

    def figures(self) -> CacheFigures:
        """Figures of the prefetch process so far."""
        counted = self.table.queue.figures
        shared = set(CacheFigures._fields) & set(FIGURES.names or ())
        values = {name: counted[name].item() for name in shared}
        wanted = counted["wanted"].item()
        return CacheFigures(**values | {
            "budget_bytes": self.table.size_bytes,
            "hit_rate": counted["granted"].item() / wanted if wanted else 1.0,
            "restarts": self.restarts,
            "lag": None if math.isnan(values["lag"]) else values["lag"],
        })  # fmt: skip

    def header(
        self,
        shell: PointShell,
        rate: float,
        law: ForceLaw,
        coupling: DirectRendering,
        start: Start,
        frames_on: str = "cpu",
    ) -> Header:
        """Header of a recording of a session in these cells, at their revision now."""
        return Header(
            self.url, self.grid, self.table.revision, shell, rate, law, self.filter.exclude,
            asdict(coupling), where=self.filter.where, start=start,
            rendering="coupled" if isinstance(coupling, SettledCoupling) else "direct",
            frames_on=frames_on,
        )  # fmt: skip

    def close(self) -> None:
        """End the prefetch process and free the memory; does nothing in a forked copy."""
        # the table and process are shared with the parent: a forked copy ends neither
        if os.getpid() != self._pid:
            return
        # before the lock: from now on `supervise` starts no further process
        self.table.cells.control["is_over"] = 1
        with self._supervising:
            self._process.end(END_TIMEOUT)
            self.table.close()

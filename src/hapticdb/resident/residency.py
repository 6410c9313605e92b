"""Residency: brings cells of an environment into a table, and keeps them true.

The only writer of its table. What it changes becomes visible at once and whole, as a new version of
the directory.
"""

import time
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from hapticdb.errors import GridError, UsageError
from hapticdb.kernels.resident import cell_table as kernels
from hapticdb.kernels.resident.cells import EMPTY_SLOT, UNKNOWN, Place
from hapticdb.query.frame import as_ids
from hapticdb.resident.changes import known_cells_touched, writes_since
from hapticdb.resident.source import CellSource
from hapticdb.resident.table import FIRST_VERSION, LOADING, CellTable
from hapticdb.resident.writer import CellWriter, UnpublishedCells
from hapticdb.store.base import NO_KEYS, Keys, Store

BATCH = 256
"""Cells that one statement asks for at most. A larger value brings more cells a second; a smaller
one brings the most urgent ones sooner."""
MOST_RENEWED = 512
"""Cells that are read again at once when others have written. A larger value keeps more of what is
known; a smaller one shows the write sooner: it shall be felt within 50 ms."""
NOTHING_KNOWN = -1
"""Stands for a revision of the database, and for its commit counter, before the first look."""


def check_cells(store: Store) -> None:
    """Refuse an environment whose curve has no cells."""
    if not store.grid.is_hierarchical:
        raise UsageError(
            f"{store.url} is in lexicographic order, which has no cells: "
            "'hapticdb copy' it to one with --curve z"
        )


class Loaded(NamedTuple):
    """What a load did: cells brought in, rows read, ranges asked, seconds that the database took.

    Fewer cells than were asked for when the table has no room for more: 0 when all others are
    wanted just now.
    """

    cells: int
    rows: int
    ranges: int
    elapsed: float


class Residency:
    """Cells of one environment in one table, without the objects that are not felt.

    It decides what is read, and when. `CellSource` reads, `CellWriter` holds and publishes.

    Parameters
    ----------
    store : Store
        A connection of its own; `reopened` exchanges it.
    table : CellTable
        Made for this; nobody else writes to it. Where another writer has filled it and has ended,
        the urgent cells are read again and all others are forgotten, in one version.
    exclude : iterable of int
        Ids of objects that are left out of all cells.
    urgent : (n,) int64
        Cells that tools are near, distinct, most urgent first.
    clock : callable
        Seconds, for what a load reports.

    Attributes
    ----------
    writer : CellWriter
        What is in the table.
    n_loaded : int
        Cells brought in so far.

    Raises
    ------
    UsageError
        When the environment's curve has no cells.
    """

    def __init__(
        self,
        store: Store,
        table: CellTable,
        exclude: Iterable[int] = (),
        *,
        urgent: Keys = NO_KEYS,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        check_cells(store)
        self.table = table
        self.grid = store.grid
        self.writer = CellWriter(table)
        self.n_loaded = 0
        self._clock = clock
        self._urgent = NO_KEYS
        self._revision = NOTHING_KNOWN
        self._commit_count = NOTHING_KNOWN
        is_first = table.version == FIRST_VERSION
        self._source = CellSource(store, as_ids(exclude), clock, may_measure=is_first)
        if not is_first:
            self._take_over(urgent)
        self.refresh()

    def _take_over(self, urgent: Keys) -> None:
        """Go on with the table of a writer that has ended: its last version is whole.

        None of its cells is known to be true. The environment may have been replaced since, and a
        new file may have the same number of writes as the old one.
        """
        self.writer.take_over()
        self.table.cells.control[LOADING] = 0
        # a third of the table: the cells are read into other slots before the old ones are free
        urgent = urgent[: min(MOST_RENEWED, self.table.n_slots // 3)]
        self.want(urgent, self.slots_of(urgent))

    def reopened(self, store: Store) -> None:
        """Go on with another connection to the same environment, after the first was lost.

        Another environment of the same grid in the same place makes all cells unknown.

        Raises
        ------
        GridError
            When an environment of another grid has taken its place.
        """
        if store.grid != self.grid:
            raise GridError(
                f"{store.url} is another environment than before: start the session again"
            )
        if store.identity != self.store.identity:
            self._revision = NOTHING_KNOWN
        self._source.store = store
        self._commit_count = NOTHING_KNOWN
        self.writer.slots.free_lost()
        self.refresh()

    @property
    def store(self) -> Store:
        """The connection by which cells are read."""
        return self._source.store

    @property
    def exclude(self) -> Keys:
        """Ids (E,) of objects that are left out of all cells."""
        return self._source.exclude

    @property
    def place(self) -> Place:
        """The grid, as kernels take it."""
        return Place(*self.grid.origin, self.grid.voxel_size, float(self.grid.side))

    @property
    def revision(self) -> int:
        """The database's revision that all resident cells are of."""
        return self._revision

    # -- what is wanted and known ------------------------------------------------------------------

    def begin_round(self) -> None:
        """Begin to name wanted cells anew: those of a few rounds ago may be evicted."""
        self.writer.slots.begin_round()

    def slots_of(self, cells: Keys) -> Keys:
        """Slots (n,) of cells (n,): UNKNOWN, EMPTY_SLOT, or where they are."""
        return self.writer.directory.slots_of(cells)

    def want(self, cells: Keys, slots: Keys) -> None:
        """Keep cells (n,), most urgent first, in slots (n,), from eviction for a few rounds.

        When others write, these are read again at once, in this order.
        """
        self.writer.slots.want(slots)
        self._urgent = cells

    def missing(self, cells: Keys) -> Keys:
        """Those of the cells (n,) that are unknown, in their order. All of them become wanted."""
        slots = self.slots_of(cells)
        self.want(cells, slots)
        return np.compress(slots == UNKNOWN, cells)

    # -- bringing in -------------------------------------------------------------------------------

    def make_resident(self, cells: Keys) -> None:
        """Make cells (n,) resident, all of them together, however many statements that takes.

        Raises
        ------
        UsageError
            When they do not fit into the table together.
        """
        self.begin_round()
        missing = self.missing(cells)
        for _ in range(4 + 2 * len(missing) // BATCH):
            if not len(missing):
                return
            for at in range(0, len(missing), BATCH):
                self.load(missing[at : at + BATCH])
            missing = self.missing(cells)
        raise UsageError(
            f"the tool and its surroundings meet {len(cells)} cells at once, more than fit into "
            f"{self.table.size_bytes} bytes: check the tool's unit, or give a larger budget"
        )

    def warm_up(self) -> None:
        """Compile what is first called at an eviction or a write."""
        kernels.cells_of_curve_keys(NO_KEYS, self.grid.bits, self.grid.curve_code, NO_KEYS.copy())
        self.writer.slots.warm_up()

    def load(self, cells: Keys) -> Loaded:
        """Bring in cells (n,), distinct and unknown, by one statement; at most `BATCH` are taken.

        If others have written meanwhile, their writes are followed in the same version, so that all
        that is resident is of one revision.
        """
        cells = cells[: min(BATCH, max(self.table.n_slots // 4, 1))]
        self._make_room(len(cells))
        self.table.cells.control[LOADING] = len(cells)
        started = self._clock()
        try:
            read = self._read_batch(cells)
            if self.store.version() != self._commit_count:
                self.writer.slots.give_back(read.slots)
                _, read = self._follow_writes(cells)
            else:
                self._publish(NO_KEYS, read)
        finally:
            self.table.cells.control[LOADING] = 0
        elapsed = self._clock() - started
        self.n_loaded += len(read.cells)
        return Loaded(len(read.cells), read.n_rows, read.n_ranges, elapsed)

    def refresh(self) -> int:
        """Follow what others have written; returns how many writes that were.

        Cells that a write has touched are read again or become unknown, in one version: no frame
        mixes two revisions of an object.
        """
        n_writes, _ = self._follow_writes(NO_KEYS)
        return n_writes

    def _follow_writes(self, asked: Keys) -> tuple[int, UnpublishedCells]:
        """Bring known cells to the last revision, and unknown ones (n,) with them.

        Of the touched cells the most urgent are read again and the others are forgotten, so that
        memory and time have a bound however much was written. Returns the number of writes, and all
        cells that were read.
        """
        with self.store.snapshot():
            revision = self.store.revision()
            writes = writes_since(self.store, self._revision, revision)
            if writes is None:
                writes, touched = [], self.writer.known()
            else:
                touched = known_cells_touched(writes, self.grid, self.slots_of, self.writer.known)
            again = self._urgent[np.isin(self._urgent, touched)][:MOST_RENEWED]
            read = self._read_all(np.concatenate([asked, again]))
            commit_count = self.store.version()
        self._revision, before = revision, self._revision
        self._commit_count = commit_count
        if len(touched) or len(read.cells) or revision != before:
            self._publish(touched, read)
        return len(writes), read

    def _read_all(self, cells: Keys) -> UnpublishedCells:
        """Read cells (n,), batch by batch, as far as there is room."""
        self._make_room(len(cells))
        parts = [self._read_batch(cells[at : at + BATCH]) for at in range(0, len(cells), BATCH)]
        return UnpublishedCells(
            np.concatenate([NO_KEYS, *(part.cells for part in parts)]),
            np.concatenate([NO_KEYS, *(part.slots for part in parts)]),
            sum(part.n_rows for part in parts),
            sum(part.n_ranges for part in parts),
        )

    def _read_batch(self, cells: Keys) -> UnpublishedCells:
        """Read cells (n,) by one statement, as many of them as slots are free."""
        slots = self.writer.slots.next_free(len(cells))
        if not len(slots):
            return UnpublishedCells()
        cells = cells[: len(slots)]
        read = self._source.read(cells, self.table, slots)
        self.writer.slots.take(slots)
        self.writer.slots.give_back(slots[read.is_empty])
        slots[read.is_empty] = EMPTY_SLOT
        return UnpublishedCells(cells, slots, read.n_rows, read.n_ranges)

    def _make_room(self, n_cells: int) -> None:
        """Free so many slots, as far as there are cells that are not wanted just now."""
        surplus = min(4 * BATCH, self.table.n_slots // 8)
        self.writer.evict_for(n_cells, surplus, self._urgent, self._revision)

    def _publish(self, leaving: Keys, read: UnpublishedCells) -> None:
        """Publish what has left and come, as of the present revision."""
        self.writer.publish(leaving, read, self._urgent, self._revision)

"""Residency: fetches cells of an environment into a table, and keeps them up to date.

It is the only writer of its table. Each change becomes visible in one step, as a new version of the
directory.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from hapticdb.errors import GridError, ObjectNotFoundError, UsageError
from hapticdb.kernels.resident import cell_table as kernels
from hapticdb.kernels.resident.cells import EMPTY_SLOT, UNKNOWN, CellGrid
from hapticdb.resident.changes import FollowedExclusions, known_cells_touched, writes_since
from hapticdb.resident.source import CellSource
from hapticdb.resident.table import FIRST_VERSION, CellTable
from hapticdb.resident.writer import CellWriter, UnpublishedCells
from hapticdb.store.base import NO_KEYS, Change, Keys, Store
from hapticdb.store.filtering import Filter
from hapticdb.store.finding import Words

BATCH = 256
"""Greatest number of cells in one statement. A larger value fetches more cells a second; a smaller
one fetches the most urgent ones sooner."""
MOST_RENEWED = 512
"""Most cells read again at once after a write of others. Larger: more cells stay; smaller: the
write takes effect sooner. It shall do so within 50 ms."""
NOTHING_KNOWN = -1
"""Value of the database's revision, and of its commit counter, before the first query."""


def check_cells(store: Store) -> None:
    """Refuse an environment if its curve has no cells."""
    if not store.grid.is_hierarchical:
        raise UsageError(
            f"{store.url} is in lexicographic order, which has no cells: "
            "'hapticdb copy' it to one with --curve z"
        )


def check_distances(store: Store, exclude: Keys, changes: Sequence[Change] | None = None) -> None:
    """Refuse objects without distances: the law distance has no forces on them.

    exclude (E,) : ids of excepted objects; changes : the writes since the last check, or
    None to check every object.
    """
    if changes is None:
        objects = store.objects()
    else:
        objects = []
        for object_id in {change.id for change in changes if change.action != "remove"}:
            with suppress(ObjectNotFoundError):  # removed by a later write
                objects.append(store.object(object_id))
    excluded = set(exclude.tolist())
    for obj in objects:
        if not obj.has_distances and obj.id not in excluded:
            raise UsageError(
                f"object {obj.id} ({obj.name}) of {store.url} has no distances to its surface: "
                "import it again with distances, or use the law 'plane'"
            )


class Loaded(NamedTuple):
    """Result of a load: cells fetched, rows read, ranges queried, seconds of the database.

    A full table gives fewer cells than requested; 0 if all its cells are still requested.
    """

    cells: int
    rows: int
    ranges: int
    elapsed: float


class Residency:
    """Cells of one environment in one table, without the excluded objects.

    It chooses cells and times of reads. `CellSource` reads; `CellWriter` writes the table.

    store : a connection of its own; `reopened` replaces it; table : without another writer. If an
    earlier writer has filled it and has ended, the cells `urgent` (n,), near tools, distinct, most
    urgent first, are read again and all others are forgotten, in one version. exclude, where : as
    of `hapticdb.store.filtering.Filter`; the words are read again as others write, and a word
    without an object is no error. clock : returns seconds, to time loads.

    Raises UsageError if the environment's curve has no cells, or the table has distances and an
    object of the filter has none; also later, after a write of others.
    """

    def __init__(
        self,
        store: Store,
        table: CellTable,
        exclude: Words = (),
        *,
        where: Words = (),
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
        # a table in use needs its cells at once: then no time to calibrate
        is_first = table.version == FIRST_VERSION
        self._excluded = FollowedExclusions(Filter(where, exclude))
        self._source = CellSource(store, self._excluded.ids, clock, may_measure=is_first)
        if not is_first:
            self._take_over(urgent)
        self.refresh()

    def _take_over(self, urgent: Keys) -> None:
        """Continue with the table of an ended writer: its last version is complete.

        Its cells may be out of date: the environment may have been replaced since then, and a new
        file may have the same number of writes as the old one.
        """
        self.writer.take_over()
        # a third of the table: the cells are read into other slots before the old ones are free
        urgent = urgent[: min(MOST_RENEWED, self.table.n_slots // 3)]
        self.want(urgent, self.slots_of(urgent))

    def reopened(self, store: Store) -> None:
        """Continue with a new connection to the environment, after the old one was lost.

        If it is now another environment with the same grid, all cells become unknown; with another
        grid a GridError is raised.
        """
        if store.grid != self.grid:
            raise GridError(
                f"{store.url} is another environment than before: start the session again"
            )
        # a new file may have the same revision: the number alone proves nothing
        if store.identity != self.store.identity:
            self._revision = NOTHING_KNOWN
        self._source.store = store
        self._commit_count = NOTHING_KNOWN
        # the lost connection may have ended a load between `take` and publication
        self.writer.slots.free_lost()
        self.refresh()

    @property
    def store(self) -> Store:
        """The connection for cells."""
        return self._source.store

    @property
    def exclude(self) -> Keys:
        """Ids (E,) of the excluded objects, at `revision`."""
        return self._source.exclude

    @property
    def cell_grid(self) -> CellGrid:
        """The grid in the kernels' form."""
        return CellGrid(*self.grid.origin, self.grid.voxel_size, float(self.grid.side))

    @property
    def revision(self) -> int:
        """Revision of the database for all resident cells."""
        return self._revision

    # -- what is wanted and known ------------------------------------------------------------------

    def begin_round(self) -> None:
        """Begin a round of requests; cells last requested a few rounds ago may be evicted."""
        self.writer.slots.begin_round()

    def slots_of(self, cells: Keys) -> Keys:
        """Slots (n,) of cells (n,): UNKNOWN, EMPTY_SLOT, or a slot."""
        return self.writer.slots_of(cells)

    def want(self, cells: Keys, slots: Keys) -> None:
        """Protect cells (n,), most urgent first, in slots (n,), from eviction for a few rounds.

        After a write of others, these cells are read again at once, in this order.
        """
        self.writer.slots.want(slots)
        self._urgent = cells

    def missing(self, cells: Keys) -> Keys:
        """Return the unknown ones of cells (n,), in their order; all count as requested."""
        slots = self.slots_of(cells)
        self.want(cells, slots)
        return np.compress(slots == UNKNOWN, cells)

    # -- bringing in -------------------------------------------------------------------------------

    def make_resident(self, cells: Keys) -> None:
        """Make all cells (n,) resident at the same time, by as many statements as necessary.

        Raises UsageError if they do not fit into the table together.
        """
        self.begin_round()
        missing = self.missing(cells)
        # bounded: a load may evict cells of an earlier one, and writes of others make some unknown
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
        """Compile the kernels of an eviction and a write."""
        kernels.cells_of_curve_keys(NO_KEYS, self.grid.bits, self.grid.curve_code)
        self.writer.slots.warm_up()

    def load(self, cells: Keys) -> Loaded:
        """Fetch up to `BATCH` of cells (n,), distinct and unknown, by one statement.

        If others have written meanwhile, their writes are followed in the same version, so that all
        resident cells have one revision.
        """
        # in a small table a whole batch would evict most of the others
        cells = cells[: min(BATCH, max(self.table.n_slots // 4, 1))]
        self._make_room(len(cells))
        started = self._clock()
        read = self._read_now(cells)
        if read is None:
            _, read = self._follow_writes(cells)
        else:
            self.writer.publish(NO_KEYS, read, self._urgent, self._revision)
        elapsed = self._clock() - started
        self.n_loaded += len(read.cells)
        return Loaded(len(read.cells), read.n_rows, read.n_ranges, elapsed)

    def _read_now(self, cells: Keys) -> UnpublishedCells | None:
        """Read cells (n,) of the known revision; None if others have written since then."""
        read = self._read_batch(cells)
        # optimistic: the read is outside a snapshot, and counts if nobody committed meanwhile
        if self.store.version() == self._commit_count:
            return read
        # in no directory: free at once, no frame has seen them
        self.writer.slots.give_back(read.slots)
        return None

    def refresh(self) -> int:
        """Follow the writes of others; returns their number.

        Changed cells are read again or become unknown, in one version, so no frame mixes two
        revisions of an object.
        """
        n_writes, _ = self._follow_writes(NO_KEYS)
        return n_writes

    def _follow_writes(self, requested: Keys) -> tuple[int, UnpublishedCells]:
        """Update all cells to the last revision, and read the unknown cells `requested` (n,).

        The most urgent changed cells are read again, the others are forgotten. So memory and time
        are bounded for any amount of writes. Returns the number of writes, and all cells read.
        """
        # one snapshot: revision, changes, exclusions and cells must agree
        with self.store.snapshot():
            revision = self.store.revision()
            writes = writes_since(self.store, self._revision, revision)
            only_written = self._excluded.follow(self.store, writes)
            self._source.exclude = self._excluded.ids
            if self.table.has_distances:
                check_distances(self.store, self.exclude, writes if only_written else None)
            # other objects are felt than before: their cells are in no listed write,
            # so all are doubtful
            if writes is None or not only_written:
                touched = self.writer.known()
            else:
                touched = known_cells_touched(writes, self.grid, self.slots_of, self.writer.known)
            again = self._urgent[np.isin(self._urgent, touched)][:MOST_RENEWED]
            read = self._read_all(np.concatenate([requested, again]))
            # inside the snapshot: a commit right after it must differ from this number
            commit_count = self.store.version()
        # only after the reads: an error above must leave the old revision
        self._revision, before = revision, self._revision
        self._commit_count = commit_count
        if len(touched) or len(read.cells) or revision != before:
            self.writer.publish(touched, read, self._urgent, self._revision)
        return len(writes or ()), read

    def _read_all(self, cells: Keys) -> UnpublishedCells:
        """Read cells (n,), batch by batch, while there is room."""
        self._make_room(len(cells))
        parts = [self._read_batch(cells[at : at + BATCH]) for at in range(0, len(cells), BATCH)]
        return UnpublishedCells(
            np.concatenate([NO_KEYS, *(part.cells for part in parts)]),
            np.concatenate([NO_KEYS, *(part.slots for part in parts)]),
            sum(part.n_rows for part in parts),
            sum(part.n_ranges for part in parts),
        )

    def _read_batch(self, cells: Keys) -> UnpublishedCells:
        """Read cells (n,) by one statement; no more than have room."""
        slots = self.writer.slots.next_free(len(cells))
        if not len(slots):
            return UnpublishedCells()
        cells = cells[: len(slots)]
        is_empty, n_rows, n_ranges = self._source.read(cells, self.table, slots)
        # after the read: its error leaves the slots free
        self.writer.slots.take(slots)
        self.writer.slots.give_back(slots[is_empty])
        slots[is_empty] = EMPTY_SLOT
        return UnpublishedCells(cells, slots, n_rows, n_ranges)

    def _make_room(self, n_cells: int) -> None:
        """Free slots for `n_cells` cells, but none of a requested cell."""
        # several batches at once: each eviction waits for the readers
        surplus = min(4 * BATCH, self.table.n_slots // 8)
        self.writer.evict_for(n_cells, surplus, self._urgent, self._revision)

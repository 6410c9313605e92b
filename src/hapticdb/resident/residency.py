"""Residency: brings cells of an environment into a table, and keeps them true.

The only writer of its table. What it changes becomes visible at once and whole, as a new version of
the directory; slots and directories are used again when no frame can see them any more.
"""

import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import GridError, UsageError
from hapticdb.kernels.resident import cell_table as kernels
from hapticdb.kernels.resident.cells import BUFFERS, EMPTY_SLOT, UNKNOWN, Place
from hapticdb.query.frame import as_ids
from hapticdb.query.grouping import group_spans
from hapticdb.query.quantiles import QuantileVector
from hapticdb.resident.costs import costs_at_start
from hapticdb.resident.table import FIRST_VERSION, LOADING, CellTable
from hapticdb.store.base import CELL_SHIFT, NO_KEYS, Change, Keys, Store, row_shift

BATCH = 256
"""Cells that one statement asks for at most."""
MOST_RENEWED = 512
"""Cells that are read again in one go when others have written: it shall be felt within 50 ms."""
MOST_CHANGES = 4096
"""Writes that are caught up with one by one; after more, all is forgotten."""
RECENT = 4
"""Rounds of wishes within which a wanted cell is not evicted."""
PATIENCE = 0.02
"""Seconds until a reader that holds a version is looked after: its process may be gone."""
PAUSE = 5e-5
FEW_CELLS = 1 << 14
"""In the ranges of a write: more, and what is known is looked through instead of them."""


def check_cells(store: Store) -> None:
    """Refuse an environment whose curve has no cells."""
    if not store.grid.is_hierarchical:
        raise UsageError(
            f"{store.url} is in lexicographic order, which has no cells: "
            "'hapticdb copy' it to one with --curve z"
        )


class Loaded(NamedTuple):
    """What a load did: cells brought in, rows read, ranges asked, seconds that the database took.

    Fewer cells than were asked for when the table has no room, none when nothing could make way.
    """

    cells: int
    rows: int
    ranges: int
    elapsed: float


class _Brought(NamedTuple):
    """Cells in slots that no directory names yet; EMPTY_SLOT for those without a voxel."""

    cells: Keys
    slots: Keys
    rows: int = 0
    ranges: int = 0


class _Delta(NamedTuple):
    gone: Keys
    cells: Keys
    slots: Keys


class Residency:
    """Cells of one environment in one table, without the objects that are not felt.

    Parameters
    ----------
    store : Store
        A connection of its own; `reopened` exchanges it.
    table : CellTable
        Made for this; nobody else writes to it. One that another has filled is gone on with: its
        most urgent cells are read again, the others forgotten, in one version.
    exclude : iterable of int
        Ids of objects that are left out of all cells.
    urgent : (n,) int64
        Cells that tools are near, distinct, most urgent first.
    clock : callable
        Seconds, for what a load reports.

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
        self.store = store
        self.table = table
        self.exclude = as_ids(exclude)
        self.grid = store.grid
        self.round = RECENT
        self.loaded = self.rows = self.evicted = self.n_resident = 0
        self._clock = clock
        self._cell_of_slot = np.full(table.n_slots, UNKNOWN, dtype=np.int64)
        self._wanted_at = np.zeros(table.n_slots, dtype=np.int64)
        self._urgent = NO_KEYS
        self._free = list(range(table.n_slots - 1, EMPTY_SLOT, -1))
        self._limbo: deque[tuple[int, list[int]]] = deque()
        self._empty: dict[int, None] = {}  # in the order in which they came
        self._most_empty = table.capacity // 2 - table.n_slots
        self._hand = 0
        self._deltas: deque[_Delta] = deque(maxlen=BUFFERS - 1)
        self._n_outdated = 0
        self._revision = -1
        self._version = -1
        self._quantiles = QuantileVector.of(store)
        is_first = table.version == FIRST_VERSION
        may_measure = is_first and self._quantiles.n_rows > 0
        self._costs = costs_at_start(store, clock, may_measure=may_measure)
        if not is_first:
            self._adopt(urgent)
        self.refresh()

    def _adopt(self, urgent: Keys) -> None:
        """Go on with the table of a writer that has ended: its last version is whole.

        Its cells are those of an environment that may have been replaced since, and nothing tells:
        a new file may have the number of the old. So none of them is known to be true.
        """
        table, which = self.table.cells, self.table.version % BUFFERS
        entries = np.flatnonzero(table.keys[which] >= 0)
        cells, slots = table.keys[which][entries], table.slots[which][entries].astype(np.int64)
        is_filled = slots > EMPTY_SLOT
        self._cell_of_slot[slots[is_filled]] = cells[is_filled]
        self.n_resident = int(np.count_nonzero(is_filled))
        self._empty = dict.fromkeys(cells[~is_filled].tolist())
        taken = set(slots.tolist())
        self._free = [slot for slot in self._free if slot not in taken]
        self._n_outdated = BUFFERS - 1
        table.control[LOADING] = 0
        self._wait_for_readers(self.table.version)  # what older versions showed is free now
        urgent = urgent[: min(MOST_RENEWED, self.table.n_slots // 3)]  # and room to read them again
        self.want(urgent, self.slots_of(urgent))

    def reopened(self, store: Store) -> None:
        """Go on with another connection to the same environment, after the first was lost.

        What came in its place, another environment of the same grid, makes all cells unknown.

        Raises
        ------
        GridError
            When another environment has taken its place.
        """
        if store.grid != self.grid:
            raise GridError(
                f"{store.url} is another environment than before: start the session again"
            )
        if store.identity != self.store.identity:
            self._revision = -1
        self.store = store
        self._version = -1
        taken = {slot for _, slots in self._limbo for slot in slots}
        self._free = [  # those, too, that a load had taken when the connection was lost
            slot
            for slot in np.flatnonzero(self._cell_of_slot < 0).tolist()
            if slot != EMPTY_SLOT and slot not in taken
        ]
        self.refresh()

    @property
    def revision(self) -> int:
        """The database's revision that all resident cells are of."""
        return self._revision

    @property
    def n_empty(self) -> int:
        """Cells known to be empty."""
        return len(self._empty)

    @property
    def place(self) -> Place:
        """The grid, as kernels take it."""
        return Place(*self.grid.origin, self.grid.voxel_size, float(self.grid.side))

    # -- bringing in -------------------------------------------------------------------------

    def slots_of(self, cells: Keys) -> Keys:
        """Slots (n,) of cells (n,): UNKNOWN, EMPTY_SLOT, or where they are."""
        slots = np.empty(len(cells), dtype=np.int64)
        table = self.table.cells
        kernels.slots_of_cells(table.keys, table.slots, self.table.version % BUFFERS, cells, slots)
        return slots

    def want(self, cells: Keys, slots: Keys) -> None:
        """Keep cells (n,), most urgent first, given their slots (n,), from being evicted a while.

        When others write, these are read again at once, in this order.
        """
        self._wanted_at[slots[slots > EMPTY_SLOT]] = self.round
        self._urgent = cells

    def missing(self, cells: Keys) -> Keys:
        """Those of the cells (n,) that are unknown, in their order; the others are wanted anew."""
        slots = self.slots_of(cells)
        self.want(cells, slots)
        return np.compress(slots == UNKNOWN, cells)

    def bring(self, cells: Keys) -> None:
        """Make cells (n,) resident, all of them at once, however many statements that takes.

        Raises
        ------
        UsageError
            When they do not fit into the table together.
        """
        self.round += 1
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
        """Compile what first comes with an eviction or a change."""
        bits, curve = self.grid.bits, self.grid.curve_code
        kernels.cells_of_curve_keys(NO_KEYS, bits, curve, np.empty(0, dtype=np.int64))
        kernels.slots_to_free(
            self._cell_of_slot, self._wanted_at, self.table.cells.used, 0, 0, 0,
            np.empty(0, dtype=np.int64),
        )  # fmt: skip

    def load(self, cells: Keys) -> Loaded:
        """Bring in cells (n,), distinct and unknown, by one statement; at most `BATCH` are taken.

        A database that others have written meanwhile is caught up with at the same time, so that
        all that is resident is of one revision.
        """
        cells = cells[: min(BATCH, max(self.table.n_slots // 4, 1))]
        self._make_room(len(cells))
        self.table.cells.control[LOADING] = len(cells)
        started = self._clock()
        try:
            brought = self._bring(cells)
            if self.store.version() != self._version:
                self._give_back(brought.slots)
                brought = self._catch_up(cells)[1]
            else:
                self._enter(NO_KEYS, brought)
        finally:
            self.table.cells.control[LOADING] = 0
        elapsed = self._clock() - started
        self.loaded += len(brought.cells)
        self.rows += brought.rows
        return Loaded(len(brought.cells), brought.rows, brought.ranges, elapsed)

    def refresh(self) -> int:
        """Catch up with what others have written; returns how many writes that were.

        Cells that a write touched become known anew, or unknown, in one version: no frame mixes
        two revisions of an object.
        """
        return self._catch_up(NO_KEYS)[0]

    def _catch_up(self, asked: Keys) -> tuple[int, _Brought]:
        """Bring known cells to the last revision, and unknown ones (n,) with them.

        Of the known ones the most urgent are read again, others forgotten: the memory that this
        takes, and the time, have a bound however much was written. Returns how many writes that
        were, and all that was brought.
        """
        with self.store.snapshot():
            revision = self.store.revision()
            changes = self._changes(revision)
            if changes is None:
                changes, known = [], self._known()
            else:
                spans = [change.ranges for change in changes]
                known = self._known_within(np.concatenate(spans) if spans else _NO_SPANS)
            again = self._urgent[np.isin(self._urgent, known)][:MOST_RENEWED]
            brought = self._bring_all(np.concatenate([asked, again]))
            version = self.store.version()
        self._revision, before = revision, self._revision
        self._version = version
        if len(known) or len(brought.cells) or revision != before:
            self._enter(known, brought)
        return len(changes), brought

    def _changes(self, revision: int) -> list[Change] | None:
        """Writes since the known revision, or None when they cannot be told one by one."""
        missed = revision - self._revision
        if self._revision < 0 or not 0 <= missed <= MOST_CHANGES:
            return None  # below: a server came back without its last commits
        changes = list(self.store.changes(self._revision)) if missed else []
        return changes if len(changes) >= missed else None

    def _bring_all(self, cells: Keys) -> _Brought:
        """Bring in cells (n,), batch by batch, as far as there is room."""
        self._make_room(len(cells))
        parts = [self._bring(cells[at : at + BATCH]) for at in range(0, len(cells), BATCH)]
        return _Brought(
            np.concatenate([NO_KEYS, *(part.cells for part in parts)]),
            np.concatenate([NO_KEYS, *(part.slots for part in parts)]),
            sum(part.rows for part in parts),
            sum(part.ranges for part in parts),
        )

    def _bring(self, cells: Keys) -> _Brought:
        """Read cells (n,) by one statement into free slots, which no frame can see."""
        count = min(len(cells), len(self._free))
        if not count:
            return _Brought(NO_KEYS, NO_KEYS)
        cells = cells[:count]
        slots = np.array(self._free[-count:], dtype=np.int64)
        bits, curve = self.grid.bits, self.grid.curve_code
        shift = row_shift(self.store.layout)
        on_curve = np.empty(count, dtype=np.int64)
        kernels.curve_keys_of_cells(cells, bits, curve, on_curve)
        order = np.argsort(on_curve)
        on_curve = on_curve[order]
        lows = on_curve << (CELL_SHIFT - shift)
        highs = ((on_curve + 1) << (CELL_SHIFT - shift)) - 1
        ranges = group_spans(lows, highs, self._quantiles, self._costs)
        rows = self.store.scan(*ranges)
        words, masks = self.table.cells.words, self.table.cells.masks
        words[slots] = 0
        masks[slots] = 0
        kernels.fill_cells(
            rows.keys, rows.ids, rows.occupancy, self.exclude, on_curve, slots[order], bits, curve,
            shift, words, masks,
        )  # fmt: skip
        is_empty = masks[slots] == 0
        del self._free[-count:]
        self._give_back(slots[is_empty])
        slots[is_empty] = EMPTY_SLOT
        return _Brought(cells, slots, len(rows), len(ranges.lows))

    def _give_back(self, slots: Keys) -> None:
        """Free slots (n,) that no directory has named."""
        self._free += slots[slots > EMPTY_SLOT].tolist()

    # -- what is known -----------------------------------------------------------------------

    def _known(self) -> Keys:
        """All resident and empty cells."""
        filled = self._cell_of_slot[self._cell_of_slot >= 0]
        return np.concatenate([filled, np.fromiter(self._empty, np.int64, len(self._empty))])

    def _known_within(self, spans: NDArray[np.int64]) -> Keys:
        """Resident and empty cells whose voxel keys meet closed spans (n, 2)."""
        bits, curve = self.grid.bits, self.grid.curve_code
        if not len(spans):
            return NO_KEYS
        first, last = spans[:, 0] >> CELL_SHIFT, spans[:, 1] >> CELL_SHIFT
        if (last - first + 1).sum() <= FEW_CELLS:
            met = np.concatenate([np.arange(a, b + 1) for a, b in zip(first, last, strict=True)])
            met = np.unique(met)
            cells = np.empty(len(met), dtype=np.int64)
            kernels.cells_of_curve_keys(met, bits, curve, cells)
            is_known = self.slots_of(cells) != UNKNOWN
            return np.compress(is_known, cells)
        known = self._known()
        on_curve = np.empty(len(known), dtype=np.int64)
        kernels.curve_keys_of_cells(known, bits, curve, on_curve)
        order = np.argsort(on_curve)
        on_curve = on_curve[order]
        depth = np.zeros(len(known) + 1, dtype=np.int64)
        np.add.at(depth, np.searchsorted(on_curve, first), 1)
        np.add.at(depth, np.searchsorted(on_curve, last, side="right"), -1)
        return np.compress(np.cumsum(depth[:-1]) > 0, known[order])

    # -- slots -------------------------------------------------------------------------------

    def _make_room(self, n_cells: int) -> None:
        """Free so many slots, as far as what is not wanted just now makes way."""
        self._collect()
        if len(self._free) >= n_cells:
            return
        wanted = max(n_cells - len(self._free), min(4 * BATCH, self.table.n_slots // 8))
        out = np.empty(wanted, dtype=np.int64)
        count = 0
        for since in (self.round - RECENT, self.round):
            found, self._hand = kernels.slots_to_free(
                self._cell_of_slot, self._wanted_at, self.table.cells.used, since, self._hand,
                wanted - count, out[count:],
            )  # fmt: skip
            count += found
            if len(self._free) + count >= n_cells:
                break
        if count:
            self.evicted += count
            self._enter(self._cell_of_slot[out[:count]], _Brought(NO_KEYS, NO_KEYS))
            self._wait_for_readers(self.table.version)
            self._collect()

    def _collect(self) -> None:
        """Free the slots that no frame can see any more."""
        if self._limbo:
            oldest = kernels.oldest_version_read(self.table.cells.readers)
            while self._limbo and self._limbo[0][0] <= oldest:
                self._free += self._limbo.popleft()[1]

    def _enter(self, gone: Keys, brought: _Brought) -> None:
        """Take cells out and others in, in one version; cells in both have new slots."""
        cells, slots = brought.cells, brought.slots
        freed = self._take_out(gone)
        is_filled = slots > EMPTY_SLOT
        new_empty = cells[~is_filled].tolist()
        crowd = self._crowd(len(new_empty))
        filled = slots[is_filled]
        self._cell_of_slot[filled] = cells[is_filled]
        self._wanted_at[filled] = self.round
        self.table.cells.used[filled] = 1
        self.n_resident += len(filled)
        self._empty.update(dict.fromkeys(new_empty))
        self._publish(_Delta(np.concatenate([gone, crowd]), cells, slots))
        if freed:
            self._limbo.append((self.table.version, freed))

    def _take_out(self, cells: Keys) -> list[int]:
        """Strike cells (n,) off the lists; returns their slots, which frames may still see."""
        slots = self.slots_of(cells)
        for cell in cells[slots == EMPTY_SLOT].tolist():
            self._empty.pop(cell, None)
        freed: list[int] = slots[slots > EMPTY_SLOT].tolist()
        self._cell_of_slot[freed] = UNKNOWN
        self.n_resident -= len(freed)
        return freed

    def _crowd(self, n_new: int) -> Keys:
        """Empty cells that are forgotten, that so many new ones have room in the directory.

        The oldest, and some more than must be; wanted ones last, from the least urgent.
        """
        surplus = len(self._empty) + n_new - self._most_empty
        if surplus <= 0:
            return NO_KEYS
        known = np.fromiter(self._empty, np.int64, len(self._empty))
        others = known[~np.isin(known, self._urgent)]
        wanted = self._urgent[::-1][np.isin(self._urgent[::-1], known)]
        n_gone = max(surplus, min(surplus + self._most_empty // 8, len(others)))
        gone = np.concatenate([others, wanted])[:n_gone]
        for cell in gone.tolist():
            del self._empty[cell]
        return gone

    # -- versions ----------------------------------------------------------------------------

    def _publish(self, delta: _Delta) -> None:
        """Bring the oldest buffer up to date, change it, and publish it."""
        version = self.table.version + 1
        self._wait_for_readers(version - BUFFERS + 1)
        table, which = self.table.cells, version % BUFFERS
        steps = (*self._deltas, delta)
        if self._n_outdated:
            self._n_outdated -= 1
            table.keys[which] = table.keys[(version - 1) % BUFFERS]
            table.slots[which] = table.slots[(version - 1) % BUFFERS]
            steps = (delta,)
        for step in steps:
            kernels.remove_cells(table.keys, table.slots, which, step.gone)
            kernels.insert_cells(table.keys, table.slots, which, step.cells, step.slots)
        self._deltas.append(delta)
        kernels.publish(table.control, version, self._revision)

    def _wait_for_readers(self, version: int) -> None:
        """Wait until no frame reads a version older than that; frames are short."""
        waited_since = time.monotonic()
        while kernels.oldest_version_read(self.table.cells.readers) < version:
            time.sleep(PAUSE)
            if time.monotonic() - waited_since > PATIENCE:
                self.table.release_dead()
                waited_since = time.monotonic()


_NO_SPANS = np.empty((0, 2), dtype=np.int64)

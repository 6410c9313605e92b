"""The only writer of a cell table: makes slots, empty cells and the directory consistent.

A table has several copies of its directory. A frame reads one copy, the published version, from its
start to its end, so it never reads a part of a change. The writer changes the oldest copy after all
frames have left it, and publishes it as the next version in one step. Slots are used again when no
frame can read them any more.
"""

import time
from collections import deque
from typing import NamedTuple

import numpy as np

from hapticdb.kernels.records.cells import BUFFERS
from hapticdb.kernels.resident import cell_table as kernels
from hapticdb.kernels.resident.cells import EMPTY_SLOT, UNKNOWN
from hapticdb.resident.table import CellTable
from hapticdb.store.base import NO_KEYS, Keys

TIMEOUT = 0.02
"""Seconds of waiting for frames of old versions before the writer checks the processes of these
readers. Larger: a dead reader delays the writer longer."""
PAUSE = 5e-5
"""Seconds between two checks of the readers. A larger value delays each eviction; a smaller one
takes processor time from these frames."""
ROUNDS_KEPT = 4
"""Rounds without eviction after a cell's last request, if others can be evicted. Larger: a
returning tool finds its cells; in a small table fewer cells are left to evict."""


class CellSlots:
    """Slots of one table: free, filled, or retired until no frame can see them.

    Slot `EMPTY_SLOT` belongs to no cell: it represents all empty cells. n_filled : slots with a
    cell in the directory.
    """

    def __init__(self, table: CellTable) -> None:
        self._round = ROUNDS_KEPT
        self.n_filled = 0
        self._used = table.cells.used
        self._cell_of_slot = np.full(table.n_slots, UNKNOWN, dtype=np.int64)
        self._wanted_at = np.zeros(table.n_slots, dtype=np.int64)
        # descending: slots leave from the end, the lowest first
        self._free = list(range(table.n_slots - 1, EMPTY_SLOT, -1))
        self._retired: deque[tuple[int, list[int]]] = deque()
        self._clock_hand = 0

    @property
    def n_free(self) -> int:
        """Number of free slots."""
        return len(self._free)

    def cells(self) -> Keys:
        """Cells (n,) in slots."""
        return self._cell_of_slot[self._cell_of_slot >= 0]

    def begin_round(self) -> None:
        """Begin a round of requests."""
        self._round += 1

    def want(self, slots: Keys) -> None:
        """Protect cells in slots (n,) for `ROUNDS_KEPT` rounds; ignores EMPTY_SLOT and UNKNOWN."""
        self._wanted_at[slots[slots > EMPTY_SLOT]] = self._round

    # -- from free to filled ----------------------------------------------------------------------

    def next_free(self, count: int) -> Keys:
        """Return up to `count` free slots; they stay free until `take`."""
        count = min(count, len(self._free))
        return np.array(self._free[len(self._free) - count :], dtype=np.int64)

    def take(self, slots: Keys) -> None:
        """Remove slots (n,) from the free ones; they must be the result of `next_free`."""
        del self._free[len(self._free) - len(slots) :]

    def give_back(self, slots: Keys) -> None:
        """Free slots (n,) in use but in no directory; ignores EMPTY_SLOT."""
        self._free += slots[slots > EMPTY_SLOT].tolist()

    def fill(self, slots: Keys, cells: Keys) -> None:
        """Store the cells (n,) of slots (n,): used, and requested in this round."""
        self._cell_of_slot[slots] = cells
        self._wanted_at[slots] = self._round
        self._used[slots] = 1
        self.n_filled += len(slots)

    # -- from filled to free ----------------------------------------------------------------------

    def cells_to_evict(self, n_free: int, surplus: int) -> Keys:
        """Cells to evict for `n_free` free slots; fewer if all others are requested.

        The clock algorithm: cells without use since the hand's last pass leave first. If any must
        leave, `surplus` cells leave if possible. Cells requested in this round stay.
        """
        if self.n_free >= n_free:
            return np.empty(0, dtype=np.int64)
        wanted = max(n_free - self.n_free, surplus)
        out = np.empty(wanted, dtype=np.int64)
        count = 0
        # two passes of the clock: first cells that no recent round requested,
        # then all but this round's
        for since in (self._round - ROUNDS_KEPT, self._round):
            found, self._clock_hand = kernels.slots_to_free(
                self._cell_of_slot, self._wanted_at, self._used, since, self._clock_hand,
                wanted - count, out[count:],
            )  # fmt: skip
            count += found
            if self.n_free + count >= n_free:
                break
        return self._cell_of_slot[out[:count]]

    def clear(self, slots: list[int]) -> None:
        """Forget the cells of slots; the slots are not free yet, see `retire`."""
        self._cell_of_slot[slots] = UNKNOWN
        self.n_filled -= len(slots)

    def retire(self, slots: list[int], version: int) -> None:
        """Reserve cleared slots until no frame reads a version before `version`."""
        if slots:
            self._retired.append((version, slots))

    def free_retired(self, oldest_version_read: int) -> None:
        """Free the retired slots out of reach of running frames."""
        # epoch-based reclamation: versions ascend in the queue, so the first one decides
        while self._retired and self._retired[0][0] <= oldest_version_read:
            self._free += self._retired.popleft()[1]

    # -- after a failure --------------------------------------------------------------------------

    def take_over(self, cells: Keys, slots: Keys) -> None:
        """Continue with the cells (n,) of an earlier writer in slots (n,)."""
        self._cell_of_slot[slots] = cells
        self.n_filled = len(slots)
        self._free = [slot for slot in self._free if self._cell_of_slot[slot] == UNKNOWN]

    def free_lost(self) -> None:
        """Free the slots of a failed load."""
        retired = {slot for _, slots in self._retired for slot in slots}
        unnamed = np.flatnonzero(self._cell_of_slot == UNKNOWN).tolist()
        # a retired slot has no cell either, but a frame may still read it
        self._free = [slot for slot in unnamed if slot != EMPTY_SLOT and slot not in retired]

    def warm_up(self) -> None:
        """Compile the kernels of an eviction."""
        nothing = np.empty(0, dtype=np.int64)
        kernels.slots_to_free(self._cell_of_slot, self._wanted_at, self._used, 0, 0, 0, nothing)


class UnpublishedCells(NamedTuple):
    """Cells (n,) in slots (n,) in no directory yet, and the cost of reading them.

    The slot of an empty cell is EMPTY_SLOT.
    """

    cells: Keys = NO_KEYS
    slots: Keys = NO_KEYS
    n_rows: int = 0
    n_ranges: int = 0


class CellWriter:
    """The only writer of a table's cells.

    slots : of cells with voxels or distances; n_evicted : cells evicted so far.
    """

    def __init__(self, table: CellTable) -> None:
        self._table = table
        self.slots = CellSlots(table)
        self._empty: dict[int, None] = {}
        """Empty cells, oldest first."""
        self._most_empty = table.capacity // 2 - table.n_slots
        self._changes: deque[tuple[Keys, UnpublishedCells]] = deque(maxlen=BUFFERS - 1)
        """Cells removed and added with the last versions."""
        self._n_unknown_copies = 0
        self.n_evicted = 0

    @property
    def n_resident(self) -> int:
        """Number of cells with voxels or distances, each in a slot."""
        return self.slots.n_filled

    @property
    def n_empty(self) -> int:
        """Number of empty cells."""
        return len(self._empty)

    def known(self) -> Keys:
        """All resident and empty cells, (n,)."""
        return np.concatenate([self.slots.cells(), self._known_empty()])

    def _known_empty(self) -> Keys:
        return np.fromiter(self._empty, np.int64, len(self._empty))

    def slots_of(self, cells: Keys) -> Keys:
        """Slots (n,) of cells (n,) in the published version: UNKNOWN, EMPTY_SLOT, or a slot."""
        slots = np.empty(len(cells), dtype=np.int64)
        table, which = self._table.cells, self._table.version % BUFFERS
        kernels.slots_of_cells(table.keys, table.slots, which, cells, slots)
        return slots

    def entries(self) -> tuple[Keys, Keys]:
        """All cells (n,) of the published version, and their slots (n,)."""
        table, which = self._table.cells, self._table.version % BUFFERS
        filled = np.flatnonzero(table.keys[which] >= 0)
        return table.keys[which][filled], table.slots[which][filled].astype(np.int64)

    def take_over(self) -> None:
        """Continue with the last published cells of an ended writer."""
        cells, slots = self.entries()
        is_filled = slots > EMPTY_SLOT
        self.slots.take_over(cells[is_filled], slots[is_filled])
        self._empty.update(dict.fromkeys(cells[~is_filled].tolist()))
        self._n_unknown_copies = BUFFERS - 1  # only the published copy is complete
        # slots of older versions are free when no frame reads these versions
        self._wait_for_readers(self._table.version)

    def evict_for(self, n_free: int, surplus: int, urgent: Keys, revision: int) -> None:
        """Evict cells until `n_free` slots are free, but no requested cells.

        surplus : as for `CellSlots.cells_to_evict`; urgent, revision : as for `publish`.
        """
        self.slots.free_retired(self._oldest_version_read())
        leaving = self.slots.cells_to_evict(n_free, surplus)
        if len(leaving):
            self.n_evicted += len(leaving)
            # out of the directory first; the slots are free when no frame reads an older version
            self.publish(leaving, UnpublishedCells(), urgent, revision)
            self._wait_for_readers(self._table.version)
            self.slots.free_retired(self._oldest_version_read())

    def publish(self, leaving: Keys, read: UnpublishedCells, urgent: Keys, revision: int) -> None:
        """Remove cells and add others in one version; cells in both get new slots.

        urgent : last to be forgotten if too many are empty; revision : of the database,
        the same for all cells.
        """
        # before any change: the published directory still has the cells that leave
        slots = self.slots_of(leaving)
        for cell in leaving[slots == EMPTY_SLOT].tolist():
            self._empty.pop(cell, None)
        cleared: list[int] = slots[slots > EMPTY_SLOT].tolist()
        self.slots.clear(cleared)
        is_filled = read.slots > EMPTY_SLOT
        new_empty = read.cells[~is_filled].tolist()
        forgotten = self._forget_for(len(new_empty), urgent)
        self.slots.fill(read.slots[is_filled], read.cells[is_filled])
        # before the publication: a mirror that sees the version must also see its slots
        self._table.filled[read.slots[is_filled]] = self._table.version + 1
        self._empty.update(dict.fromkeys(new_empty))
        self._publish(np.concatenate([leaving, forgotten]), read, revision)
        # after it: only now no new frame can find them
        self.slots.retire(cleared, self._table.version)

    def _publish(self, leaving: Keys, read: UnpublishedCells, revision: int) -> None:
        """Publish the next version of the directory."""
        version = self._table.version + 1
        # the buffer of the next version is that of BUFFERS versions ago: no frame may read it now
        self._wait_for_readers(version - BUFFERS + 1)
        table, which = self._table.cells, version % BUFFERS
        # this buffer is BUFFERS versions old: all changes since are applied again,
        # so no table is copied
        changes = (*self._changes, (leaving, read))
        if self._n_unknown_copies:
            self._n_unknown_copies -= 1
            # after a take-over the changes are unknown: a whole copy, once for each other buffer
            table.keys[which] = table.keys[(version - 1) % BUFFERS]
            table.slots[which] = table.slots[(version - 1) % BUFFERS]
            changes = changes[-1:]
        for gone, new in changes:
            kernels.remove_cells(table.keys, table.slots, which, gone)
            kernels.insert_cells(table.keys, table.slots, which, new.cells, new.slots)
        self._changes.append((leaving, read))
        # the one write that shows the new directory: until then readers use the old one
        kernels.publish(table.control, version, revision)

    def _forget_for(self, n_new: int, urgent: Keys) -> Keys:
        """Forget empty cells to make room for `n_new` others; returns them.

        If there is room, no cell is removed. Otherwise the oldest leave, and an eighth of the limit
        more than necessary, so this happens seldom. Urgent cells (U,), most urgent first,
        leave only if the other cells are not enough; the least urgent ones leave first.
        """
        surplus = len(self._empty) + n_new - self._most_empty
        if surplus <= 0:
            return NO_KEYS
        known = self._known_empty()
        # insertion order of the dict: the oldest first
        others = known[~np.isin(known, urgent)]
        oldest_kept = urgent[::-1][np.isin(urgent[::-1], known)]
        n_leaving = max(surplus, min(surplus + self._most_empty // 8, len(others)))
        leaving = np.concatenate([others, oldest_kept])[:n_leaving]
        for cell in leaving.tolist():
            self._empty.pop(cell, None)
        return leaving

    def _oldest_version_read(self) -> int:
        """Oldest version in use by a frame; a very large number if no frame runs."""
        return int(kernels.oldest_version_read(self._table.cells.readers))

    def _wait_for_readers(self, version: int) -> None:
        """Wait until no frame reads a version older than `version`; a frame takes microseconds."""
        waited_since = time.monotonic()
        while self._oldest_version_read() < version:
            time.sleep(PAUSE)
            # a killed reader keeps its version for ever: look for dead processes
            if time.monotonic() - waited_since > TIMEOUT:
                self._table.release_dead()
                waited_since = time.monotonic()

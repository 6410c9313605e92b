"""The only writer of a cell table: keeps slots, empty cells and the directory consistent.

Every change is published as one version of the directory; a frame never reads a part of a change.
Slots and copies of the directory are used again when no frame can read them any more.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from hapticdb.kernels.resident.cells import EMPTY_SLOT
from hapticdb.resident.directory import CellDirectory, DirectoryChange
from hapticdb.resident.slots import CellSlots
from hapticdb.resident.table import CellTable
from hapticdb.store.base import NO_KEYS, Keys


class UnpublishedCells(NamedTuple):
    """Cells (n,) in slots (n,) that are in no directory yet, and the cost of reading them.

    The slot of a cell that is empty is EMPTY_SLOT.
    """

    cells: Keys = NO_KEYS
    slots: Keys = NO_KEYS
    n_rows: int = 0
    n_ranges: int = 0


class EmptyCells:
    """Cells known to be empty, oldest first.

    Parameters
    ----------
    limit : int
        Greatest number of cells.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._cells: dict[int, None] = {}

    def __len__(self) -> int:
        """Count the cells."""
        return len(self._cells)

    def keys(self) -> Keys:
        """All cells, (n,) int64, oldest first."""
        return np.fromiter(self._cells, np.int64, len(self._cells))

    def add(self, cells: Iterable[int]) -> None:
        """Add cells, after `forget_for` has made room for them."""
        self._cells.update(dict.fromkeys(cells))

    def discard(self, cells: Iterable[int]) -> None:
        """Remove cells; unknown ones are ignored."""
        for cell in cells:
            self._cells.pop(cell, None)

    def forget_for(self, n_new: int, urgent: Keys) -> Keys:
        """Remove cells so that `n_new` others have room; returns the removed ones.

        If there is room, no cell is removed. Otherwise the oldest leave, and an eighth of the limit
        more than necessary, so that this happens seldom. Urgent cells (U,), most urgent first,
        leave only if the other cells are not enough; the least urgent ones leave first.
        """
        surplus = len(self._cells) + n_new - self._limit
        if surplus <= 0:
            return NO_KEYS
        known = self.keys()
        others = known[~np.isin(known, urgent)]
        kept_longest = urgent[::-1][np.isin(urgent[::-1], known)]
        n_leaving = max(surplus, min(surplus + self._limit // 8, len(others)))
        leaving = np.concatenate([others, kept_longest])[:n_leaving]
        self.discard(leaving.tolist())
        return leaving


class CellWriter:
    """The only writer of a table's cells.

    Parameters
    ----------
    table : CellTable
        The table; it has no other writer.

    Attributes
    ----------
    slots : CellSlots
        Cells with voxels or distances.
    empty : EmptyCells
        Cells without any.
    directory : CellDirectory
        Published map of both, for frames.
    n_evicted : int
        Number of cells evicted so far.
    """

    def __init__(self, table: CellTable) -> None:
        self._filled = table.filled
        self.slots = CellSlots(table)
        self.empty = EmptyCells(table.capacity // 2 - table.n_slots)
        self.directory = CellDirectory(table)
        self.n_evicted = 0

    @property
    def n_resident(self) -> int:
        """Number of cells with voxels or distances, each in a slot."""
        return self.slots.n_filled

    @property
    def n_empty(self) -> int:
        """Number of cells known to be empty."""
        return len(self.empty)

    def known(self) -> Keys:
        """All resident and empty cells, (n,)."""
        return np.concatenate([self.slots.cells(), self.empty.keys()])

    def take_over(self) -> None:
        """Continue with the cells that an earlier writer, which has ended, published last."""
        cells, slots = self.directory.entries()
        is_filled = slots > EMPTY_SLOT
        self.slots.take_over(cells[is_filled], slots[is_filled])
        self.empty.add(cells[~is_filled].tolist())
        self.directory.take_over()
        # slots of older versions are free when no frame reads these versions
        self.directory.wait_for_readers(self.directory.version)

    def evict_for(self, n_free: int, surplus: int, urgent: Keys, revision: int) -> None:
        """Evict cells until `n_free` slots are free, but keep cells that are still wanted.

        surplus : as for `CellSlots.cells_to_evict`; urgent, revision : as for `publish`.
        """
        self.slots.free_retired(self.directory.oldest_version_read())
        leaving = self.slots.cells_to_evict(n_free, surplus)
        if len(leaving):
            self.n_evicted += len(leaving)
            self.publish(leaving, UnpublishedCells(), urgent, revision)
            self.directory.wait_for_readers(self.directory.version)
            self.slots.free_retired(self.directory.oldest_version_read())

    def publish(self, leaving: Keys, read: UnpublishedCells, urgent: Keys, revision: int) -> None:
        """Remove cells and add others in one version; cells in both get new slots.

        urgent : cells that are forgotten last if too many are empty; revision : of the database,
        the same for all cells.
        """
        slots = self.directory.slots_of(leaving)
        self.empty.discard(leaving[slots == EMPTY_SLOT].tolist())
        cleared: list[int] = slots[slots > EMPTY_SLOT].tolist()
        self.slots.clear(cleared)
        is_filled = read.slots > EMPTY_SLOT
        new_empty = read.cells[~is_filled].tolist()
        forgotten = self.empty.forget_for(len(new_empty), urgent)
        self.slots.fill(read.slots[is_filled], read.cells[is_filled])
        self._filled[read.slots[is_filled]] = self.directory.version + 1
        self.empty.add(new_empty)
        change = DirectoryChange(np.concatenate([leaving, forgotten]), read.cells, read.slots)
        self.directory.publish(change, revision)
        self.slots.retire(cleared, self.directory.version)

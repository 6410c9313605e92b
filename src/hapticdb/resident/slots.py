"""The slots of a cell table, as its only writer uses them: their cells, and evictions."""

from collections import deque

import numpy as np

from hapticdb.kernels.resident import cell_table as kernels
from hapticdb.kernels.resident.cells import EMPTY_SLOT, UNKNOWN
from hapticdb.resident.table import CellTable
from hapticdb.store.base import Keys

ROUNDS_KEPT = 4
"""Rounds in which a wanted cell is not evicted if others can be. A larger value keeps the cells of
a tool that turns back; in a small table it leaves fewer cells to evict."""


class CellSlots:
    """Slots of one table: free, filled, or retired until no frame can see them.

    Slot `EMPTY_SLOT` belongs to no cell: it represents all cells that are known to be empty.

    Attributes
    ----------
    n_filled : int
        Number of slots with a cell in the directory.
    """

    def __init__(self, table: CellTable) -> None:
        self._round = ROUNDS_KEPT
        self.n_filled = 0
        self._used = table.cells.used
        self._cell_of_slot = np.full(table.n_slots, UNKNOWN, dtype=np.int64)
        self._wanted_at = np.zeros(table.n_slots, dtype=np.int64)
        self._free = list(range(table.n_slots - 1, EMPTY_SLOT, -1))
        self._retired: deque[tuple[int, list[int]]] = deque()
        self._clock_hand = 0

    @property
    def n_free(self) -> int:
        """Number of slots that a cell can be read into now."""
        return len(self._free)

    def cells(self) -> Keys:
        """Cells (n,) in slots."""
        return self._cell_of_slot[self._cell_of_slot >= 0]

    def begin_round(self) -> None:
        """Begin a round of wanted cells."""
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
        """Free slots (n,) that were taken but are in no directory; ignores EMPTY_SLOT."""
        self._free += slots[slots > EMPTY_SLOT].tolist()

    def fill(self, slots: Keys, cells: Keys) -> None:
        """Store the cells (n,) of slots (n,); they count as used, and as wanted in this round."""
        self._cell_of_slot[slots] = cells
        self._wanted_at[slots] = self._round
        self._used[slots] = 1
        self.n_filled += len(slots)

    # -- from filled to free ----------------------------------------------------------------------

    def cells_to_evict(self, n_free: int, surplus: int) -> Keys:
        """Cells to evict so that `n_free` slots are free; fewer if all others are wanted.

        The clock algorithm: cells that no frame has used since the hand last passed leave first.
        If any must leave, `surplus` cells leave if possible. Cells wanted in this round stay.
        """
        if self.n_free >= n_free:
            return np.empty(0, dtype=np.int64)
        wanted = max(n_free - self.n_free, surplus)
        out = np.empty(wanted, dtype=np.int64)
        count = 0
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
        """Free the retired slots that no running frame can read."""
        while self._retired and self._retired[0][0] <= oldest_version_read:
            self._free += self._retired.popleft()[1]

    # -- after a failure --------------------------------------------------------------------------

    def take_over(self, cells: Keys, slots: Keys) -> None:
        """Continue with the cells (n,) that an earlier writer has left in slots (n,)."""
        self._cell_of_slot[slots] = cells
        self.n_filled = len(slots)
        self._free = [slot for slot in self._free if self._cell_of_slot[slot] == UNKNOWN]

    def free_lost(self) -> None:
        """Free the slots that were taken for a load which then failed."""
        retired = {slot for _, slots in self._retired for slot in slots}
        unnamed = np.flatnonzero(self._cell_of_slot == UNKNOWN).tolist()
        self._free = [slot for slot in unnamed if slot != EMPTY_SLOT and slot not in retired]

    def warm_up(self) -> None:
        """Compile the kernels that an eviction calls."""
        nothing = np.empty(0, dtype=np.int64)
        kernels.slots_to_free(self._cell_of_slot, self._wanted_at, self._used, 0, 0, 0, nothing)

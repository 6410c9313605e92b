"""The slots of a cell table, seen from its one writer: which cell is where, and which leaves."""

from collections import deque

import numpy as np

from hapticdb.kernels.resident import cell_table as kernels
from hapticdb.kernels.resident.cells import EMPTY_SLOT, UNKNOWN
from hapticdb.resident.table import CellTable
from hapticdb.store.base import Keys

ROUNDS_KEPT = 4
"""Rounds for which a wanted cell is not evicted, as long as others can be. A larger value keeps the
cells of a tool that turns back; in a small table it leaves less to evict."""


class CellSlots:
    """Slots of one table: free, filled, or retired until no frame can see them.

    Slot `EMPTY_SLOT` belongs to no cell: it stands for all that are known to be empty.

    Attributes
    ----------
    n_filled : int
        Slots with a cell that the directory names.
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
        """Slots that a cell can be read into now."""
        return len(self._free)

    def cells(self) -> Keys:
        """Cells (n,) in slots."""
        return self._cell_of_slot[self._cell_of_slot >= 0]

    def begin_round(self) -> None:
        """Begin a round in which wanted cells are named anew."""
        self._round += 1

    def want(self, slots: Keys) -> None:
        """Keep the cells of slots (n,) for `ROUNDS_KEPT` rounds; ignores EMPTY_SLOT and UNKNOWN."""
        self._wanted_at[slots[slots > EMPTY_SLOT]] = self._round

    # -- from free to filled ----------------------------------------------------------------------

    def next_free(self, count: int) -> Keys:
        """Slots that are free, `count` of them at most. They stay free until `take`."""
        count = min(count, len(self._free))
        return np.array(self._free[len(self._free) - count :], dtype=np.int64)

    def take(self, slots: Keys) -> None:
        """Take slots (n,), just as `next_free` gave them, out of the free ones."""
        del self._free[len(self._free) - len(slots) :]

    def give_back(self, slots: Keys) -> None:
        """Free slots (n,) that were taken and that no directory has named; ignores EMPTY_SLOT."""
        self._free += slots[slots > EMPTY_SLOT].tolist()

    def fill(self, slots: Keys, cells: Keys) -> None:
        """Note the cells (n,) of slots (n,). They count as used, and as wanted in this round."""
        self._cell_of_slot[slots] = cells
        self._wanted_at[slots] = self._round
        self._used[slots] = 1
        self.n_filled += len(slots)

    # -- from filled to free ----------------------------------------------------------------------

    def cells_to_evict(self, n_free: int, surplus: int) -> Keys:
        """Cells that may leave so that `n_free` slots are free; fewer where all others are wanted.

        Cells that no frame has used since the clock's hand last passed leave first. If any must
        leave, `surplus` leave where so many can. Cells wanted in the present round stay.
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
        """Forget the cells of slots. They are not free yet: see `retire`."""
        self._cell_of_slot[slots] = UNKNOWN
        self.n_filled -= len(slots)

    def retire(self, slots: list[int], version: int) -> None:
        """Keep cleared slots back until no frame reads a version before that one."""
        if slots:
            self._retired.append((version, slots))

    def free_retired(self, oldest_version_read: int) -> None:
        """Free the retired slots that no frame can see any more."""
        while self._retired and self._retired[0][0] <= oldest_version_read:
            self._free += self._retired.popleft()[1]

    # -- after a failure --------------------------------------------------------------------------

    def take_over(self, cells: Keys, slots: Keys) -> None:
        """Go on with the cells (n,) that another writer has left in slots (n,)."""
        self._cell_of_slot[slots] = cells
        self.n_filled = len(slots)
        self._free = [slot for slot in self._free if self._cell_of_slot[slot] == UNKNOWN]

    def free_lost(self) -> None:
        """Free the slots that were taken for a load which then failed."""
        retired = {slot for _, slots in self._retired for slot in slots}
        unnamed = np.flatnonzero(self._cell_of_slot == UNKNOWN).tolist()
        self._free = [slot for slot in unnamed if slot != EMPTY_SLOT and slot not in retired]

    def warm_up(self) -> None:
        """Compile what an eviction calls."""
        nothing = np.empty(0, dtype=np.int64)
        kernels.slots_to_free(self._cell_of_slot, self._wanted_at, self._used, 0, 0, 0, nothing)

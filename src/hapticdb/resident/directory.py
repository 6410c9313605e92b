"""The directory of a cell table, as its only writer uses it.

A table has several copies of its directory. A frame reads one copy, the published version, from its
start to its end. The writer changes the oldest copy after all frames have left it, and publishes it
as the next version in one step.
"""

import time
from collections import deque
from typing import NamedTuple

import numpy as np

from hapticdb.kernels.resident import cell_table as kernels
from hapticdb.kernels.resident.cells import BUFFERS
from hapticdb.resident.table import CellTable
from hapticdb.store.base import Keys

PATIENCE = 0.02
"""Seconds that the writer waits for frames of old versions before it checks whether the processes
of these readers still run. A larger value delays the writer longer after a reader has died."""
PAUSE = 5e-5
"""Seconds between two checks of the readers. A larger value delays each eviction; a smaller one
takes processor time from the frames that the writer waits for."""


class DirectoryChange(NamedTuple):
    """Changes of one version: cells (G,) that leave, and cells (n,) that come, with their slots.

    A cell in both gets a new slot.
    """

    leaving: Keys
    cells: Keys
    slots: Keys


class CellDirectory:
    """Map from cells to slots, in successive versions.

    Parameters
    ----------
    table : CellTable
        The table; its directory has no other writer.
    """

    def __init__(self, table: CellTable) -> None:
        self._table = table
        self._changes: deque[DirectoryChange] = deque(maxlen=BUFFERS - 1)
        self._n_unknown_copies = 0

    @property
    def version(self) -> int:
        """Number of the published version."""
        return self._table.version

    def slots_of(self, cells: Keys) -> Keys:
        """Slots (n,) of cells (n,) in the published version: UNKNOWN, EMPTY_SLOT, or a slot."""
        slots = np.empty(len(cells), dtype=np.int64)
        table = self._table.cells
        kernels.slots_of_cells(table.keys, table.slots, self.version % BUFFERS, cells, slots)
        return slots

    def entries(self) -> tuple[Keys, Keys]:
        """All cells (n,) of the published version, and their slots (n,)."""
        table, which = self._table.cells, self.version % BUFFERS
        filled = np.flatnonzero(table.keys[which] >= 0)
        return table.keys[which][filled], table.slots[which][filled].astype(np.int64)

    def take_over(self) -> None:
        """Continue after another writer has ended: only its published copy is complete."""
        self._n_unknown_copies = BUFFERS - 1

    def publish(self, change: DirectoryChange, revision: int) -> None:
        """Publish the next version, with the database's revision of its cells."""
        version = self.version + 1
        self.wait_for_readers(version - BUFFERS + 1)
        table, which = self._table.cells, version % BUFFERS
        changes = (*self._changes, change)
        if self._n_unknown_copies:
            self._n_unknown_copies -= 1
            table.keys[which] = table.keys[(version - 1) % BUFFERS]
            table.slots[which] = table.slots[(version - 1) % BUFFERS]
            changes = (change,)
        for one in changes:
            kernels.remove_cells(table.keys, table.slots, which, one.leaving)
            kernels.insert_cells(table.keys, table.slots, which, one.cells, one.slots)
        self._changes.append(change)
        kernels.publish(table.control, version, revision)

    def oldest_version_read(self) -> int:
        """Oldest version that a frame is reading; a very large number if no frame runs."""
        return int(kernels.oldest_version_read(self._table.cells.readers))

    def wait_for_readers(self, version: int) -> None:
        """Wait until no frame reads a version older than `version`; a frame takes microseconds."""
        waited_since = time.monotonic()
        while self.oldest_version_read() < version:
            time.sleep(PAUSE)
            if time.monotonic() - waited_since > PATIENCE:
                self._table.release_dead()
                waited_since = time.monotonic()

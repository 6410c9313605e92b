"""A copy of a cell table in the memory of a graphics processor."""

from typing import Any

import numpy as np
from numba import cuda
from numpy.typing import NDArray

from hapticdb.errors import UsageError
from hapticdb.kernels.field.distance_law import DistanceFieldLaw
from hapticdb.kernels.field.lattice import BEYOND
from hapticdb.kernels.force_law import reads_distances
from hapticdb.kernels.records.cells import BUFFERS
from hapticdb.kernels.resident.cells import (
    CELL_WORDS,
    EMPTY_SLOT,
    UNKNOWN,
    Cells,
    Seen,
)
from hapticdb.resident.table import CellTable

MOST_LISTED = 1 << 21
"""Most cells of a grid for a list of all of them on the GPU, 8 MB: one access finds a slot. Larger:
larger grids are listed, and the list is copied at each change of cells."""


class CellMirror:
    """The cells of a table on the GPU: changed slots are copied, the directory whole.

    It has as many slots as the table, so evicted cells leave the GPU, too, and unknown cells are
    unknown there. The table's writer may use it, and a reader within a frame.

    law : of the frames that read it, in the kernels' form; side : voxels of the grid on each axis,
    None for the queries of a hand, with directory, masks and payload alone. arrays : keys, slots,
    words, gate and payload, as `kernels.gpu.gpu_frames.frames_under` takes them; n_copied : slots
    copied so far. Raises UsageError if the table is larger than the GPU's free memory.
    """

    def __init__(self, table: CellTable, law: object, side: int | None) -> None:
        self._table = table
        self._law = law
        self._version = 0
        self._directory: tuple[int, tuple[Any, ...]] = -1, ()
        self._has_words = side is not None
        self.n_copied = 0
        self._has_distances = reads_distances(law)
        n_slots = table.n_slots
        free = cuda.current_context().get_memory_info()[0]
        if free < table.size_bytes:
            raise UsageError(
                f"a budget of {table.size_bytes} bytes for resident cells: the GPU has {free} free"
            )
        across = -(-(side or 0) // 32)
        self._across = across if across**3 <= MOST_LISTED else 0
        n_listed = self._across**3 or table.capacity
        values = table.cells.payload
        n_words = n_slots if self._has_words else 1
        words = cuda.to_device(np.zeros((n_words, CELL_WORDS), np.uint32))
        gate, payload = words, cuda.to_device(np.full((1, 1), BEYOND, np.uint8))
        if self._has_distances and values is not None:
            gate = cuda.to_device(np.zeros((n_words, CELL_WORDS), np.uint32))
            payload = cuda.device_array(values.shape, np.uint8)
        self.arrays = (
            cuda.device_array((1, 1 if self._across else n_listed), np.int64),
            cuda.device_array((1, n_listed), np.int32),
            words,
            gate,
            payload,
        )

    def update(self, version: int | None = None) -> int:
        """Copy the changes since the last time; returns the number of copied slots.

        version: of the directory of a reader's frame; None: the newest. No kernel may read
        the arrays meanwhile.
        """
        version = version or self._table.version
        if version == self._version:
            return 0
        cells, which = self._table.cells, version % BUFFERS
        keys, slots, words, gate, payload = self.arrays
        # a dense list costs one access a lookup; the hash table of a large grid needs probes
        if self._across:
            slots.copy_to_device(self._listed(cells, which))
        else:
            keys.copy_to_device(np.ascontiguousarray(cells.keys[which : which + 1]))
            slots.copy_to_device(np.ascontiguousarray(cells.slots[which : which + 1]))
        # by version, not by content: a slot is written once for each cell in it
        is_new = self._table.filled > self._version
        # shared by all empty cells and never written
        is_new[EMPTY_SLOT] = False
        # neighbours in one copy: each has the fixed cost of a transfer
        runs = _runs_of(np.flatnonzero(is_new))
        for first, end in runs:
            if self._has_distances and cells.payload is not None:
                payload[first:end].copy_to_device(cells.payload[first:end])
            if self._has_words:
                words[first:end].copy_to_device(cells.words[first:end])
                if self._has_distances and cells.payload is not None:
                    gate[first:end].copy_to_device(self._gate_of(cells, slice(first, end)))
        self._version = version
        n_slots = sum(end - first for first, end in runs)
        self.n_copied += n_slots
        return n_slots

    def seen(self) -> Seen:
        """Voxels of the copied cells, in the form for searches.

        The arrays are the same each time; kernels write `used`.
        """
        version, arrays = self._directory
        if version != self._version:
            cells, which = self._table.cells, slice(self._version % BUFFERS, None)
            found: list[NDArray[Any]] = [cells.masks]
            if self._across:
                found += [cells.keys[which][:1], cells.slots[which][:1]]
            parts = [np.ascontiguousarray(one) for one in found]
            # made once: a recorded launch keeps their addresses
            if not arrays:
                made = [cuda.device_array(one.shape, one.dtype) for one in parts]
                keys, slots = made[1:] or self.arrays[:2]
                arrays = keys, slots, made[0], cuda.device_array(self._table.n_slots, np.uint8)
            for array, part in zip((arrays[2], *arrays[:2]), parts, strict=False):
                array.copy_to_device(part)
            self._directory = self._version, arrays
        keys, slots, masks, used = arrays
        return Seen(keys, slots, self.arrays[2], masks, used, 0)

    def _listed(self, cells: Cells, which: int) -> NDArray[np.int32]:
        """Slots (1, n) of all cells of the grid, in the published directory."""
        found = np.full((1, self._across**3), UNKNOWN, np.int32)
        filled = np.flatnonzero(cells.keys[which] >= 0)
        of_cells = cells.keys[which][filled]
        i, j, k = of_cells >> 32, (of_cells >> 16) & 0xFFFF, of_cells & 0xFFFF  # `key_of_cell`
        found[0, (i * self._across + j) * self._across + k] = cells.slots[which][filled]
        return found

    def _gate_of(self, cells: Cells, part: slice) -> NDArray[np.uint32]:
        """Voxels of slots with possible contacts: a frame reads no distances elsewhere."""
        if isinstance(self._law, DistanceFieldLaw) and cells.near is not None:
            return cells.near[part]
        voxels = np.zeros((len(cells.masks[part]), CELL_WORDS), np.uint32)  # of the marked bricks
        columns = np.arange(CELL_WORDS)
        shifts = ((columns >> 8) << 4 | ((columns >> 3) & 3) << 2).astype(np.uint64)
        for brick in range(4):
            is_marked = (cells.masks[part, None] >> (shifts + np.uint64(brick))) & np.uint64(1)
            voxels |= is_marked.astype(np.uint32) * np.uint32(0xFF << 8 * brick)
        return voxels


def _runs_of(slots: NDArray[np.int64]) -> list[tuple[int, int]]:
    """First slot and end of each run of neighbours in slots (n,), ascending."""
    if not len(slots):
        return []
    breaks = np.flatnonzero(np.diff(slots) > 1) + 1
    firsts = slots[np.concatenate([[0], breaks])]
    ends = slots[np.concatenate([breaks - 1, [-1]])] + 1
    return list(zip(firsts.tolist(), ends.tolist(), strict=True))

"""Resident cells: voxels in shared memory, read by frames without waiting for a database.

A cell has 32^3 voxels in 1024 words: word ``(i & 31) << 5 | (j & 31)``, bit ``k & 31``. A
directory, an open-addressing hash table, maps a cell to its slot. Slot 0 is always empty, and the
slot of every empty cell; a cell without an entry is *unknown*. Each slot also has a 64-bit mask of
its 4^3 bricks; the bit of a brick with a voxel is set.

A table with distances also has, for each slot, the least distance of all objects at 34^3 voxel
centres: the cell's own and one more on each side (`hapticdb.kernels.field.lattice`). There a brick
with a row of the band has its bit, too, and a cell without a voxel takes a slot. A second array of
words, `near`, has a bit for each voxel in range of the distance law (`near_voxels`): a frame tests
one bit there before it interpolates distances.

Directories are published in versions, in three buffers in turn. A frame announces its version and
reads no other, so never a half-changed directory. The writing process reuses a buffer or a slot
only when no frame can still read it (`hapticdb.resident.table`).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import (
    BYTES,
    BYTES2,
    FLOAT,
    FLOATS,
    FLOATS2,
    INT,
    INTS2,
    INTS32_2,
    NONE,
    WORDS,
    WORDS32_2,
    fields_of,
    inlined,
    leaf,
    record_of,
)
from hapticdb.kernels.records.cells import BUFFERS, CONTROL, MOST_MISSED, READER
from hapticdb.kernels.resident.fence import fence
from hapticdb.kernels.rigid import moved

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

CELL_WORDS = 1024
UNKNOWN = -1
EMPTY_SLOT = 0
GROUP, BLOCK = 4, 64
"""Runs in a group and in a block, culled by one bounding sphere. Larger: culled less often."""


class Cells(NamedTuple):
    """Cell table in shared memory, laid out by `hapticdb.resident.table.CellTable`.

    control () of CONTROL; readers (R,) of READER : read leases;
    keys (3, capacity) int64 and slots (3, capacity) int32 : directories; words (slots, 1024)
    uint32; masks (slots,) uint64; used (slots,) uint8 : set by frames at a read of the slot;
    payload (slots, 34^3) uint8 : stored distances, all BEYOND in slot 0; near (slots, 1024)
    uint32 : voxels in range of the distance law. The last two are None in a table without
    distances.
    """

    control: NDArray[np.void]
    readers: NDArray[np.void]
    keys: NDArray[np.int64]
    slots: NDArray[np.int32]
    words: NDArray[np.uint32]
    masks: NDArray[np.uint64]
    used: NDArray[np.uint8]
    payload: NDArray[np.uint8] | None = None
    near: NDArray[np.uint32] | None = None

    def without_distances(self) -> "Cells":
        """The same cells for kernels that read voxels alone: they are compiled for None here."""
        return self._replace(payload=None, near=None)


_ALL = record_of(CONTROL), record_of(READER, 1), INTS2, INTS32_2, WORDS32_2, WORDS, BYTES
CELLS = fields_of(Cells, *_ALL, NONE, NONE)
CELLS_WITH_DISTANCES = fields_of(Cells, *_ALL, BYTES2, WORDS32_2)


class Seen(NamedTuple):
    """Voxels for one frame: arrays of `Cells`, and the number of its directory.

    words : of the occupied voxels, or of the near ones (`near_voxels`).
    """

    keys: NDArray[np.int64]
    slots: NDArray[np.int32]
    words: NDArray[np.uint32]
    masks: NDArray[np.uint64]
    used: NDArray[np.uint8]
    which: int


class CellGrid(NamedTuple):
    """Grid for kernels: origin x, y, z and voxel size in metres, voxels on each axis (side)."""

    x: float
    y: float
    z: float
    size: float
    side: float


CELL_GRID = fields_of(CellGrid, FLOAT, FLOAT, FLOAT, FLOAT, FLOAT)


SCRATCH_ROWS = 24
"""Rows of `Clusters.scratch`, named in `runs.Scratch`."""


class Clusters(NamedTuple):
    """Point shell for frames: runs of points, with bounding spheres.

    points (N, 6) : metres and inward normals, tool frame, in the order of the shell; center (3,);
    spheres (C, 4) : centre and radius, metres, of each run of `run` points, or (0, 4) for none;
    groups (G + B, 4) : the same of each group of `GROUP` runs, then of each block if there are
    `BLOCK` runs; columns (3, N) : the points again, a row for each axis; scratch (SCRATCH_ROWS,
    run) : memory for one placed run, separate for each thread.
    """

    points: Floats
    center: Floats
    spheres: Floats
    groups: Floats
    run: int
    columns: Floats
    scratch: Floats


CLUSTERS = fields_of(Clusters, FLOATS2, FLOATS, FLOATS2, FLOATS2, INT, FLOATS2, FLOATS2)


@leaf
def n_runs_of(shell):
    """Number of a shell's runs; the last may be shorter."""
    return (shell.points.shape[0] + shell.run - 1) // shell.run


@leaf
def key_of_cell(ci, cj, ck):
    """Directory key of cell (ci, cj, ck): 16 bits each for cj and ck, the upper bits for ci."""
    return (ci << 32) | (cj << 16) | ck


@leaf
def cell_key(i, j, k):
    """Directory key of the cell of voxel (i, j, k)."""
    return key_of_cell(i >> 5, j >> 5, k >> 5)


@inlined
def cells_of_box(x, y, z, reach, side):
    """First and last cell on each axis, i, j, k, of a cube's part in the grid.

    (x, y, z), reach : the cube's centre and half its side, voxels. First coordinates are clamped to
    the grid before they become integers: the largest floats exceed int64.
    """
    top = side - 1.0
    return (
        np.int64(min(max(x - reach, 0.0), side)) >> 5, np.int64(min(x + reach, top)) >> 5,
        np.int64(min(max(y - reach, 0.0), side)) >> 5, np.int64(min(y + reach, top)) >> 5,
        np.int64(min(max(z - reach, 0.0), side)) >> 5, np.int64(min(z + reach, top)) >> 5,
    )  # fmt: skip


@inlined
def in_voxels(transform, grid, x, y, z):
    """Point of the tool, metres, transformed by a pose, in voxels from the grid's origin."""
    x, y, z = moved(transform, x, y, z)
    return (x - grid.x) / grid.size, (y - grid.y) / grid.size, (z - grid.z) / grid.size


@leaf
def column_of(i, j):
    """Index in its cell of the word with voxel (i, j, k), for any k."""
    return ((i & 31) << 5) | (j & 31)


@leaf
def bit_in(word, k):
    """Bit of voxel (i, j, k) in its word, 0 or 1."""
    return (word >> np.uint32(k & 31)) & 1


@leaf
def brick_bit(i, j, k):
    """Bit number, in its cell's mask, of the brick with voxel (i, j, k)."""
    return np.uint64((((i >> 3) & 3) << 4) | (((j >> 3) & 3) << 2) | ((k >> 3) & 3))


@leaf
def spread_key(key, capacity):
    """First index of a key's probe sequence in a table of that capacity, a power of two."""
    # Fibonacci hashing (Knuth, volume 3, section 6.4); the fold mixes the upper axis in
    return (((key ^ (key >> 29)) * 0x9E3779B97F4A7C1) >> 20) & (capacity - 1)


@inlined
def place_in_set(found, key):
    """Index of a key in found (capacity,), an open-addressing set; the free index for a new key."""
    capacity = found.shape[0]
    at = spread_key(key, capacity)
    # terminates: a set is never full
    while found[at] >= 0 and found[at] != key:
        at = (at + 1) & (capacity - 1)
    return at


@inlined
def slot_of(keys, slots, which, key):
    """Slot of a cell in directory `which`, or UNKNOWN."""
    capacity = keys.shape[1]
    at = spread_key(key, capacity)
    # linear probing: the first free entry proves the cell unknown
    while keys[which, at] >= 0:
        if keys[which, at] == key:
            return np.int64(slots[which, at])
        at = (at + 1) & (capacity - 1)
    return np.int64(UNKNOWN)


@inlined
def seen_in(cells, which, words):
    """Words of voxels for a frame in directory `which`; for leaves, not for entries."""
    return Seen(cells.keys, cells.slots, words, cells.masks, cells.used, which)


@leaf
def begin_frame(cells, reader):
    """Announce a frame of a reader; return its directory, valid until `end_frame`."""
    control, lease = cells.control[()], cells.readers[reader]
    while True:
        version = control.version
        # hazard pointer: announce, then verify; a writer that missed it has a newer version here
        lease.version = version
        fence()
        # else the buffer may already be in reuse: announce the newer version
        if control.version == version:
            which = version % BUFFERS
            lease.revision = control.revisions[which]
            return which


@leaf
def end_frame(cells, reader):
    """End the frame that `begin_frame` announced; its directory may be reused."""
    # all reads of the directory end before the lease does
    fence()
    cells.readers[reader].version = 0


@inlined
def with_missed(missed, count, key):
    """Add an unknown cell to a MISSED, unless present or the list is full; return its length."""
    # linear search: the list has at most MOST_MISSED cells
    for n in range(count):
        if missed.cells[n] == key:
            return count
    if count < MOST_MISSED:
        missed.cells[count] = key
        return count + 1
    return count


@inlined
def enter_cell(seen, key, missed, n_missed):
    """Slot and mask of a cell, and the length of the list `missed` of unknown cells.

    The slot is marked as used. The mask of an empty or unknown cell is zero.
    """
    slot = slot_of(seen.keys, seen.slots, seen.which, key)
    mask = np.uint64(0)
    if slot > EMPTY_SLOT:
        seen.used[slot] = 1  # for the clock eviction
        mask = seen.masks[slot]
    elif slot < 0:
        n_missed = with_missed(missed, n_missed, key)
    return slot, mask, n_missed

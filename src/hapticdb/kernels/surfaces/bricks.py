"""Bricks under construction: hash table from packed brick key to 512 bits of occupancy.

A brick is a cube of 8 x 8 x 8 voxels; bit n of its occupancy is the voxel with Z-order n of (i, j,
k) modulo 8. So each of its eight 64-bit words is a cube of 4 x 4 x 4 voxels, and a run of voxels
along any axis sets its bits in a word by one OR with a shifted mask.

The number of an axis here is that of its bit in each group of three: 2 for i, 1 for j, 0 for k.
While bricks are being filled, their key is *packed*: (i >> 3, j >> 3, k >> 3) in 18 bits each,
cheaper to compute than the Z-order key, which each brick needs once, at the end.

The table grows by doubling, so its memory is in proportion to the existing bricks, not to the grid.
Its arrays are the fields of a `_BrickTable`; the caller counts the bricks in use.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import INTS, INTS2, entry, leaf, maker
from hapticdb.kernels.curves import Z_ORDER, compact, encode

FIRST_CAPACITY = np.int64(256)
"""Capacity of a new table, bricks. Larger: slower for small parts, by the time to clear it."""
RUNS_AT_ONCE = 1024
"""Runs in the buffer: 40 kB. Fewer: arrays pass between kernels more often. More: the buffer leaves
the first-level cache."""
RUN_AXIS, RUN_LAST = 3, 4
"""Columns of a run after its first voxel (i, j, k): its axis, and its last coordinate on it."""
PACKED_BITS = 18
"""Bits of a coordinate in a packed key: a grid has at most 2^21 voxels an axis, 2^18 bricks."""
PACKED_MASK = (1 << PACKED_BITS) - 1


class _BrickTable(NamedTuple):
    """Hash table of bricks of capacity C, with 2 C slots for short probes.

    keys (C,) int64, packed; words (C, 8) int64, zero where unused; slots (2 C,) int32, open
    addressing with linear probing: index of a brick, or -1; recent (256, 2) int64, cache of keys
    and brick indices.
    """

    keys: NDArray[np.int64]
    words: NDArray[np.int64]
    slots: NDArray[np.int32]
    recent: NDArray[np.int64]


def _run_masks() -> NDArray[np.int64]:
    """Masks (3, 4, 4): bits of the voxels first..last of a word along an axis."""
    masks = np.zeros((3, 4, 4), dtype=np.int64)
    for axis in range(3):
        for first in range(4):
            for last in range(first, 4):
                bits = sum(1 << ((n + 6 * (n >> 1)) << axis) for n in range(first, last + 1))
                masks[axis, first, last] = bits
    return masks


RUN_MASKS = _run_masks()


@leaf
def _first_slot(key, mask):
    """First slot of a packed key's probe sequence. No product has more than 63 bits."""
    mixed = (key & 0x7FFFFFF) * 0x5BD1E995 + (key >> 27) * 0x2545F491
    return (mixed >> 20 ^ mixed) & mask


@maker
def new_table(capacity):
    """Empty table; capacity : bricks, a power of two."""
    keys = np.empty(capacity, np.int64)
    words = np.zeros((capacity, 8), np.int64)
    slots = np.empty(2 * capacity, np.int32)
    for n in range(2 * capacity):
        slots[n] = -1
    recent = np.empty((256, 2), np.int64)
    for n in range(256):
        recent[n, 0] = -1
        recent[n, 1] = -1
    return _BrickTable(keys, words, slots, recent)


@maker
def grown(table, n_bricks, wanted):
    """Copy of the first `n_bricks` bricks in a larger table, with room for `wanted`."""
    capacity = 2 * table.keys.shape[0]
    while capacity < wanted:
        capacity *= 2
    larger = new_table(capacity)
    mask = 2 * capacity - 1
    # rehash: bricks keep their indices, so the words move by a copy
    for n in range(n_bricks):
        larger.keys[n] = table.keys[n]
        for word in range(8):
            larger.words[n, word] = table.words[n, word]
        slot = _first_slot(larger.keys[n], mask)
        while larger.slots[slot] >= 0:
            slot = (slot + 1) & mask
        larger.slots[slot] = n
    return larger


@leaf
def mark_while_room(table, n_bricks, runs, done, n_runs):
    """Mark runs done..n_runs until the table is full; return the runs done and the bricks in use.

    This function replaces and passes on no array, since numba would count references to it
    atomically: half of the time of voxelizing, with one call a run.
    """
    keys, words, slots, recent = table
    mask = slots.shape[0] - 1
    while done < n_runs:
        axis = runs[done, RUN_AXIS]
        last = runs[done, RUN_LAST]
        first = runs[done, 2 - axis]
        # upper bound, tested before the run: it is never left half marked
        if n_bricks + bricks_of_run(first, last) > keys.shape[0]:
            break
        runs[done, 2 - axis] = 0
        i, j, k = runs[done, 0], runs[done, 1], runs[done, 2]
        runs[done, 2 - axis] = first
        column = ((i >> 3) << (2 * PACKED_BITS)) | ((j >> 3) << PACKED_BITS) | (k >> 3)
        column_word = (i & 4) | ((j & 4) >> 1) | ((k & 4) >> 2)
        i, j, k = i & 3, j & 3, k & 3
        # Z-order bit of the first voxel in its word of 4^3: strides 1, 2, 4, then 8, 16, 32
        shift = ((i + 6 * (i >> 1)) << 2) + ((j + 6 * (j >> 1)) << 1) + k + 6 * (k >> 1)
        last_word = last >> 2
        start = first & 3
        for at in range(first >> 2, last_word + 1):
            key = column | ((at >> 1) << (PACKED_BITS * axis))
            # direct-mapped cache of recent bricks: neighbouring runs cross the same ones
            memo = (key ^ (key >> 15) ^ (key >> 30)) & 255
            if recent[memo, 0] != key:
                slot = _first_slot(key, mask)
                while slots[slot] >= 0 and keys[slots[slot]] != key:
                    slot = (slot + 1) & mask
                if slots[slot] < 0:
                    slots[slot] = n_bricks
                    keys[n_bricks] = key
                    n_bricks += 1
                recent[memo, 0] = key
                recent[memo, 1] = slots[slot]
            end = (last & 3) if at == last_word else 3
            word = column_word | ((at & 1) << axis)
            words[recent[memo, 1], word] |= RUN_MASKS[axis, start, end] << shift
            start = 0
        done += 1
    return done, n_bricks


@leaf
def bricks_of_run(first, last):
    """Upper bound of the bricks crossed by a run."""
    return ((last - first) >> 3) + 2


@maker
def mark_runs(table, n_bricks, runs, n_runs):
    """Mark the first `n_runs` rows of runs (R, 5) int64; return the table and the bricks in use.

    A row is the first voxel (i, j, k) of the run, then `RUN_AXIS` and `RUN_LAST`.
    """
    done = np.int64(0)
    while True:
        done, n_bricks = mark_while_room(table, n_bricks, runs, done, n_runs)
        if done == n_runs:
            return table, n_bricks
        first, last = runs[done, 2 - runs[done, RUN_AXIS]], runs[done, RUN_LAST]
        table = grown(table, n_bricks, n_bricks + bricks_of_run(first, last))


@entry(INTS, INTS2, INTS2)
def brick_voxels_kernel(bricks_z, words, out):
    """Voxels of bricks. bricks_z (B,), words (B, 8) int64; out (voxels, 3) int64."""
    row = 0
    for n in range(bricks_z.shape[0]):
        key = bricks_z[n]
        i = compact(key >> 2) << 3
        j = compact(key >> 1) << 3
        k = compact(key) << 3
        for w in range(8):
            word = words[n, w]
            if word == 0:
                continue
            for b in range(64):
                if (word >> b) & 1:
                    bit = (w << 6) | b
                    out[row, 0] = i | compact(bit >> 2)
                    out[row, 1] = j | compact(bit >> 1)
                    out[row, 2] = k | compact(bit)
                    row += 1


def sorted_bricks(
    packed: NDArray[np.int64], words: NDArray[np.int64], n_bricks: int
) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """First `n_bricks` of packed keys and words in Z-order: keys (B,), occupancy (B, 64)."""
    keys = packed[:n_bricks]
    rest = keys >> PACKED_BITS
    places = np.stack([rest >> PACKED_BITS, rest & PACKED_MASK, keys & PACKED_MASK], axis=1)
    # packed keys serve the hash table alone: Z-order is made once a piece, not once a visit
    bricks_z = encode(places, PACKED_BITS, Z_ORDER)
    order = np.argsort(bricks_z)
    return bricks_z[order], words[order].astype("<i8", copy=False).view(np.uint8)


def mark_points(
    points: NDArray[np.float64], bits: int
) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Bricks of the voxels of points (N, 3), as from `voxelize.voxelize`.

    Points are in voxels from the grid's origin; those outside the grid, or not finite, are ignored.
    Boxes are half-open here: voxel (i, j, k) contains the points of [i, i + 1) x ...
    """
    points = points.reshape(-1, 3)
    in_grid = ((points >= 0.0) & (points < float(1 << bits))).all(axis=1)
    keys = np.sort(encode(points[in_grid].astype(np.int64), bits, Z_ORDER))
    bricks_z, brick = np.unique(keys >> 9, return_inverse=True)
    occupancy = np.zeros((len(bricks_z), 64), dtype=np.uint8)
    np.bitwise_or.at(occupancy, (brick, (keys & 511) >> 3), (1 << (keys & 7)).astype(np.uint8))
    return bricks_z, occupancy


def count_voxels(occupancy: NDArray[np.uint8]) -> int:
    """Count the voxels set in occupancies (B, 64)."""
    return int.from_bytes(occupancy.tobytes(), "little").bit_count()


def brick_voxels(bricks_z: NDArray[np.int64], occupancy: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Voxels (n, 3) of bricks (B,) with occupancies (B, 64): by brick, then by bit number."""
    contiguous = np.ascontiguousarray(occupancy, dtype=np.uint8).reshape(-1, 64)
    words = contiguous.view("<i8").astype(np.int64, copy=False)
    out = np.empty((count_voxels(contiguous), 3), dtype=np.int64)
    brick_voxels_kernel(np.ascontiguousarray(bricks_z, dtype=np.int64), words, out)
    return out

"""Runs of a shell's points: culling by bounding spheres, and cells of the other runs."""

from collections import namedtuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import inlined
from hapticdb.kernels.field.lattice import CELL_VALUES, cell_place, place_before
from hapticdb.kernels.resident.cells import (
    BLOCK,
    CELL_WORDS,
    EMPTY_SLOT,
    GROUP,
    UNKNOWN,
    in_voxels,
    key_of_cell,
    slot_of,
)
from hapticdb.kernels.rigid import moved

MOST_COLUMNS = 64
"""Most columns (i, j) read in a box. In a larger box an occupied brick counts as near."""
MOST_CELLS = 8
"""Most cells read in a box. A larger box counts as near, and its points are looked up."""


WORD_BITS = 10
"""Binary logarithm of `CELL_WORDS`."""
FURTHEST = float(1 << 22)
"""Coordinate beyond every grid and within 32 bits, voxels."""


Scratch = namedtuple(  # noqa: PYI024 - each field is an array (run,) of floats
    "Scratch",
    "px py pz x y z nx ny nz number base word bit kept to_interpolate part_x part_y part_z here "
    "there depth weight slot_of base_of",
)
"""Placed run of a shell: rows of `Clusters.scratch`, each with a number for each point.

px, py, pz : metres. x, y, z : voxels. nx, ny, nz : rotated normal. number : index of the point.
base : start of its cell's distances, less the offset of the cell's first centre. word, bit : of
its voxel, in the words of the whole table. kept : indices for `keep_points`. to_interpolate : index
of the lowest corner of an interpolation. part_x, part_y, part_z : fractions between its corners.
here, there : distance at the point and ahead of it, voxels. depth : m. weight. slot_of,
base_of : of the run's cells.

Rows are separate arrays, not records of points, so the compiler vectorizes loops over points.
Indices are integers below 2^53, exact in a float.
"""


@inlined
def scratch_of(shell):
    """Named rows of a shell's scratch; for leaves, not for entries."""
    r = shell.scratch
    return Scratch(
        r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], r[8], r[9], r[10], r[11],
        r[12], r[13], r[14], r[15], r[16], r[17], r[18], r[19], r[20], r[21], r[22], r[23],
    )  # fmt: skip


def _masks_of_runs(stride: int) -> NDArray[np.uint64]:
    """Masks (4, 4): entry [low, high] has the bricks low .. high, with bits `stride` apart."""
    masks = np.zeros((4, 4), dtype=np.uint64)
    for low in range(4):
        for high in range(low, 4):
            bits = [b for b in range(64) if low <= (b // stride) % 4 <= high]
            masks[low, high] = sum(1 << b for b in bits)
    return masks


_MASKS_I, _MASKS_J, _MASKS_K = _masks_of_runs(16), _masks_of_runs(4), _masks_of_runs(1)
_COLUMNS = np.array(
    [[((2 << high) - 1) & ~((1 << low) - 1) for high in range(32)] for low in range(32)]
).astype(np.uint32)
"""Masks (32, 32) for a word: entry [low, high] has the bits k = low .. high."""


@inlined
def _is_something_near(seen, low_i, low_j, low_k, high_i, high_j, high_k):
    """Whether a closed box in the grid may contain a voxel of `seen`; unknown cells count, too.

    The masks of bricks are read first, then, in a small box, the words. The loop over words has no
    early exit, since a mispredicted branch costs more than ten words.
    """
    keys, slots, words, masks, used, which = seen
    is_near = False
    first_i, first_j, first_k = low_i >> 5, low_j >> 5, low_k >> 5
    last_i, last_j, last_k = high_i >> 5, high_j >> 5, high_k >> 5
    n_cells = (last_i - first_i + 1) * (last_j - first_j + 1) * (last_k - first_k + 1)
    n_columns = (high_i - low_i + 1) * (high_j - low_j + 1)
    if n_cells > MOST_CELLS:
        return True
    for ci in range(first_i, last_i + 1):
        i0, i1 = max(low_i, ci << 5) & 31, min(high_i, (ci << 5) | 31) & 31
        for cj in range(first_j, last_j + 1):
            j0, j1 = max(low_j, cj << 5) & 31, min(high_j, (cj << 5) | 31) & 31
            for ck in range(first_k, last_k + 1):
                slot = slot_of(keys, slots, which, key_of_cell(ci, cj, ck))
                # unknown counts as near: points there must be counted by the frame
                if slot < 0:
                    return True
                if slot == EMPTY_SLOT:
                    continue
                used[slot] = 1
                k0, k1 = max(low_k, ck << 5) & 31, min(high_k, (ck << 5) | 31) & 31
                bricks = _MASKS_I[i0 >> 3, i1 >> 3] & _MASKS_J[j0 >> 3, j1 >> 3]
                # bricks of the box by one AND of three slabs: most boxes end here
                if not masks[slot] & bricks & _MASKS_K[k0 >> 3, k1 >> 3]:
                    continue
                if n_columns > MOST_COLUMNS:
                    return True
                hit_bits = np.uint32(0)
                for i in range(i0, i1 + 1):
                    for word in range((i << 5) | j0, ((i << 5) | j1) + 1):
                        hit_bits |= words[slot, word]
                # one test for all columns: the interval of k is the same
                if hit_bits & _COLUMNS[k0, k1]:
                    is_near = True
    return is_near


@inlined
def _is_sphere_free(seen, spheres, n, transform, grid, reached):
    """Whether no voxel is in the AABB of sphere n of a placed shell, enlarged by `reached` voxels.

    Unknown cells count as occupied; space outside the grid is free.
    """
    side = grid.side
    x, y, z = in_voxels(transform, grid, spheres[n, 0], spheres[n, 1], spheres[n, 2])
    radius = spheres[n, 3] / grid.size + reached
    if x + radius < 0.0 or y + radius < 0.0 or z + radius < 0.0:
        return True
    if x - radius >= side or y - radius >= side or z - radius >= side:
        return True
    return not _is_something_near(
        seen,
        # clamped before the conversion: a far pose exceeds int64
        np.int64(max(x - radius, 0.0)),
        np.int64(max(y - radius, 0.0)),
        np.int64(max(z - radius, 0.0)),
        np.int64(min(x + radius, side - 1.0)),
        np.int64(min(y + radius, side - 1.0)),
        np.int64(min(z + radius, side - 1.0)),
    )


@inlined
def _free_runs(seen, shell, run, transform, grid, reached):
    """Number of runs, from `run` on, farther than `reached` voxels from all: BLOCK, GROUP, 1 or 0.

    A shell without spheres lists in `groups` the runs to skip, or has no groups: then it is 0.
    """
    spheres, groups = shell.spheres, shell.groups
    if spheres.shape[0] == 0:
        return np.int64(groups[run, 0]) if groups.shape[0] > 0 else np.int64(0)
    n_runs = spheres.shape[0]
    # coarse to fine, each only at its own first run
    if run % BLOCK == 0 and n_runs >= BLOCK:
        block = (n_runs + GROUP - 1) // GROUP + run // BLOCK
        if _is_sphere_free(seen, groups, block, transform, grid, reached):
            return BLOCK
    if run % GROUP == 0 and _is_sphere_free(seen, groups, run // GROUP, transform, grid, reached):
        return GROUP
    return 1 if _is_sphere_free(seen, spheres, run, transform, grid, reached) else 0


@inlined
def next_run(seen, shell, run, end, transform, grid, reached):
    """First run, from `run` on and before `end`, possibly near a voxel; `end` or more without one.

    All frames and searches traverse a shell by it, forwards.
    """
    while run < end:
        n_free = _free_runs(seen, shell, run, transform, grid, reached)
        if n_free == 0:
            break
        run += n_free
    return run


@inlined
def place_run(shell, run, transform, grid, scratch):
    """Place the points of a run: scratch takes metres and voxels.

    Returns the first point and their number. One loop for each axis, for vectorization: this halves
    the time of a flat frame of 100,000 points.
    """
    ox, oy, oz, size, columns = grid.x, grid.y, grid.z, grid.size, shell.columns
    start = run * shell.run
    count = min(shell.run, columns.shape[1] - start)
    for at in range(count):
        x, y, z = columns[0, start + at], columns[1, start + at], columns[2, start + at]
        x, y, z = moved(transform, x, y, z)
        scratch.px[at], scratch.py[at], scratch.pz[at] = x, y, z
    for at in range(count):
        scratch.x[at] = (scratch.px[at] - ox) / size
    for at in range(count):
        scratch.y[at] = (scratch.py[at] - oy) / size
    for at in range(count):
        scratch.z[at] = (scratch.pz[at] - oz) / size
    return start, count


@inlined
def _voxel_on_axis(x):
    """Voxel of a coordinate as int32, so the compiler converts several at once."""
    return np.int32(min(max(np.floor(x), -1.0), FURTHEST))


@inlined
def cells_of_run(seen, count, side, scratch):
    """Slots of a placed run's cells into `scratch`; return the box of these cells.

    The box is that of the run's voxels, with k fastest, then j; `base_of` takes the start of each
    cell's distances, less the offset of the cell's first centre. Returns the number of cells, the
    numbers along j and k, and the first cell. The number is 0 if all bricks are unmarked, and below
    0 for a look-up point by point: a part of the run is outside the grid or in an unknown cell, or
    there are more cells than points or `MOST_CELLS`. The loop over points is plain, for
    vectorization.
    """
    # cells of the AABB, not of each point: a look-up each instead of a hash for each point
    i0 = i1 = _voxel_on_axis(scratch.x[0])
    j0 = j1 = _voxel_on_axis(scratch.y[0])
    k0 = k1 = _voxel_on_axis(scratch.z[0])
    for at in range(count):
        i = _voxel_on_axis(scratch.x[at])
        j = _voxel_on_axis(scratch.y[at])
        k = _voxel_on_axis(scratch.z[at])
        i0, i1 = min(i0, i), max(i1, i)
        j0, j1 = min(j0, j), max(j1, j)
        k0, k1 = min(k0, k), max(k1, k)
    ci, cj, ck = np.int64(i0 >> 5), np.int64(j0 >> 5), np.int64(k0 >> 5)
    n_i, n_j, n_k = (i1 >> 5) - ci + 1, (j1 >> 5) - cj + 1, (k1 >> 5) - ck + 1
    n_cells = n_i * n_j * n_k
    is_inside = min(i0, j0, k0) >= 0 and max(i1, j1, k1) < side
    if not is_inside or n_cells > min(MOST_CELLS, count):
        return np.int64(UNKNOWN), n_j, n_k, ci, cj, ck
    hit_bits = np.uint64(0)
    for n in range(n_cells):
        i, j, k = ci + n // (n_j * n_k), cj + n // n_k % n_j, ck + n % n_k
        slot = slot_of(seen.keys, seen.slots, seen.which, key_of_cell(i, j, k))
        # the look-up point by point lists only unknown cells that have a point
        if slot < 0:
            return np.int64(UNKNOWN), n_j, n_k, ci, cj, ck
        if slot > EMPTY_SLOT:
            seen.used[slot] = 1
            hit_bits |= seen.masks[slot]
        scratch.slot_of[n] = slot
        first = cell_place(np.int64(0), np.int64(0), np.int64(0)) + slot * CELL_VALUES
        # so that a point's index is base + offset of its voxel in the whole grid
        scratch.base_of[n] = float(first - place_before(i << 5, j << 5, k << 5))
    return n_cells if hit_bits else np.int64(0), n_j, n_k, ci, cj, ck


@inlined
def words_of_run(count, box, start, scratch):
    """Number, base, word and bit of a run's points, in the cells of `cells_of_run`.

    All are integers below 2^53, exact in floats, so the compiler vectorizes the loops: it cannot
    with integers of 64 bits. Runs in a single cell, more than half of them, need no cell of a
    point.
    """
    n_cells, n_j, n_k, ci, cj, ck = box
    for at in range(count):
        scratch.number[at] = start + at
        # k modulo 32, in floats
        scratch.bit[at] = np.floor(scratch.z[at]) - 32.0 * np.floor(scratch.z[at] / 32.0)
    if n_cells == 1:
        first = scratch.slot_of[0] * CELL_WORDS - 32.0 * (32.0 * ci + cj)
        base = scratch.base_of[0]
        for at in range(count):
            scratch.word[at] = first + 32.0 * np.floor(scratch.x[at]) + np.floor(scratch.y[at])
            scratch.base[at] = base
        return
    for at in range(count):
        i, j = np.floor(scratch.x[at] / 32.0), np.floor(scratch.y[at] / 32.0)
        cell = ((i - ci) * n_j + (j - cj)) * n_k + (np.floor(scratch.z[at] / 32.0) - ck)
        scratch.kept[at] = cell
        scratch.word[at] = (
            32.0 * (np.floor(scratch.x[at]) - 32.0 * i) + np.floor(scratch.y[at]) - 32.0 * j
        )
    for at in range(count):
        cell = np.int64(scratch.kept[at])
        scratch.word[at] += CELL_WORDS * scratch.slot_of[cell]
        scratch.base[at] = scratch.base_of[cell]


@inlined
def keep_points(scratch, count, n_kept):
    """Move the points listed in `kept` to the front, unless they are all points of the run."""
    if n_kept == count:
        return
    # ascending, so in place: the source is never before the target
    for n in range(n_kept):
        at = np.int64(scratch.kept[n])
        scratch.px[n], scratch.py[n], scratch.pz[n] = scratch.px[at], scratch.py[at], scratch.pz[at]
        scratch.x[n], scratch.y[n], scratch.z[n] = scratch.x[at], scratch.y[at], scratch.z[at]
        scratch.number[n], scratch.base[n] = scratch.number[at], scratch.base[at]

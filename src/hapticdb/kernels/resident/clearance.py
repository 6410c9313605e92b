"""Nearest occupied voxels of resident cells, and the cells that a search for them needs.

A search stops at the first cell that is not resident. The caller fetches that cell and goes on; no
distance is guessed.
"""

import math

import numpy as np

from hapticdb.kernels._jit import FLOAT, FLOATS2, FLOATS3, INT, INTS, entry, inlined, leaf
from hapticdb.kernels.bits import highest_bit, lowest_bit
from hapticdb.kernels.resident.cells import (
    EMPTY_SLOT,
    PLACE,
    key_of_cell,
    place_in_set,
    slot_of,
)
from hapticdb.kernels.rigid import moved, transform_of

AXIS_BITS = 21
"""Bits of each coordinate of a packed voxel, i uppermost. Three coordinates must fit an int64."""
AXIS_MASK = (1 << AXIS_BITS) - 1


@leaf
def packed(i, j, k):
    """Voxel (i, j, k) as one number."""
    return (i << (2 * AXIS_BITS)) | (j << AXIS_BITS) | k


@leaf
def unpacked(voxel):
    """Voxel (i, j, k) of a number; undoes `packed`."""
    return voxel >> (2 * AXIS_BITS), (voxel >> AXIS_BITS) & AXIS_MASK, voxel & AXIS_MASK


@leaf
def gap(x, low, high):
    """Distance of x from the interval low .. high, 0 inside."""
    return max(low - x, x - high, 0.0)


@leaf
def _window_of(x, radius, first):
    """First and last voxel, 0 to 31, of a cell from `first` on whose gap to x may be below radius.

    Voxels of a cell that lies wholly on one side of x give its border voxel.
    """
    low = np.int64(min(max(math.floor(x - radius) - first, 0), 31))
    high = np.int64(min(max(math.floor(x + radius) - first, 0), 31))
    return low, high


@inlined
def _nearest_in_cell(words, slot, mask, ci, cj, ck, x, y, z, square, voxel):
    """Least squared distance from (x, y, z) to a voxel of one cell, and that voxel, packed.

    Returns `square` and `voxel` as given if no voxel is nearer. All lengths in voxels. Only columns
    within the radius are looked at, so the loops hardly branch: a fifth off a search.
    """
    radius = math.sqrt(square)
    i0, j0, k0 = ci << 5, cj << 5, ck << 5
    first_i, last_i = _window_of(x, radius, i0)
    first_j, last_j = _window_of(y, radius, j0)
    low, high = _window_of(z, radius, k0)
    # columns begin at the place's own height
    middle = np.int64(min(max(math.floor(z) - k0, 0), 31))
    window = (np.int64(2) << high) - (np.int64(1) << low)
    for bi in range(first_i >> 3, (last_i >> 3) + 1):
        di = gap(x, i0 + 8.0 * bi, i0 + 8.0 * bi + 8.0)
        if not (mask >> np.uint64(bi << 4)) & np.uint64(0xFFFF):
            continue
        for bj in range(first_j >> 3, (last_j >> 3) + 1):
            bricks = np.int64((mask >> np.uint64((bi << 4) | (bj << 2))) & np.uint64(0xF))
            dj = gap(y, j0 + 8.0 * bj, j0 + 8.0 * bj + 8.0)
            if not bricks or di * di + dj * dj >= square:
                continue
            height, kept = np.inf, np.int64(0)  # squared gap to the bricks that may be near
            for bk in range(low >> 3, (high >> 3) + 1):
                if (bricks >> bk) & 1:
                    dk = gap(z, k0 + (bk << 3), k0 + (bk << 3) + 8.0)
                    if di * di + dj * dj + dk * dk < square:
                        height = min(height, dk * dk)
                        kept |= np.int64(0xFF) << (bk << 3)
            kept &= window
            if not kept:
                continue
            for i in range(max(first_i, bi << 3), min(last_i, (bi << 3) | 7) + 1):
                dx = gap(x, i0 + i, i0 + i + 1.0)
                for j in range(max(first_j, bj << 3), min(last_j, (bj << 3) | 7) + 1):
                    met = np.int64(words[slot, (i << 5) | j]) & kept
                    if not met:
                        continue
                    dy = gap(y, j0 + j, j0 + j + 1.0)
                    column = dx * dx + dy * dy
                    if column + height >= square:
                        continue
                    above, below = met >> middle, met & ((np.int64(1) << middle) - 1)
                    if above:
                        k = k0 + middle + lowest_bit(above)
                        dz = gap(z, k, k + 1.0)
                        if column + dz * dz < square:
                            square = column + dz * dz
                            voxel = packed(i0 + i, j0 + j, k)
                    if below:
                        k = k0 + highest_bit(below)
                        dz = gap(z, k, k + 1.0)
                        if column + dz * dz < square:
                            square = column + dz * dz
                            voxel = packed(i0 + i, j0 + j, k)
    return square, voxel


@leaf
def square_to(x, y, z, voxel):
    """Squared distance to the box of a packed voxel, all in voxels."""
    i, j, k = unpacked(voxel)
    dx, dy, dz = gap(x, i, i + 1.0), gap(y, j, j + 1.0), gap(z, k, k + 1.0)
    return dx * dx + dy * dy + dz * dz


@inlined
def nearest_voxel(keys, slots, words, masks, used, which, x, y, z, square, voxel, side):
    """Occupied voxel nearest to (x, y, z), all in voxels, if nearer than the root of `square`.

    Returns its box's squared distance and the voxel, packed, or both as given; voxel -2 when a cell
    in reach is not resident.
    """
    radius = math.sqrt(square)
    top = np.int64(side) - 1
    first_i = np.int64(max(math.floor(x - radius), 0)) >> 5
    first_j = np.int64(max(math.floor(y - radius), 0)) >> 5
    first_k = np.int64(max(math.floor(z - radius), 0)) >> 5
    last_i = np.int64(min(math.floor(x + radius), top)) >> 5
    last_j = np.int64(min(math.floor(y + radius), top)) >> 5
    last_k = np.int64(min(math.floor(z + radius), top)) >> 5
    for ci in range(first_i, last_i + 1):
        di = gap(x, 32.0 * ci, 32.0 * ci + 32.0)
        for cj in range(first_j, last_j + 1):
            dj = gap(y, 32.0 * cj, 32.0 * cj + 32.0)
            for ck in range(first_k, last_k + 1):
                dk = gap(z, 32.0 * ck, 32.0 * ck + 32.0)
                if di * di + dj * dj + dk * dk >= square:
                    continue
                slot = slot_of(keys, slots, which, key_of_cell(ci, cj, ck))
                if slot < 0:
                    return square, np.int64(-2)
                if slot == EMPTY_SLOT:
                    continue
                used[slot] = 1
                square, voxel = _nearest_in_cell(
                    words, slot, masks[slot], ci, cj, ck, x, y, z, square, voxel
                )
    return square, voxel


@leaf
def room_around(seen, x, y, z, half, most, side):
    """How far a cube may grow on each side before it meets an occupied brick or an unknown cell.

    (x, y, z), half: the cube's centre and half its side, voxels. The result is at most `most`, and
    not above zero if the cube meets one already.
    """
    reach, top = half + most, side - 1.0
    least = reach
    for ci in range(np.int64(max(x - reach, 0.0)) >> 5, (np.int64(min(x + reach, top)) >> 5) + 1):
        di = gap(x, 32.0 * ci, 32.0 * ci + 32.0)
        for cj in range(
            np.int64(max(y - reach, 0.0)) >> 5, (np.int64(min(y + reach, top)) >> 5) + 1
        ):
            dj = max(di, gap(y, 32.0 * cj, 32.0 * cj + 32.0))
            if dj >= least:
                continue
            for ck in range(
                np.int64(max(z - reach, 0.0)) >> 5, (np.int64(min(z + reach, top)) >> 5) + 1
            ):
                dk = max(dj, gap(z, 32.0 * ck, 32.0 * ck + 32.0))
                if dk >= least:
                    continue
                slot = slot_of(seen.keys, seen.slots, seen.which, key_of_cell(ci, cj, ck))
                if slot == EMPTY_SLOT:
                    continue
                if slot < 0:
                    least = dk
                else:
                    seen.used[slot] = 1
                    least = _nearest_brick(
                        seen.masks[slot], 32.0 * ci, 32.0 * cj, 32.0 * ck, x, y, z, least
                    )
                if least <= half:
                    return least - half
    return least - half


@leaf
def _nearest_brick(mask, i, j, k, x, y, z, least):
    """Distance on the axis where it is largest, from (x, y, z) to the nearest brick of a cell.

    mask: of the cell, whose lowest corner is (i, j, k); all in voxels. `least` if none is nearer.
    """
    for bi in range(4):
        if not (mask >> np.uint64(bi << 4)) & np.uint64(0xFFFF):
            continue
        di = gap(x, i + 8.0 * bi, i + 8.0 * bi + 8.0)
        if di >= least:
            continue
        for bj in range(4):
            four = (mask >> np.uint64((bi << 4) | (bj << 2))) & np.uint64(0xF)
            dj = max(di, gap(y, j + 8.0 * bj, j + 8.0 * bj + 8.0))
            if not four or dj >= least:
                continue
            for bk in range(4):
                if (four >> np.uint64(bk)) & np.uint64(1):
                    least = min(least, max(dj, gap(z, k + 8.0 * bk, k + 8.0 * bk + 8.0)))
    return least


@entry(FLOATS2, FLOATS3, PLACE, INT, INT, FLOAT, INTS, INT)
def cells_near(points, poses, place, first, stride, reach, found, most):
    """Distinct cells within `reach` metres of points (N, 3+) at every stride-th of the poses.

    At poses[0] only points from `first` on count. The cells go into found (capacity,) int64, an
    open-addressing set, all -1 before; its capacity is a power of two, above 2 most. The search
    ends before there are more than `most` cells. Returns the number of cells.
    """
    ox, oy, oz, size, side = place.x, place.y, place.z, place.size, place.side
    top = side - 1.0
    r = reach / size
    count = 0
    for n in range(0, poses.shape[0], stride):
        transform = transform_of(poses[n])
        low_memo = high_memo = np.int64(-1)
        for p in range(first if n == 0 else 0, points.shape[0]):
            x, y, z = moved(transform, points[p, 0], points[p, 1], points[p, 2])
            x, y, z = (x - ox) / size, (y - oy) / size, (z - oz) / size
            if not (-r <= x <= side + r and -r <= y <= side + r and -r <= z <= side + r):
                continue
            first_i, last_i = np.int64(max(x - r, 0.0)) >> 5, np.int64(min(x + r, top)) >> 5
            first_j, last_j = np.int64(max(y - r, 0.0)) >> 5, np.int64(min(y + r, top)) >> 5
            first_k, last_k = np.int64(max(z - r, 0.0)) >> 5, np.int64(min(z + r, top)) >> 5
            low = key_of_cell(first_i, first_j, first_k)
            high = key_of_cell(last_i, last_j, last_k)
            if low == low_memo and high == high_memo:
                continue
            low_memo, high_memo = low, high
            n_cells = (last_i - first_i + 1) * (last_j - first_j + 1) * (last_k - first_k + 1)
            if count + n_cells > most and count > 0:
                return count
            for ci in range(first_i, last_i + 1):
                for cj in range(first_j, last_j + 1):
                    for ck in range(first_k, last_k + 1):
                        key = key_of_cell(ci, cj, ck)
                        at = place_in_set(found, key)
                        if found[at] < 0:
                            found[at] = key
                            count += 1
    return count

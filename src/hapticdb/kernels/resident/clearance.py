"""Clearance of a swept shell from occupied voxels, by bounds that are kept from pose to pose.

The search stops at the first cell that is not resident and returns where it stopped. The caller
fetches that cell and continues the search; no distance is guessed.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import (
    FLOAT,
    FLOATS,
    FLOATS2,
    FLOATS3,
    INT,
    INTS,
    entry,
    fields_of,
    inlined,
    leaf,
)
from hapticdb.kernels.bits import highest_bit, lowest_bit
from hapticdb.kernels.resident.cells import (
    CELLS,
    CLUSTERS,
    EMPTY_SLOT,
    PLACE,
    begin_frame,
    end_frame,
    key_of_cell,
    place_in_set,
    slot_of,
)
from hapticdb.kernels.resident.sweep import CAUTION, packed, unpacked
from hapticdb.kernels.rigid import moved, transform_of

MARGIN = 4.0
"""Voxels that a search reaches beyond the distance that matters now. Larger: longer searches, fewer
repeated ones."""


class Bounds(NamedTuple):
    """Bounds on the clearance, in voxels, kept from sample to sample.

    expiry (N,): for each point, the earliest travel at which it can reach an occupied voxel, if it
    went straight there: its distance now is at least expiry - travel; of_runs (C,): the earliest
    expiry of the points of each run; nearest (N,) int64: the voxel, packed, that was nearest to
    each point in its last search, or -1; least (W,): least distance so far in each window of the
    path; state (2,): indices `SOONEST`, `LEAST`; where (6,) int64: indices `SAMPLE` to `LOOKED`.
    """

    expiry: NDArray[np.float64]
    of_runs: NDArray[np.float64]
    nearest: NDArray[np.int64]
    least: NDArray[np.float64]
    state: NDArray[np.float64]
    where: NDArray[np.int64]


BOUNDS = fields_of(Bounds, FLOATS, FLOATS, INTS, FLOATS, FLOATS, INTS)


SOONEST, LEAST = 0, 1
"""Indices into `Bounds.state`: the least expiry of all points, and the least distance, voxels."""
SAMPLE, POINT, VOXEL, NEAREST, STOPPED, LOOKED = 0, 1, 2, 3, 4, 5
"""Indices into `Bounds.where`: sample, point and voxel of the least distance; the point that was
nearest last; the point, or first point of a run, at which the search stopped; the number of poses
at which any point was looked at, because bounds of earlier poses did not reach so far."""


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


@inlined
def nearest_to(keys, slots, words, masks, used, which, x, y, z, cap, near, side):
    """Squared distance from (x, y, z) to the nearest occupied voxel, and that voxel; all in voxels.

    The search reaches as far as `cap` + `MARGIN`, or as the voxel `near` (packed, or -1 for none)
    if that is nearer. The voxel is -1 when there is none, and -2 when a cell in reach is unknown.
    """
    square, voxel = (cap + MARGIN) ** 2, np.int64(-1)
    if near >= 0 and square_to(x, y, z, near) < square:
        square, voxel = square_to(x, y, z, near), near
    return nearest_voxel(
        keys, slots, words, masks, used, which, x, y, z, square, voxel, side
    )  # fmt: skip


@inlined
def _far_run(
    keys, slots, words, masks, used, which, spheres, at, near, cap, transform, place
):  # fmt: skip
    """Lower bound, voxels, of the distance from a placed run's points to any occupied voxel.

    It comes from the run's sphere, looked for as far as `cap`; -1 when a cell in reach is unknown.
    near: a voxel, packed, with which the search begins, or -1.
    """
    size = place.size
    x, y, z = moved(transform, spheres[at, 0], spheres[at, 1], spheres[at, 2])
    radius = spheres[at, 3] / size
    square, voxel = nearest_to(
        keys, slots, words, masks, used, which, (x - place.x) / size, (y - place.y) / size,
        (z - place.z) / size, cap + radius, near, place.side,
    )  # fmt: skip
    return -1.0 if voxel == -2 else max(math.sqrt(square) - radius, 0.0)


@inlined
def near_points(
    keys, slots, words, masks, used, which, points, run, at, transform, place, travel, cap, sample,
    expiry, nearest, state, where,
):  # fmt: skip
    """Distances of the points of run `at` that may be nearer than `cap`, into arrays of `Bounds`.

    Returns the least of `cap` and these distances, and the run's earliest expiry, all in voxels; -1
    and 0 when a cell is unknown. sample: number of the pose on the path.
    """
    ox, oy, oz, size, side = place.x, place.y, place.z, place.size, place.side
    soonest = np.inf
    start = at * run
    for p in range(start, min(start + run, points.shape[0])):
        if expiry[p] - travel < cap:
            x, y, z = moved(transform, points[p, 0], points[p, 1], points[p, 2])
            square, voxel = nearest_to(
                keys, slots, words, masks, used, which,
                (x - ox) / size, (y - oy) / size, (z - oz) / size, cap, nearest[p], side,
            )  # fmt: skip
            if voxel == -2:
                where[STOPPED] = p
                return -1.0, 0.0
            distance = math.sqrt(square)
            nearest[p] = voxel
            expiry[p] = travel + distance - CAUTION
            if voxel >= 0 and distance < cap:
                cap = distance
                where[NEAREST] = p
                if distance < state[LEAST]:
                    state[LEAST] = distance
                    where[SAMPLE] = sample
                    where[POINT] = p
                    where[VOXEL] = voxel
        soonest = min(soonest, expiry[p])
    return cap, soonest


@entry(CELLS, INT, CLUSTERS, FLOATS3, INT, INT, FLOATS, INTS, PLACE, FLOAT, BOUNDS)
def find_clearance(
    cells, reader, shell, poses, first, base, travels, windows, place, small, bounds
):  # fmt: skip
    """Least distance from the points to an occupied voxel's box at poses[first:], in `bounds`.

    travels (B,): largest way of any point from the path's start to each pose, voxels; windows (B,)
    int64: the entry of `bounds.least` that each pose counts for; base: number of poses[0] as a
    sample of the path; small: runs with a radius of at most so many voxels are searched as a whole
    before their points. Returns the number of poses done. It is less than B when a cell was not
    resident; then `bounds.where[STOPPED]` has the point, or the first point of the run.
    """
    _, _, keys, slots, words, masks, used, _, _ = cells
    points, _, spheres, _, run, _, _ = shell
    expiry, of_runs, nearest, least, state, where = bounds
    which = begin_frame(cells, reader)
    for n in range(first, poses.shape[0]):
        travel, window = travels[n], windows[n]
        cap = least[window]
        if state[SOONEST] - travel >= cap:
            continue
        transform = transform_of(poses[n])
        soonest = np.inf
        # first the run of the point that was nearest last: it bounds the search for all others
        for turn_of in range(-1, of_runs.shape[0]):
            at = where[NEAREST] // run if turn_of < 0 else turn_of
            is_expired = of_runs[at] - travel < cap and turn_of >= 0
            if is_expired and spheres.shape[0] > 0 and spheres[at, 3] <= small * place.size:
                bound = _far_run(
                    keys, slots, words, masks, used, which, spheres, at, nearest[at * run], cap,
                    transform, place,
                )  # fmt: skip
                if bound < 0.0:
                    where[STOPPED] = at * run
                    end_frame(cells, reader)
                    return n
                of_runs[at] = max(of_runs[at], travel + bound - CAUTION)
            if of_runs[at] - travel < cap:
                cap, soonest_of_run = near_points(
                    keys, slots, words, masks, used, which, points, run, at, transform, place,
                    travel, cap, base + n, expiry, nearest, state, where,
                )  # fmt: skip
                if cap < 0.0:
                    end_frame(cells, reader)
                    return n
                of_runs[at] = soonest_of_run
            if turn_of >= 0:
                soonest = min(soonest, of_runs[at])
        least[window] = cap
        state[SOONEST] = soonest
        where[LOOKED] += 1
    end_frame(cells, reader)
    return poses.shape[0]


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

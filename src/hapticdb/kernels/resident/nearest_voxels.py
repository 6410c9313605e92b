"""Distance of a shell from occupied voxels at unrelated poses.

Bounding spheres (balls) are searched before their points: groups of runs, then runs. The result
around a point is cached for its cube of space (`records.NEAR_CUBE`), and bounds the distance of
every point in this cube. So most balls and points need no search, at this pose and at later ones.

The search of a pose stops at the first unknown cell, and returns the point it has reached. The
caller fetches cells there and continues the search; no distance is guessed.
"""

import math

import numpy as np

from hapticdb.kernels._jit import FLOAT, FLOATS, FLOATS3, INT, INTS, entry, inlined, leaf, record_of
from hapticdb.kernels.bits import highest_bit, lowest_bit
from hapticdb.kernels.records.rows import NEAR_CUBE
from hapticdb.kernels.resident.cells import (
    CELL_GRID,
    CELLS,
    CLUSTERS,
    EMPTY_SLOT,
    GROUP,
    Seen,
    begin_frame,
    cells_of_box,
    end_frame,
    in_voxels,
    key_of_cell,
    slot_of,
    spread_key,
)
from hapticdb.kernels.rigid import gap, transform_of

AXIS_BITS = 21
"""Bits of each coordinate of a packed voxel, i uppermost. Three coordinates must fit an int64."""
AXIS_MASK = (1 << AXIS_BITS) - 1


CAUTION = 1e-6
"""Margin of bounds for rounding errors, voxels."""
POINT, RUN, GROUPED = 0, 1, 2
"""Unit of a search: a point, a run of points, a group of runs."""
CUBE_OF_BALL = 2
"""Binary logarithm of the edge, voxels, of the balls' cubes. Larger: more hits in the cache, and
looser bounds of the distance."""
SURVEY, NEAREST_BALL, ALL = 0, 1, 2
"""Passes of a pose's search: bounds of all balls, the points of the ball with the least bound, and
all balls and points possibly nearer than these."""


NOT_KNOWN = np.zeros((), NEAR_CUBE)
"""Empty entry of the cache of cubes: an array (F,) of such records, F a power of two,
direct-mapped. A cache is valid for one revision and one thread."""
NOT_KNOWN["key"] = NOT_KNOWN["nearest"] = -1
NOT_KNOWN["bound"] = -1.0


@leaf
def packed(i, j, k):
    """Voxel (i, j, k) as one integer."""
    return (i << (2 * AXIS_BITS)) | (j << AXIS_BITS) | k


@leaf
def unpacked(voxel):
    """Voxel (i, j, k) of an integer; inverse of `packed`."""
    return voxel >> (2 * AXIS_BITS), (voxel >> AXIS_BITS) & AXIS_MASK, voxel & AXIS_MASK


@leaf
def _window_of(x, radius, first):
    """First and last voxel, 0 to 31, of a cell from `first` on, possibly within `radius` of x.

    For a cell wholly on one side of x, its border voxel.
    """
    low = np.int64(min(max(math.floor(x - radius) - first, 0), 31))
    high = np.int64(min(max(math.floor(x + radius) - first, 0), 31))
    return low, high


@inlined
def _nearest_in_cell(seen, slot, ci, cj, ck, x, y, z, square, voxel):
    """Least squared distance from (x, y, z) to a voxel of one cell, and this voxel, packed.

    Returns `square` and `voxel` as given if no voxel is nearer. All lengths in voxels. Only columns
    within the radius are read, so the loops hardly branch: a fifth off a search.
    """
    radius, words, mask = math.sqrt(square), seen.words, seen.masks[slot]
    i0, j0, k0 = ci << 5, cj << 5, ck << 5
    first_i, last_i = _window_of(x, radius, i0)
    first_j, last_j = _window_of(y, radius, j0)
    low, high = _window_of(z, radius, k0)
    # columns are searched up and down from the point's own height
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
            height, kept = np.inf, np.int64(0)  # squared gap to the bricks possibly near
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
                    hit_bits = np.int64(words[slot, (i << 5) | j]) & kept
                    if not hit_bits:  # 32 voxels in one test
                        continue
                    dy = gap(y, j0 + j, j0 + j + 1.0)
                    column = dx * dx + dy * dy
                    if column + height >= square:
                        continue
                    above, below = hit_bits >> middle, hit_bits & ((np.int64(1) << middle) - 1)
                    if above:
                        k = k0 + middle + lowest_bit(above)  # nearest above, by bit scan
                        dz = gap(z, k, k + 1.0)
                        if column + dz * dz < square:
                            square = column + dz * dz
                            voxel = packed(i0 + i, j0 + j, k)
                    if below:
                        k = k0 + highest_bit(below)  # nearest below
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
def nearest_voxel(seen, x, y, z, square, voxel, side):
    """Occupied voxel nearest to (x, y, z), all in voxels, if nearer than the root of `square`.

    Returns its box's squared distance and the voxel, packed, or both as given; voxel -2 if a cell
    in reach is not resident.
    """
    box = cells_of_box(x, y, z, math.sqrt(square), side)
    first_i, last_i, first_j, last_j, first_k, last_k = box
    for ci in range(first_i, last_i + 1):
        di = gap(x, 32.0 * ci, 32.0 * ci + 32.0)
        for cj in range(first_j, last_j + 1):
            dj = gap(y, 32.0 * cj, 32.0 * cj + 32.0)
            for ck in range(first_k, last_k + 1):
                dk = gap(z, 32.0 * ck, 32.0 * ck + 32.0)
                if di * di + dj * dj + dk * dk >= square:
                    continue
                slot = slot_of(seen.keys, seen.slots, seen.which, key_of_cell(ci, cj, ck))
                if slot < 0:
                    return square, np.int64(-2)
                if slot == EMPTY_SLOT:
                    continue
                seen.used[slot] = 1
                square, voxel = _nearest_in_cell(seen, slot, ci, cj, ck, x, y, z, square, voxel)
    return square, voxel


@leaf
def room_around(seen, x, y, z, half, most, side):
    """Voxels a cube may grow on each side before it reaches a marked brick or an unknown cell.

    (x, y, z), half : the cube's centre and half its side, voxels. The result is at most `most`, and
    not above zero if the cube reaches one already.
    """
    least = half + most
    first_i, last_i, first_j, last_j, first_k, last_k = cells_of_box(x, y, z, least, side)
    for ci in range(first_i, last_i + 1):
        di = gap(x, 32.0 * ci, 32.0 * ci + 32.0)
        for cj in range(first_j, last_j + 1):
            dj = max(di, gap(y, 32.0 * cj, 32.0 * cj + 32.0))
            if dj >= least:
                continue
            for ck in range(first_k, last_k + 1):
                dk = max(dj, gap(z, 32.0 * ck, 32.0 * ck + 32.0))
                if dk >= least:
                    continue
                slot = slot_of(seen.keys, seen.slots, seen.which, key_of_cell(ci, cj, ck))
                if slot == EMPTY_SLOT:  # free, without its mask
                    continue
                if slot < 0:
                    least = dk  # no nearer than the unknown cell
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
    """Chebyshev distance from (x, y, z) to the nearest marked brick of a cell, at most `least`.

    mask : of the cell with lowest corner (i, j, k); all in voxels.
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


@inlined
def _level_at(spheres, groups, run, point, largest):
    """Unit of the next search at a point: GROUPED, RUN or POINT.

    It is the largest unit with its first point there and a radius of `largest` m or less.
    """
    if spheres.shape[0] == 0 or point % run != 0 or point // run >= spheres.shape[0]:
        return POINT
    if point % (GROUP * run) == 0 and groups[point // (GROUP * run), 3] <= largest:
        return GROUPED
    return RUN if spheres[point // run, 3] <= largest else POINT


@inlined
def _ball_at(points, spheres, groups, run, point, level):
    """Centre and radius, tool frame, metres, of the unit at a point, and its number of points."""
    if level == POINT:
        return points[point, 0], points[point, 1], points[point, 2], 0.0, np.int64(1)
    if level == RUN:
        n = point // run
        return spheres[n, 0], spheres[n, 1], spheres[n, 2], spheres[n, 3], run
    n = point // (GROUP * run)
    return groups[n, 0], groups[n, 1], groups[n, 2], groups[n, 3], GROUP * run


@leaf
def _bounded_by(x, y, z, square, voxel):
    """Start of a search: squared distance and `voxel` if nearer, else `square` and -1."""
    if voxel >= 0 and square_to(x, y, z, voxel) < square:
        return square_to(x, y, z, voxel), voxel
    return square, np.int64(-1)


@inlined
def bound_at(cubes, seen, x, y, z, wanted, near, shift, side):
    """Lower bound of the distance from (x, y, z) to an occupied voxel, and a voxel near it or -1.

    All in voxels. Reads the cache for the point's cube, or searches around the cube's middle, just
    far enough to detect any voxel nearer than `wanted` to a point of the cube. near : occupied
    voxel as the start of a search, or -1; shift : binary logarithm of the cube's edge. The bound is
    0 outside the grid, and if a cell is not resident.
    """
    if not (0.0 <= x < side and 0.0 <= y < side and 0.0 <= z < side):
        return 0.0, np.int64(-1)
    edge = 1.0 * (np.int64(1) << shift)
    i, j, k = np.int64(x) >> shift, np.int64(y) >> shift, np.int64(z) >> shift
    mx, my, mz = (i + 0.5) * edge, (j + 0.5) * edge, (k + 0.5) * edge
    # both cube sizes share the cache: the lowest bit tells them apart
    key = packed(i, j, k) << 1 | (shift == CUBE_OF_BALL)
    cube = cubes[spread_key(key, cubes.shape[0])]
    # half the diagonal: the search from the middle serves every point of the cube
    far = wanted + 0.5 * math.sqrt(3.0) * edge
    # without a voxel the cached bound is only the radius of its search: it may be too short
    if cube.key != key or (cube.nearest < 0 and cube.bound < far):
        square, voxel = _bounded_by(mx, my, mz, far * far, near)
        square, voxel = nearest_voxel(seen, mx, my, mz, square, voxel, side)
        if voxel == -2:  # not cached: the cell may arrive
            return 0.0, np.int64(-1)
        cube.key = key
        cube.bound = math.sqrt(square)
        cube.nearest = voxel
    x, y, z = x - mx, y - my, z - mz
    # 1-Lipschitz; the search may end at its radius, which is a bound as well
    return cube.bound - math.sqrt(x * x + y * y + z * z) - CAUTION, cube.nearest


@leaf
def promised(x, y, z, voxel):
    """Upper bound of the distance from (x, y, z) by an occupied voxel; infinite for -1."""
    return math.sqrt(square_to(x, y, z, voxel)) + CAUTION if voxel >= 0 else np.inf


@entry(
    CELLS,
    INT,
    CLUSTERS,
    FLOATS3,
    CELL_GRID,
    FLOAT,
    INT,
    record_of(NEAR_CUBE, 1),
    FLOATS,
    INTS,
    INTS,
)
def find_nearest(cells, reader, shell, poses, grid, largest, fine, cubes, squares, nearest, done):
    """Least squared distance from the points to an occupied voxel's box at each of poses (B, 4, 4).

    largest : greatest radius, m, of a run or group searched as a whole. fine : binary logarithm of
    the edge, voxels, of the points' cubes, at most `CUBE_OF_BALL`. squares (B,) : greatest distance
    to search before, least after, squared, voxels; nearest (B,) : the point, or -1 while nothing is
    nearer; done (B,) : points searched. Fewer than N: a cell at the pose is not resident, and a
    later call continues there.
    """
    points, _, spheres, groups, run, _, _ = shell
    size, side, total = grid.size, grid.side, points.shape[0]
    seed = hot = near = np.int64(-1)
    which = begin_frame(cells, reader)
    # made here: references to a leaf's result are not counted
    seen = Seen(cells.keys, cells.slots, cells.words, cells.masks, cells.used, which)
    for n in range(poses.shape[0]):
        if done[n] >= total:
            continue
        transform = transform_of(poses[n])
        square, best = squares[n], nearest[n]
        if seed >= 0 and hot >= 0:  # the nearest voxel at the pose before
            point = in_voxels(transform, grid, points[hot, 0], points[hot, 1], points[hot, 2])
            bound = square_to(point[0], point[1], point[2], seed)
            square, best = (bound, hot) if bound < square else (square, best)
        within, least, first, first_end = math.sqrt(square), np.inf, np.int64(0), np.int64(0)
        for turn in range(SURVEY if done[n] == 0 else ALL, ALL + 1):
            begin = done[n] if turn == ALL else np.int64(0)
            at, end = (first, first_end) if turn == NEAREST_BALL else (begin, total)
            level = _level_at(spheres, groups, run, at, largest)
            while at < end and within > 0.0 and (turn != SURVEY or level != POINT):
                x, y, z, radius, n_points = _ball_at(points, spheres, groups, run, at, level)
                x, y, z = in_voxels(transform, grid, x, y, z)
                radius /= size
                bound, voxel = bound_at(
                    cubes, seen, x, y, z, within + radius, near,
                    fine if level == POINT else CUBE_OF_BALL, side,
                )  # fmt: skip
                near = voxel if voxel >= 0 else near
                if turn == SURVEY:
                    if bound - radius < least:
                        least, first, first_end = bound - radius, at, min(at + n_points, total)
                    within = min(within, promised(x, y, z, voxel) + radius)
                elif bound < within + radius and level != POINT:
                    level = RUN if level == GROUPED and spheres[at // run, 3] <= largest else POINT
                    continue
                elif bound < within:
                    limit, voxel = _bounded_by(x, y, z, within * within, voxel)
                    limit, voxel = nearest_voxel(seen, x, y, z, limit, voxel, side)
                    if voxel == -2:
                        break
                    if voxel >= 0:
                        seed, square, best, within = voxel, limit, at, math.sqrt(limit)
                at += n_points
                level = _level_at(spheres, groups, run, at, largest)
        squares[n], nearest[n] = square, best
        done[n] = total if square == 0.0 else min(at, total)
        hot = best
    end_frame(cells, reader)

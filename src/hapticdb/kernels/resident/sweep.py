"""A path swept through resident cells: poses between poses, hits with their voxels, clearance.

The last two stop at the first cell that is not resident and say where, so that whoever fetches
cells can bring it in and go on; nothing is guessed.
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
    INTS2,
    entry,
    fields_of,
    inlined,
    leaf,
)
from hapticdb.kernels.motion import place as write_pose
from hapticdb.kernels.motion import product, quaternion_by
from hapticdb.kernels.query.contact import center_of, contact_depth, turn
from hapticdb.kernels.query.grouping import first_bound
from hapticdb.kernels.resident.cells import (
    CELLS,
    CLUSTERS,
    EMPTY_SLOT,
    GROUP,
    PLACE,
    begin_frame,
    cell_key,
    end_frame,
    is_sphere_free,
    slot_of,
    spread_key,
)

AXIS_BITS = 21
"""Of each coordinate of a packed voxel, i uppermost."""
AXIS_MASK = (1 << AXIS_BITS) - 1
CAUTION = 1e-6
"""Voxels that a bound is kept on the safe side of roundings."""
MARGIN = 4.0
"""Voxels beyond what matters now that a search looks, so that it need not be repeated soon."""


class Found(NamedTuple):
    """Hits as `find_hits` writes them, H of them.

    samples (H,) int64: indices into the poses; points (H,) int64: of the shell; places (H,) int64:
    where `voxels` has the voxel; depths (H,): metres, not below 0; voxels (capacity,) int64: an
    open-addressing set of packed voxels, -1 where free, its capacity a power of two.
    """

    samples: NDArray[np.int64]
    points: NDArray[np.int64]
    places: NDArray[np.int64]
    depths: NDArray[np.float64]
    voxels: NDArray[np.int64]


FOUND = fields_of(Found, INTS, INTS, INTS, FLOATS, INTS)


class Bounds(NamedTuple):
    """What is known about clearance, in voxels, kept from sample to sample.

    expiry (N,): for each point, a travel at which it may have come to an occupied voxel at the
    earliest, if it went straight there: its distance now is at least expiry - travel; of_runs (C,):
    the same for all points of each run of a cluster; nearest (N,)
    int64: the voxel, packed, that it was nearest to when last looked at, or -1; least (W,): of each
    window of the path so far; state (2,): the least expiry, the least distance of all; where (5,)
    int64: sample, point and voxel of that, the point that was nearest last, and where it stopped.
    """

    expiry: NDArray[np.float64]
    of_runs: NDArray[np.float64]
    nearest: NDArray[np.int64]
    least: NDArray[np.float64]
    state: NDArray[np.float64]
    where: NDArray[np.int64]


BOUNDS = fields_of(Bounds, FLOATS, FLOATS, INTS, FLOATS, FLOATS, INTS)


SOONEST, LEAST = 0, 1
SAMPLE, POINT, VOXEL, NEAREST, STOPPED = 0, 1, 2, 3, 4


@entry(FLOATS3, FLOATS2, FLOATS2, FLOATS2, INTS, FLOATS, INT, FLOATS3)
def poses_between(poses, centers, quaternions, turns, starts, center, first, out):
    """Samples first .. first + B of a path, out (B, 4, 4): its centre on lines, turning by slerp.

    poses (M, 4, 4): as given, which samples at them are; centers (M, 3): where the point `center`
    (3,) of the tool is at each, metres; quaternions (M, 4); turns (M - 1, 3): from each to the
    next, rotation vectors, world frame; starts (M,) int64: which sample each pose is.
    """
    at = first_bound(first + 1, starts, np.int64(0)) - 1
    x, y, z = center[0], center[1], center[2]
    for n in range(out.shape[0]):
        sample = first + n
        while at + 1 < starts.shape[0] and starts[at + 1] <= sample:
            at += 1
        pose = out[n]
        if sample == starts[at]:
            for a in range(4):
                for b in range(4):
                    pose[a, b] = poses[at, a, b]
            continue
        share = (sample - starts[at]) / (starts[at + 1] - starts[at])
        qw, qx = quaternions[at, 0], quaternions[at, 1]
        qy, qz = quaternions[at, 2], quaternions[at, 3]
        qw, qx, qy, qz = product(
            *quaternion_by(share * turns[at, 0], share * turns[at, 1], share * turns[at, 2]),
            qw, qx, qy, qz,
        )  # fmt: skip
        px = centers[at, 0] + share * (centers[at + 1, 0] - centers[at, 0])
        py = centers[at, 1] + share * (centers[at + 1, 1] - centers[at, 1])
        pz = centers[at, 2] + share * (centers[at + 1, 2] - centers[at, 2])
        write_pose(px, py, pz, qw, qx, qy, qz, pose)
        pose[0, 3] -= turn(pose[0, 0], pose[0, 1], pose[0, 2], x, y, z)
        pose[1, 3] -= turn(pose[1, 0], pose[1, 1], pose[1, 2], x, y, z)
        pose[2, 3] -= turn(pose[2, 0], pose[2, 1], pose[2, 2], x, y, z)
        pose[3, 0] = 0.0
        pose[3, 1] = 0.0
        pose[3, 2] = 0.0
        pose[3, 3] = 1.0


@leaf
def packed(i, j, k):
    """Voxel (i, j, k) as one number."""
    return (i << (2 * AXIS_BITS)) | (j << AXIS_BITS) | k


@entry(INTS, INTS2)
def unpack(voxels, out):
    """Undo `packed` for voxels (n,) int64 into out (n, 3)."""
    for n in range(voxels.shape[0]):
        out[n, 0] = voxels[n] >> (2 * AXIS_BITS)
        out[n, 1] = (voxels[n] >> AXIS_BITS) & AXIS_MASK
        out[n, 2] = voxels[n] & AXIS_MASK


@entry(CELLS, INT, CLUSTERS, FLOATS3, INTS, PLACE, INT, INT, FOUND)
def find_hits(cells, reader, shell, poses, samples, place, first, count, found):
    """Hits at poses[samples[first:]], appended to `found` from its entry `count` on.

    Runs of points whose sphere is free are passed over. Returns how many of the samples (S,) are
    done and how many hits there are now: fewer samples than S when a cell was not resident, and the
    rest of the last one's hits are not counted. Depths are those of `cells.felt`, bit for bit.
    """
    keys, slots, words, masks, used = cells.keys, cells.slots, cells.words, cells.masks, cells.used
    points, spheres, groups, run = shell.points, shell.spheres, shell.groups, shell.run
    out_samples, out_points, out_places, out_depths, voxels = found
    capacity = voxels.shape[0]
    ox, oy, oz, size, side = place.x, place.y, place.z, place.size, place.side
    which = begin_frame(cells, reader)
    for at in range(first, samples.shape[0]):
        pose = poses[samples[at]]
        a, b, c, u = pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]
        d, e, f, v = pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]
        g, h, m, w = pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]
        before = count
        group_is_free = False
        for start in range(0, points.shape[0], run):
            if spheres.shape[0] > 0:
                cluster = start // run
                if cluster % GROUP == 0:
                    group_is_free = is_sphere_free(
                        keys, slots, words, masks, used, which, groups, cluster // GROUP, side,
                        size, ox, oy, oz, a, b, c, u, d, e, f, v, g, h, m, w,
                    )  # fmt: skip
                if group_is_free or is_sphere_free(
                    keys, slots, words, masks, used, which, spheres, cluster, side, size,
                    ox, oy, oz, a, b, c, u, d, e, f, v, g, h, m, w,
                ):  # fmt: skip
                    continue
            for n in range(start, min(start + run, points.shape[0])):
                px, py, pz = points[n, 0], points[n, 1], points[n, 2]
                px, py, pz = (
                    turn(a, b, c, px, py, pz) + u,
                    turn(d, e, f, px, py, pz) + v,
                    turn(g, h, m, px, py, pz) + w,
                )
                x, y, z = (px - ox) / size, (py - oy) / size, (pz - oz) / size
                if not (0.0 <= x < side and 0.0 <= y < side and 0.0 <= z < side):
                    continue
                i, j, k = np.int64(x), np.int64(y), np.int64(z)
                slot = slot_of(keys, slots, which, cell_key(i, j, k))
                if slot < 0:
                    end_frame(cells, reader)
                    return at, before
                if not (words[slot, ((i & 31) << 5) | (j & 31)] >> np.uint32(k & 31)) & 1:
                    continue
                nx, ny, nz = points[n, 3], points[n, 4], points[n, 5]
                nx, ny, nz = (
                    turn(a, b, c, nx, ny, nz),
                    turn(d, e, f, nx, ny, nz),
                    turn(g, h, m, nx, ny, nz),
                )
                cx, cy, cz = (
                    center_of(px, ox, size),
                    center_of(py, oy, size),
                    center_of(pz, oz, size),
                )
                voxel = packed(i, j, k)
                entry_at = spread_key(voxel, capacity)
                while voxels[entry_at] >= 0 and voxels[entry_at] != voxel:
                    entry_at = (entry_at + 1) & (capacity - 1)
                voxels[entry_at] = voxel
                out_samples[count] = samples[at]
                out_points[count] = n
                out_places[count] = entry_at
                out_depths[count] = max(contact_depth(px, py, pz, nx, ny, nz, cx, cy, cz), 0.0)
                count += 1
    end_frame(cells, reader)
    return samples.shape[0], count


@leaf
def gap(x, low, high):
    """How far x lies outside the interval low .. high."""
    return max(low - x, x - high, 0.0)


@inlined
def nearest_in_cell(words, slot, mask, ci, cj, ck, x, y, z, square, voxel):
    """Least squared distance to a voxel of one cell, and that voxel, packed; those given if nearer.

    All in voxels.
    """
    radius = math.sqrt(square)
    for bi in range(4):
        if not (mask >> np.uint64(bi << 4)) & np.uint64(0xFFFF):
            continue
        i0 = (ci << 5) + (bi << 3)
        di = gap(x, i0, i0 + 8.0)
        if di >= radius:
            continue
        for bj in range(4):
            if not (mask >> np.uint64((bi << 4) | (bj << 2))) & np.uint64(0xF):
                continue
            j0 = (cj << 5) + (bj << 3)
            dj = gap(y, j0, j0 + 8.0)
            if di * di + dj * dj >= square:
                continue
            for bk in range(4):
                if not (mask >> np.uint64((bi << 4) | (bj << 2) | bk)) & np.uint64(1):
                    continue
                k0 = (ck << 5) + (bk << 3)
                dk = gap(z, k0, k0 + 8.0)
                if di * di + dj * dj + dk * dk >= square:
                    continue
                for i in range(i0, i0 + 8):
                    dx = gap(x, i, i + 1.0)
                    if dx * dx >= square:
                        continue
                    for j in range(j0, j0 + 8):
                        dy = gap(y, j, j + 1.0)
                        column = dx * dx + dy * dy
                        if column >= square:
                            continue
                        word = words[slot, ((i & 31) << 5) | (j & 31)]
                        byte = (np.int64(word) >> (k0 & 31)) & 255
                        k = k0
                        while byte:
                            if byte & 1:
                                dz = gap(z, k, k + 1.0)
                                if column + dz * dz < square:
                                    square = column + dz * dz
                                    voxel = packed(i, j, k)
                            byte >>= 1
                            k += 1
    return square, voxel


@leaf
def square_to(x, y, z, voxel):
    """Squared distance to the box of a packed voxel, all in voxels."""
    i, j, k = voxel >> (2 * AXIS_BITS), (voxel >> AXIS_BITS) & AXIS_MASK, voxel & AXIS_MASK
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
                slot = slot_of(keys, slots, which, (ci << 32) | (cj << 16) | ck)
                if slot < 0:
                    return square, np.int64(-2)
                if slot == EMPTY_SLOT:
                    continue
                used[slot] = 1
                square, voxel = nearest_in_cell(
                    words, slot, masks[slot], ci, cj, ck, x, y, z, square, voxel
                )
    return square, voxel


@inlined
def far_run(
    keys, slots, words, masks, used, which, spheres, at, near, cap, side, size, ox, oy, oz,
    a, b, c, u, d, e, f, v, g, h, m, w,
):  # fmt: skip
    """Bound, voxels, from a placed run's sphere to what is nearest, as far as `cap`; -1 if unknown.

    near: a voxel, packed, to begin with, or -1. A point of the run is no nearer than the bound.
    """
    x, y, z = spheres[at, 0], spheres[at, 1], spheres[at, 2]
    radius = spheres[at, 3] / size
    x, y, z = (
        (turn(a, b, c, x, y, z) + u - ox) / size,
        (turn(d, e, f, x, y, z) + v - oy) / size,
        (turn(g, h, m, x, y, z) + w - oz) / size,
    )
    square, voxel = (cap + radius + MARGIN) ** 2, np.int64(-1)
    if near >= 0 and square_to(x, y, z, near) < square:
        square, voxel = square_to(x, y, z, near), near
    square, voxel = nearest_voxel(
        keys, slots, words, masks, used, which, x, y, z, square, voxel, side
    )
    return -1.0 if voxel == -2 else max(math.sqrt(square) - radius, 0.0)


@entry(CELLS, INT, CLUSTERS, FLOATS3, INT, INT, FLOATS, INTS, PLACE, FLOAT, BOUNDS)
def find_clearance(
    cells, reader, shell, poses, first, base, travels, windows, place, small, bounds
):  # fmt: skip
    """Least distance from the points to an occupied voxel's box at poses[first:], in `bounds`.

    travels (B,): how far any point can have come at each pose since the path's start, voxels;
    windows (B,) int64: which of `bounds.least` each pose counts for; base: number of poses[0] as a
    sample of the path; small: voxels, runs of no greater radius are looked at as one, before their
    points. Returns how many poses are done: fewer than B when a cell was not resident,
    and `bounds.where` has the point, or the first of the run.
    """
    keys, slots, words, masks, used = cells.keys, cells.slots, cells.words, cells.masks, cells.used
    points, spheres, run = shell.points, shell.spheres, shell.run
    expiry, of_runs, nearest, least, state, where = bounds
    ox, oy, oz, size, side = place.x, place.y, place.z, place.size, place.side
    total = points.shape[0]
    which = begin_frame(cells, reader)
    for n in range(first, poses.shape[0]):
        travel, window = travels[n], windows[n]
        cap = least[window]
        if state[SOONEST] - travel >= cap:
            continue
        a, b, c, u = poses[n, 0, 0], poses[n, 0, 1], poses[n, 0, 2], poses[n, 0, 3]
        d, e, f, v = poses[n, 1, 0], poses[n, 1, 1], poses[n, 1, 2], poses[n, 1, 3]
        g, h, m, w = poses[n, 2, 0], poses[n, 2, 1], poses[n, 2, 2], poses[n, 2, 3]
        soonest = np.inf
        # the run of what was nearest last comes first: it bounds the search for all others
        for turn_of in range(-1, of_runs.shape[0]):
            at = where[NEAREST] // run if turn_of < 0 else turn_of
            start = at * run
            is_expired = of_runs[at] - travel < cap and turn_of >= 0
            if is_expired and spheres.shape[0] > 0 and spheres[at, 3] <= small * size:
                bound = far_run(
                    keys, slots, words, masks, used, which, spheres, at, nearest[start], cap, side,
                    size, ox, oy, oz, a, b, c, u, d, e, f, v, g, h, m, w,
                )  # fmt: skip
                if bound < 0.0:
                    where[STOPPED] = start
                    end_frame(cells, reader)
                    return n
                of_runs[at] = max(of_runs[at], travel + bound - CAUTION)
            if of_runs[at] - travel < cap:
                soonest_of_run = np.inf
                for p in range(start, min(start + run, total)):
                    if expiry[p] - travel < cap:
                        px, py, pz = points[p, 0], points[p, 1], points[p, 2]
                        x = (turn(a, b, c, px, py, pz) + u - ox) / size
                        y = (turn(d, e, f, px, py, pz) + v - oy) / size
                        z = (turn(g, h, m, px, py, pz) + w - oz) / size
                        square, voxel = (cap + MARGIN) ** 2, np.int64(-1)
                        if nearest[p] >= 0 and square_to(x, y, z, nearest[p]) < square:
                            square, voxel = square_to(x, y, z, nearest[p]), nearest[p]
                        square, voxel = nearest_voxel(
                            keys, slots, words, masks, used, which, x, y, z, square, voxel, side
                        )
                        if voxel == -2:
                            where[STOPPED] = p
                            end_frame(cells, reader)
                            return n
                        distance = math.sqrt(square)
                        nearest[p] = voxel
                        expiry[p] = travel + distance - CAUTION
                        if voxel >= 0 and distance < cap:
                            cap = distance
                            where[NEAREST] = p
                            if distance < state[LEAST]:
                                state[LEAST] = distance
                                where[SAMPLE] = base + n
                                where[POINT] = p
                                where[VOXEL] = voxel
                    soonest_of_run = min(soonest_of_run, expiry[p])
                of_runs[at] = soonest_of_run
            if turn_of >= 0:
                soonest = min(soonest, of_runs[at])
        least[window] = cap
        state[SOONEST] = soonest
    end_frame(cells, reader)
    return poses.shape[0]


@entry(FLOATS2, FLOATS3, PLACE, INT, INT, FLOAT, INTS, INT)
def cells_near(points, poses, place, first, stride, reach, found, most):
    """Distinct cells within reach, metres, of points (N, 3+): at poses[0] from point `first` on.

    Then at every stride-th pose, all points. They go into found (capacity,) int64, -1 all over
    before, an open-addressing set whose capacity is a power of two, above 2 most; it ends before
    they are more than `most`. Returns how many they are.
    """
    capacity = found.shape[0]
    ox, oy, oz, size, side = place.x, place.y, place.z, place.size, place.side
    top = side - 1.0
    r = reach / size
    count = 0
    for n in range(0, poses.shape[0], stride):
        a, b, c, u = poses[n, 0, 0], poses[n, 0, 1], poses[n, 0, 2], poses[n, 0, 3]
        d, e, f, v = poses[n, 1, 0], poses[n, 1, 1], poses[n, 1, 2], poses[n, 1, 3]
        g, h, m, w = poses[n, 2, 0], poses[n, 2, 1], poses[n, 2, 2], poses[n, 2, 3]
        low_memo = high_memo = np.int64(-1)
        for p in range(first if n == 0 else 0, points.shape[0]):
            px, py, pz = points[p, 0], points[p, 1], points[p, 2]
            x = (turn(a, b, c, px, py, pz) + u - ox) / size
            y = (turn(d, e, f, px, py, pz) + v - oy) / size
            z = (turn(g, h, m, px, py, pz) + w - oz) / size
            if not (-r <= x <= side + r and -r <= y <= side + r and -r <= z <= side + r):
                continue
            first_i, last_i = np.int64(max(x - r, 0.0)) >> 5, np.int64(min(x + r, top)) >> 5
            first_j, last_j = np.int64(max(y - r, 0.0)) >> 5, np.int64(min(y + r, top)) >> 5
            first_k, last_k = np.int64(max(z - r, 0.0)) >> 5, np.int64(min(z + r, top)) >> 5
            low = (first_i << 32) | (first_j << 16) | first_k
            high = (last_i << 32) | (last_j << 16) | last_k
            if low == low_memo and high == high_memo:
                continue
            low_memo, high_memo = low, high
            n_cells = (last_i - first_i + 1) * (last_j - first_j + 1) * (last_k - first_k + 1)
            if count + n_cells > most and count > 0:
                return count
            for ci in range(first_i, last_i + 1):
                for cj in range(first_j, last_j + 1):
                    for ck in range(first_k, last_k + 1):
                        key = (ci << 32) | (cj << 16) | ck
                        at = spread_key(key, capacity)
                        while found[at] >= 0 and found[at] != key:
                            at = (at + 1) & (capacity - 1)
                        if found[at] < 0:
                            found[at] = key
                            count += 1
    return count

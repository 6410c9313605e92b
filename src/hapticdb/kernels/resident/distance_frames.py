"""Frames of the distance law over resident cells: `feeling.felt`, many points at a time.

A run goes through short loops, one after another, over the points in near voxels. In one long loop
a processor has room for hardly more than one point at a time, waits for each look-up, and takes 1.6
times as long. No loop after the first branches. The sums run in the order of the points, and a
point that does not push adds zero, so the results are those of the frames on rows, bit for bit.
"""

import numpy as np

from hapticdb.kernels._jit import inlined
from hapticdb.kernels.field.corners import fetch_corners, interpolated
from hapticdb.kernels.field.lattice import CELL_VALUES, VOXELS_A_STEP, cell_place, place_before
from hapticdb.kernels.field.law import AHEAD, agreement, depth_and_weight
from hapticdb.kernels.law import accumulate, average_into
from hapticdb.kernels.resident.cells import (
    CELL_WORDS,
    CONTACTS,
    DEEPEST,
    HITS,
    LISTED,
    UNKNOWN,
    UNKNOWNS,
    bit_in,
    brick_bit,
    cell_key,
    column_of,
    enter_cell,
)
from hapticdb.kernels.resident.runs import (
    BASE,
    BIT,
    INDEX,
    KEPT,
    WORD,
    WORD_BITS,
    cells_of_run,
    free_runs,
    keep_points,
    place_run,
    words_of_run,
)
from hapticdb.kernels.rigid import moved, transform_of, turned

NORMAL, LOOK_UP, PART, HERE, THERE, DEPTH, WEIGHT = 6, 11, 12, 15, 16, 17, 18
"""Rows of the scratch, after the six of `place_run` and beside `runs.INDEX` and `runs.BASE`.

The turned normal (3); the index of the lowest corner around a place, and the place between the
corners (3); distance at the point and ahead of it, voxels; depth, m; weight. Indices are whole
numbers that a float has exactly.
"""


@inlined
def _near_of_run(
    keys, slots, words, masks, used, near, which, start, count, side, scratch, met, missed, n_hits,
    n_missed, last_key, slot, mask, base,
):  # fmt: skip
    """Move the points of a placed run that are in near voxels to the front of `scratch`.

    Every point in a known brick is written there, and the next one over it if it was not near: a
    mispredicted branch costs more. last_key, slot, mask, base: the cell of the last point. Returns
    the numbers of near points, of hits and of cells on the list `missed` so far, and of points in
    unknown cells, and then the cell of the last point.
    """
    n_near = n_unknown = np.int64(0)
    for at in range(count):
        x, y, z = scratch[3, at], scratch[4, at], scratch[5, at]
        if not (0.0 <= x < side and 0.0 <= y < side and 0.0 <= z < side):
            continue
        i, j, k = np.int64(x), np.int64(y), np.int64(z)
        key = cell_key(i, j, k)
        if key != last_key:
            last_key = key
            slot, mask, n_missed = enter_cell(
                keys, slots, masks, used, which, key, missed, n_missed
            )
            first = cell_place(np.int64(0), np.int64(0), np.int64(0)) + slot * CELL_VALUES
            base = float(first - place_before(i & -32, j & -32, k & -32))
        if not (mask >> brick_bit(i, j, k)) & np.uint64(1):
            n_unknown += slot < 0
            continue
        column = column_of(i, j)
        met[n_hits] = start + at
        n_hits += np.int64(bit_in(words[slot, column], k))
        scratch[0, n_near], scratch[3, n_near] = scratch[0, at], x
        scratch[1, n_near], scratch[4, n_near] = scratch[1, at], y
        scratch[2, n_near], scratch[5, n_near] = scratch[2, at], z
        scratch[INDEX, n_near], scratch[BASE, n_near] = start + at, base
        n_near += np.int64(bit_in(near[slot, column], k))
    return n_near, n_hits, n_missed, n_unknown, last_key, slot, mask, base


@inlined
def _near_in_cells(words, near, start, count, n_cells, n_j, n_k, ci, cj, ck, scratch, met, n_hits):
    """`_near_of_run` for a run in the cells that `runs.cells_of_run` found: without a branch.

    Returns the numbers of near points and of hits. A hit is near, and a near voxel in a brick.
    """
    words_of_run(count, n_cells, n_j, n_k, ci, cj, ck, start, scratch)
    n_near = np.int64(0)
    for at in range(count):
        word, bit = np.int64(scratch[WORD, at]), np.int64(scratch[BIT, at])
        slot, column = word >> WORD_BITS, word & (CELL_WORDS - 1)
        met[n_hits] = start + at
        n_hits += np.int64(bit_in(words[slot, column], bit))
        scratch[KEPT, n_near] = at
        n_near += np.int64(bit_in(near[slot, column], bit))
    keep_points(scratch, count, n_near, BASE + 1)
    return n_near, n_hits


@inlined
def _find_places(scratch, count, ahead):
    """Where to look up the first points of `scratch`, moved `ahead` voxels along their normals."""
    for at in range(count):
        x = scratch[3, at] + ahead * scratch[NORMAL, at]
        y = scratch[4, at] + ahead * scratch[NORMAL + 1, at]
        z = scratch[5, at] + ahead * scratch[NORMAL + 2, at]
        x0, y0, z0 = np.floor(x - 0.5), np.floor(y - 0.5), np.floor(z - 0.5)
        scratch[LOOK_UP, at] = scratch[BASE, at] + place_before(x0, y0, z0)
        scratch[PART, at] = x - 0.5 - x0
        scratch[PART + 1, at] = y - 0.5 - y0
        scratch[PART + 2, at] = z - 0.5 - z0


@inlined
def _look_up(payload, scratch, count, row):
    """Distances u, voxels, at the places of the first points of `scratch`, into a row of it."""
    for at in range(count):
        scratch[row, at] = VOXELS_A_STEP * interpolated(
            payload, np.uint64(np.int64(scratch[LOOK_UP, at])), scratch[PART, at],
            scratch[PART + 1, at], scratch[PART + 2, at],
        )  # fmt: skip


@inlined
def _weigh(payload, points, transform, size, scratch, count):
    """Turned normal, depth (at least 0) and weight of the first points of `scratch`.

    Distances are fetched into the cache while the normals are turned. This takes a seventh off a
    frame of 100,000 contacts.
    """
    for row in range(NORMAL, NORMAL + 3):
        for at in range(count):
            scratch[row, at] = 0.0
    _find_places(scratch, count, 0.0)
    for at in range(count):
        fetch_corners(payload, np.uint64(np.int64(scratch[LOOK_UP, at])))
    for at in range(count):
        n = np.int64(scratch[INDEX, at])
        nx, ny, nz = turned(transform, points[n, 3], points[n, 4], points[n, 5])
        scratch[NORMAL, at] = nx
        scratch[NORMAL + 1, at] = ny
        scratch[NORMAL + 2, at] = nz
    _look_up(payload, scratch, count, HERE)
    _find_places(scratch, count, AHEAD)
    _look_up(payload, scratch, count, THERE)
    for at in range(count):
        share = agreement(scratch[HERE, at], scratch[THERE, at])
        depth, weight = depth_and_weight(scratch[HERE, at], size)
        scratch[DEPTH, at] = max(depth * share, 0.0)
        scratch[WEIGHT, at] = weight * share


def felt_by_distance(law, cells, which, shell, pose, place, met, missed, out):
    """`feeling.felt` under the distance law; the table has distances."""
    _, _, keys, slots, words, masks, used, payload, near = cells
    points, _, spheres, groups, run, columns, scratch = shell
    transform = transform_of(pose)
    mx, my, mz = moved(transform, shell.center[0], shell.center[1], shell.center[2])
    fx = fy = fz = tx = ty = tz = weight = deepest = 0.0
    last_key, slot, mask, base = np.int64(-1), np.int64(UNKNOWN), np.uint64(0), 0.0
    n_hits = n_contacts = n_unknown = n_missed = cluster = start = np.int64(0)
    while start < points.shape[0]:
        n_free = free_runs(
            keys, slots, near, masks, used, which, spheres, groups, cluster, transform, place, 0.0
        )
        if n_free > 0:
            cluster += n_free
            start += n_free * run
            continue
        n_run = min(run, points.shape[0] - start)
        place_run(columns, start, n_run, transform, place, scratch)
        n_near = np.int64(0)
        n_cells, n_j, n_k, ci, cj, ck = cells_of_run(
            keys, slots, masks, used, which, n_run, place.side, scratch
        )
        if n_cells > 0:
            n_near, n_hits = _near_in_cells(
                words, near, start, n_run, n_cells, n_j, n_k, ci, cj, ck, scratch, met, n_hits
            )
        elif n_cells < 0:
            n_near, n_hits, n_missed, n_strange, last_key, slot, mask, base = _near_of_run(
                keys, slots, words, masks, used, near, which, start, n_run, place.side, scratch,
                met, missed, n_hits, n_missed, last_key, slot, mask, base,
            )  # fmt: skip
            n_unknown += n_strange
        cluster += 1
        start += n_run
        if n_near == 0:
            continue
        _weigh(payload, points, transform, place.size, scratch, n_near)
        for at in range(n_near):
            depth = scratch[DEPTH, at]
            weight += scratch[WEIGHT, at]
            n_contacts += depth > 0.0
            deepest = max(deepest, depth)
            fx, fy, fz, tx, ty, tz = accumulate(
                fx, fy, fz, tx, ty, tz, scratch[0, at], scratch[1, at], scratch[2, at],
                scratch[NORMAL, at], scratch[NORMAL + 1, at], scratch[NORMAL + 2, at],
                mx, my, mz, depth, law.stiffness,
            )  # fmt: skip
    average_into(out, weight, fx, fy, fz, tx, ty, tz)
    out[HITS], out[CONTACTS] = n_hits, n_contacts
    out[UNKNOWNS], out[DEEPEST] = n_unknown, deepest
    missed[LISTED] = n_missed

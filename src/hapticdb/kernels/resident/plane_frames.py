"""Frames of the tangent-plane law over resident cells: `feeling.felt`, many points at a time.

A run goes through short loops, as in `distance_frames`: the points that hit move to the front of
the scratch, then come normals, depths and sums. Where a run meets few cells, all of them known, no
loop branches. The sums run in the order of the points, and a point that does not push adds zero, so
the results are those of `feeling.felt`, bit for bit.
"""

import numpy as np

from hapticdb.kernels._jit import inlined
from hapticdb.kernels.law import accumulate, average_into, depth_below_plane
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
    BIT,
    KEPT,
    PLACES,
    WORD,
    WORD_BITS,
    cells_of_run,
    free_runs,
    keep_points,
    place_run,
    words_of_run,
)
from hapticdb.kernels.rigid import moved, transform_of, turned

NORMAL, DEPTH = 6, 9
"""Rows of the scratch, after the six of `place_run`: the turned normal (3); depth, m."""


@inlined
def _hits_in_cells(words, start, count, n_cells, n_j, n_k, ci, cj, ck, scratch, met, n_before):
    """Move the hits of a run in the cells of `runs.cells_of_run` to the front; returns n_hits.

    met takes their indices from `n_before` on; scratch, rows 0-5, their places.
    """
    words_of_run(count, n_cells, n_j, n_k, ci, cj, ck, start, scratch)
    n_hits = np.int64(0)
    for at in range(count):
        word, bit = np.int64(scratch[WORD, at]), np.int64(scratch[BIT, at])
        met[n_before + n_hits] = start + at
        scratch[KEPT, n_hits] = at
        n_hits += np.int64(bit_in(words[word >> WORD_BITS, word & (CELL_WORDS - 1)], bit))
    keep_points(scratch, count, n_hits, PLACES)
    return n_hits


@inlined
def _hits_of_run(
    keys, slots, words, masks, used, which, start, count, side, scratch, met, n_before, missed,
    n_missed, last_key, slot, mask,
):  # fmt: skip
    """`_hits_in_cells` for any run, point by point.

    last_key, slot, mask: the cell of the last point. Returns the numbers of hits, of points in
    unknown cells, and of cells on the list `missed` so far, and then the cell of the last point.
    """
    n_hits = n_unknown = np.int64(0)
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
        # bricks first: most of space is free, and the mask is in a register
        if not (mask >> brick_bit(i, j, k)) & np.uint64(1):
            n_unknown += slot < 0
            continue
        if bit_in(words[slot, column_of(i, j)], k):
            met[n_before + n_hits] = start + at
            scratch[0, n_hits], scratch[3, n_hits] = scratch[0, at], x
            scratch[1, n_hits], scratch[4, n_hits] = scratch[1, at], y
            scratch[2, n_hits], scratch[5, n_hits] = scratch[2, at], z
            n_hits += 1
    return n_hits, n_unknown, n_missed, last_key, slot, mask


@inlined
def _respond_to_hits(points, transform, place, met, n_before, count, scratch):
    """Turned normals and depths (at least 0) of the first points of the scratch.

    The voxels' centres are those of `contact.center_of`, whose quotient is in the scratch already.
    """
    ox, oy, oz, size = place.x, place.y, place.z, place.size
    for at in range(count):
        n = met[n_before + at]
        nx, ny, nz = turned(transform, points[n, 3], points[n, 4], points[n, 5])
        scratch[NORMAL, at] = nx
        scratch[NORMAL + 1, at] = ny
        scratch[NORMAL + 2, at] = nz
    for at in range(count):
        px, py, pz = scratch[0, at], scratch[1, at], scratch[2, at]
        depth = depth_below_plane(
            px, py, pz, scratch[NORMAL, at], scratch[NORMAL + 1, at], scratch[NORMAL + 2, at],
            ox + size * (np.floor(scratch[3, at]) + 0.5),
            oy + size * (np.floor(scratch[4, at]) + 0.5),
            oz + size * (np.floor(scratch[5, at]) + 0.5),
        )  # fmt: skip
        scratch[DEPTH, at] = max(depth, 0.0)


def felt_by_plane(law, cells, which, shell, pose, place, met, missed, out):
    """`feeling.felt` under the tangent-plane law."""
    _, _, keys, slots, words, masks, used, _, _ = cells
    points, _, spheres, groups, run, columns, scratch = shell
    transform = transform_of(pose)
    mx, my, mz = moved(transform, shell.center[0], shell.center[1], shell.center[2])
    fx = fy = fz = tx = ty = tz = deepest = 0.0
    last_key, slot, mask = np.int64(-1), np.int64(UNKNOWN), np.uint64(0)
    n_hits = n_contacts = n_unknown = n_missed = cluster = start = np.int64(0)
    while start < points.shape[0]:
        n_free = free_runs(
            keys, slots, words, masks, used, which, spheres, groups, cluster, transform, place, 0.0
        )
        if n_free > 0:
            cluster += n_free
            start += n_free * run
            continue
        n_run = min(run, points.shape[0] - start)
        place_run(columns, start, n_run, transform, place, scratch)
        n_new = np.int64(0)
        n_cells, n_j, n_k, ci, cj, ck = cells_of_run(
            keys, slots, masks, used, which, n_run, place.side, scratch
        )
        if n_cells > 0:
            n_new = _hits_in_cells(
                words, start, n_run, n_cells, n_j, n_k, ci, cj, ck, scratch, met, n_hits
            )
        elif n_cells < 0:
            n_new, n_strange, n_missed, last_key, slot, mask = _hits_of_run(
                keys, slots, words, masks, used, which, start, n_run, place.side, scratch, met,
                n_hits, missed, n_missed, last_key, slot, mask,
            )  # fmt: skip
            n_unknown += n_strange
        cluster += 1
        start += n_run
        if n_new == 0:
            continue
        _respond_to_hits(points, transform, place, met, n_hits, n_new, scratch)
        n_hits += n_new
        for at in range(n_new):
            depth = scratch[DEPTH, at]
            n_contacts += depth > 0.0
            deepest = max(deepest, depth)
            fx, fy, fz, tx, ty, tz = accumulate(
                fx, fy, fz, tx, ty, tz, scratch[0, at], scratch[1, at], scratch[2, at],
                scratch[NORMAL, at], scratch[NORMAL + 1, at], scratch[NORMAL + 2, at],
                mx, my, mz, depth, law.stiffness,
            )  # fmt: skip
    average_into(out, float(n_hits), fx, fy, fz, tx, ty, tz)
    out[HITS], out[CONTACTS] = n_hits, n_contacts
    out[UNKNOWNS], out[DEEPEST] = n_unknown, deepest
    missed[LISTED] = n_missed

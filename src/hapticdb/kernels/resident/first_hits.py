"""Whether a shell hits anything at poses in no order: the search of a pose ends at one hit."""

import numpy as np

from hapticdb.kernels._jit import FLOATS3, INT, INTS, entry
from hapticdb.kernels.resident.cells import (
    CELLS,
    CLUSTERS,
    GROUP,
    PLACE,
    Seen,
    begin_frame,
    bit_in,
    cell_key,
    column_of,
    end_frame,
    slot_of,
)
from hapticdb.kernels.resident.runs import free_runs, place_run
from hapticdb.kernels.rigid import transform_of

NOTHING, UNDECIDED = -1, -2
"""In the place of a point: no point hits; no point hits in a cell that is resident, and one lies in
a cell that is not."""


@entry(CELLS, INT, CLUSTERS, FLOATS3, PLACE, INTS)
def find_first_hits(cells, reader, shell, poses, place, found):
    """A point that is in an occupied voxel at each of poses (B, 4, 4), into found (B,) int64.

    It is NOTHING or UNDECIDED where there is none. The search begins at the points that hit last,
    so neighbouring poses should follow one another. Hits are those of `feeling.felt`.
    """
    points, _, spheres, groups, run, columns, scratch = shell
    side, total = place.side, points.shape[0]
    begin = np.int64(0)
    which = begin_frame(cells, reader)
    # made here: references to what a leaf returns are not counted
    seen = Seen(cells.keys, cells.slots, cells.words, cells.masks, cells.used, which)
    for n in range(poses.shape[0]):
        transform = transform_of(poses[n])
        hit = np.int64(NOTHING)
        for turn in range(2):  # from the points that hit last to the end, then those before
            start, end = (begin, total) if turn == 0 else (np.int64(0), begin)
            cluster = start // run
            while start < end and hit < 0:
                n_free = free_runs(seen, spheres, groups, cluster, transform, place, 0.0)
                if n_free > 0:
                    cluster += n_free
                    start += n_free * run
                    continue
                n_run = min(run, total - start)
                place_run(columns, start, n_run, transform, place, scratch)
                for at in range(n_run):
                    x, y, z = scratch[3, at], scratch[4, at], scratch[5, at]
                    if not (0.0 <= x < side and 0.0 <= y < side and 0.0 <= z < side):
                        continue
                    i, j, k = np.int64(x), np.int64(y), np.int64(z)
                    slot = slot_of(seen.keys, seen.slots, seen.which, cell_key(i, j, k))
                    if slot < 0:
                        hit = np.int64(UNDECIDED)
                    elif bit_in(seen.words[slot, column_of(i, j)], k):
                        hit = start + at
                        break
                cluster += 1
                start += n_run
            if hit >= 0:
                break
        found[n] = hit
        if hit >= 0:
            begin = hit // (GROUP * run) * (GROUP * run)
    end_frame(cells, reader)

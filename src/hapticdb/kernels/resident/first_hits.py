"""Whether a shell hits anything at poses in no order: the search of a pose ends at one hit."""

import numpy as np

from hapticdb.kernels._jit import FLOATS3, INT, INTS, entry, inlined
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
    n_runs_of,
    slot_of,
)
from hapticdb.kernels.resident.runs import next_run, place_run, scratch_of
from hapticdb.kernels.rigid import transform_of

NOTHING, UNDECIDED = -1, -2
"""In the place of a point: no point hits; no point hits in a cell that is resident, and one lies in
a cell that is not."""


@inlined
def _hit_in_run(seen, shell, scratch, run, transform, place):
    """A point of a run that is in an occupied voxel, NOTHING or UNDECIDED."""
    side, hit = place.side, np.int64(NOTHING)
    start, count = place_run(shell, run, transform, place, scratch)
    for at in range(count):
        x, y, z = scratch.x[at], scratch.y[at], scratch.z[at]
        if not (0.0 <= x < side and 0.0 <= y < side and 0.0 <= z < side):
            continue
        i, j, k = np.int64(x), np.int64(y), np.int64(z)
        slot = slot_of(seen.keys, seen.slots, seen.which, cell_key(i, j, k))
        if slot < 0:
            hit = np.int64(UNDECIDED)
        elif bit_in(seen.words[slot, column_of(i, j)], k):
            return start + at
    return hit


@inlined
def _first_hit(seen, shell, transform, place, begin):
    """A point that hits, NOTHING or UNDECIDED; the search begins at run `begin`."""
    scratch, hit = scratch_of(shell), np.int64(NOTHING)
    for turn in range(2):  # from there to the end, then the runs before
        run, end = (begin, n_runs_of(shell)) if turn == 0 else (np.int64(0), begin)
        while True:
            run = next_run(seen, shell, run, end, transform, place, 0.0)
            if run >= end:
                break
            found = _hit_in_run(seen, shell, scratch, run, transform, place)
            if found >= 0:
                return found
            hit = min(hit, found)
            run += 1
    return hit


@entry(CELLS, INT, CLUSTERS, FLOATS3, PLACE, INTS)
def find_first_hits(cells, reader, shell, poses, place, found):
    """A point that is in an occupied voxel at each of poses (B, 4, 4), into found (B,) int64.

    It is NOTHING or UNDECIDED where there is none. The search begins at the points that hit last,
    so neighbouring poses should follow one another. Hits are those of `feeling.felt`.
    """
    begin = np.int64(0)
    which = begin_frame(cells, reader)
    # made here: references to what a leaf returns are not counted
    seen = Seen(cells.keys, cells.slots, cells.words, cells.masks, cells.used, which)
    for n in range(poses.shape[0]):
        found[n] = _first_hit(seen, shell, transform_of(poses[n]), place, begin)
        if found[n] >= 0:
            begin = found[n] // (GROUP * shell.run) * GROUP
    end_frame(cells, reader)

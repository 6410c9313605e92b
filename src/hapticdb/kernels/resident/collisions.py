"""Collision queries of a shell at poses in any order: a pose ends at its first hit."""

import numpy as np

from hapticdb.kernels._jit import FLOATS3, INT, INTS, entry, inlined
from hapticdb.kernels.resident.cells import (
    CELL_GRID,
    CELLS,
    CLUSTERS,
    GROUP,
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
"""Instead of a point: no hit; no hit in a resident cell, and a point in an unknown one."""


@inlined
def _hit_in_run(seen, shell, scratch, run, transform, grid):
    """Point of a run in an occupied voxel, NOTHING or UNDECIDED."""
    side, hit = grid.side, np.int64(NOTHING)
    start, count = place_run(shell, run, transform, grid, scratch)
    for at in range(count):
        x, y, z = scratch.x[at], scratch.y[at], scratch.z[at]
        if not (0.0 <= x < side and 0.0 <= y < side and 0.0 <= z < side):
            continue
        i, j, k = np.int64(x), np.int64(y), np.int64(z)
        slot = slot_of(seen.keys, seen.slots, seen.which, cell_key(i, j, k))
        if slot < 0:
            # goes on: a hit in a resident cell outweighs it
            hit = np.int64(UNDECIDED)
        elif bit_in(seen.words[slot, column_of(i, j)], k):
            return start + at
    return hit


@inlined
def _first_hit(seen, shell, transform, grid, begin):
    """Point of a shell in an occupied voxel, NOTHING or UNDECIDED; starts at run `begin`."""
    scratch, hit = scratch_of(shell), np.int64(NOTHING)
    for turn in range(2):  # from there to the end, then the runs before
        run, end = (begin, n_runs_of(shell)) if turn == 0 else (np.int64(0), begin)
        while True:
            run = next_run(seen, shell, run, end, transform, grid, 0.0)
            if run >= end:
                break
            found = _hit_in_run(seen, shell, scratch, run, transform, grid)
            if found >= 0:
                return found
            hit = min(hit, found)  # UNDECIDED outweighs NOTHING
            run += 1
    return hit


@entry(CELLS, INT, CLUSTERS, FLOATS3, CELL_GRID, INTS)
def find_first_hits(cells, reader, shell, poses, grid, found):
    """A point in an occupied voxel at each of poses (B, 4, 4), into found (B,) int64.

    It is NOTHING or UNDECIDED without one. The search begins at the group of the last hit, so
    neighbouring poses should follow one another. Hits are those of `cell_frames.evaluate_frame`.
    """
    begin = np.int64(0)
    which = begin_frame(cells, reader)
    # made here: references to a leaf's result are not counted
    seen = Seen(cells.keys, cells.slots, cells.words, cells.masks, cells.used, which)
    for n in range(poses.shape[0]):
        found[n] = _first_hit(seen, shell, transform_of(poses[n]), grid, begin)
        if found[n] >= 0:
            begin = found[n] // (GROUP * shell.run) * GROUP
    end_frame(cells, reader)

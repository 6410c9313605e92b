"""Budgets of points: how many points near something a frame of a large tool looks at.

A frame within the budget is that of the flat loop, bit for bit. A frame beyond it looks at one of
each 2, 4, 8 ... points of the runs near something. Which points these are depends on the runs that
are near, so it must not depend on what is in memory. An unknown cell counts as occupied, and would
make runs near that are not. So a frame beyond its budget that has a listed run beside an unknown
cell counts that run as an unknown point: the loop holds the frame, and a replay leaves it out.
Every frame that is compared has the same points in a session and in a replay.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import (
    FLOATS2,
    FLOATS3,
    INT,
    INTS,
    INTS2,
    entry,
    fields_of,
    leaf,
)
from hapticdb.kernels.field.law import DISTANCE_FIELD
from hapticdb.kernels.law import TANGENT_PLANE
from hapticdb.kernels.resident.cells import (
    BLOCK,
    CELLS,
    CELLS_WITH_DISTANCES,
    CLUSTERS,
    HITS,
    LISTED,
    PLACE,
    UNKNOWNS,
    Clusters,
    begin_frame,
    cells_of_box,
    end_frame,
    in_voxels,
    key_of_cell,
    seen_in,
    slot_of,
    with_missed,
)
from hapticdb.kernels.resident.feeling import felt, felt_where
from hapticdb.kernels.resident.runs import is_block_free, is_sphere_free
from hapticdb.kernels.rigid import is_rigid, transform_of

HASH_FACTOR, LOW_32 = 0x45D9F3B, 0xFFFFFFFF
"""Factor of the hash of a group of points, and the bits that are kept of a product."""
LOOKED_AT, LEFT_OUT, COUNTS = 0, 1, 2
"""Columns of the counts of frames: points near something that a frame looked at, and that its
budget left out."""


class Budget(NamedTuple):
    """Most points near something that a frame looks at: no bound where nothing can be listed.

    listed (C,) int64: the runs near something; skips (C, 1): the number of runs that a frame skips
    from each run on; chosen (K, 6), columns (3, K), indices (K,) int64: points of a frame beyond
    the budget.
    """

    most: int
    listed: NDArray[np.int64]
    skips: NDArray[np.float64]
    chosen: NDArray[np.float64]
    columns: NDArray[np.float64]
    indices: NDArray[np.int64]


BUDGET = fields_of(Budget, INT, INTS, FLOATS2, FLOATS2, FLOATS2, INTS)


@leaf
def list_near_runs(seen, shell, listed, transform, place, margin):
    """List the runs of a placed shell that are near something; returns their number.

    Whether a run is near depends on the pose and on the cells around it alone: a block's sphere
    holds those of its runs, so a block that is skipped has no run that is near.
    """
    spheres, count, n = shell.spheres, np.int64(0), np.int64(0)
    while n < spheres.shape[0]:
        if is_block_free(seen, spheres, shell.groups, n, transform, place, margin):
            n += BLOCK
            continue
        if not is_sphere_free(seen, spheres, n, transform, place, margin):
            listed[count] = n
            count += 1
        n += 1
    return count


@leaf
def points_listed(listed, count, run, n_points):
    """Number of points of the listed runs; only the last run of a shell may be shorter."""
    last = (n_points - 1) // run
    short = (last + 1) * run - n_points
    return count * run - (short if count > 0 and listed[count - 1] == last else 0)


@leaf
def skip_between(listed, count, skips):
    """Write the number of runs that a frame skips, from each run on that it comes to."""
    at = 0
    for n in range(count):
        if listed[n] > at:
            skips[at, 0] = listed[n] - at
        at = listed[n] + 1
        skips[at - 1, 0] = 0.0
    if at < skips.shape[0]:
        skips[at, 0] = skips.shape[0] - at


@leaf
def _chosen_of_group(group, stride):
    """Number of the one point that a frame looks at of a group of `stride` points of a shell.

    stride: a power of two, at most 2^31. The place in the group is a hash of the group's number:
    one place for all groups would make a grid, because the points are in Z-order, and would miss
    an edge between its rows. The hash is T. Mueller's for 32 bits: shifts and products, twice.
    """
    mixed = ((group ^ (group >> 16)) * HASH_FACTOR) & LOW_32
    mixed = ((mixed ^ (mixed >> 16)) * HASH_FACTOR) & LOW_32
    return group * stride + ((mixed ^ (mixed >> 16)) & (stride - 1))


@leaf
def choose_points(budget, count, points, columns, run):
    """Copy one point of each 2, 4, 8 ... of a shell if it is in a listed run; returns the number.

    These are the most that the budget allows, in the order of the shell. Which point
    stands for a group depends on its number alone: it stays while other runs come near.
    """
    most, listed, _, chosen, chosen_columns, indices = budget
    stride, n_chosen = 2, 0
    while points_listed(listed, count, run, points.shape[0]) > stride * most:
        stride *= 2
    n = 0
    while n < count:
        start = listed[n] * run
        end = min(start + run, points.shape[0])
        for group in range(start // stride, (end - 1) // stride + 1):
            at = _chosen_of_group(group, stride)
            if at < start or at >= end:
                continue
            if n_chosen == most:
                n_chosen = most + 1
                break
            for axis in range(3):
                chosen[n_chosen, 3 + axis] = points[at, 3 + axis]
                chosen_columns[axis, n_chosen] = columns[axis, at]
            indices[n_chosen] = at
            n_chosen += 1
        n += 1
        if n_chosen > most:  # groups that lie in several runs are chosen by chance
            stride, n_chosen, n = 2 * stride, 0, 0
    return n_chosen


@leaf
def _runs_beside_unknown(seen, spheres, listed, count, transform, place, margin, missed):
    """Number of the listed runs whose box meets an unknown cell; these cells go into `missed`."""
    n_missed, n_runs = missed[LISTED], 0
    for m in range(count):
        n = listed[m]
        x, y, z = in_voxels(transform, place, spheres[n, 0], spheres[n, 1], spheres[n, 2])
        r = spheres[n, 3] / place.size + margin
        first_i, last_i, first_j, last_j, first_k, last_k = cells_of_box(x, y, z, r, place.side)
        is_beside = False
        for ci in range(first_i, last_i + 1):
            for cj in range(first_j, last_j + 1):
                for ck in range(first_k, last_k + 1):
                    key = key_of_cell(ci, cj, ck)
                    if slot_of(seen.keys, seen.slots, seen.which, key) < 0:
                        is_beside = True
                        n_missed = with_missed(missed, n_missed, key)
        n_runs += is_beside
    missed[LISTED] = n_missed
    return n_runs


@leaf
def felt_within(law, cells, which, shell, pose, place, met, missed, budget, counts, out):
    """`feeling.felt` within a budget; counts (COUNTS,) int64 keeps the greatest numbers of points.

    Without a budget `counts` stays as it is.
    """
    points, center, spheres, _, run, columns, scratch = shell
    felt_in, margin, _ = felt_where(law, cells.words, cells.near)
    listed, transform, seen = budget.listed, transform_of(pose), seen_in(cells, which, felt_in)
    count, part, is_beyond = np.int64(0), shell, False
    if listed.shape[0] > 0:
        count = list_near_runs(seen, shell, listed, transform, place, margin)
        n_near = n_looked = points_listed(listed, count, run, points.shape[0])
        is_beyond = n_near > budget.most
        if is_beyond:
            n_looked = choose_points(budget, count, points, columns, run)
            part = Clusters(
                budget.chosen[:n_looked], center, spheres[:0], spheres[:0], run, budget.columns,
                scratch,
            )  # fmt: skip
        else:
            skip_between(listed, count, budget.skips)
            part = Clusters(points, center, spheres[:0], budget.skips, run, columns, scratch)
        counts[LOOKED_AT] = max(counts[LOOKED_AT], n_looked)
        counts[LEFT_OUT] = max(counts[LEFT_OUT], n_near - n_looked)
    felt(law, cells, which, part, pose, place, met, missed, out)
    if is_beyond:
        for hit in range(np.int64(out[HITS])):
            met[hit] = budget.indices[met[hit]]
        out[UNKNOWNS] += _runs_beside_unknown(
            seen, spheres, listed, count, transform, place, margin, missed
        )


@entry(
    CELLS, INT, CLUSTERS, FLOATS3, PLACE, TANGENT_PLANE, INTS, INTS, FLOATS2, BUDGET, INTS2,
    also={CELLS: CELLS_WITH_DISTANCES, TANGENT_PLANE: DISTANCE_FIELD},
)  # fmt: skip
def feel_kernel(cells, reader, shell, poses, place, law, met, missed, out, budget, counts):
    """`feeling.felt` at poses (M, 4, 4) into out (M, RESULTS); met, missed: of the last frame.

    Where there are more points near something than the budget, a frame looks at one of each 2, 4,
    8 ... of them, so that every cluster keeps its share (`choose_points`). Then out counts runs
    beside unknown cells as unknown points, and `missed` lists the cells. counts: (M, COUNTS), or
    (1, COUNTS) for the greatest of all. Returns the number of poses done: fewer than M when one is
    not rigid.
    """
    last = counts.shape[0] - 1
    for n in range(poses.shape[0]):
        if not is_rigid(poses[n]):
            return n
        which = begin_frame(cells, reader)
        felt_within(
            law, cells, which, shell, poses[n], place, met, missed, budget, counts[min(n, last)],
            out[n],
        )  # fmt: skip
        end_frame(cells, reader)
    return poses.shape[0]

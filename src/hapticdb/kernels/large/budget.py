"""Frames of a session's tool: clusters sleep where it is large, and a budget bounds the points.

A frame within the budget is that of the flat loop, bit for bit. A frame beyond it looks at one of
each 2, 4, 8 ... points of the runs near something (`sleeping`). Which points these are depends on
the runs that are near, so it must not depend on what is in memory. An unknown cell counts as
occupied, and would make runs near that are not. So a frame beyond its budget that has a listed run
beside an unknown cell counts that run as an unknown point: the loop holds the frame or waits, and a
replay leaves it out. Every frame that is compared has the same points in a session and in a replay.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import FLOATS2, FLOATS3, INT, INTS, INTS2, entry, leaf
from hapticdb.kernels.field.law import DISTANCE_FIELD
from hapticdb.kernels.large.sleeping import (
    LEFT_OUT,
    LOOKED_AT,
    SLEEPERS,
    Sleepers,
    choose_points,
    felt_margin,
    list_near_runs,
    placed_center,
    points_listed,
    skip_between,
)
from hapticdb.kernels.law import TANGENT_PLANE
from hapticdb.kernels.resident.cells import (
    CELLS,
    CELLS_WITH_DISTANCES,
    CLUSTERS,
    HITS,
    LISTED,
    PLACE,
    UNKNOWNS,
    Clusters,
    begin_frame,
    end_frame,
    key_of_cell,
    slot_of,
    with_missed,
)
from hapticdb.kernels.resident.feeling import frame_of
from hapticdb.kernels.rigid import is_rigid, transform_of


class Asleep(NamedTuple):
    """Frames with sleeping clusters.

    budget: most points near something that a frame looks at; counts (1, COUNTS) int64 takes the
    greatest numbers of a period: see `sleeping.LOOKED_AT`.
    """

    sleepers: Sleepers
    budget: int
    counts: NDArray[np.int64]


@leaf
def _runs_beside_unknown(cells, which, shell, listed, count, transform, place, margin, missed):
    """Number of the listed runs whose box meets an unknown cell; these cells go into `missed`."""
    keys, slots, spheres = cells.keys, cells.slots, shell.spheres
    top, n_missed, n_runs = place.side - 1.0, missed[LISTED], 0
    for m in range(count):
        n = listed[m]
        x, y, z = placed_center(spheres, n, transform, place)
        r = spheres[n, 3] / place.size + margin
        is_beside = False
        for ci in range(np.int64(max(x - r, 0.0)) >> 5, (np.int64(min(x + r, top)) >> 5) + 1):
            for cj in range(np.int64(max(y - r, 0.0)) >> 5, (np.int64(min(y + r, top)) >> 5) + 1):
                for ck in range(
                    np.int64(max(z - r, 0.0)) >> 5, (np.int64(min(z + r, top)) >> 5) + 1
                ):
                    key = key_of_cell(ci, cj, ck)
                    if slot_of(keys, slots, which, key) < 0:
                        is_beside = True
                        n_missed = with_missed(missed, n_missed, key)
        n_runs += is_beside
    missed[LISTED] = n_missed
    return n_runs


@leaf
def felt_asleep(cells, which, shell, pose, place, law, met, missed, sleepers, budget, counts, out):
    """`feeling.felt` with sleeping clusters and a budget of points.

    counts (COUNTS,) keeps the greatest numbers (`sleeping.LOOKED_AT`).
    """
    points, center, _, _, run, columns, scratch = shell
    listed, skips, nothing = sleepers.listed, sleepers.skips, sleepers.nothing
    chosen, chosen_columns, indices = sleepers.chosen, sleepers.columns, sleepers.indices
    transform = transform_of(pose)
    count = list_near_runs(cells, which, shell, sleepers, transform, place, law)
    n_near = points_listed(listed, count, run, points.shape[0])
    n_looked = n_near
    part = Clusters(points, center, nothing, skips, run, columns, scratch)
    if n_near <= budget:
        skip_between(listed, count, skips)
    else:
        n_looked = choose_points(
            listed, count, points, columns, run, budget, chosen, chosen_columns, indices
        )
        part = Clusters(chosen[:n_looked], center, nothing, nothing, run, chosen_columns, scratch)
    frame_of(law, cells, which, part, pose, place, met, missed, out)
    if n_near > budget:
        for hit in range(np.int64(out[HITS])):
            met[hit] = indices[met[hit]]
        out[UNKNOWNS] += _runs_beside_unknown(
            cells, which, shell, listed, count, transform, place, felt_margin(law), missed
        )
    counts[LOOKED_AT] = max(counts[LOOKED_AT], n_looked)
    counts[LEFT_OUT] = max(counts[LEFT_OUT], n_near - n_looked)


@entry(
    CELLS, INT, CLUSTERS, FLOATS3, PLACE, TANGENT_PLANE, INTS, INTS, FLOATS2, SLEEPERS, INT, INTS2,
    also={CELLS: CELLS_WITH_DISTANCES, TANGENT_PLANE: DISTANCE_FIELD},
)  # fmt: skip
def feel_within(
    cells, reader, shell, poses, place, law, met, missed, out, sleepers, budget, counts
):
    """`feeling.feel_kernel` with sleeping clusters, at most `budget` points a frame.

    Where there are more points near something than the budget, a frame looks at one of each 2, 4,
    8 ... of them, so that every cluster keeps its share (`sleeping.choose_points`). Then out (M,
    RESULTS) counts runs beside unknown cells as unknown points, and `missed` lists the cells.
    counts (M, COUNTS) int64 keeps the greatest numbers of each pose, or (1, COUNTS) those of all.
    Returns the number of poses done.
    """
    for n in range(poses.shape[0]):
        if not is_rigid(poses[n]):
            return n
        which = begin_frame(cells, reader)
        felt_asleep(
            cells, which, shell, poses[n], place, law, met, missed, sleepers, budget,
            counts[min(n, counts.shape[0] - 1)], out[n],
        )  # fmt: skip
        end_frame(cells, reader)
    return poses.shape[0]

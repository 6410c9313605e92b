"""Frames of a session's tool: clusters sleep where it is large, and a budget bounds the points.

A frame within the budget is that of the flat loop, bit for bit. A frame beyond it looks at one of
each 2, 4, 8 ... points of the runs near something (`sleeping`). Which points these are depends on
the runs that are near, so it must not depend on what is in memory. An unknown cell counts as
occupied, and would make runs near that are not. So a frame beyond its budget that has a listed run
beside an unknown cell counts that run as an unknown point: the loop holds the frame, and a replay
leaves it out. Every frame that is compared has the same points in a session and in a replay.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import FLOATS2, FLOATS3, INT, INTS, INTS2, entry, fields_of, leaf
from hapticdb.kernels.field.law import DISTANCE_FIELD
from hapticdb.kernels.large.sleeping import (
    LEFT_OUT,
    LOOKED_AT,
    SLEEPERS,
    Sleepers,
    choose_points,
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
from hapticdb.kernels.resident.feeling import felt, felt_margin, felt_words
from hapticdb.kernels.rigid import is_rigid, transform_of


class Asleep(NamedTuple):
    """What of a shell may sleep: nothing if `sleepers` has no blocks.

    budget: most points near something that a frame looks at; counts (M, COUNTS) int64 keeps the
    greatest numbers of each pose, or (1, COUNTS) those of all: see `sleeping.LOOKED_AT`. Where
    nothing sleeps, no budget holds and `counts` stays as it is.
    """

    sleepers: Sleepers
    budget: int
    counts: NDArray[np.int64]


ASLEEP = fields_of(Asleep, SLEEPERS, INT, INTS2)


@leaf
def _runs_beside_unknown(
    keys, slots, which, spheres, listed, count, transform, place, margin, missed
):  # fmt: skip
    """Number of the listed runs whose box meets an unknown cell; these cells go into `missed`."""
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
def felt_asleep(cells, which, shell, pose, place, law, met, missed, asleep, counted, out):
    """`feeling.felt` with what sleeps of the shell, and its budget of points.

    counted: the row of `Asleep.counts` of this frame.
    """
    points, center, _, _, run, columns, scratch = shell
    sleepers, budget, counts = asleep
    listed, skips, nothing = sleepers.listed, sleepers.skips, sleepers.nothing
    chosen, chosen_columns, indices = sleepers.chosen, sleepers.columns, sleepers.indices
    transform = transform_of(pose)
    count = n_near = n_looked = np.int64(0)
    part, is_beyond = shell, False
    if sleepers.boxes.shape[0] > 0:
        count = list_near_runs(
            cells.control, cells.keys, cells.slots, felt_words(law, cells.words, cells.near),
            cells.masks, cells.used, which, shell.spheres, sleepers, transform, place,
            felt_margin(law),
        )  # fmt: skip
        n_near = n_looked = points_listed(listed, count, run, points.shape[0])
        is_beyond = n_near > budget
        part = Clusters(points, center, nothing, skips, run, columns, scratch)
        if is_beyond:
            n_looked = choose_points(
                listed, count, points, columns, run, budget, chosen, chosen_columns, indices
            )
            part = Clusters(
                chosen[:n_looked], center, nothing, nothing, run, chosen_columns, scratch
            )
        else:
            skip_between(listed, count, skips)
        counts[counted, LOOKED_AT] = max(counts[counted, LOOKED_AT], n_looked)
        counts[counted, LEFT_OUT] = max(counts[counted, LEFT_OUT], n_near - n_looked)
    felt(law, cells, which, part, pose, place, met, missed, out)
    if is_beyond:
        for hit in range(np.int64(out[HITS])):
            met[hit] = indices[met[hit]]
        out[UNKNOWNS] += _runs_beside_unknown(
            cells.keys, cells.slots, which, shell.spheres, listed, count, transform, place,
            felt_margin(law), missed,
        )  # fmt: skip


@entry(
    CELLS, INT, CLUSTERS, FLOATS3, PLACE, TANGENT_PLANE, INTS, INTS, FLOATS2, ASLEEP,
    also={CELLS: CELLS_WITH_DISTANCES, TANGENT_PLANE: DISTANCE_FIELD},
)  # fmt: skip
def feel_kernel(cells, reader, shell, poses, place, law, met, missed, out, asleep):
    """`feeling.felt` at poses (M, 4, 4) into out (M, RESULTS); met, missed: of the last frame.

    Where there are more points near something than the budget of a shell that sleeps, a frame looks
    at one of each 2, 4, 8 ... of them, so that every cluster keeps its share
    (`sleeping.choose_points`). Then out counts runs beside unknown cells as unknown points, and
    `missed` lists the cells. Returns the number of poses done: fewer than M when one is not rigid.
    """
    last = asleep.counts.shape[0] - 1
    for n in range(poses.shape[0]):
        if not is_rigid(poses[n]):
            return n
        which = begin_frame(cells, reader)
        felt_asleep(
            cells, which, shell, poses[n], place, law, met, missed, asleep, min(n, last), out[n]
        )
        end_frame(cells, reader)
    return poses.shape[0]

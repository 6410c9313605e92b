"""Frames over resident cells: contacts and wrench of a placed shell, without a database.

A run of points passes through short loops, one after another: the points in range move to the front
of the scratch, then come normals, depths and sums. In one long loop a processor has room for hardly
more than one point at a time, waits for each look-up, and takes 1.6 times as long. For a run in few
cells, none of them unknown, no loop branches. The sums run in the order of the points, and a point
without a force adds zero, so the results are those of the frames on rows, bit for bit. Only
`voxels_in_range` and `_weigh` differ between laws.
"""

from typing import Any

import numpy as np

from hapticdb.kernels._jit import (
    FLOATS3,
    INT,
    INTS,
    chosen_by_type,
    entry,
    inlined,
    leaf,
    record_of,
)
from hapticdb.kernels.field.corners import fetch_corners, interpolated
from hapticdb.kernels.field.distance_law import (
    AHEAD,
    DISTANCE_FIELD,
    DistanceFieldLaw,
    agreement,
    depth_and_weight,
)
from hapticdb.kernels.field.lattice import CELL_VALUES, VOXELS_A_STEP, cell_place, place_before
from hapticdb.kernels.force_law import (
    NO_WRENCH,
    TANGENT_PLANE,
    TangentPlaneLaw,
    accumulate,
    average_into,
    depth_below_plane,
    force_range,
    reach,
    respond,
    sample_slot,
    share_slot,
)
from hapticdb.kernels.records.cells import MISSED
from hapticdb.kernels.records.hand import RESULT
from hapticdb.kernels.resident.cells import (
    CELL_GRID,
    CELL_WORDS,
    CELLS,
    CELLS_WITH_DISTANCES,
    CLUSTERS,
    UNKNOWN,
    begin_frame,
    bit_in,
    brick_bit,
    cell_key,
    column_of,
    end_frame,
    enter_cell,
    n_runs_of,
    seen_in,
)
from hapticdb.kernels.resident.runs import (
    WORD_BITS,
    cells_of_run,
    keep_points,
    next_run,
    place_run,
    scratch_of,
    words_of_run,
)
from hapticdb.kernels.rigid import is_rigid, moved, transform_of, turned


def _in_near_voxels(law, words, near):  # noqa: ARG001 - the arguments of each choice
    """`voxels_in_range` of the distance law."""
    return near, 0.0, np.int64(0)


def _in_voxels_alone(law, words, near):  # noqa: ARG001 - likewise
    """`voxels_in_range` of the tangent-plane law."""
    return words, 0.0, np.int64(0)


def _around_voxels(law, words, near):  # noqa: ARG001 - likewise
    """`voxels_in_range` of a law with a margin alone."""
    return words, force_range(law), np.int64(1)


@inlined
def _near_of_run(
    anyway, seen, words, start, count, side, scratch, hits, missed, n_hits, n_missed, last
):
    """Move the points of a placed run in range of the law to the front of `scratch`.

    Every point in a marked brick is written there, and overwritten by the next one if out of range:
    a mispredicted branch costs more. anyway : 1 to include points of any voxel in a marked brick;
    last : key, slot, mask and base of the last point's cell. Returns the numbers of points in
    range, of hits and of cells on the list `missed` so far, and of points in unknown cells, then
    the last point's cell.
    """
    last_key, slot, mask, base = last
    n_near = n_unknown = np.int64(0)
    for at in range(count):
        x, y, z = scratch.x[at], scratch.y[at], scratch.z[at]
        if not (0.0 <= x < side and 0.0 <= y < side and 0.0 <= z < side):
            continue
        i, j, k = np.int64(x), np.int64(y), np.int64(z)
        key = cell_key(i, j, k)
        if key != last_key:
            last_key = key
            slot, mask, n_missed = enter_cell(seen, key, missed, n_missed)
            # in floats, exact below 2^53, as the scratch has them
            first = cell_place(0, 0, 0) + slot * CELL_VALUES
            base = float(first - place_before(i & -32, j & -32, k & -32))
        # bricks first: most of space is free, and the mask is in a register
        if not (mask >> brick_bit(i, j, k)) & np.uint64(1):
            n_unknown += slot < 0
            continue
        column = column_of(i, j)
        hit, bit = bit_in(words[slot, column], k), bit_in(seen.words[slot, column], k)
        # always written, counted if hit
        hits[n_hits] = start + at
        n_hits += np.int64(hit)
        scratch.px[n_near], scratch.x[n_near] = scratch.px[at], x
        scratch.py[n_near], scratch.y[n_near] = scratch.py[at], y
        scratch.pz[n_near], scratch.z[n_near] = scratch.pz[at], z
        scratch.number[n_near], scratch.base[n_near] = start + at, base
        if anyway:
            scratch.word[n_near] = (slot << WORD_BITS) + column
        n_near += np.int64(bit) | anyway
    return n_near, n_hits, n_missed, n_unknown, (last_key, slot, mask, base)


@inlined
def _near_in_cells(words, in_range, start, count, box, scratch, hits, n_hits):
    """`_near_of_run` for a run in the cells of `runs.cells_of_run`: without a branch.

    Returns the numbers of points in range and of hits. Set bits are in marked bricks alone.
    """
    words_of_run(count, box, start, scratch)
    n_near = np.int64(0)
    for at in range(count):
        word, k = np.int64(scratch.word[at]), np.int64(scratch.bit[at])
        slot, column = word >> WORD_BITS, word & (CELL_WORDS - 1)
        hit, bit = bit_in(words[slot, column], k), bit_in(in_range[slot, column], k)
        hits[n_hits] = start + at
        n_hits += np.int64(hit)
        # stream compaction without a branch
        scratch.kept[n_near] = at
        n_near += np.int64(bit)
    keep_points(scratch, count, n_near)
    return n_near, n_hits


@inlined
def _turn_normals(points, transform, scratch, count):
    """Rotated normals of the first points of `scratch`."""
    for at in range(count):
        n = np.int64(scratch.number[at])
        nx, ny, nz = turned(transform, points[n, 3], points[n, 4], points[n, 5])
        scratch.nx[at], scratch.ny[at], scratch.nz[at] = nx, ny, nz


@inlined
def _find_places(scratch, count, ahead):
    """Interpolation index and fractions of the first points, `ahead` voxels along the normals."""
    for at in range(count):
        x = scratch.x[at] + ahead * scratch.nx[at]
        y = scratch.y[at] + ahead * scratch.ny[at]
        z = scratch.z[at] + ahead * scratch.nz[at]
        # lowest of the 8 centres around the place: centres are at half voxels
        x0, y0, z0 = np.floor(x - 0.5), np.floor(y - 0.5), np.floor(z - 0.5)
        scratch.to_interpolate[at] = scratch.base[at] + place_before(x0, y0, z0)
        scratch.part_x[at] = x - 0.5 - x0
        scratch.part_y[at] = y - 0.5 - y0
        scratch.part_z[at] = z - 0.5 - z0


@inlined
def _interpolate(payload, scratch, count, out):
    """Distances u, voxels, interpolated for the first points of `scratch`, into a row of it."""
    for at in range(count):
        out[at] = VOXELS_A_STEP * interpolated(
            payload, np.uint64(np.int64(scratch.to_interpolate[at])), scratch.part_x[at],
            scratch.part_y[at], scratch.part_z[at],
        )  # fmt: skip


def _weigh_by_distance(law, cells, points, transform, grid, scratch, count):  # noqa: ARG001
    """`_weigh` under the distance law.

    The distances are prefetched into the cache while the normals are rotated: a seventh off a frame
    of 100,000 contacts.
    """
    payload = cells.payload
    for at in range(count):
        scratch.nx[at] = scratch.ny[at] = scratch.nz[at] = 0.0  # for `_find_places`, at 0 ahead
    _find_places(scratch, count, 0.0)
    for at in range(count):
        fetch_corners(payload, np.uint64(np.int64(scratch.to_interpolate[at])))
    _turn_normals(points, transform, scratch, count)
    _interpolate(payload, scratch, count, scratch.here)
    _find_places(scratch, count, AHEAD)
    _interpolate(payload, scratch, count, scratch.there)
    for at in range(count):
        share = agreement(scratch.here[at], scratch.there[at])
        depth, weight = depth_and_weight(scratch.here[at], grid.size)
        scratch.depth[at] = max(depth * share, 0.0)
        scratch.weight[at] = weight * share


@inlined
def _center_on_axis(origin, size, x):
    """Coordinate of the voxel's centre at x, voxels, in metres, as in `shell_keys.center_of`."""
    return origin + size * (np.floor(x) + 0.5)


def _weigh_by_plane(law, cells, points, transform, grid, scratch, count):  # noqa: ARG001
    """`_weigh` under the tangent-plane law."""
    _turn_normals(points, transform, scratch, count)
    for at in range(count):
        depth = depth_below_plane(
            scratch.px[at], scratch.py[at], scratch.pz[at],
            scratch.nx[at], scratch.ny[at], scratch.nz[at],
            _center_on_axis(grid.x, grid.size, scratch.x[at]),
            _center_on_axis(grid.y, grid.size, scratch.y[at]),
            _center_on_axis(grid.z, grid.size, scratch.z[at]),
        )  # fmt: skip
        scratch.depth[at] = max(depth, 0.0)
        scratch.weight[at] = 1.0


def _weigh_by_leaves(law, cells, points, transform, grid, scratch, count):
    """`_weigh` under any law, by its `Leaves`."""
    payload = cells.payload
    _turn_normals(points, transform, scratch, count)
    for at in range(count):
        word, x, y, z = np.int64(scratch.word[at]), scratch.x[at], scratch.y[at], scratch.z[at]
        slot = word >> WORD_BITS
        is_hit = bit_in(cells.words[slot, word & (CELL_WORDS - 1)], np.int64(z)) != 0
        sample = sample_slot(law, payload, slot, x, y, z)
        scratch.depth[at] = scratch.weight[at] = 0.0
        # the point stays in the scratch without a force: adding zero keeps the order of the sums
        if not (is_hit or sample <= reach(law)):
            continue
        nx, ny, nz = scratch.nx[at], scratch.ny[at], scratch.nz[at]
        depth, weight = respond(
            law, is_hit, sample, scratch.px[at], scratch.py[at], scratch.pz[at], nx, ny, nz,
            _center_on_axis(grid.x, grid.size, x), _center_on_axis(grid.y, grid.size, y),
            _center_on_axis(grid.z, grid.size, z), grid.size,
        )  # fmt: skip
        share = share_slot(law, payload, slot, x, y, z, nx, ny, nz, sample)
        scratch.depth[at] = max(depth * share, 0.0)
        scratch.weight[at] = weight * share


OF_LAWS: dict[type, Any] = {
    DistanceFieldLaw: (_in_near_voxels, _weigh_by_distance),
    TangentPlaneLaw: (_in_voxels_alone, _weigh_by_plane),
}
OF_OTHERS = _around_voxels, _weigh_by_leaves
voxels_in_range = chosen_by_type(lambda law: OF_LAWS.get(law, OF_OTHERS)[0])
"""Range of a law: words of voxels; voxels around them; 1 to include points outside these, too."""
_weigh = chosen_by_type(lambda law: OF_LAWS.get(law, OF_OTHERS)[1])
"""Rotated normal, depth (at least 0) and weight of the first points of the scratch."""


@leaf
def evaluate_frame(law, cells, which, shell, pose, grid, hits, missed, out):
    """One frame: hits of a placed shell and the wrench of its contacts, into `out`, a RESULT.

    hits (N,) : indices of the hits; missed : a MISSED, the unknown cells with points. A point in an
    unknown cell is neither a hit nor a miss. Arithmetic and order of the sums are those of
    `shell_keys.locate` and `refining.refine`.
    """
    points, scratch, words, n_runs = shell.points, scratch_of(shell), cells.words, n_runs_of(shell)
    in_range, margin, anyway = voxels_in_range(law, words, cells.near)
    seen = seen_in(cells, which, in_range)
    transform = transform_of(pose)
    center = moved(transform, shell.center[0], shell.center[1], shell.center[2])
    sums, weight, deepest = NO_WRENCH, 0.0, 0.0
    last = np.int64(-1), np.int64(UNKNOWN), np.uint64(0), 0.0
    n_hits = n_contacts = n_unknown = n_missed = np.int64(0)
    run = np.int64(-1)
    while True:
        run = next_run(seen, shell, run + 1, n_runs, transform, grid, margin)
        if run >= n_runs:
            break
        start, n_run = place_run(shell, run, transform, grid, scratch)
        n_near = np.int64(0)
        box = cells_of_run(seen, n_run, grid.side, scratch)
        # a law with contacts outside the marked voxels needs the words of `_near_of_run`
        if box[0] > 0 and not anyway:
            n_near, n_hits = _near_in_cells(
                words, seen.words, start, n_run, box, scratch, hits, n_hits
            )
        elif box[0] != 0:
            n_near, n_hits, n_missed, n_strange, last = _near_of_run(
                anyway, seen, words, start, n_run, grid.side, scratch, hits, missed, n_hits,
                n_missed, last,
            )  # fmt: skip
            n_unknown += n_strange
        if n_near == 0:
            continue
        _weigh(law, cells, points, transform, grid, scratch, n_near)
        # in the order of the points: floating-point sums depend on it
        for at in range(n_near):
            depth = scratch.depth[at]
            weight += scratch.weight[at]
            n_contacts += depth > 0.0
            deepest = max(deepest, depth)
            point = (
                scratch.px[at], scratch.py[at], scratch.pz[at],
                scratch.nx[at], scratch.ny[at], scratch.nz[at],
            )  # fmt: skip
            sums = accumulate(sums, point, center, depth, law.stiffness)
    average_into(out.wrench, weight, sums)
    out.hits, out.contacts = n_hits, n_contacts
    out.unknown, out.deepest = n_unknown, deepest
    missed.n_cells = n_missed


@entry(
    CELLS, INT, CLUSTERS, FLOATS3, CELL_GRID, TANGENT_PLANE, INTS, record_of(MISSED),
    record_of(RESULT, 1),
    also={CELLS: CELLS_WITH_DISTANCES, TANGENT_PLANE: DISTANCE_FIELD},
)  # fmt: skip
def evaluate_frames(cells, reader, shell, poses, grid, law, hits, missed_record, out):
    """Evaluate poses (M, 4, 4) into out (M,) of RESULT; `hits`, `missed` : of the last frame.

    Returns the number of poses done: fewer than M when one is not rigid.
    """
    for n in range(poses.shape[0]):
        if not is_rigid(poses[n]):
            return n
        # a lease for each frame, not for all: a long batch must not block the writer
        which = begin_frame(cells, reader)
        evaluate_frame(law, cells, which, shell, poses[n], grid, hits, missed_record[()], out[n])
        end_frame(cells, reader)
    return poses.shape[0]

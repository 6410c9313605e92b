"""Proximity query of a tool: its points near a surface at one pose, by the distance field.

A query evaluates distance and gradient at the points possibly near. A point with a large lower
bound is deferred until the tool has moved as far: its `due` is the path length of the tool's
farthest point at the point's next evaluation. Runs of points are deferred likewise, by `run_due`.
"""

import math
from collections import namedtuple

import numpy as np

from hapticdb.kernels._jit import inlined, leaf
from hapticdb.kernels.field.distance_law import ONSET
from hapticdb.kernels.field.lattice import HALF_WIDTH
from hapticdb.kernels.field.spline import (
    bound_in_free_block,
    lower_bound,
    nearest_bound,
    second_derivatives,
    spline,
)
from hapticdb.kernels.hand.calling import call
from hapticdb.kernels.resident.cells import (
    EMPTY_SLOT,
    UNKNOWN,
    brick_bit,
    cell_key,
    enter_cell,
    in_voxels,
    n_runs_of,
    seen_in,
)
from hapticdb.kernels.resident.nearest_voxels import room_around
from hapticdb.kernels.rigid import moment, moved, transform_of

MARGIN = 0.5
"""Distance beyond the onset, voxels, of the points in the equations of a step. Larger: contacts of
longer steps are predicted, and more points are in the equations."""
FAR = ONSET + MARGIN + 0.1
"""Greatest lower bound of an evaluated point, voxels; the tenth is room for the smoothing spline.
Larger: points are evaluated more often."""
FLOOR = 1.0
"""Least distance to a surface, voxels: no step brings a point nearer. Smaller: firmer contacts,
less smooth ones; below about 0.7 the gradients are wrong."""
LEAST_BOUND = 0.1
"""Least lower bound of the distance, voxels: no step brings a point below it. Smaller: points get
nearer to sheets; the proof in `advancement` needs a value above 0."""
ENOUGH = 0.3
"""Lower bound of a near point, voxels, sufficient without the tighter `lower_bound`. Larger: fewer
and longer advances in contact, and more computing for each point."""
NEVER = 1e30
"""Path length beyond any tool's travel, voxels."""

BENT = 0.05
"""Curvature, 1/voxel, subtracted as noise of the stored distances. Larger: less resistance along
rough surfaces, and overshooting steps in gentle hollows."""
OPEN, SHUT, NOT_KNOWN, MANY = 0, 1, 2, 3
"""Results of a query: pose free; a point too near; points in unknown cells; too many near points,
to be merged."""
MOST_MERGED = 64
"""Most points represented by one contact: a run. Larger: broad contacts cost less."""
LONGEST_REST = 16.0
"""Greatest path length of a large tool's run between tests of its sphere, voxels. Larger: fewer
tests in free space, and more cells read by each."""
RUNS_ANEW, POINTS_ANEW = 1, 2
"""Resets before a GPU's next query: of `run_due` alone, or of `due`, too."""
ROOMY = 4
"""Merged contacts are split again with fewer near points than this part of the most. Larger: points
return later, and the number of contacts changes less often."""


@leaf
def clamped_into(grid, px, py, pz):
    """Point, m, clamped into the grid, and its offset from there: six numbers, voxels."""
    size, last = grid.size, grid.side - 1e-6
    px, py, pz = (px - grid.x) / size, (py - grid.y) / size, (pz - grid.z) / size
    x, y, z = min(max(px, 0.0), last), min(max(py, 0.0), last), min(max(pz, 0.0), last)
    return x, y, z, px - x, py - y, pz - z


@leaf
def _outside_grid(u, gx, gy, gz, bound, dx, dy, dz):
    """Distance, gradient and bound at a point outside the grid, from those at the clamped point.

    (dx, dy, dz) : offset from there, voxels. All surfaces are in the grid, so its length adds to u.
    """
    path_length = math.sqrt(dx * dx + dy * dy + dz * dz)
    gx = gx if dx == 0.0 else dx / path_length
    gy = gy if dy == 0.0 else dy / path_length
    gz = gz if dz == 0.0 else dz / path_length
    # projection on the convex grid lengthens no distance: the clamped point's bound holds here, too
    return u + path_length, gx, gy, gz, max(bound, path_length)


@inlined
def distance_at(payload, slot, mask, at):
    """Distance u, gradient (3) and lower bound at a point from `clamped_into`: five numbers."""
    x, y, z, dx, dy, dz = at
    i, j, k = np.int64(x), np.int64(y), np.int64(z)
    u, gx, gy, gz = HALF_WIDTH, 0.0, 0.0, 0.0
    if (mask >> brick_bit(i, j, k)) & np.uint64(1):
        u, gx, gy, gz = spline(payload, slot, x, y, z)
        # far points take the tighter bound at once, since it defers them for longer
        bound = nearest_bound(payload, slot, x, y, z) if u < ONSET + MARGIN else 0.0
        if bound < ENOUGH:
            bound = lower_bound(payload, slot, x, y, z)
    else:
        # an empty cell is a free block of 32^3 voxels, an unmarked brick one of 8^3
        bound = bound_in_free_block(x, y, z, 5 if slot == EMPTY_SLOT else 3)
    if dx != 0.0 or dy != 0.0 or dz != 0.0:
        u, gx, gy, gz, bound = _outside_grid(u, gx, gy, gz, bound, dx, dy, dz)
    return u, gx, gy, gz, bound


@inlined
def bound_at(payload, slot, mask, at):
    """Lower bound of `distance_at` alone."""
    x, y, z, dx, dy, dz = at
    if (mask >> brick_bit(np.int64(x), np.int64(y), np.int64(z))) & np.uint64(1):
        bound = nearest_bound(payload, slot, x, y, z)
        if bound < ENOUGH:
            bound = lower_bound(payload, slot, x, y, z)
    else:
        bound = bound_in_free_block(x, y, z, 5 if slot == EMPTY_SLOT else 3)
    if dx != 0.0 or dy != 0.0 or dz != 0.0:
        bound = max(bound, math.sqrt(dx * dx + dy * dy + dz * dz))
    return bound


@leaf
def _bends_of(gx, gy, gz, xx, yy, zz, xy, xz, yz):
    """Principal curvatures of a hollow surface across a gradient, and directions: c, v, d, w.

    Eigenvalues, in closed form, of the negated 2 x 2 matrix of the distance's second derivatives in
    the plane across the gradient, less BENT. c >= d; 0 for a flat or bulging surface; v, w are unit
    vectors.
    """
    ux, uy, uz = (gz, 0.0, -gx) if abs(gy) > 0.7 * (abs(gx) + abs(gz)) else (-gz, 0.0, gx)
    if abs(ux) + abs(uz) < 1e-9:  # gradient along y: any perpendicular will do
        ux, uy, uz = 1.0, 0.0, 0.0
    length = math.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux / length, uy / length, uz / length
    wx, wy, wz = moment(gx, gy, gz, ux, uy, uz)
    length = max(math.sqrt(wx * wx + wy * wy + wz * wz), 1e-12)
    wx, wy, wz = wx / length, wy / length, wz / length
    px, py, pz = (
        xx * ux + xy * uy + xz * uz,
        xy * ux + yy * uy + yz * uz,
        xz * ux + yz * uy + zz * uz,
    )
    qx, qy, qz = (
        xx * wx + xy * wy + xz * wz,
        xy * wx + yy * wy + yz * wz,
        xz * wx + yz * wy + zz * wz,
    )
    a = -(px * ux + py * uy + pz * uz)
    b = -(px * wx + py * wy + pz * wz)
    c = -(qx * wx + qy * wy + qz * wz)
    middle, half = 0.5 * (a + c), math.sqrt(0.25 * (a - c) * (a - c) + b * b)
    # Jacobi rotation: it diagonalises the symmetric 2 x 2 matrix
    angle = 0.5 * math.atan2(2.0 * b, a - c)
    cosine, sine = math.cos(angle), math.sin(angle)
    return (
        max(middle + half - BENT, 0.0),
        cosine * ux + sine * wx, cosine * uy + sine * wy, cosine * uz + sine * wz,
        max(middle - half - BENT, 0.0),
        cosine * wx - sine * ux, cosine * wy - sine * uy, cosine * wz - sine * uz,
    )  # fmt: skip


@leaf
def along_and_about(lever, x, y, z):
    """Direction at a lever (3) from the centre, and its moment: six numbers."""
    a, b, c = moment(lever[0], lever[1], lever[2], x, y, z)
    return x, y, z, a, b, c


@leaf
def bends_at(payload, slot, at, lever, sample):
    """Two curvatures at a near point, and `along_and_about` of both directions.

    at : from `clamped_into`; lever (3), m; sample : from `distance_at` there.
    """
    xx, yy, zz, xy, xz, yz = second_derivatives(payload, slot, at[0], at[1], at[2])
    c, vx, vy, vz, d, wx, wy, wz = _bends_of(
        sample[1], sample[2], sample[3], xx, yy, zz, xy, xz, yz
    )
    return c, d, along_and_about(lever, vx, vy, vz), along_and_about(lever, wx, wy, wz)


@inlined
def may_be_hollow(mask, at, u):
    """Whether to compute curvatures at a near point: u below ONSET, in a brick with distances."""
    bit = brick_bit(np.int64(at[0]), np.int64(at[1]), np.int64(at[2]))
    return u < ONSET and (mask >> bit) & np.uint64(1) != 0


@leaf
def _write_bends(bends, found):
    """Write the curvatures of a near point from `bends_at`; return whether any is above 0."""
    bends.curvature[0], bends.curvature[1] = found[0], found[1]
    for axis in range(3):
        bends.along[0, axis], bends.about[0, axis] = found[2][axis], found[2][3 + axis]
        bends.along[1, axis], bends.about[1, axis] = found[3][axis], found[3][3 + axis]
    return found[0] > 0.0


@inlined
def _goes_nearer(u, bound, before):
    """Whether a point is too near a surface, and no farther from it than before."""
    # a point that is already too near may move away, or the tool could never leave a surface
    return (u < FLOOR and u <= before.u) or (bound < LEAST_BOUND and bound <= before.bound)


ProximityQuery = namedtuple(  # noqa: PYI024 - its types are those of the cells that a kernel reads
    "ProximityQuery", "cells which shell grid follower kept near bends contacts missed"
)
"""Arguments of a tool's proximity queries: input, state and output.

cells : `Cells` with distances; which : the frame's directory; shell : `Clusters`; grid : the
grid; follower : record of FOLLOWER; kept (N,) of POINT; near (2, N) of NEAR, bends (2, N) of
BENDS : near points of two poses, in the order of the points, row `follower.side` for the tool's
pose; contacts (N,) int64 : points in contact; missed : a MISSED, the unknown cells.
"""


@leaf
def _query_run(query, run, transform, center):
    """Evaluate the due points of run number `run` -> OPEN, SHUT or MANY, as below."""
    cells, which, shell, grid, follower, kept, _, _, _, missed = query
    seen, points = seen_in(cells, which, cells.words), shell.points
    start, end = run * shell.run, min((run + 1) * shell.run, points.shape[0])
    payload, (cx, cy, cz), half = cells.payload, center, 1 - follower.side
    travelled, n_near, n_missed = follower.travelled, follower.n_tried, missed.n_cells
    merged, most_near = follower.merged, follower.merges_from
    last_key, slot, mask = np.int64(-1), np.int64(UNKNOWN), np.uint64(0)
    run_due = NEVER
    for n in range(start, end):
        point = kept[n]
        # the distance is 1-Lipschitz: until `due` the point's bound stays above FAR
        if travelled < point.due:
            run_due = min(run_due, point.due)
            continue
        px, py, pz = moved(transform, points[n, 0], points[n, 1], points[n, 2])
        at = clamped_into(grid, px, py, pz)
        key = cell_key(np.int64(at[0]), np.int64(at[1]), np.int64(at[2]))
        if key != last_key:  # neighbours share a cell: few hash look-ups
            last_key = key
            slot, mask, n_missed = enter_cell(seen, key, missed, n_missed)
        if slot < 0:
            follower.n_unknown += 1
            point.due = run_due = -NEVER  # due at each query until the cell is resident
            continue
        if n & (merged - 1):  # represented by another point's contact
            bound = bound_at(payload, slot, mask, at)
            if bound >= LEAST_BOUND:
                point.due = travelled + bound - FAR
                run_due = min(run_due, point.due)
                continue
        sample = distance_at(payload, slot, mask, at)
        u, bound = sample[0], sample[4]
        point.due = travelled + bound - FAR
        run_due = min(run_due, point.due)
        if u >= ONSET + MARGIN and bound >= LEAST_BOUND:
            continue
        if follower.is_advancing and _goes_nearer(u, bound, point):
            return SHUT  # `run_due` unwritten: the run stays due
        if 0 < most_near <= n_near and merged < MOST_MERGED:
            return MANY  # near points stay due: the merged query finds them again
        lever = px - cx, py - cy, pz - cz
        near = query.near[half, n_near]
        near.point, near.u, near.bound, near.is_hollow = n, u, bound, False
        both = along_and_about(lever, sample[1], sample[2], sample[3])
        for axis in range(3):
            near.along[axis], near.about[axis] = both[axis], both[3 + axis]
        if follower.is_bent and may_be_hollow(mask, at, u):
            bends = query.bends[half, n_near]
            near.is_hollow = _write_bends(bends, bends_at(payload, slot, at, lever, sample))
        n_near += 1
    kept[run].run_due = run_due
    follower.n_tried, missed.n_cells = n_near, n_missed
    return OPEN


@leaf
def rest_of_sphere(seen, spheres, run, transform, grid):
    """Voxels a run's sphere may travel before a point in it can be near; at most 0 if one may."""
    x, y, z = in_voxels(transform, grid, spheres[run, 0], spheres[run, 1], spheres[run, 2])
    return room_around(seen, x, y, z, spheres[run, 3] / grid.size + FAR, LONGEST_REST, grid.side)


@leaf
def _query_due_runs(query, transform, center, path_length):
    """Evaluate the points of all due runs -> OPEN, SHUT or MANY.

    The sphere of a run already due at the last query, `path_length` voxels ago, is not tested.
    """
    cells, which, shell, grid, follower, kept, _, _, _, missed = query
    travelled = follower.travelled
    follower.n_tried = follower.n_unknown = missed.n_cells = 0
    for run in range(n_runs_of(shell)):
        due = kept[run].run_due
        if travelled < due:
            continue
        # a run due twice in a row has points near: its sphere would fail again
        if follower.is_large and (due == -NEVER or due >= travelled - path_length):
            rest = rest_of_sphere(
                seen_in(cells, which, cells.words), shell.spheres, run, transform, grid
            )
            if rest > 0.0:
                kept[run].run_due = travelled + rest
                continue
        found = _query_run(query, run, transform, center)
        if found != OPEN:
            return found
    return OPEN


@leaf
def query_proximity(query, pose, path_length, is_advancing):
    """Proximity query of the tool at a pose (4, 4) -> OPEN, SHUT or NOT_KNOWN.

    path_length : path length of the farthest point since the last query, voxels. is_advancing :
    SHUT if a point is nearer than FLOOR or LEAST_BOUND allow, and no farther than at the tool's
    pose. The near points go into the other row of `near`, not that of the tool's pose; SHUT leaves
    it incomplete.

    A GPU may run the query instead (`kernels.gpu.proximity_queries`), through `follower.gpu_query`.
    Its sessions merge contacts: from `merges_from` near points on, one contact represents 2, 4, 8
    ... neighbours by index, up to `MOST_MERGED`. Of the others only the bounds are computed, so no
    point crosses a surface. The CPU merges likewise, as the GPU's test oracle.
    """
    shell, follower, kept = query.shell, query.follower, query.kept
    # before any test of `due`; the way back from a refused pose adds to it, too
    follower.travelled += path_length
    follower.is_advancing, follower.way = is_advancing, path_length
    follower.n_queries += 1
    follower.merged = max(follower.merged, 1)
    if follower.gpu_query != 0:
        return call(follower.gpu_query)
    transform = transform_of(pose)
    center = moved(transform, shell.center[0], shell.center[1], shell.center[2])
    while True:
        # restart at each doubling: one factor holds for all near points of a pose
        found = _query_due_runs(query, transform, center, path_length)
        if found != MANY:
            break
        follower.merged *= 2
    if found == SHUT:
        return SHUT
    travelled, least = follower.travelled, NEVER
    for run in range(n_runs_of(shell)):
        least = min(least, kept[run].run_due)
    # inverse of due = travelled + bound - FAR: the least bound, deferred points included
    follower.tried_clearance = least - travelled + FAR
    return OPEN if follower.n_unknown == 0 else NOT_KNOWN


@leaf
def settle(query):
    """Accept the tried pose as the tool's: its near points, their distances and onsets."""
    follower, kept = query.follower, query.kept
    before, after = query.near[follower.side], query.near[1 - follower.side]
    # merge join of the old and the new near points
    m = n = 0
    while m < follower.n_near or n < follower.n_tried:  # both in the order of the points
        if n == follower.n_tried or (m < follower.n_near and before[m].point < after[n].point):
            point = kept[before[m].point]  # no longer near
            point.u, point.bound, point.onset = HALF_WIDTH, HALF_WIDTH, ONSET
            m += 1
            continue
        near = after[n]
        m += m < follower.n_near and before[m].point == near.point
        point = kept[near.point]
        point.u, point.bound = near.u, near.bound
        # a leaving point regains the full onset while its depth is 0: no force jumps
        point.onset = max(point.onset, min(near.u, ONSET))
        n += 1
    # double buffer: until here a refused pose has cost the tool none of its near points
    follower.side, follower.n_near = 1 - follower.side, follower.n_tried
    follower.clearance, follower.astray = follower.tried_clearance, 0.0


@leaf
def take_more_points(query):
    """Halve `follower.merged` for the next query, if few contacts are near -> whether it did."""
    follower, kept = query.follower, query.kept
    if follower.merged <= 1 or ROOMY * follower.n_near > follower.merges_from:
        return False
    follower.merged //= 2
    follower.anew = max(follower.anew, RUNS_ANEW)  # a pending POINTS_ANEW stays
    if follower.gpu_query == 0:
        for n in range(kept.shape[0]):
            kept[n].run_due = -NEVER
    return True


@leaf
def query_anew(query):
    """Make every point due at the next query; the near points are unchanged."""
    follower, kept = query.follower, query.kept
    follower.travelled = follower.astray = 0.0
    follower.anew = POINTS_ANEW
    if follower.gpu_query != 0:  # the GPU has its own `due`, reset by `anew`
        return
    for n in range(kept.shape[0]):
        kept[n].due = kept[n].run_due = -NEVER


@leaf
def reset_points(query):
    """Reset all points, as at the start: none is near, and each has the full onset."""
    query_anew(query)
    follower, kept = query.follower, query.kept
    follower.n_near = follower.n_tried = 0
    for n in range(kept.shape[0]):
        kept[n].u = kept[n].bound = HALF_WIDTH
        kept[n].onset = ONSET


@leaf
def least_distance(query):
    """Least distance of the near points at the tool's pose, voxels; HALF_WIDTH without any."""
    near, least = query.near[query.follower.side], HALF_WIDTH
    for m in range(query.follower.n_near):
        least = min(least, near[m].u)
    return least


@leaf
def fix_onsets(query):
    """Begin each near point's contact at its present distance, at most at the full onset."""
    near = query.near[query.follower.side]
    for m in range(query.follower.n_near):
        query.kept[near[m].point].onset = min(near[m].u, ONSET)


@inlined
def depth_of(query, near):
    """Depth of a near point below its onset, m; negative above it."""
    return query.grid.size * (query.kept[near.point].onset - near.u)

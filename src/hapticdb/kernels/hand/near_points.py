"""Which points of the tool are near a surface, and how near: one look at one pose.

A look computes distance and gradient at each point that may be near. A point whose lower bound says
that it is far is not looked at again until the tool has moved that far: `DUE` is the way of the
farthest point at which the point is looked at next. The same holds for runs of points.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import inlined, leaf
from hapticdb.kernels.field.lattice import HALF_WIDTH
from hapticdb.kernels.field.law import ONSET
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
    LISTED,
    UNKNOWN,
    brick_bit,
    cell_key,
    enter_cell,
    in_voxels,
    n_runs_of,
    seen_in,
)
from hapticdb.kernels.resident.nearest import room_around
from hapticdb.kernels.rigid import moment, moved, transform_of

MARGIN = 0.5
"""Voxels beyond the onset at which a point enters the equations of a step. Larger: longer steps are
foreseen, and more points are in the equations."""
FAR = ONSET + MARGIN + 0.1
"""Voxels: a point with a greater lower bound is not looked at. The tenth is room for the spline,
which smooths. Larger: points are looked at more often."""
FLOOR = 1.0
"""Voxels: no step takes a point nearer to a surface. Smaller: firmer contacts, less smooth ones;
below about 0.7 the gradients are wrong."""
LEAST_BOUND = 0.1
"""Voxels: least lower bound that a step may take a point to. Smaller: points get nearer to sheets;
the rule is a proof while it is above 0."""
ENOUGH = 0.3
"""Voxels: a bound of a near point that is not improved any more. Larger: fewer and longer strides
in contact, and more computing for each point."""
NEVER = 1e30
"""A way that no tool travels."""

DUE, LAST_U, LAST_BOUND, ONSETS, RUN_DUE, ACTIVE = 0, 1, 2, 3, 4, 5
"""Rows of a field (FIELD_ROWS, N) with a number for each point: way at which the point is looked at
next; distance and bound at the tool's pose, h where it is not near; onset, voxels. RUN_DUE has the
least DUE of each run of points; ACTIVE has, for each near point in its order, whether it is in
the contact set."""
NEAR = 6
"""First row with the near points of two poses, in the order of the points: NEAR_ROWS for each."""
U, BOUND, ALONG, ABOUT = 0, 1, 2, 5
"""Rows from there on: distance and bound, voxels; gradient (3) and its moment about the centre (3),
m."""
BENDS, BEND_ROWS = 8, 7
"""First row of the two ways in which the surface bends towards a near point, and rows of each:
curvature, 1/voxel, its direction (3), and that direction's moment about the centre (3), m."""
NEAR_ROWS = BENDS + 2 * BEND_ROWS
BENT = 0.05
"""Curvature, 1/voxel, that is not counted: the noise of stored distances. Larger: less resistance
along rough surfaces, and steps that overshoot in gentle hollows."""
FIELD_ROWS = NEAR + 2 * NEAR_ROWS
FELT_POINTS, NEAR_POINTS, MET_ROWS = 0, 1, 3
"""Rows of `met` (MET_ROWS, N) int64: FELT_POINTS takes the indices of the points that are felt, and
two rows from NEAR_POINTS on those of the near points, in the order of `field`'s numbers."""
OPEN, SHUT, NOT_KNOWN, MANY = 0, 1, 2, 3
"""What a look finds: the tool may be there; a point may not; points are in unknown cells; there are
so many near points that they are merged."""
MOST_MERGED = 64
"""Most points for which one contact stands: a run. Larger: broad contacts cost less."""
LONGEST_REST = 16.0
"""Most voxels that a run of a large tool may go before its sphere is tested again. Larger: fewer
tests in free space, each of which reads more cells."""
RUNS_ANEW, POINTS_ANEW = 1, 2
"""What a look by another forgets first: when runs are due, or when points are, too."""
ROOMY = 4
"""Contacts are split again when fewer than this part of the most are near. Larger: points come back
later, and the number of contacts changes less often."""


@leaf
def clamped_into(place, px, py, pz):
    """A point, m, moved into the grid, and the way back out of it: six numbers, voxels."""
    size, last = place.size, place.side - 1e-6
    px, py, pz = (px - place.x) / size, (py - place.y) / size, (pz - place.z) / size
    x, y, z = min(max(px, 0.0), last), min(max(py, 0.0), last), min(max(pz, 0.0), last)
    return x, y, z, px - x, py - y, pz - z


@leaf
def _outside_grid(u, gx, gy, gz, bound, dx, dy, dz):
    """Distance, gradient and bound at a point outside the grid, from those where it was clamped to.

    (dx, dy, dz): the way out, voxels. All surfaces are in the grid, so the way out adds to u.
    """
    way = math.sqrt(dx * dx + dy * dy + dz * dz)
    gx = gx if dx == 0.0 else dx / way
    gy = gy if dy == 0.0 else dy / way
    gz = gz if dz == 0.0 else dz / way
    return u + way, gx, gy, gz, max(bound, way)


@inlined
def distance_at(payload, slot, mask, at):
    """Distance u, gradient (3) and bound at a point `clamped_into` the grid: five numbers."""
    x, y, z, dx, dy, dz = at
    i, j, k = np.int64(x), np.int64(y), np.int64(z)
    u, gx, gy, gz = HALF_WIDTH, 0.0, 0.0, 0.0
    if (mask >> brick_bit(i, j, k)) & np.uint64(1):
        u, gx, gy, gz = spline(payload, slot, x, y, z)
        bound = nearest_bound(payload, slot, x, y, z) if u < ONSET + MARGIN else 0.0
        if bound < ENOUGH:
            bound = lower_bound(payload, slot, x, y, z)
    else:
        bound = bound_in_free_block(x, y, z, 5 if slot == EMPTY_SLOT else 3)
    if dx != 0.0 or dy != 0.0 or dz != 0.0:
        u, gx, gy, gz, bound = _outside_grid(u, gx, gy, gz, bound, dx, dy, dz)
    return u, gx, gy, gz, bound


@inlined
def bound_at(payload, slot, mask, at):
    """The bound of `distance_at` alone."""
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
    """Curvatures of a hollow surface across a gradient and their unit directions: c, v, d, w.

    The second derivatives are those of the distance. A curvature is 0 where the surface is flat or
    bulges. Eigenvalues of the 2 x 2 matrix in the plane across the gradient, in closed form.
    """
    ux, uy, uz = (gz, 0.0, -gx) if abs(gy) > 0.7 * (abs(gx) + abs(gz)) else (-gz, 0.0, gx)
    if abs(ux) + abs(uz) < 1e-9:
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
    angle = 0.5 * math.atan2(2.0 * b, a - c)
    cosine, sine = math.cos(angle), math.sin(angle)
    return (
        max(middle + half - BENT, 0.0),
        cosine * ux + sine * wx, cosine * uy + sine * wy, cosine * uz + sine * wz,
        max(middle - half - BENT, 0.0),
        cosine * wx - sine * ux, cosine * wy - sine * uy, cosine * wz - sine * uz,
    )  # fmt: skip


@leaf
def _write_along(field, row, m, lever, x, y, z):
    """Write a direction at near point m and its moment about the centre, six rows from `row` on."""
    field[row, m], field[row + 1, m], field[row + 2, m] = x, y, z
    x, y, z = moment(lever[0], lever[1], lever[2], x, y, z)
    field[row + 3, m], field[row + 4, m], field[row + 5, m] = x, y, z


@leaf
def _bend_at(payload, slot, mask, x, y, z, lever, field, rows, m):
    """Find both bends of near point m, at (x, y, z) voxels."""
    row = rows + BENDS
    field[row, m] = field[row + BEND_ROWS, m] = 0.0
    if not (mask >> brick_bit(np.int64(x), np.int64(y), np.int64(z))) & np.uint64(1):
        return
    gx, gy, gz = field[rows + ALONG, m], field[rows + ALONG + 1, m], field[rows + ALONG + 2, m]
    xx, yy, zz, xy, xz, yz = second_derivatives(payload, slot, x, y, z)
    c, vx, vy, vz, d, wx, wy, wz = _bends_of(gx, gy, gz, xx, yy, zz, xy, xz, yz)
    field[row, m], field[row + BEND_ROWS, m] = c, d
    _write_along(field, row + 1, m, lever, vx, vy, vz)
    _write_along(field, row + BEND_ROWS + 1, m, lever, wx, wy, wz)


@inlined
def _goes_nearer(u, bound, last_u, last_bound):
    """Whether a point would be too near a surface, and no farther from it than it was."""
    return (u < FLOOR and u <= last_u) or (bound < LEAST_BOUND and bound <= last_bound)


@inlined
def write_near(payload, slot, mask, at, lever, found, is_bent, field, rows, m):
    """Write near point m into its rows.

    at: `clamped_into` the grid; lever (3), m; found: of `distance_at` there.
    """
    u, gx, gy, gz, bound = found
    field[rows + U, m], field[rows + BOUND, m] = u, bound
    _write_along(field, rows + ALONG, m, lever, gx, gy, gz)
    if is_bent and u < ONSET:
        _bend_at(payload, slot, mask, at[0], at[1], at[2], lever, field, rows, m)
    else:
        field[rows + BENDS, m] = field[rows + BENDS + BEND_ROWS, m] = 0.0


class Grasp(NamedTuple):
    """What the looks of a tool read and write.

    cells, of `Cells` with distances, and which of their directories a frame reads; shell, of
    `Clusters`; place: the grid; follower: a record of FOLLOWER; field (FIELD_ROWS, N) float64, met
    (MET_ROWS, N) int64; missed (1 + MOST_MISSED,) int64: the unknown cells, as `felt` has them.
    """

    cells: Any
    which: int
    shell: Any
    place: Any
    follower: Any
    field: NDArray[np.float64]
    met: NDArray[np.int64]
    missed: NDArray[np.int64]


@leaf
def _look_at_run(grasp, run, transform, center):
    """Look at the points of run number `run` -> OPEN, SHUT or MANY; see `look`."""
    cells, which, shell, place, follower, field, met, missed = grasp
    seen, points = seen_in(cells, which, cells.words), shell.points
    start, end = run * shell.run, min((run + 1) * shell.run, points.shape[0])
    payload, (cx, cy, cz) = cells.payload, center
    half = 1 - follower.side
    base, near = NEAR + half * NEAR_ROWS, NEAR_POINTS + half
    travelled, n_near, n_missed = follower.travelled, follower.n_tried, missed[LISTED]
    merged, most_near = follower.merged, follower.merges_from
    last_key, slot, mask = np.int64(-1), np.int64(UNKNOWN), np.uint64(0)
    run_due = NEVER
    for n in range(start, end):
        if travelled < field[DUE, n]:
            run_due = min(run_due, field[DUE, n])
            continue
        px, py, pz = moved(transform, points[n, 0], points[n, 1], points[n, 2])
        at = clamped_into(place, px, py, pz)
        key = cell_key(np.int64(at[0]), np.int64(at[1]), np.int64(at[2]))
        if key != last_key:
            last_key = key
            slot, mask, n_missed = enter_cell(seen, key, missed, n_missed)
        if slot < 0:
            follower.n_unknown += 1
            field[DUE, n] = run_due = -NEVER
            continue
        if n & (merged - 1):  # another point's contact stands for this one
            bound = bound_at(payload, slot, mask, at)
            if bound >= LEAST_BOUND:
                field[DUE, n] = travelled + bound - FAR
                run_due = min(run_due, field[DUE, n])
                continue
        looked = distance_at(payload, slot, mask, at)
        u, bound = looked[0], looked[4]
        field[DUE, n] = travelled + bound - FAR
        run_due = min(run_due, field[DUE, n])
        if u >= ONSET + MARGIN and bound >= LEAST_BOUND:
            continue
        if follower.is_walking and _goes_nearer(u, bound, field[LAST_U, n], field[LAST_BOUND, n]):
            return SHUT
        if 0 < most_near <= n_near and merged < MOST_MERGED:
            return MANY
        met[near, n_near] = n
        lever = px - cx, py - cy, pz - cz
        write_near(payload, slot, mask, at, lever, looked, follower.is_bent, field, base, n_near)
        n_near += 1
    field[RUN_DUE, run] = run_due
    follower.n_tried, missed[LISTED] = n_near, n_missed
    return OPEN


@leaf
def rest_of_sphere(seen, spheres, run, transform, place):
    """Voxels that a run's sphere may go before a point of it can be near; not above 0 if one is."""
    x, y, z = in_voxels(transform, place, spheres[run, 0], spheres[run, 1], spheres[run, 2])
    return room_around(seen, x, y, z, spheres[run, 3] / place.size + FAR, LONGEST_REST, place.side)


@leaf
def _look_at_due_runs(grasp, transform, center, way):
    """Look at the points of all runs that are due -> OPEN, SHUT or MANY.

    The sphere of a run that was near at the last look, a way ago, is not tested.
    """
    cells, which, shell, place, follower, field, _, missed = grasp
    travelled = follower.travelled
    follower.n_tried = follower.n_unknown = missed[LISTED] = 0
    for run in range(n_runs_of(shell)):
        due = field[RUN_DUE, run]
        if travelled < due:
            continue
        if follower.is_large and (due == -NEVER or due >= travelled - way):
            rest = rest_of_sphere(
                seen_in(cells, which, cells.words), shell.spheres, run, transform, place
            )
            if rest > 0.0:
                field[RUN_DUE, run] = travelled + rest
                continue
        found = _look_at_run(grasp, run, transform, center)
        if found != OPEN:
            return found
    return OPEN


@leaf
def look(grasp, pose, way, is_walking):
    """Look at the tool at a pose (4, 4) -> OPEN, SHUT or NOT_KNOWN.

    way: voxels that the farthest point has moved since the last look. is_walking: SHUT if a point
    is nearer than FLOOR or LEAST_BOUND allow, and no farther than at the tool's pose. The near
    points go into the half of `field` and `met` that the tool's pose does not use; SHUT leaves it
    unfinished. A GPU may look instead (`kernels.gpu.looks`): then it is called. Its sessions merge
    contacts: where `merges_from` points are near, one contact stands for 2, 4, 8 ... neighbours by
    index, up to `MOST_MERGED`. Of the others only the bounds are computed, so that no point passes
    a surface. The processor does the same here, as the oracle of the GPU.
    """
    shell, follower, field = grasp.shell, grasp.follower, grasp.field
    follower.travelled += way
    follower.is_walking, follower.way = is_walking, way
    follower.n_looks += 1
    follower.merged = max(follower.merged, 1)
    if follower.looker != 0:
        return call(follower.looker)
    transform = transform_of(pose)
    center = moved(transform, shell.center[0], shell.center[1], shell.center[2])
    while True:
        found = _look_at_due_runs(grasp, transform, center, way)
        if found != MANY:
            break
        follower.merged *= 2
    if found == SHUT:
        return SHUT
    travelled, least = follower.travelled, NEVER
    for run in range(n_runs_of(shell)):
        least = min(least, field[RUN_DUE, run])
    follower.tried_clearance = least - travelled + FAR
    return OPEN if follower.n_unknown == 0 else NOT_KNOWN


@leaf
def settle(follower, field, met):
    """Make the pose that was tried the tool's pose: its near points, their onsets."""
    before, after = follower.side, 1 - follower.side
    rows = NEAR + after * NEAR_ROWS
    for m in range(follower.n_near):
        field[LAST_U, met[NEAR_POINTS + before, m]] = HALF_WIDTH
        field[LAST_BOUND, met[NEAR_POINTS + before, m]] = HALF_WIDTH
    for m in range(follower.n_tried):
        n, u = met[NEAR_POINTS + after, m], field[rows + U, m]
        field[LAST_U, n], field[LAST_BOUND, n] = u, field[rows + BOUND, m]
        field[ONSETS, n] = max(field[ONSETS, n], min(u, ONSET))
    for m in range(follower.n_near):
        n = met[NEAR_POINTS + before, m]
        if field[LAST_U, n] == HALF_WIDTH:  # no longer near
            field[ONSETS, n] = ONSET
    follower.side, follower.n_near = after, follower.n_tried
    follower.clearance, follower.astray = follower.tried_clearance, 0.0


@leaf
def take_more_points(follower, field):
    """Let the next look merge half as many contacts, if there is room -> whether it does."""
    if follower.merged <= 1 or ROOMY * follower.n_near > follower.merges_from:
        return False
    follower.merged //= 2
    follower.anew = max(follower.anew, RUNS_ANEW)
    if follower.looker == 0:
        for n in range(field.shape[1]):
            field[RUN_DUE, n] = -NEVER
    return True


@leaf
def look_anew(follower, field):
    """Forget all ways, so that the next look looks at every point; near points stay as they are."""
    follower.travelled = follower.astray = 0.0
    follower.anew = POINTS_ANEW
    if follower.looker != 0:
        return
    for n in range(field.shape[1]):
        field[DUE, n] = field[RUN_DUE, n] = -NEVER


@leaf
def forget(follower, field):
    """Forget everything about the points, as at the start: each has the full onset."""
    look_anew(follower, field)
    follower.n_near = follower.n_tried = 0
    for n in range(field.shape[1]):
        field[LAST_U, n] = field[LAST_BOUND, n] = HALF_WIDTH
        field[ONSETS, n] = ONSET


@leaf
def least_distance(follower, field):
    """Least distance of the near points at the tool's pose, voxels; h without any."""
    rows = NEAR + follower.side * NEAR_ROWS
    least = HALF_WIDTH
    for m in range(follower.n_near):
        least = min(least, field[rows + U, m])
    return least


@leaf
def fix_onsets(follower, field, met):
    """Let each near point's contact begin where it is now, at most at the full onset."""
    rows = NEAR + follower.side * NEAR_ROWS
    for m in range(follower.n_near):
        field[ONSETS, met[NEAR_POINTS + follower.side, m]] = min(field[rows + U, m], ONSET)

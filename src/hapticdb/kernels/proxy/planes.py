"""The planes of a contact proxy: where the tool touches or soon may, in few rows.

Every point of the tool that may be within the band of a surface is looked at and makes one row:
lever, normal, depth, curvatures. The rows are grouped into at most MOST_PLANES planes, by normal
and place alike.
"""

import math

import numpy as np

from hapticdb.kernels._jit import leaf
from hapticdb.kernels.field.lattice import HALF_WIDTH
from hapticdb.kernels.field.law import ONSET
from hapticdb.kernels.field.spline import second_derivatives
from hapticdb.kernels.hand.near_points import (
    FAR,
    LEAST_BOUND,
    ONSETS,
    RUN_DUE,
    bends_of,
    bound_at,
    clamped_into,
    distance_at,
)
from hapticdb.kernels.records import MOST_PLANES
from hapticdb.kernels.resident.cells import brick_bit, cell_key, slot_of
from hapticdb.kernels.rigid import moved, transform_of

REACH = HALF_WIDTH - 0.15
"""Voxels: points nearer than this to a surface become rows. Larger: surfaces are foreseen farther
ahead; at the band's border distances are cut off and gradients are wrong."""
DEPTH, NORMAL, LEVER, BEND, ALONG, CLUSTER, NEAREST = 0, 1, 4, 7, 9, 12, 13
"""Columns of a row: depth, m; normal; lever, m; two curvatures, 1/m, and the direction of the
first; the plane that it belongs to; its distance from that plane's centre."""
ROW_COLUMNS = 14
ALIKE = 0.02
"""Difference of two rows (`between`) below which one plane stands for both. Larger: fewer planes,
and turns of the tool are resisted less exactly."""
NEAR_DEEPEST = 0.1
"""Voxels above the deepest point of a group that is not yet in contact within which points count.
Larger: contact begins more smoothly and later."""
FADE = 0.3
"""Voxels above contact at which a point is least worth a plane of its own. Larger: more planes are
spent on points that are far from contact."""
LEAST_WORTH = 0.01
"""Worth of such a point, where a point in contact has 1. Larger: likewise."""
FLAT = 0.05
"""Curvature, 1/voxel, that counts as none: the noise of stored distances. Larger: gentle curves are
taken for planes."""


@leaf
def _bend_along(x, y, z, xx, yy, zz, xy, xz, yz):
    """Second derivative along the unit vector (x, y, z), 1/voxel; 0 where it is FLAT."""
    bend = x * x * xx + y * y * yy + z * z * zz + 2.0 * (x * y * xy + x * z * xz + y * z * yz)
    return math.copysign(max(abs(bend) - FLAT, 0.0), bend)


@leaf
def _write_bends(payload, slot, x, y, z, gx, gy, gz, size, row):
    """Curvatures of the surface at a point, positive where it bulges, into a row."""
    xx, yy, zz, xy, xz, yz = second_derivatives(payload, slot, x, y, z)
    _, vx, vy, vz, _, wx, wy, wz = bends_of(gx, gy, gz, xx, yy, zz, xy, xz, yz)
    row[BEND] = _bend_along(vx, vy, vz, xx, yy, zz, xy, xz, yz) / size
    row[BEND + 1] = _bend_along(wx, wy, wz, xx, yy, zz, xy, xz, yz) / size
    row[ALONG], row[ALONG + 1], row[ALONG + 2] = vx, vy, vz


@leaf
def find_rows(cells, which, shell, place, tool, follower, field, rows):
    """Make a row of each point in REACH at the tool's pose -> their number, and the trust, voxels.

    The trust: how far every other point may move without contact. Where the coupling has merged
    contacts (`near_points.look`), the points that it leaves to others make no row here either.
    """
    keys, slots, masks = cells.keys, cells.slots, cells.masks
    payload = cells.payload
    transform = transform_of(tool.pose)
    cx, cy, cz = moved(transform, shell.center[0], shell.center[1], shell.center[2])
    size, points, run = place.size, shell.points, shell.run
    count, trust, merged = 0, 1e30, max(follower.merged, 1)
    for start in range(0, points.shape[0], run):
        bound = field[RUN_DUE, start // run] - follower.travelled + FAR
        if bound >= HALF_WIDTH:
            trust = min(trust, bound - ONSET)
            continue
        for n in range(start, min(start + run, points.shape[0])):
            px, py, pz = moved(transform, points[n, 0], points[n, 1], points[n, 2])
            at = clamped_into(place, px, py, pz)
            x, y, z, dx, dy, dz = at
            i, j, k = np.int64(x), np.int64(y), np.int64(z)
            slot = slot_of(keys, slots, which, cell_key(i, j, k))
            if slot < 0:
                trust = 0.0
                continue
            mask = masks[slot]
            if n & (merged - 1):
                bound = bound_at(payload, slot, mask, at)
                if bound >= LEAST_BOUND:
                    trust = min(trust, bound - LEAST_BOUND)
                    continue
            u, gx, gy, gz, bound = distance_at(payload, slot, mask, at)
            length = math.sqrt(gx * gx + gy * gy + gz * gz)
            if u >= REACH or length < 0.5:
                trust = min(trust, max(bound, min(u, HALF_WIDTH)) - ONSET)
                continue
            row = rows[count]
            row[DEPTH] = size * (field[ONSETS, n] - u)
            row[NORMAL], row[NORMAL + 1], row[NORMAL + 2] = gx / length, gy / length, gz / length
            row[LEVER], row[LEVER + 1], row[LEVER + 2] = px - cx, py - cy, pz - cz
            row[BEND] = row[BEND + 1] = 0.0
            row[ALONG], row[ALONG + 1], row[ALONG + 2] = 0.0, 0.0, 0.0
            is_inside = dx == 0.0 and dy == 0.0 and dz == 0.0
            if is_inside and (mask >> brick_bit(i, j, k)) & np.uint64(1):
                _write_bends(
                    payload, slot, x, y, z, gx / length, gy / length, gz / length, size, row
                )
            count += 1
    return count, trust


@leaf
def between(rows, n, m, radius):
    """Square of the difference of two rows: of their normals, and of their levers in radii."""
    total = 0.0
    for axis in range(3):
        turn = rows[n, NORMAL + axis] - rows[m, NORMAL + axis]
        lever = (rows[n, LEVER + axis] - rows[m, LEVER + axis]) / radius
        total += turn * turn + lever * lever
    return total


@leaf
def worth(depth, size):
    """How much a row is worth a plane of its own: 1 in contact, less the farther from it."""
    share = max(1.0 + min(depth / size, 0.0) / FADE, 0.0)
    return LEAST_WORTH + (1.0 - LEAST_WORTH) * share * share


@leaf
def group_rows(rows, count, radius, size):
    """Give each row its plane -> number of planes.

    The first plane stands around the deepest row. Each further one stands around the row that is
    farthest from all planes, times its worth (Gonzalez 1985). Rows in contact and others get planes
    of their own. The first of equal rows is taken, so the result is the same everywhere.
    """
    n_planes, latest = 0, 0
    radius = max(radius, size)  # a tool may be a single point
    for n in range(count):
        rows[n, NEAREST], rows[n, CLUSTER] = 1e30, -1.0
        latest = n if rows[n, DEPTH] > rows[latest, DEPTH] else latest
    while count > 0 and n_planes < MOST_PLANES:
        best, most = -1, ALIKE * ALIKE
        in_contact = rows[latest, DEPTH] > 0.0
        for n in range(count):
            if (rows[n, DEPTH] > 0.0) == in_contact:
                apart = between(rows, n, latest, radius)
                if apart < rows[n, NEAREST]:
                    rows[n, NEAREST], rows[n, CLUSTER] = apart, n_planes
            value = min(rows[n, NEAREST], 8.0) * worth(rows[n, DEPTH], size)
            if value > most:
                best, most = n, value
        n_planes += 1
        if best < 0:
            break
        latest = best
    return n_planes


@leaf
def write_planes(model, rows, count, n_planes, size):
    """Merge the rows of each plane.

    Of rows in contact force and count are kept: normal and lever are means weighted by depth. Of
    others those count that are nearly as deep as the deepest.
    """
    scratch, model.n_planes = model.rows, n_planes
    for m in range(n_planes):
        model.depths[m], model.weights[m] = -1e30, 0.0
        scratch[m, 0] = scratch[m, 1] = 0.0
        for axis in range(3):
            model.normals[m, axis] = model.levers[m, axis] = 0.0
    for n in range(count):
        p = np.int64(rows[n, CLUSTER])
        if p >= 0 and rows[n, DEPTH] > model.depths[p]:
            model.depths[p] = rows[n, DEPTH]
            model.bends[p, 0], model.bends[p, 1] = rows[n, BEND], rows[n, BEND + 1]
            for axis in range(3):
                model.along[p, axis] = rows[n, ALONG + axis]
    for n in range(count):
        p = np.int64(rows[n, CLUSTER])
        if p < 0:
            continue
        depth, deepest = rows[n, DEPTH], model.depths[p]
        if deepest > 0.0:
            share, part = depth, 1.0
        else:
            share = max(1.0 - (deepest - depth) / (NEAR_DEEPEST * size), 0.0)
            part = share
        scratch[p, 0] += share
        scratch[p, 1] += part * depth
        model.weights[p] += part
        for axis in range(3):
            model.normals[p, axis] += share * rows[n, NORMAL + axis]
            model.levers[p, axis] += share * rows[n, LEVER + axis]
    for m in range(n_planes):
        _finish_plane(model, m, scratch[m, 0], scratch[m, 1])


@leaf
def _finish_plane(model, p, shares, depths):
    """Divide the sums of plane p; its direction `along` is made exactly across the normal."""
    normal, lever, along = model.normals[p], model.levers[p], model.along[p]
    x, y, z = normal[0], normal[1], normal[2]
    length = max(math.sqrt(x * x + y * y + z * z), 1e-12)
    model.depths[p] = depths / model.weights[p]
    if model.depths[p] > 0.0:
        model.depths[p] *= length / shares
    for axis in range(3):
        normal[axis] /= length
        lever[axis] /= shares
    dot = normal[0] * along[0] + normal[1] * along[1] + normal[2] * along[2]
    x, y, z = along[0] - dot * normal[0], along[1] - dot * normal[1], along[2] - dot * normal[2]
    length = math.sqrt(x * x + y * y + z * z)
    if length < 0.1:
        model.bends[p, 0] = model.bends[p, 1] = 0.0
        x, y, z = (normal[2], 0.0, -normal[0]) if abs(normal[1]) > 0.7 else (
            -normal[1], normal[0], 0.0,
        )  # fmt: skip
        length = math.sqrt(x * x + y * y + z * z)
    along[0], along[1], along[2] = x / length, y / length, z / length

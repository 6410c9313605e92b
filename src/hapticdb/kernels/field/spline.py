"""Quadratic B-spline of a resident cell's distances, and proved lower bounds of the distance.

The spline covers the 27 centres around the point. It is exact for a linear distance, and its
gradient is continuous, so forces along the gradient are those of a potential. The lower bound needs
no smoothness: a distance is 1-Lipschitz, so at a point it is at least u_i - |p - c_i| for each
centre c_i, less half a quantisation step.
"""

import math

import numpy as np

from hapticdb.kernels._jit import inlined, leaf
from hapticdb.kernels.field.lattice import (
    CELL_SIDE,
    HALF_WIDTH,
    STEPS,
    VOXELS_A_STEP,
    cell_place,
)

FREE_BEYOND = math.sqrt(HALF_WIDTH * HALF_WIDTH - 0.5)
"""Lower bound, voxels, of the distance to a block of voxels, grown by half a voxel, if all its
centres and one more on each side are BEYOND: the balls of radius h about the centres cover that
space. It follows from `HALF_WIDTH`."""
ALONG_I, ALONG_J = CELL_SIDE * CELL_SIDE, CELL_SIDE
"""Index offsets in a cell from a centre to the next one along i and j."""


@leaf
def _spline_weights(t):
    """B-spline weights of three centres, at a point at t from the middle one, |t| <= 1/2."""
    return 0.5 * (0.5 - t) * (0.5 - t), 0.75 - t * t, 0.5 * (0.5 + t) * (0.5 + t)


@leaf
def _from_center(x):
    """Coordinate relative to the centre of its voxel, voxels, -1/2 to 1/2."""
    return x - math.floor(x) - 0.5


@inlined
def _line_of_three(payload, slot, at, before, here, after, t):
    """Value and slope along k at three centres from index `at` on, in steps."""
    first = float(min(payload[slot, at], STEPS))
    second = float(min(payload[slot, at + 1], STEPS))
    third = float(min(payload[slot, at + 2], STEPS))
    value = before * first + here * second + after * third
    slope = (t - 0.5) * first - 2.0 * t * second + (t + 0.5) * third
    return value, slope


@inlined
def _plane_of_nine(payload, slot, at, by, hy, ay, ty, bz, hz, az, tz):
    """Value and slopes along j and k at nine centres of one i, in steps."""
    v0, z0 = _line_of_three(payload, slot, at, bz, hz, az, tz)
    v1, z1 = _line_of_three(payload, slot, at + ALONG_J, bz, hz, az, tz)
    v2, z2 = _line_of_three(payload, slot, at + 2 * ALONG_J, bz, hz, az, tz)
    value = by * v0 + hy * v1 + ay * v2
    along_j = (ty - 0.5) * v0 - 2.0 * ty * v1 + (ty + 0.5) * v2
    return value, along_j, by * z0 + hy * z1 + ay * z2


@inlined
def spline(payload, slot, x, y, z):
    """Distance at a point of the slot's cell and its gradient: u, gx, gy, gz; u in voxels.

    (x, y, z) : in voxels from the grid's origin. Values beyond the band count as h.
    """
    tx, ty, tz = _from_center(x), _from_center(y), _from_center(z)
    bx, hx, ax = _spline_weights(tx)
    by, hy, ay = _spline_weights(ty)
    bz, hz, az = _spline_weights(tz)
    # quadratic B-spline: 27 centres, also across the cell's border by the layer of the payload
    at = cell_place((np.int64(x) & 31) - 1, (np.int64(y) & 31) - 1, (np.int64(z) & 31) - 1)
    v0, y0, z0 = _plane_of_nine(payload, slot, at, by, hy, ay, ty, bz, hz, az, tz)
    v1, y1, z1 = _plane_of_nine(payload, slot, at + ALONG_I, by, hy, ay, ty, bz, hz, az, tz)
    v2, y2, z2 = _plane_of_nine(payload, slot, at + 2 * ALONG_I, by, hy, ay, ty, bz, hz, az, tz)
    u = VOXELS_A_STEP * (bx * v0 + hx * v1 + ax * v2)
    gx = VOXELS_A_STEP * ((tx - 0.5) * v0 - 2.0 * tx * v1 + (tx + 0.5) * v2)
    gy = VOXELS_A_STEP * (bx * y0 + hx * y1 + ax * y2)
    gz = VOXELS_A_STEP * (bx * z0 + hx * z1 + ax * z2)
    return u, gx, gy, gz


@inlined
def weighted(payload, slot, at, bx, hx, ax, by, hy, ay, bz, hz, az):
    """Sum of the 27 centres from index `at` on, in voxels, with weights along each axis."""
    total = 0.0
    for plane in range(3):
        along = bx if plane == 0 else (hx if plane == 1 else ax)
        for line in range(3):
            across = along * (by if line == 0 else (hy if line == 1 else ay))
            here = at + plane * ALONG_I + line * ALONG_J
            total += across * (
                bz * min(payload[slot, here], STEPS)
                + hz * min(payload[slot, here + 1], STEPS)
                + az * min(payload[slot, here + 2], STEPS)
            )
    return VOXELS_A_STEP * total


@inlined
def second_derivatives(payload, slot, x, y, z):
    """Second derivatives of the spline at a point, as in `spline`: xx, yy, zz, xy, xz, yz."""
    tx, ty, tz = _from_center(x), _from_center(y), _from_center(z)
    bx, hx, ax = _spline_weights(tx)
    by, hy, ay = _spline_weights(ty)
    bz, hz, az = _spline_weights(tz)
    sx, sy, sz = tx - 0.5, ty - 0.5, tz - 0.5  # slopes: t - 1/2, -2 t, t + 1/2
    at = cell_place((np.int64(x) & 31) - 1, (np.int64(y) & 31) - 1, (np.int64(z) & 31) - 1)
    xx = weighted(payload, slot, at, 1.0, -2.0, 1.0, by, hy, ay, bz, hz, az)
    yy = weighted(payload, slot, at, bx, hx, ax, 1.0, -2.0, 1.0, bz, hz, az)
    zz = weighted(payload, slot, at, bx, hx, ax, by, hy, ay, 1.0, -2.0, 1.0)
    xy = weighted(payload, slot, at, sx, -2.0 * tx, tx + 0.5, sy, -2.0 * ty, ty + 0.5, bz, hz, az)
    xz = weighted(payload, slot, at, sx, -2.0 * tx, tx + 0.5, by, hy, ay, sz, -2.0 * tz, tz + 0.5)
    yz = weighted(payload, slot, at, bx, hx, ax, sy, -2.0 * ty, ty + 0.5, sz, -2.0 * tz, tz + 0.5)
    return xx, yy, zz, xy, xz, yz


@inlined
def lower_bound(payload, slot, x, y, z):
    """Lower bound of the distance at a point of the slot's cell, voxels, by its 8 centres."""
    tx, ty, tz = _from_center(x), _from_center(y), _from_center(z)
    # index of the lower centre of the 8 around the point
    bx, by, bz = np.int64(tx < 0.0), np.int64(ty < 0.0), np.int64(tz < 0.0)
    at = cell_place((np.int64(x) & 31) - bx, (np.int64(y) & 31) - by, (np.int64(z) & 31) - bz)
    lx, ly, lz = tx + bx, ty + by, tz + bz
    # squared offsets to the lower and the upper centres
    ux, uy, uz = (1.0 - lx) * (1.0 - lx), (1.0 - ly) * (1.0 - ly), (1.0 - lz) * (1.0 - lz)
    lx, ly, lz = lx * lx, ly * ly, lz * lz
    best = 0.0
    for corner in range(8):
        square = ux if corner & 4 else lx
        square += uy if corner & 2 else ly
        square += uz if corner & 1 else lz
        index = at + (corner >> 2) * ALONG_I + ((corner >> 1) & 1) * ALONG_J + (corner & 1)
        u = float(min(payload[slot, index], STEPS)) * VOXELS_A_STEP
        # distance is 1-Lipschitz: each centre bounds the point by itself, and the best one wins
        best = max(best, u - math.sqrt(square))
    # half a step for the rounding of the stored distance
    return max(best - 0.5 * VOXELS_A_STEP, 0.0)


@inlined
def nearest_bound(payload, slot, x, y, z):
    """As `lower_bound`, by the nearest centre alone: looser, in a third of the time."""
    tx, ty, tz = _from_center(x), _from_center(y), _from_center(z)
    at = cell_place(np.int64(x) & 31, np.int64(y) & 31, np.int64(z) & 31)
    u = min(payload[slot, at], STEPS) * VOXELS_A_STEP
    return max(u - math.sqrt(tx * tx + ty * ty + tz * tz) - 0.5 * VOXELS_A_STEP, 0.0)


@leaf
def bound_in_free_block(x, y, z, bits):
    """Lower bound of the distance in a block of (1 << bits)^3 voxels, voxels.

    Its centres, and those around it, are BEYOND.
    """
    side = float(1 << bits)
    x, y, z = x % side, y % side, z % side
    # to the block's border, half a voxel more to the grown block, then its own free margin
    return min(x, side - x, y, side - y, z, side - z) + 0.5 + FREE_BEYOND

"""Offsets of a surface along its normals, at the corners of its triangles."""

import math

import numpy as np

from hapticdb.kernels._jit import BOOL, FLOAT, FLOATS, FLOATS2, FLOATS3, INT, INTS2, entry, leaf
from hapticdb.kernels.triangles.surface_distance import are_near, place_corners

WHOLE, ACROSS, ALONG = range(3)
"""Direction of an offset: the normal, or its component across or along an axis."""
FLAT = 1e-6
"""Length of a sum, or of a component, of unit vectors below which it has no direction."""


@leaf
def _write_offset(normals, n, reach, axis, part, out, m):
    """Write the offsets of the corners of triangle n into triangle m of out (.., 3, 3)."""
    for i in range(3):
        x, y, z = normals[n, i, 0], normals[n, i, 1], normals[n, i, 2]
        length = 1.0
        if part != WHOLE:
            dot = x * axis[0] + y * axis[1] + z * axis[2]
            ax, ay, az = dot * axis[0], dot * axis[1], dot * axis[2]
            x, y, z = (x - ax, y - ay, z - az) if part == ACROSS else (ax, ay, az)
            length = math.sqrt(x * x + y * y + z * z)
            length = length if length > FLAT else math.inf
        out[m, i, 0], out[m, i, 1] = reach * (x / length), reach * (y / length)
        out[m, i, 2] = reach * (z / length)


@entry(FLOATS3, FLOAT, FLOATS, INT, FLOATS3)
def offset_kernel(normals, reach, axis, part, out):
    """Write displacements (T, 3, 3) of corners with normals (T, 3, 3): `reach` metres, or zero.

    axis (3,), part: the component of the normals along which they are.
    """
    for n in range(normals.shape[0]):
        _write_offset(normals, n, reach, axis, part, out, n)


@entry(FLOATS3, FLOATS3, FLOATS2, INTS2, FLOAT, FLOATS3, BOOL, FLOAT, FLOATS, INT)
def any_near_kernel(one, other, pose, pairs, far, normals, is_other, reach, axis, part):
    """Whether any of some pairs (N, 2) of triangles is within `far` metres after an offset.

    one, other (.., 3, 3), the other ones at a pose (4, 4); is_other: whether these are offset,
    before they are placed, and have the normals.
    """
    first, second, placed = np.empty((1, 3, 3)), np.empty((1, 3, 3)), np.empty((1, 3, 3))
    by, found = np.empty((1, 3, 3)), np.empty(7)
    for k in range(pairs.shape[0]):
        n, m = pairs[k, 0], pairs[k, 1]
        _write_offset(normals, m if is_other else n, reach, axis, part, by, 0)
        for i in range(3):
            for x in range(3):
                first[0, i, x] = one[n, i, x] + (0.0 if is_other else by[0, i, x])
                second[0, i, x] = other[m, i, x] + (by[0, i, x] if is_other else 0.0)
        place_corners(second, 0, 1, pose, placed)
        if are_near(first, 0, placed, 0, far, found):
            return True
    return False

"""The distance law: a point is felt by its distance to the nearest surface.

With u the distance at a point, d = g s max(0, `ONSET` - u) and F = K sum d n, where s is the voxel
size and n the point's inward normal. Each point counts g clamp((ONSET + BLENDING - u) / BLENDING,
0, 1) in the frame's average, so that force does not jump where a point comes near.

The share g = clamp((u(p + `AHEAD` n) - u(p)) / (AHEAD `FULL_SLOPE`), 0, 1) says how far the normal
agrees with the field: u must grow into the tool. Without it the two sides of a thin wall, with
opposite normals and almost the same u, would cancel. g is 1 wherever a face of the tool lies on a
face of the environment. The slope is a difference of two values of u and not the interpolant's
gradient, because that gradient jumps between lattice cells: where two surfaces are equally near, a
point's whole force would jump. It is taken ahead of the point, where u is exact, so that a point on
the surface keeps its force.

The stored distances are interpolated by `trilinear` between the 8 voxel centres around the point.
At each centre the least distance of all objects counts, and the interpolation comes after that. A
frame on rows and a frame on resident cells do the same arithmetic with the same 8 numbers, so they
agree bit for bit.
"""

import math
from typing import NamedTuple

import numpy as np

from hapticdb.kernels._jit import FLOAT, fields_of, inlined, leaf
from hapticdb.kernels.field.lattice import (
    CELL_SIDE,
    HALF_WIDTH,
    ROW_SIDE,
    STEPS,
    VOXELS_A_STEP,
    cell_place,
    row_place,
    trilinear,
)
from hapticdb.kernels.law import Leaves, define

ONSET = 1.5
"""delta, voxels: the distance at which a point begins to be felt.

Trilinear distances are exact to 0.016 voxels down to 0.7 (physics.md), so the force is smooth for
the first 0.8 voxels of depth. Larger: smoother deep forces, and contact earlier before the surface.
"""
BLENDING = 1.0
"""r, voxels: beyond the onset, the width in which a point's weight in the average falls to 0.

Larger: smoother forces at the edges of a tool, and more points that lower the average before they
push. `ONSET` + `BLENDING` must stay below `HALF_WIDTH`, where nothing is known any more.
"""
REACH = ONSET + BLENDING
"""Largest distance of a point that counts in the average, voxels."""
AHEAD = 0.4
"""Way along the normal over which the share's slope is taken, voxels; below 1/2, so that a row has
all centres that it needs.

Larger: errors of u matter less. Smaller: points close to the surface keep their force longer.
"""
FULL_SLOPE = 0.25
"""Slope of u along the normal from which on a point counts fully; 1 where a face meets a face.

Larger: points whose normals are askew push less. Smaller: the share changes faster with the pose.
"""
LARGEST_ERROR = 0.5 * VOXELS_A_STEP
"""Largest rounding error of a stored distance, voxels."""
FELT_WITHIN = min(
    HALF_WIDTH + math.sqrt(3.0),
    HALF_WIDTH + 3.0 / (16.0 * (HALF_WIDTH - LARGEST_ERROR - REACH)),
)
"""A point that is this far from every surface, in voxels, has u > `REACH`: it feels nothing.

Proof. Let D be the true distance at the point, t_i the squared distance of centre i from the point,
w_i its trilinear weight, h = `HALF_WIDTH` and e = `LARGEST_ERROR`. A distance is 1-Lipschitz, so
the stored value at centre i is at least min(D - sqrt(t_i), h) - e. For D > h and g = D - h this is
at least h - t_i / (4 g) - e, because g + t / (4 g) >= sqrt(t). On each axis the squares of the
distances, weighted, add up to f (1 - f) <= 1/4, so sum w_i t_i <= 3/4. Hence u >= h - 3 / (16 g) -
e, which is above the reach for g > 3 / (16 (h - e - reach)). For D > h + sqrt(3) all 8 centres are
beyond h, and u = h.
"""

I1, J1, K1 = np.uint64(ROW_SIDE * ROW_SIDE), np.uint64(ROW_SIDE), np.uint64(1)
"""Ways in a row's distances from a centre to the next one on each axis."""


class DistanceFieldLaw(NamedTuple):
    """Distance law. stiffness: K, N/m."""

    stiffness: float


DISTANCE_FIELD = fields_of(DistanceFieldLaw, FLOAT)


def _least_of_rows(law, payload, counts, first, end, x, y, z):  # noqa: ARG001
    """U at a point, in voxels from the grid's origin, from rows first .. end - 1 of its brick.

    payload (R, 1000) uint8; rows that do not count are left out; h without a row.
    """
    return _least_of_brick(
        payload, counts, first, end, x, y, z, np.int64(x) & -8, np.int64(y) & -8, np.int64(z) & -8
    )


@inlined
def _least_of_brick(payload, counts, first, end, x, y, z, i, j, k):
    """U at a point in, or under 1/2 voxel beside, the brick whose first voxel is (i, j, k)."""
    x0, y0, z0 = np.floor(x - 0.5), np.floor(y - 0.5), np.floor(z - 0.5)
    # unsigned: an index that may be negative is tested at each of the 8 reads
    at = np.uint64(row_place(np.int64(x0) - i, np.int64(y0) - j, np.int64(z0) - k))
    q000 = q001 = q010 = q011 = q100 = q101 = q110 = q111 = np.int64(STEPS)
    for signed in range(first, end):
        if counts[signed]:
            row = np.uint64(signed)
            q000 = min(q000, np.int64(payload[row, at]))
            q001 = min(q001, np.int64(payload[row, at + K1]))
            q010 = min(q010, np.int64(payload[row, at + J1]))
            q011 = min(q011, np.int64(payload[row, at + J1 + K1]))
            q100 = min(q100, np.int64(payload[row, at + I1]))
            q101 = min(q101, np.int64(payload[row, at + I1 + K1]))
            q110 = min(q110, np.int64(payload[row, at + I1 + J1]))
            q111 = min(q111, np.int64(payload[row, at + I1 + J1 + K1]))
    return VOXELS_A_STEP * trilinear(
        q000, q001, q010, q011, q100, q101, q110, q111, x - 0.5 - x0, y - 0.5 - y0, z - 0.5 - z0
    )


def _least_of_slot(law, payload, slot, x, y, z):  # noqa: ARG001
    """U at a point of a slot's cell, in voxels from the grid's origin."""
    return _least_of_cell(
        payload, slot, x, y, z, np.int64(x) & -32, np.int64(y) & -32, np.int64(z) & -32
    )


@inlined
def _least_of_cell(payload, slot, x, y, z, i, j, k):
    """U at a point in, or under 1/2 voxel beside, the cell whose first voxel is (i, j, k)."""
    x0, y0, z0 = math.floor(x - 0.5), math.floor(y - 0.5), math.floor(z - 0.5)
    at = cell_place(np.int64(x0) - i, np.int64(y0) - j, np.int64(z0) - k)
    q000 = min(np.int64(payload[slot, at]), STEPS)
    q001 = min(np.int64(payload[slot, at + 1]), STEPS)
    q010 = min(np.int64(payload[slot, at + CELL_SIDE]), STEPS)
    q011 = min(np.int64(payload[slot, at + CELL_SIDE + 1]), STEPS)
    at += CELL_SIDE * CELL_SIDE
    q100 = min(np.int64(payload[slot, at]), STEPS)
    q101 = min(np.int64(payload[slot, at + 1]), STEPS)
    q110 = min(np.int64(payload[slot, at + CELL_SIDE]), STEPS)
    q111 = min(np.int64(payload[slot, at + CELL_SIDE + 1]), STEPS)
    return VOXELS_A_STEP * trilinear(
        q000, q001, q010, q011, q100, q101, q110, q111, x - 0.5 - x0, y - 0.5 - y0, z - 0.5 - z0
    )


@leaf
def depth_and_weight(sample, size):
    """Depth below the onset in metres, negative above it, and the weight in the average."""
    return size * (ONSET - sample), min(max((REACH - sample) / BLENDING, 0.0), 1.0)


def _below_onset(law, is_hit, sample, px, py, pz, nx, ny, nz, cx, cy, cz, size):  # noqa: ARG001
    """Depth below the onset in metres, negative above it, and the weight in the average."""
    return depth_and_weight(sample, size)


@leaf
def agreement(sample, ahead):
    """Share of a point with distance `sample` at the point and `ahead` a bit into the tool."""
    return min(max((ahead - sample) / (AHEAD * FULL_SLOPE), 0.0), 1.0)


def _share_of_rows(law, payload, counts, first, end, x, y, z, nx, ny, nz, sample):  # noqa: ARG001
    """How far the normal agrees with the distances of rows first .. end - 1, 0 to 1."""
    ahead = _least_of_brick(
        payload, counts, first, end, x + AHEAD * nx, y + AHEAD * ny, z + AHEAD * nz,
        np.int64(x) & -8, np.int64(y) & -8, np.int64(z) & -8,
    )  # fmt: skip
    return agreement(sample, ahead)


def _share_of_slot(law, payload, slot, x, y, z, nx, ny, nz, sample):  # noqa: ARG001
    """How far the normal agrees with the distances of a slot's cell, 0 to 1."""
    ahead = _least_of_cell(
        payload, slot, x + AHEAD * nx, y + AHEAD * ny, z + AHEAD * nz,
        np.int64(x) & -32, np.int64(y) & -32, np.int64(z) & -32,
    )  # fmt: skip
    return agreement(sample, ahead)


def _reach_of(law):  # noqa: ARG001
    """Distance up to which a point counts, voxels."""
    return REACH


def _felt_within_of(law):  # noqa: ARG001
    """Distance from all voxels from which on nothing is felt: no surface lies nearer than these."""
    return FELT_WITHIN


define(
    DistanceFieldLaw,
    Leaves(
        respond=_below_onset,
        reach=_reach_of,
        felt_within=_felt_within_of,
        sample_rows=_least_of_rows,
        sample_slot=_least_of_slot,
        share_rows=_share_of_rows,
        share_slot=_share_of_slot,
    ),
)

"""Distance law: penalty forces on the unsigned distance field.

With u the distance at a point, d = g s max(0, `ONSET` - u) and F = K sum d n, for the voxel size s
and the point's inward normal n. Each point counts g clamp((ONSET + BLENDING - u) / BLENDING, 0, 1)
in the frame's average, so that force is continuous when a point comes near.

The share g = clamp((u(p + `AHEAD` n) - u(p)) / (AHEAD `FULL_SLOPE`), 0, 1) measures the agreement
of the normal with the field: u must grow into the tool. Without it the two sides of a thin wall,
with opposite normals and almost the same u, would cancel. g is 1 for a face of the tool on a face
of the environment. The slope is a difference of two values of u instead of the interpolant's
gradient, because that gradient jumps between lattice cells: at equal distances to two surfaces, a
point's whole force would jump. It is evaluated ahead of the point, in the range of exact u, so that
a point on the surface retains its force.

`trilinear` interpolates the stored distances at the 8 voxel centres around the point. At each
centre the least distance of all objects counts, before the interpolation. A frame on rows and a
frame on resident cells do the same arithmetic with the same 8 numbers, so they agree bit for bit.
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
from hapticdb.kernels.force_law import Leaves, define

ONSET = 1.5
"""delta, voxels: greatest distance of a point with a force.

Trilinear distances are exact to 0.016 voxels down to 0.7, so the force is smooth for
the first 0.8 voxels of depth. Larger: smoother deep forces, and contact earlier before the surface.
"""
BLENDING = 1.0
"""r, voxels: range beyond the onset in which a point's weight in the average falls to 0.

Larger: smoother forces at the edges of a tool, and more points without force in the average.
`ONSET` + `BLENDING` must stay below `HALF_WIDTH`, the end of the band.
"""
REACH = ONSET + BLENDING
"""Greatest distance of a point with a weight in the average, voxels."""
AHEAD = 0.4
"""Distance along the normal for the share's slope, voxels; below 1/2, the margin of a row.

Larger: errors of u matter less. Smaller: points close to the surface retain their force longer.
"""
FULL_SLOPE = 0.25
"""Least slope of u along the normal for a share of 1; the slope is 1 between two flat faces.

Larger: less force from points with askew normals. Smaller: the share changes faster with the pose.
"""
LARGEST_ERROR = 0.5 * VOXELS_A_STEP
"""Greatest rounding error of a stored distance, voxels."""
FORCE_RANGE = min(
    HALF_WIDTH + math.sqrt(3.0),
    HALF_WIDTH + 3.0 / (16.0 * (HALF_WIDTH - LARGEST_ERROR - REACH)),
)
"""Distance from every surface, in voxels, beyond which a point has u > `REACH` and no force.

Proof. Let D be the true distance at the point, t_i the squared distance of centre i from the point,
w_i its trilinear weight, h = `HALF_WIDTH` and e = `LARGEST_ERROR`. A distance is 1-Lipschitz, so
the stored value at centre i is at least min(D - sqrt(t_i), h) - e. For D > h and g = D - h this is
at least h - t_i / (4 g) - e, because g + t / (4 g) >= sqrt(t). On each axis the squares of the
distances, weighted, add up to f (1 - f) <= 1/4, so sum w_i t_i <= 3/4. Hence u >= h - 3 / (16 g) -
e, above the reach for g > 3 / (16 (h - e - reach)). For D > h + sqrt(3) all 8 centres are beyond h,
and u = h.
"""

I1, J1, K1 = np.uint64(ROW_SIDE * ROW_SIDE), np.uint64(ROW_SIDE), np.uint64(1)
"""Index offsets in a row from a centre to the next one on each axis."""


class DistanceFieldLaw(NamedTuple):
    """Distance law. stiffness: K, N/m."""

    stiffness: float


DISTANCE_FIELD = fields_of(DistanceFieldLaw, FLOAT)


def _least_of_rows(law, payload, counts, first, end, x, y, z):  # noqa: ARG001
    """U at a point, in voxels from the grid's origin, from rows first .. end - 1 of its brick.

    payload (R, 1000) uint8; counts (R,) selects rows; h without a row.
    """
    return _least_of_brick(
        payload, counts, first, end, x, y, z, np.int64(x) & -8, np.int64(y) & -8, np.int64(z) & -8
    )


@inlined
def _least_of_brick(payload, counts, first, end, x, y, z, i, j, k):
    """U at a point in the brick with first voxel (i, j, k), or under 1/2 voxel outside it."""
    x0, y0, z0 = np.floor(x - 0.5), np.floor(y - 0.5), np.floor(z - 0.5)
    # unsigned: a signed index is tested for a negative value at each of the 8 reads
    at = np.uint64(row_place(np.int64(x0) - i, np.int64(y0) - j, np.int64(z0) - k))
    # minimum at each centre before the interpolation, as cells store it
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
    """U at a point in the cell with first voxel (i, j, k), or under 1/2 voxel outside it."""
    x0, y0, z0 = math.floor(x - 0.5), math.floor(y - 0.5), math.floor(z - 0.5)
    at = cell_place(np.int64(x0) - i, np.int64(y0) - j, np.int64(z0) - k)
    # BEYOND counts as h, as in the rows
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
    """Depth below the onset, metres, negative above it, and weight in the average, 0 to 1."""
    return size * (ONSET - sample), min(max((REACH - sample) / BLENDING, 0.0), 1.0)


def _below_onset(law, is_hit, sample, px, py, pz, nx, ny, nz, cx, cy, cz, size):  # noqa: ARG001
    """Depth and weight of a point, as of `depth_and_weight`."""
    return depth_and_weight(sample, size)


@leaf
def agreement(sample, ahead):
    """Share g, by the distances `sample` at the point and `ahead` at `AHEAD` along the normal."""
    return min(max((ahead - sample) / (AHEAD * FULL_SLOPE), 0.0), 1.0)


def _share_of_rows(law, payload, counts, first, end, x, y, z, nx, ny, nz, sample):  # noqa: ARG001
    """Share g, 0 to 1, by the distances of rows first .. end - 1."""
    ahead = _least_of_brick(
        payload, counts, first, end, x + AHEAD * nx, y + AHEAD * ny, z + AHEAD * nz,
        # brick of the point itself: its row has a layer for the place ahead
        np.int64(x) & -8, np.int64(y) & -8, np.int64(z) & -8,
    )  # fmt: skip
    return agreement(sample, ahead)


def _share_of_slot(law, payload, slot, x, y, z, nx, ny, nz, sample):  # noqa: ARG001
    """Share g, 0 to 1, by the distances of a slot's cell."""
    ahead = _least_of_cell(
        payload, slot, x + AHEAD * nx, y + AHEAD * ny, z + AHEAD * nz,
        # cell of the point itself, as in `_share_of_rows`
        np.int64(x) & -32, np.int64(y) & -32, np.int64(z) & -32,
    )  # fmt: skip
    return agreement(sample, ahead)


def _reach_of(law):  # noqa: ARG001
    """Greatest distance of a point with a weight, voxels."""
    return REACH


def _force_range_of(law):  # noqa: ARG001
    """Distance from all voxels, hence from all surfaces, without a force; voxels."""
    return FORCE_RANGE


define(
    DistanceFieldLaw,
    Leaves(
        respond=_below_onset,
        reach=_reach_of,
        force_range=_force_range_of,
        sample_rows=_least_of_rows,
        sample_slot=_least_of_slot,
        share_rows=_share_of_rows,
        share_slot=_share_of_slot,
    ),
)

"""Proof that pieces of a moving surface keep away from the environment, pose after pose.

A piece is a ball around a point of the tool's surface. A pose stands for a part of the path, on
which no place of the tool is farther than `off` from its place at the pose. So a piece meets no
surface there if its point is farther from all surfaces than its radius and `off`.

The lower bound of that distance is the larger of two: to the nearest occupied voxel's box, in which
every surface lies, and, in a table with distances, `spline.lower_bound`. The search stops at the
first cell that is not resident and returns where it stopped.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import (
    BYTES,
    FLOAT,
    FLOATS,
    FLOATS2,
    FLOATS3,
    INT,
    INTS,
    entry,
    fields_of,
    leaf,
)
from hapticdb.kernels.field.spline import lower_bound, upper_bound
from hapticdb.kernels.resident.cells import (
    CELLS,
    CELLS_WITH_DISTANCES,
    PLACE,
    begin_frame,
    cell_key,
    end_frame,
    slot_of,
)
from hapticdb.kernels.resident.clearance import nearest_to
from hapticdb.kernels.resident.sweep import CAUTION, unpacked
from hapticdb.kernels.rigid import moved, transform_of


class Pieces(NamedTuple):
    """P pieces of the tool, and what is known of them; lengths of bounds in voxels.

    points (P, 3): metres, tool frame; radii (P,); expiry (P,): the earliest travel at which a point
    can reach a surface, if it went straight there; nearest (P,) int64: the voxel, packed, that was
    nearest last, or -1; is_tight (P,) uint8: whether a pose does not prove the piece clear; state
    (3,): indices `SOONEST`, `LEAST`, `WITHIN`; where (4,) int64: indices `STOPPED` to `LOOKED`.
    """

    points: NDArray[np.float64]
    radii: NDArray[np.float64]
    expiry: NDArray[np.float64]
    nearest: NDArray[np.int64]
    is_tight: NDArray[np.uint8]
    state: NDArray[np.float64]
    where: NDArray[np.int64]


PIECES = fields_of(Pieces, FLOATS2, FLOATS, FLOATS, INTS, BYTES, FLOATS, INTS)

SOONEST, LEAST, WITHIN = 0, 1, 2
"""Indices into `Pieces.state`: the least expiry less radius of all pieces; the least proved gap
between a piece and a surface where it is not tight; the least upper bound of the distance between a
point and a surface."""
STOPPED, POSE, POINT, LOOKED = 0, 1, 2, 3
"""Indices into `Pieces.where`: the point at which the search stopped; pose and point of `WITHIN`;
the number of poses at which any point was looked at."""


@leaf
def _farthest_in(x, y, z, voxel):
    """Distance from (x, y, z) to the farthest corner of a packed voxel's box, all in voxels."""
    i, j, k = unpacked(voxel)
    dx, dy, dz = max(x - i, i + 1.0 - x), max(y - j, j + 1.0 - y), max(z - k, k + 1.0 - z)
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@leaf
def _stored_bounds(payload, slot, x, y, z):
    """Bounds, voxels, of the distance to a surface by the stored distances, if there are any."""
    if payload is None:
        return 0.0, np.inf
    return lower_bound(payload, slot, x, y, z), upper_bound(payload, slot, x, y, z)


@entry(
    CELLS, INT, PIECES, FLOATS3, FLOATS, FLOATS, PLACE, FLOAT, FLOAT, INT, BYTES,
    also={CELLS: CELLS_WITH_DISTANCES},
)  # fmt: skip
def prove(cells, reader, pieces, poses, travels, offs, place, slack, wanted, first, is_tight):
    """Bound the distances of pieces at poses[first:] from all surfaces, into `pieces`.

    travels (B,), ascending: bound on any point's way from the path's start to each pose, to which
    `slack` is added once; offs (B,): the part of the path that each pose stands for; wanted: gap
    below which a piece is tight at a pose; is_tight (B,) uint8: set for a pose with a tight piece.
    All in voxels. Returns the number of poses done, fewer than B when a cell was not resident.
    """
    _, _, keys, slots, words, masks, used, payload, _ = cells
    points, radii, expiry, nearest, tight, state, where = pieces
    ox, oy, oz, size, side = place.x, place.y, place.z, place.size, place.side
    which = begin_frame(cells, reader)
    for n in range(first, poses.shape[0]):
        spent = travels[n] + offs[n]
        if state[SOONEST] - spent >= state[LEAST]:
            continue
        transform = transform_of(poses[n])
        soonest = np.inf
        for p in range(points.shape[0]):
            radius = radii[p]
            if expiry[p] - radius - spent < state[LEAST]:
                x, y, z = moved(transform, points[p, 0], points[p, 1], points[p, 2])
                x, y, z = (x - ox) / size, (y - oy) / size, (z - oz) / size
                cap = radius + offs[n] + state[LEAST]
                square, voxel = nearest_to(
                    keys, slots, words, masks, used, which, x, y, z, cap, nearest[p], side
                )
                slot = np.int64(0)
                is_inside = 0.0 <= x < side and 0.0 <= y < side and 0.0 <= z < side
                if is_inside:
                    slot = slot_of(
                        keys, slots, which, cell_key(np.int64(x), np.int64(y), np.int64(z))
                    )
                if voxel == -2 or slot < 0:
                    where[STOPPED] = p
                    end_frame(cells, reader)
                    return n
                nearest[p] = voxel
                distance = math.sqrt(square)
                within = _farthest_in(x, y, z, voxel) if voxel >= 0 else np.inf
                if is_inside:
                    low, high = _stored_bounds(payload, slot, x, y, z)
                    distance, within = max(distance, low), min(within, high)
                if within < state[WITHIN]:
                    state[WITHIN] = within
                    where[POSE] = n
                    where[POINT] = p
                distance -= CAUTION
                expiry[p] = max(expiry[p], travels[n] + distance - slack)
                gap = distance - radius - offs[n]
                if gap < wanted:
                    tight[p] = 1
                    is_tight[n] = 1
                else:
                    state[LEAST] = min(state[LEAST], gap)
            soonest = min(soonest, expiry[p] - radius)
        state[SOONEST] = soonest
        where[LOOKED] += 1
    end_frame(cells, reader)
    return poses.shape[0]

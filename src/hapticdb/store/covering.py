"""Key ranges covering an object or a box."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.grid import Grid
from hapticdb.kernels.query import key_ranges
from hapticdb.store.base import Keys, Layout, Object, row_shift

BOX_CUBES = 16
"""Cubes along a box's longest edge. More: more ranges, with fewer keys outside the box."""
BAND_MARGIN = 5
"""Margin around an object's bounds for its rows of distances, voxels: half width of the band, one
for the centres beside a brick, and rounding."""


class Ranges(NamedTuple):
    """Closed ranges of row keys, ascending and disjoint: lows (G,), highs (G,) int64."""

    lows: Keys
    highs: Keys


EVERYWHERE = Ranges(np.zeros(1, np.int64), np.full(1, np.iinfo(np.int64).max))
"""All row keys."""


def object_ranges(grid: Grid, layout: Layout, obj: Object) -> Ranges:
    """Key ranges over an object's bounds, a voxel wider; `BAND_MARGIN` with distances."""
    low, high = grid.voxels_of(obj.bounds)
    margin = BAND_MARGIN if obj.has_distances else 1
    return box_ranges(grid, layout, low - margin, high + margin)


def box_ranges(
    grid: Grid, layout: Layout, low: NDArray[np.int64], high: NDArray[np.int64]
) -> Ranges:
    """Key ranges covering the voxels low (3,) to high (3,), clipped to the grid."""
    low = np.clip(low, 0, grid.side - 1)
    high = np.clip(high, 0, grid.side - 1)
    longest = int((high - low).max()) + 1
    # bits of the finest cubes: about 16 of them along the box, none finer than a brick
    finest = max((longest // BOX_CUBES).bit_length(), 3)
    found = key_ranges.ranges_of_box(low, high, grid.bits, grid.curve_code, min(finest, grid.bits))
    found >>= row_shift(layout)
    # voxel ranges may meet in one row of bricks: merged, so that no row is read twice
    starts = np.flatnonzero(np.append(True, found[1:, 0] > found[:-1, 1] + 1))
    ends = np.append(starts[1:], len(found)) - 1
    return Ranges(found[starts, 0].copy(), found[ends, 1].copy())

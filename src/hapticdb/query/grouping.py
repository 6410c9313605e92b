"""Grouping a frame's sorted keys into ranges: points, MaxGap, CBGroup (the paper, section 5)."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import UsageError
from hapticdb.grid import Grid
from hapticdb.kernels.query import grouping as kernels
from hapticdb.query.cost_model import CostModel
from hapticdb.query.quantiles import QuantileVector
from hapticdb.store.base import Covering, Keys, Layout, Object, Store, row_shift

DEFAULT_MAXGAP = 500
"""The paper's MAXGAP, in voxel keys. A larger value gives fewer ranges, which hold more rows."""
BOX_CUBES = 16
"""Cubes along a box's longest edge when it is covered by key ranges. A larger value gives more
ranges, which hold fewer keys outside the box."""


BAND_MARGIN = 5
"""Voxels around an object's bounds in which its rows of distances lie: the half width of the band,
a voxel more since a row also has the centres beside its brick, and rounding."""


class Ranges(NamedTuple):
    """Closed ranges of row keys, ascending and disjoint: lows (G,), highs (G,) int64."""

    lows: Keys
    highs: Keys


def maxgap(keys: Keys, first: Keys, last: Keys, gap: int) -> Ranges:
    """Group neighbouring keys p < q if and only if q - p <= gap, in voxel keys on both layouts.

    Parameters
    ----------
    keys : (U,) int64
        Distinct row keys, ascending.
    first, last : (U,) int64
        Lowest and highest voxel key asked for under each row key.
    gap : int
        MAXGAP; 0 is the point query sequence.
    """
    if gap < 0:
        raise UsageError(f"MAXGAP {gap}: give 0 or more")
    # Keys have at most 63 bits, and so have the gaps between them.
    return Ranges(*kernels.group_by_gap(keys, first, last, min(int(gap), 2**63 - 1)))


def cbgroup(keys: Keys, quantiles: QuantileVector, costs: CostModel) -> Ranges:
    """Close a gap if and only if scanning it costs no more than another descent of the index.

    The gap between keys p < q covers p+1 .. q-1. The costs of gaps add up, so deciding each gap by
    itself gives the least cost over all groupings.
    """
    return group_spans(keys, keys, quantiles, costs)


def group_spans(lows: Keys, highs: Keys, quantiles: QuantileVector, costs: CostModel) -> Ranges:
    """CBGroup over closed spans of row keys (U,), ascending and disjoint, such as spans of cells.

    The gap between two spans is closed on the same condition as between two keys.
    """
    lows, highs = lows.copy(), highs.copy()
    count = kernels.group_by_cost(
        lows, highs, quantiles.bounds, quantiles.rows_per_bucket, costs.row_in_gap, costs.descent
    )
    return Ranges(lows[:count], highs[:count])


def object_ranges(grid: Grid, layout: Layout, obj: Object) -> Ranges:
    """Ranges of row keys that cover an object's bounds, enlarged by a voxel on each side.

    If the object has distances, the ranges also cover the bricks around it that hold distances.
    """
    low, high = grid.voxels_of(obj.bounds)
    margin = BAND_MARGIN if obj.has_distances else 1
    return box_ranges(grid, layout, low - margin, high + margin)


def covering(store: Store) -> Covering:
    """Argument `covering` of a write: `object_ranges` of a store's objects."""

    def ranges(obj: Object) -> Iterator[tuple[int, int]]:
        lows, highs = object_ranges(store.grid, store.layout, obj)
        return zip(lows.tolist(), highs.tolist(), strict=True)

    return ranges


def box_ranges(
    grid: Grid, layout: Layout, low: NDArray[np.int64], high: NDArray[np.int64]
) -> Ranges:
    """Ranges of row keys that cover the voxels low (3,) to high (3,), cut to the grid."""
    low = np.clip(low, 0, grid.side - 1)
    high = np.clip(high, 0, grid.side - 1)
    longest = int((high - low).max()) + 1
    finest = max((longest // BOX_CUBES).bit_length(), 3)
    found = kernels.ranges_of_box(low, high, grid.bits, grid.curve_code, min(finest, grid.bits))
    found >>= row_shift(layout)
    starts = np.flatnonzero(np.append(True, found[1:, 0] > found[:-1, 1] + 1))
    ends = np.append(starts[1:], len(found)) - 1
    return Ranges(found[starts, 0].copy(), found[ends, 1].copy())

"""Grouping a frame's sorted keys into ranges: MaxGap and CBGroup (the paper, section 5)."""

from hapticdb.kernels.query import grouping as kernels
from hapticdb.paper.cost_model import CostModel
from hapticdb.paper.quantiles import QuantileVector
from hapticdb.store.base import Keys
from hapticdb.store.covering import Ranges

DEFAULT_MAXGAP = 500
"""The paper's MAXGAP, in voxel keys. A larger value gives fewer ranges, which hold more rows."""


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
    # Keys have at most 63 bits, and so have the gaps between them.
    return Ranges(*kernels.group_by_gap(keys, first, last, min(int(gap), 2**63 - 1)))


def cbgroup(lows: Keys, highs: Keys, quantiles: QuantileVector, costs: CostModel) -> Ranges:
    """Close a gap if and only if scanning it costs no more than another descent of the index.

    The gap between keys p < q covers p+1 .. q-1. The costs of gaps add up, so deciding each gap by
    itself gives the least cost over all groupings.

    Parameters
    ----------
    lows, highs : (U,) int64
        Closed spans of row keys, ascending and disjoint: single keys, or spans of cells.
    """
    lows, highs = lows.copy(), highs.copy()
    count = kernels.group_by_cost(
        lows, highs, quantiles.bounds, quantiles.rows_per_bucket, costs.row_in_gap, costs.descent
    )
    return Ranges(lows[:count], highs[:count])

"""Grouping a frame's sorted keys into ranges: MaxGap and CBGroup (the paper, section 5)."""

from hapticdb.kernels.query import key_ranges as kernels
from hapticdb.paper.cost_model import CostModel
from hapticdb.paper.quantiles import QuantileVector
from hapticdb.store.base import Keys
from hapticdb.store.covering import Ranges

DEFAULT_MAXGAP = 500
"""The paper's MAXGAP, in voxel keys. Larger: fewer ranges, with more rows."""


def maxgap(keys: Keys, first: Keys, last: Keys, gap: int) -> Ranges:
    """Group neighbouring keys p < q if and only if q - p <= gap, in voxel keys on both layouts.

    keys (U,) int64 : distinct row keys, ascending; first, last (U,) int64 : lowest and highest
    requested voxel key under each row key; gap : MAXGAP; 0 is the point query sequence.
    """
    # Keys have at most 63 bits, and so have the gaps between them.
    return Ranges(*kernels.group_by_gap(keys, first, last, min(int(gap), 2**63 - 1)))


def cbgroup(lows: Keys, highs: Keys, quantiles: QuantileVector, costs: CostModel) -> Ranges:
    """Close a gap if and only if scanning it costs no more than another descent of the index.

    The costs of the gaps add up, so each can be decided by itself.

    lows, highs (U,) int64 : closed spans of row keys, ascending and disjoint.
    """
    lows, highs = lows.copy(), highs.copy()
    count = kernels.group_by_cost(
        lows, highs, quantiles.bounds, quantiles.rows_per_bucket, costs.row_in_gap, costs.descent
    )
    return Ranges(lows[:count], highs[:count])

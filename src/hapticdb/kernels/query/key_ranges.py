"""Grouping of sorted keys into ranges (the paper, section 5), and ranges over a box."""

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import FLOAT, INT, INTS, entry, leaf
from hapticdb.kernels.curves import LEXICOGRAPHIC, encode

Ints = NDArray[np.int64]


@leaf
def first_bound(x, bounds, start):
    """Index of the first bound >= x, from index `start` on; R + 1 if there is none.

    Galloping search: a frame's keys lie close together, so the next bound is mostly the same as
    the last one.
    """
    total = bounds.shape[0]
    step = 1
    low = start
    high = start
    while high < total and bounds[high] < x:
        low = high + 1
        high += step
        step *= 2
    high = min(high, total)
    while low < high:
        middle = (low + high) >> 1
        if bounds[middle] < x:
            low = middle + 1
        else:
            high = middle
    return low


@leaf
def _rows_below_bound(x, low, bounds, rows_per_bucket):
    """Expected rows with a key < x, given the first bound >= x.

    A bucket [b[i-1], b[i]) counts in proportion to its part below x. A bucket of zero width counts
    fully if its value is below x.
    """
    if low == 0:
        return 0.0
    if low == bounds.shape[0]:
        return (low - 1) * rows_per_bucket
    left = bounds[low - 1]
    return (low - 1 + (x - left) / (bounds[low] - left)) * rows_per_bucket


@leaf
def _rows_between(left, right, bounds, rows_per_bucket, start):
    """Expected rows with a key in [left, right]; no bound below index `start` is >= left."""
    if right < left:
        return 0.0
    at, after = first_bound(left, bounds, start), bounds.shape[0]
    if right < bounds[after - 1]:  # else no key is above it, and it may be the largest int64
        # half-open [left, right + 1): `_rows_below_bound` counts keys below a bound
        right += 1
        after = first_bound(right, bounds, at)
    up_to = _rows_below_bound(right, after, bounds, rows_per_bucket)
    return up_to - _rows_below_bound(left, at, bounds, rows_per_bucket)


@entry(INT, INT, INTS, FLOAT)
def gap_rows(left, right, bounds, rows_per_bucket):
    """Expected rows with a key in [left, right]. bounds (R + 1,) int64, ascending -> float."""
    return _rows_between(left, right, bounds, rows_per_bucket, np.int64(0))


@entry(INTS, INTS, INTS, INT)
def group_by_gap(keys, first, last, maxgap):
    """MaxGap: neighbouring keys p < q share a range if and only if q - p <= maxgap.

    keys (U,) row keys, ascending; first, last (U,) the lowest and highest requested voxel key of
    each. Returns the ranges' lowest and highest row keys.
    """
    total = keys.shape[0]
    lows = np.empty(total, dtype=np.int64)
    highs = np.empty(total, dtype=np.int64)
    count = 0
    for n in range(total):
        # gap between requested voxels, in voxel keys also for rows of bricks
        if n > 0 and first[n] - last[n - 1] <= maxgap:
            highs[count - 1] = keys[n]
            continue
        lows[count] = keys[n]
        highs[count] = keys[n]
        count += 1
    return lows[:count], highs[:count]


@entry(INTS, INTS, INTS, FLOAT, FLOAT, FLOAT)
def group_by_cost(lows, highs, bounds, rows_per_bucket, row_cost, descent_cost):
    """CBGroup: a gap is closed if and only if scanning it costs no more than another descent.

    lows, highs (U,) int64: closed spans of row keys, ascending and disjoint, merged in place;
    bounds (R + 1,) int64, the quantile vector; both costs in the same unit. Returns the
    number of ranges.
    """
    count = at = np.int64(0)
    for n in range(lows.shape[0]):
        if count > 0:
            first = highs[count - 1] + 1
            # ascending gaps: each search starts at the last one's bound
            at = first_bound(first, bounds, at)
            expected = _rows_between(first, lows[n] - 1, bounds, rows_per_bucket, at)
            if expected * row_cost <= descent_cost:
                highs[count - 1] = highs[n]
                continue
        lows[count] = lows[n]
        highs[count] = highs[n]
        count += 1
    return count


def ranges_of_box(low: Ints, high: Ints, bits: int, curve: int, finest: int) -> Ints:
    """Closed ranges of voxel keys (G, 2) covering the voxels low .. high (3,), both included.

    On a hierarchical curve each range is a cube with an edge of 2^finest voxels. In lexicographic
    order it is a run of slabs, at most 1024. Ascending, and not merged.
    """
    if curve == LEXICOGRAPHIC:
        starts = np.arange(low[0], high[0] + 1, (high[0] - low[0]) // 1024 + 1)
        ends = np.append(starts[1:] - 1, high[0])
        corners = (np.broadcast_arrays(starts, *low[1:]), np.broadcast_arrays(ends, *high[1:]))
        return np.stack([encode(np.stack(at, axis=1), bits, curve) for at in corners], axis=1)
    axes = [np.arange(*ends) for ends in zip(low >> finest, (high >> finest) + 1, strict=True)]
    cubes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    keys = np.sort(encode(cubes, bits - finest, curve))
    return np.stack([keys << 3 * finest, ((keys + 1) << 3 * finest) - 1], axis=1)

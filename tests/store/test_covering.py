"""Key ranges that cover a box."""

from itertools import pairwise, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hapticdb import Grid
from hapticdb.grid import CurveName
from hapticdb.store.base import Layout, row_shift
from hapticdb.store.covering import box_ranges
from voxels import KINDS

triples = st.lists(st.integers(-3, 34), min_size=3, max_size=3)


@pytest.mark.parametrize(("layout", "curve"), KINDS)
@settings(max_examples=40, deadline=None)
@given(a=triples, b=triples)
def test_box_ranges_contain_all_rows_of_box(
    layout: Layout, curve: CurveName, a: list[int], b: list[int]
) -> None:
    """Ranges ascend, are disjoint, merged where they touch, and cut to the grid."""
    grid = Grid(1.0, (0, 0, 0), 5, curve)
    low, high = np.minimum(a, b).astype(np.int64), np.maximum(a, b).astype(np.int64)
    found = box_ranges(grid, layout, low, high)
    pairs = list(zip(found.lows.tolist(), found.highs.tolist(), strict=True))
    axes = [range(max(lo, 0), min(hi, 31) + 1) for lo, hi in zip(low, high, strict=True)]
    voxels = np.array(list(product(*axes)), dtype=np.int64)
    held = {key for first, last in pairs for key in range(first, last + 1)}
    assert set((grid.encode(voxels) >> row_shift(layout)).tolist()) <= held
    assert all(first <= last for first, last in pairs)
    assert all(before + 1 < after for (_, before), (after, _) in pairwise(pairs))
    assert min(held) >= 0
    assert max(held) < 8**5 >> row_shift(layout)


@pytest.mark.parametrize("curve", ["z", "hilbert"])
@settings(max_examples=30, deadline=None)
@given(
    ends=st.lists(
        st.lists(st.integers(0, 2**21 - 1), min_size=3, max_size=3), min_size=2, max_size=2
    )
)
def test_box_ranges_count_bounded(curve: CurveName, ends: list[list[int]]) -> None:
    """17 cubes lie along the longest edge at most; the outer two layers are not merged."""
    grid = Grid(1.0, (0, 0, 0), 21, curve)
    low, high = np.min(ends, axis=0), np.max(ends, axis=0)
    ranges = box_ranges(grid, "brick", low, high)
    assert 1 <= len(ranges.lows) <= 17**3 - 13**3
    corners = grid.encode(np.array(list(product(*zip(low, high, strict=True))))) >> 9
    at = np.searchsorted(ranges.lows, corners, side="right") - 1
    assert (ranges.highs[at] >= corners).all()

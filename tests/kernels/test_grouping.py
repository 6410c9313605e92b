"""Expected rows and key ranges, compared with plain definitions by brute force on small grids."""

from fractions import Fraction
from itertools import pairwise, product

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hapticdb.kernels.curves import HILBERT, LEXICOGRAPHIC, Z_ORDER, encode
from hapticdb.kernels.query.key_ranges import gap_rows, group_by_cost, group_by_gap, ranges_of_box

JIT = not numba.config.DISABLE_JIT
few = settings(max_examples=300 if JIT else 60, deadline=None)
LAST_KEY = 2**63 - 1
BITS = 4
SIDE = 1 << BITS

# few values, so that bounds coincide and ends fall on bounds; and the whole width of a key
small = st.integers(0, 40)
large = st.integers(0, LAST_KEY)


def bounds_of(values: st.SearchStrategy[int]) -> st.SearchStrategy[list[int]]:
    return st.lists(values, min_size=2, max_size=12).map(sorted)


def expected_rows(left: int, right: int, bounds: list[int], per_bucket: Fraction) -> Fraction:
    """Exact sum over the buckets of overlap with [left, right + 1) divided by width.

    A bucket of zero width counts fully if its value lies in the range.
    """
    total = Fraction(0)
    for low, high in pairwise(bounds):
        if low == high:
            total += left <= low <= right
        else:
            overlap = min(high, right + 1) - max(low, left)
            total += Fraction(max(overlap, 0), high - low)
    return total * per_bucket


def as_keys(values: list[int]) -> NDArray[np.int64]:
    return np.array(values, dtype=np.int64)


@few
@given(
    bounds=st.one_of(bounds_of(small), bounds_of(large)),
    ends=st.one_of(st.tuples(small, small), st.tuples(large, large)),
    eighths=st.integers(1, 80),
)
def test_gap_rows_equal_plain_definition(
    bounds: list[int], ends: tuple[int, int], eighths: int
) -> None:
    left, right = sorted(ends)
    wanted = expected_rows(left, right, bounds, Fraction(eighths, 8))
    found = gap_rows(left, right, as_keys(bounds), eighths / 8)
    # the result is a difference of two sums, each up to the number of all rows
    assert found == pytest.approx(float(wanted), rel=1e-12, abs=1e-13 * eighths * len(bounds))


def test_gap_rows_last_key_of_largest_grid() -> None:
    bounds = as_keys([0, LAST_KEY - 4, LAST_KEY])
    assert gap_rows(LAST_KEY - 1, LAST_KEY, bounds, 8.0) == pytest.approx(2.0)
    assert gap_rows(0, LAST_KEY, bounds, 8.0) == 16.0
    assert gap_rows(LAST_KEY, LAST_KEY, bounds, 8.0) == 0.0


def test_group_by_gap_no_keys() -> None:
    none = np.empty(0, dtype=np.int64)
    lows, highs = group_by_gap(none, none, none, 500)
    assert len(lows) == len(highs) == 0
    assert group_by_cost(none.copy(), none.copy(), as_keys([0, 9]), 1.0, 1.0, 1.0) == 0


# --- boxes --------------------------------------------------------------------------------------

corners = st.lists(st.integers(0, SIDE - 1), min_size=3, max_size=3)


def cubes_met(low: NDArray[np.int64], high: NDArray[np.int64], finest: int) -> int:
    """Number of aligned cubes with an edge of 2^finest voxels that a box meets."""
    return int(np.prod((high >> finest) - (low >> finest) + 1))


def voxels_between(low: NDArray[np.int64], high: NDArray[np.int64]) -> NDArray[np.int64]:
    axes = [range(a, b + 1) for a, b in zip(low.tolist(), high.tolist(), strict=True)]
    return np.array(list(product(*axes)), dtype=np.int64)


def covered(ranges: NDArray[np.int64]) -> list[int]:
    """All keys of the ranges, ascending; a key in several ranges is repeated."""
    return sorted(key for low, high in ranges.tolist() for key in range(low, high + 1))


@pytest.mark.parametrize("curve", [Z_ORDER, HILBERT], ids=["z", "hilbert"])
@few
@given(a=corners, b=corners, finest=st.integers(0, BITS))
def test_ranges_of_box_cover_its_cubes(curve: int, a: list[int], b: list[int], finest: int) -> None:
    """Each key is covered once. Cubes of one voxel cover the box exactly."""
    low, high = np.minimum(a, b).astype(np.int64), np.maximum(a, b).astype(np.int64)
    ranges = ranges_of_box(low, high, BITS, curve, finest)
    keys = covered(ranges)
    box = encode(voxels_between(low, high), BITS, curve).tolist()
    assert len(set(keys)) == len(keys)
    assert set(box) <= set(keys)
    rounded = low >> finest << finest, ((high >> finest) + 1 << finest) - 1
    assert set(keys) <= set(encode(voxels_between(*rounded), BITS, curve).tolist())
    if finest == 0:
        assert keys == sorted(box)
    assert len(ranges) <= cubes_met(low, high, finest)


@few
@given(a=corners, b=corners)
def test_ranges_of_box_lexicographic_slabs(a: list[int], b: list[int]) -> None:
    low, high = np.minimum(a, b).astype(np.int64), np.maximum(a, b).astype(np.int64)
    ranges = ranges_of_box(low, high, BITS, LEXICOGRAPHIC, 3)
    keys = covered(ranges)
    assert set(encode(voxels_between(low, high), BITS, LEXICOGRAPHIC).tolist()) <= set(keys)
    assert len(set(keys)) == len(keys)
    assert len(ranges) == high[0] - low[0] + 1

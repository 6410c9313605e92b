"""Grouping keys into ranges: MaxGap as defined, CBGroup against brute force (case 10)."""

from collections.abc import Iterator
from itertools import pairwise, product

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from hapticdb.paper.cost_model import CostModel
from hapticdb.paper.grouping import cbgroup, maxgap
from hapticdb.paper.quantiles import QuantileVector
from hapticdb.store.base import Keys
from hapticdb.store.covering import Ranges

few = settings(max_examples=100, deadline=None)
LARGEST = 2**63 - 2


def as_keys(values: list[int]) -> Keys:
    return np.array(values, dtype=np.int64)


def as_pairs(ranges: Ranges) -> list[tuple[int, int]]:
    return list(zip(ranges.lows.tolist(), ranges.highs.tolist(), strict=True))


def key_lists(values: st.SearchStrategy[int], most: int) -> st.SearchStrategy[list[int]]:
    return st.lists(values, min_size=1, max_size=most, unique=True).map(sorted)


def definition_of_maxgap(keys: list[int], gap: int) -> list[tuple[int, int]]:
    """Neighbours p < q share a range if and only if q - p <= gap."""
    ranges = [(keys[0], keys[0])]
    for p, q in pairwise(keys):
        ranges.append((ranges.pop()[0], q) if q - p <= gap else (q, q))
    return ranges


@few
@given(
    keys=st.one_of(key_lists(st.integers(0, 60), 30), key_lists(st.integers(0, LARGEST), 30)),
    gap=st.one_of(st.integers(0, 20), st.integers(0, 2**70)),
)
@example(keys=[0, 2**62 + 1, LARGEST], gap=2**70)
def test_maxgap_equals_definition(keys: list[int], gap: int) -> None:
    array = as_keys(keys)
    assert as_pairs(maxgap(array, array, array, gap)) == definition_of_maxgap(keys, gap)


@few
@given(voxels=key_lists(st.integers(0, 20 * 512), 60), gap=st.integers(0, 3000))
def test_maxgap_bricks_equal_voxel_keys(voxels: list[int], gap: int) -> None:
    """Two bricks share a range if and only if voxels of both share one on the voxel layout."""
    under: dict[int, list[int]] = {}
    for voxel in voxels:
        under.setdefault(voxel >> 9, []).append(voxel)
    found = maxgap(
        as_keys(list(under)),
        as_keys([v[0] for v in under.values()]),
        as_keys([v[-1] for v in under.values()]),
        gap,
    )
    cuts = {p >> 9 for p, q in pairwise(voxels) if q - p > gap and p >> 9 != q >> 9}
    wanted: list[tuple[int, int]] = []
    first = None
    for brick in under:
        first = brick if first is None else first
        if brick in cuts or brick == max(under):
            wanted.append((first, brick))
            first = None
    assert as_pairs(found) == wanted


def costs_of(descent: float, row: float) -> CostModel:
    """A model in which only a descent and a scanned row cost anything."""
    return CostModel(statement=0.0, descent=descent, block=row, row=row / 2, rows_per_block=2.0)


def all_groupings(keys: list[int]) -> Iterator[list[tuple[int, int]]]:
    """Every way to cut sorted keys into ranges: 2^(n-1)."""
    for is_cut in product((False, True), repeat=len(keys) - 1):
        ranges = [(keys[0], keys[0])]
        for key, cut in zip(keys[1:], is_cut, strict=True):
            ranges.append((key, key) if cut else (ranges.pop()[0], key))
        yield ranges


def least_cost(keys: list[int], quantiles: QuantileVector, costs: CostModel) -> float:
    """Cost of the cheapest of all groupings, summed range by range."""
    known = {
        (low, high): costs.descent + costs.row_scanned * quantiles.rows_between(low, high)
        for low, high in product(keys, keys)
        if low <= high
    }
    return min(sum(map(known.__getitem__, ranges)) for ranges in all_groupings(keys))


def vectors(values: st.SearchStrategy[int]) -> st.SearchStrategy[QuantileVector]:
    """Quantile vectors of few distinct values, so that many buckets have no width."""
    return st.builds(
        lambda bounds, n_rows: QuantileVector(as_keys(sorted(bounds)), n_rows),
        st.lists(values, min_size=2, max_size=30),
        st.integers(1, 500),
    )


def scenes() -> st.SearchStrategy[tuple[list[int], QuantileVector]]:
    """Keys asked for, and a quantile vector over the same values."""
    ties, spread = st.integers(0, 25), st.integers(0, LARGEST)
    return st.one_of(
        st.tuples(key_lists(ties, 14), vectors(ties)),
        st.tuples(key_lists(spread, 10), vectors(spread)),
        st.tuples(key_lists(spread, 10), vectors(ties)),
    )


@settings(max_examples=150, deadline=None)
@given(scene=scenes(), descent=st.floats(0, 100), row=st.floats(0, 10))
@example(
    scene=(list(range(14)), QuantileVector(as_keys([0, 3, 3, 3, 9, 9, 13]), 60)),
    descent=5.0,
    row=1.0,
)
@example(
    scene=(list(range(0, 28, 2)), QuantileVector(as_keys([1, 1, 5, 5, 5, 5, 16, 27]), 70)),
    descent=12.0,
    row=1.0,
)
def test_cbgroup_optimal_cost(
    scene: tuple[list[int], QuantileVector], descent: float, row: float
) -> None:
    keys, quantiles = scene
    costs = costs_of(descent, row)
    found = as_pairs(cbgroup(as_keys(keys), as_keys(keys), quantiles, costs))
    cost = sum(descent + costs.row_scanned * quantiles.rows_between(*pair) for pair in found)
    assert cost == pytest.approx(least_cost(keys, quantiles, costs), rel=1e-9, abs=1e-9)
    assert found in list(all_groupings(keys))


def test_cbgroup_closes_gap_at_equal_cost() -> None:
    quantiles = QuantileVector(as_keys([0, 8, 16]), 16)  # one row a key
    keys = as_keys([1, 6])  # four keys between
    assert len(cbgroup(keys, keys, quantiles, costs_of(4.0, 1.0)).lows) == 1
    assert len(cbgroup(keys, keys, quantiles, costs_of(3.99, 1.0)).lows) == 2

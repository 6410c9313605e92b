"""Sorting leaves, with the JIT on or off."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hapticdb.kernels.query.sorting import SORTED_RUN, insert_distinct, sorting_order

KEYS = st.integers(-(2**63), 2**63 - 1)


@given(
    st.lists(KEYS, max_size=80)
    | st.builds(
        lambda seed, n, most: np.random.default_rng(seed).integers(0, most, n).tolist(),
        st.integers(0, 2**32),
        st.integers(0, 10 * int(SORTED_RUN)),
        st.sampled_from([2, 50, 2**40]),
    )
)
def test_the_order_is_that_of_a_stable_sort(keys: list[int]) -> None:
    array = np.array(keys, dtype=np.int64)
    order = sorting_order(array)
    assert order.tolist() == sorted(range(len(keys)), key=keys.__getitem__)


@given(st.lists(st.integers(0, 30)), st.integers(0, 3))
def test_distinct_values_are_kept_ascending(values: list[int], start: int) -> None:
    kept = np.full(start + len(values), -7, dtype=np.int64)
    count = np.int64(0)
    for value in values:
        count = insert_distinct(kept, np.int64(start), count, np.int64(value))
    assert kept[start : start + count].tolist() == sorted(set(values))
    assert (kept[:start] == -7).all()

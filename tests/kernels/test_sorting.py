"""Sorting leaves, with the JIT on or off."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hapticdb.kernels.query.sorting import insert_distinct, sorting_order

KEYS = st.integers(-(2**63), 2**63 - 1)


@given(
    st.lists(KEYS, max_size=80, unique=True)
    | st.builds(
        lambda seed, n: np.random.default_rng(seed).permutation(2**10)[:n].tolist(),
        st.integers(0, 2**32),
        st.integers(0, 2**10),
    )
)
def test_sorting_order_sorts_distinct_keys(keys: list[int]) -> None:
    array = np.array(keys, dtype=np.int64)
    assert array[sorting_order(array)].tolist() == sorted(keys)


@given(st.lists(st.integers(0, 30)), st.integers(0, 3))
def test_insert_distinct_ascending(values: list[int], start: int) -> None:
    kept = np.full(start + len(values), -7, dtype=np.int64)
    count = np.int64(0)
    for value in values:
        count = insert_distinct(kept, np.int64(start), count, np.int64(value))
    assert kept[start : start + count].tolist() == sorted(set(values))
    assert (kept[:start] == -7).all()

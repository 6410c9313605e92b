"""Ranges and keys cut at the borders of shards, against a plain loop over keys."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hapticdb import Grid
from hapticdb.store.base import CELL_SHIFT
from hapticdb.store.postgres.shards.pieces import (
    borders_by_rows,
    even_borders,
    pieces_of_keys,
    pieces_of_ranges,
)
from hapticdb.store.postgres.shards.statistics import joined_histograms
from hapticdb.store.postgres.shards.view import LiveView, changed_versions

LAST = 60
firsts_of = st.lists(st.integers(0, LAST), max_size=5).map(
    lambda some: np.array([0, *sorted(some)], dtype=np.int64)
)
key_sets = st.sets(st.integers(0, LAST))


def owner(firsts: np.ndarray, key: int) -> int:
    """The last shard whose first key is not above the key."""
    return max(n for n, first in enumerate(firsts.tolist()) if first <= key)


def ranges_of(keys: set[int]) -> np.ndarray:
    """Closed ranges (n, 2) that hold exactly these keys; neighbours are not joined always."""
    ends: list[list[int]] = []
    for key in sorted(keys):
        if ends and ends[-1][1] == key - 1 and key % 7:
            ends[-1][1] = key
        else:
            ends.append([key, key])
    return np.array(ends, dtype=np.int64).reshape(-1, 2)


@given(firsts_of, key_sets)
def test_pieces_of_ranges_hold_each_key_once_on_its_owner(
    firsts: np.ndarray, keys: set[int]
) -> None:
    ends = ranges_of(keys)
    found: list[tuple[int, int]] = []
    for piece in pieces_of_ranges(firsts, ends[:, 0], ends[:, 1]):
        assert (piece.lows <= piece.highs).all()
        for low, high in zip(piece.lows.tolist(), piece.highs.tolist(), strict=True):
            found += [(piece.shard, key) for key in range(low, high + 1)]
    assert found == [(owner(firsts, key), key) for key in sorted(keys)]


@given(firsts_of, key_sets)
def test_pieces_of_keys_hold_each_key_once_on_its_owner(firsts: np.ndarray, keys: set[int]) -> None:
    ordered = np.array(sorted(keys), dtype=np.int64)
    found = [
        (shard, key)
        for shard, some in pieces_of_keys(firsts, ordered)
        for key in ordered[some].tolist()
    ]
    assert found == [(owner(firsts, key), key) for key in sorted(keys)]


@pytest.mark.parametrize("bits", [1, 5, 6, 10, 21])
@pytest.mark.parametrize("count", [1, 3, 8, 100])
def test_even_borders_cut_the_grid_between_cells(bits: int, count: int) -> None:
    borders = even_borders(Grid(0.01, (0, 0, 0), bits), count)
    assert borders[0] == 0
    assert (np.diff(borders) >= 0).all()
    assert (borders % (1 << CELL_SHIFT) == 0).all()
    assert borders[-1] < 1 << max(3 * bits, CELL_SHIFT)


@given(st.lists(st.integers(0, 2**24), min_size=40, max_size=400), st.integers(1, 7))
def test_borders_by_rows_share_the_rows_but_for_a_cell(keys: list[int], count: int) -> None:
    rows = np.sort(np.array(keys, dtype=np.int64))
    n_buckets = 1000
    ranks = np.maximum(-(-np.arange(n_buckets + 1) * len(rows) // n_buckets), 1)
    borders = borders_by_rows(rows[ranks - 1], 0, count)
    assert (np.diff(borders) >= 0).all()
    # each border lies less than a cell below the row of its rank
    wanted = rows[ranks[np.round(n_buckets * np.arange(1, count) / count).astype(int)] - 1]
    assert ((wanted - borders[1:] >= 0) & (wanted - borders[1:] < 1 << CELL_SHIFT)).all()


@given(st.lists(st.tuples(st.integers(1, 500), st.integers(0, 2)), min_size=1, max_size=4))
def test_joined_histograms_have_the_ranks_of_all_rows(shards: list[tuple[int, int]]) -> None:
    resolution = 10_000
    bounds, counts, everything = [], [], []
    for n, (count, spread) in enumerate(shards):
        rows = 10_000 * n + np.arange(count) * spread
        ranks = np.maximum(-(-np.arange(resolution + 1) * count // resolution), 1)
        bounds.append(rows[ranks - 1])
        counts.append(count)
        everything.append(rows)
    found, n_rows = joined_histograms(bounds, counts)
    whole = np.concatenate(everything)
    assert n_rows == len(whole)
    assert len(found) == resolution + 1
    assert (np.diff(found) >= 0).all()
    ranks = np.arange(resolution + 1) * n_rows / resolution
    below = np.searchsorted(whole, found, "left")
    up_to = np.searchsorted(whole, found, "right")
    assert (below <= ranks + 1).all()
    assert (up_to >= ranks - 1).all()


@given(
    st.dictionaries(st.integers(1, 9), st.integers(0, 3)),
    st.lists(st.tuples(st.integers(1, 9), st.integers(0, 3))),
)
def test_rows_count_in_the_live_version_only(
    live: dict[int, int], rows: list[tuple[int, int]]
) -> None:
    ids = np.array(sorted(live), dtype=np.int64)
    versions = np.array([live[key] for key in sorted(live)], dtype=np.int64)
    none = np.empty(0, np.int64)
    view = LiveView(1, 0, none, none, ids, versions)
    asked = np.array(rows, dtype=np.int64).reshape(-1, 2)
    found = view.are_live(asked[:, 0], asked[:, 1]).tolist()
    assert found == [live.get(object_id) == version for object_id, version in rows]


@given(
    st.dictionaries(st.integers(1, 9), st.integers(0, 3)),
    st.dictionaries(st.integers(1, 12), st.integers(-1, 3)),
)
def test_versions_change_as_in_a_dictionary(before: dict[int, int], new: dict[int, int]) -> None:
    arrays = [
        np.array([list(pair) for pair in sorted(some.items())], dtype=np.int64).reshape(-1, 2)
        for some in (before, new)
    ]
    found = changed_versions(arrays[0][:, 0], arrays[0][:, 1], arrays[1][:, 0], arrays[1][:, 1])
    wanted = {key: version for key, version in (before | new).items() if version >= 0}
    assert dict(zip(*(column.tolist() for column in found), strict=True)) == wanted
    assert (np.diff(found[0]) > 0).all()
    assert {key: version for key, version in arrays[0].tolist()} == before  # noqa: C416

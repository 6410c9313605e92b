"""Tests of statistics: quantiles of the keys, their age, cost figures."""

import numpy as np
import pytest

from hapticdb.query.grouping import covering
from hapticdb.store.base import (
    Store,
)
from hapticdb.testing.case import StoreCase
from hapticdb.testing.scenes import (
    EVERYWHERE,
)


class StatisticsContract(StoreCase):
    """Tests of the statistics that grouping by cost needs."""

    @pytest.mark.parametrize("resolution", [1, 3, 7, 100, 5000])
    def test_quantiles_follow_definition_2(self, store: Store, resolution: int) -> None:
        """Bound i is the key of rank ceil(i N / v) among all rows, ties counted one by one."""
        rows = store.scan(*EVERYWHERE)
        keys = np.sort(rows.keys)
        bounds, n_rows, _ = store.quantiles(resolution)
        ranks = [max(-(-i * len(keys) // resolution), 1) for i in range(resolution + 1)]
        assert n_rows == len(keys)
        assert bounds.tolist() == [int(keys[rank - 1]) for rank in ranks]

    def test_kept_quantiles_are_never_stale(self, store: Store) -> None:
        """After a write they are computed again."""
        store.analyze(10)
        kept = store.quantiles(10)
        assert kept.source == "kept"
        store.remove(1, covering(store))
        anew = store.quantiles(10)
        assert anew.source == "computed"
        assert anew.n_rows < kept.n_rows

    def test_freshness_counts_the_writes_since(self, store: Store) -> None:
        """The age is unknown before `analyze`, 0 right after it, and 1 after a removal."""
        assert store.freshness(10).revision is None
        store.analyze(10)
        assert store.freshness(10) == (2, 0)
        store.remove(1, covering(store))
        assert store.freshness(10) == (2, 1)
        store.analyze(10)
        assert store.freshness(10) == (3, 0)

    def test_costs_are_kept_by_machine(self, store: Store) -> None:
        """Figures return as saved."""
        assert store.costs("here") is None
        store.save_costs("here", {"row": 0.25, "row.spread": 0.5})
        assert store.costs("here") == {"row": 0.25, "row.spread": 0.5}
        assert store.costs("there") is None

"""Tests of reading: rows by key and by object, statistics, Figure 3."""

import numpy as np
import pytest

from contract.case import StoreCase, one_kind
from hapticdb.grid import Grid
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.store.base import LocatedShell, Store
from voxels import EVERYWHERE, blob, kind


class ReadingContract(StoreCase):
    def test_lookup_all_rows_of_keys(self, store: Store, plain: dict[int, set[int]]) -> None:
        spread = np.linspace(0, max(plain) + 3, 20_000, dtype=np.int64)
        known = np.array(sorted(plain), dtype=np.int64)[::3]
        keys = np.unique(np.concatenate([spread, known, known + 1]))
        some = np.unique(np.concatenate([spread[::200], known[::20], known[::20] + 1]))
        for rows, asked in ((store.lookup(keys), keys), (store.lookup_each(some), some)):
            expected = [(k, i) for k in asked.tolist() for i in sorted(plain.get(k, ()))]
            assert sorted(zip(rows.keys.tolist(), rows.ids.tolist(), strict=True)) == expected

    def test_scan_closed_ranges_in_order(self, store: Store, plain: dict[int, set[int]]) -> None:
        known = sorted(plain)
        cuts = np.array(known, dtype=np.int64)
        lows, highs = cuts[::5].copy(), cuts[2::5].copy()
        lows = lows[: len(highs)].copy()
        expected = [
            (k, i)
            for lo, hi in zip(lows.tolist(), highs.tolist(), strict=True)
            for k in known
            if lo <= k <= hi
            for i in sorted(plain[k])
        ]
        rows = store.scan(lows, highs)
        assert rows.keys.tolist() == sorted(rows.keys.tolist())
        assert sorted(zip(rows.keys.tolist(), rows.ids.tolist(), strict=True)) == sorted(expected)
        assert store.count(lows, highs) == len(expected)

    def test_scan_occupancy_as_written(self, store: Store) -> None:
        if store.layout == "voxel":
            assert not store.lookup(np.zeros(1, dtype=np.int64)).occupancy.size
            return
        written = rows_of_voxels(blob(1, (20, 20, 20)), *kind(store))
        rows = store.scan(written.keys[:1].copy(), written.keys[-1:].copy())
        mine = rows.occupancy.reshape(-1, 64)[rows.ids == 1]
        np.testing.assert_array_equal(mine, written.occupancy.reshape(-1, 64))

    def test_lookup_scan_no_keys_empty(self, store: Store) -> None:
        none = np.empty(0, dtype=np.int64)
        assert len(store.lookup(none)) == len(store.scan(none, none)) == 0
        assert len(store.lookup_each(none)) == store.count(none, none) == 0

    def test_rows_of_one_object(self, store: Store) -> None:
        written = rows_of_voxels(blob(2, (24, 20, 20)), *kind(store))
        rows = store.rows_of(2, *EVERYWHERE)
        np.testing.assert_array_equal(rows.keys, written.keys)
        np.testing.assert_array_equal(rows.occupancy, written.occupancy)
        assert set(rows.ids.tolist()) == {2}
        assert not len(store.rows_of(3, *EVERYWHERE))

    def test_store_empty_environment(self) -> None:
        store = self.make(Grid(0.01, (0, 0, 0), 5), "brick")
        assert store.revision() == store.size().rows == len(store.objects()) == 0
        assert not list(store.changes())
        assert store.quantiles(10)[1] == 0
        store.discard()

    @pytest.mark.parametrize("resolution", [1, 3, 7, 100, 5000])
    def test_quantiles_definition_2(self, store: Store, resolution: int) -> None:
        """Bound i is the key of rank ceil(i N / v) among all rows, ties counted one by one."""
        rows = store.scan(*EVERYWHERE)
        keys = np.sort(rows.keys)
        bounds, n_rows, _ = store.quantiles(resolution)
        ranks = [max(-(-i * len(keys) // resolution), 1) for i in range(resolution + 1)]
        assert n_rows == len(keys)
        assert bounds.tolist() == [int(keys[rank - 1]) for rank in ranks]

    def test_quantiles_stored_never_stale(self, store: Store) -> None:
        store.analyze(10)
        kept = store.quantiles(10)
        assert kept.source == "kept"
        store.remove(1)
        anew = store.quantiles(10)
        assert anew.source == "computed"
        assert anew.n_rows < kept.n_rows

    def test_freshness_counts_writes(self, store: Store) -> None:
        assert store.freshness(10).revision is None
        store.analyze(10)
        assert store.freshness(10) == (2, 0)
        store.remove(1)
        assert store.freshness(10) == (2, 1)
        store.analyze(10)
        assert store.freshness(10) == (3, 0)

    @one_kind
    def test_costs_by_machine(self, store: Store) -> None:
        assert store.costs("here") is None
        store.save_costs("here", {"row": 0.25, "row.spread": 0.5})
        assert store.costs("here") == {"row": 0.25, "row.spread": 0.5}
        assert store.costs("there") is None

    def test_statement_hits_and_exclusions(self, store: Store) -> None:
        both = np.array([[22, 20, 20], [16, 20, 20], [60, 60, 60]], dtype=np.int64)
        keys = store.grid.encode(both)
        if store.layout == "brick":
            places = both & 7
            order = Grid(1.0, (0, 0, 0), 3).encode(places)
            keys = (keys >> 9 << 9) | order
        placed = np.zeros((4, 6))
        placed[:3, :3] = store.grid.centers(both) - np.array([0.0, 0.0, 0.002])
        placed[:3, 5] = 1.0
        none = np.empty(0, dtype=np.int64)
        frame = LocatedShell(placed, keys, 1000.0, none)
        ordinals, ids = store.statement_hits(frame)
        assert sorted(zip(ordinals.tolist(), ids.tolist(), strict=True)) == [(0, 1), (0, 2), (1, 1)]
        np.testing.assert_allclose(store.statement(frame)[:3], [0, 0, 4.0])
        without = frame._replace(exclude=np.array([1], dtype=np.int64))
        np.testing.assert_allclose(store.statement(without)[:3], [0, 0, 2.0])
        far_apart, many = np.array([1, 1 << 40]), np.arange(2, 9000)
        for others, force in ((far_apart, 2.0), (many, 4.0), (many + 7, 4.0)):
            without = frame._replace(exclude=others)
            np.testing.assert_allclose(store.statement(without)[:3], [0, 0, force])
            excluded = set(store.statement_hits(without)[1].tolist())
            assert excluded == {1, 2} - set(others.tolist())
        nothing = frame._replace(exclude=np.array([1, 2], dtype=np.int64))
        assert not store.statement(nothing).any()
        assert not len(store.statement_hits(nothing)[0])

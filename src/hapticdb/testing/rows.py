"""Tests of reading rows: lookups, scans and counts, by key and by object."""

import numpy as np

from hapticdb.grid import Grid
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.store.base import Store
from hapticdb.testing.case import StoreCase
from hapticdb.testing.scenes import (
    EVERYWHERE,
    blob,
    kind,
)


class RowsContract(StoreCase):
    """Tests of the reads that a frame needs."""

    def test_lookup_finds_every_row_of_a_key_and_no_other(
        self, store: Store, plain: dict[int, set[int]]
    ) -> None:
        """Tests `lookup` and, with fewer keys, `lookup_each`, which asks once for each."""
        spread = np.linspace(0, max(plain) + 3, 20_000, dtype=np.int64)
        known = np.array(sorted(plain), dtype=np.int64)[::3]
        keys = np.unique(np.concatenate([spread, known, known + 1]))
        some = np.unique(np.concatenate([spread[::200], known[::20], known[::20] + 1]))
        for rows, asked in ((store.lookup(keys), keys), (store.lookup_each(some), some)):
            expected = [(k, i) for k in asked.tolist() for i in sorted(plain.get(k, ()))]
            assert sorted(zip(rows.keys.tolist(), rows.ids.tolist(), strict=True)) == expected

    def test_scan_reads_closed_ranges_in_order(
        self, store: Store, plain: dict[int, set[int]]
    ) -> None:
        """Ranges of a single key and many ranges at once are tested, too."""
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

    def test_occupancy_returns_as_written(self, store: Store) -> None:
        """All 512 bits of each brick return."""
        if store.layout == "voxel":
            assert not store.lookup(np.zeros(1, dtype=np.int64)).occupancy.size
            return
        written = rows_of_voxels(blob(1, (20, 20, 20)), *kind(store))
        rows = store.scan(written.keys[:1].copy(), written.keys[-1:].copy())
        mine = rows.occupancy.reshape(-1, 64)[rows.ids == 1]
        np.testing.assert_array_equal(mine, written.occupancy.reshape(-1, 64))

    def test_nothing_asked_is_nothing_found(self, store: Store) -> None:
        """Some engines cannot bind empty arrays."""
        none = np.empty(0, dtype=np.int64)
        assert len(store.lookup(none)) == len(store.scan(none, none)) == 0
        assert len(store.lookup_each(none)) == store.count(none, none) == 0

    def test_rows_of_leaves_the_others_out(self, store: Store) -> None:
        """The two objects overlap."""
        written = rows_of_voxels(blob(2, (24, 20, 20)), *kind(store))
        rows = store.rows_of(2, *EVERYWHERE)
        np.testing.assert_array_equal(rows.keys, written.keys)
        np.testing.assert_array_equal(rows.occupancy, written.occupancy)
        assert set(rows.ids.tolist()) == {2}
        assert not len(store.rows_of(3, *EVERYWHERE))

    def test_an_empty_environment_answers(self) -> None:
        """It has no rows and no objects, and its revision is 0."""
        store = self.make(Grid(0.01, (0, 0, 0), 5), "brick")
        assert store.revision() == store.size().rows == len(store.objects()) == 0
        assert not list(store.changes())
        assert store.quantiles(10)[1] == 0
        store.discard()

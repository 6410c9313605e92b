"""Tests of distances beside the voxels: written, read and removed with their objects."""

from dataclasses import replace

import numpy as np
import pytest

from contract.case import StoreCase
from hapticdb.errors import EnvironmentExistsError
from hapticdb.grid import CurveName, Grid
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.store import parsing
from hapticdb.store.base import (
    BRICK_BYTES,
    NO_KEYS,
    Change,
    Keys,
    LocatedShell,
    Rows,
    Store,
    all_rows,
    row_shift,
)
from voxels import EVERYWHERE, blob, voxel_object, with_distances

GRID = Grid(0.01, (-0.3, 0.1, 0.2), 6)
CURVES: list[CurveName] = ["z", "hilbert"]
PLACES = {1: (20, 20, 20), 2: (24, 20, 20), 3: (28, 24, 20)}
"""Centres of three overlapping blobs, by id."""
Content = dict[tuple[int, int], tuple[bytes, bytes]]


def _content_of(rows: Rows, object_id: int | None = None) -> Content:
    assert rows.distances is not None
    ids = rows.ids.tolist() if object_id is None else [object_id] * len(rows)
    places = list(zip(rows.keys.tolist(), ids, strict=True))
    assert places == sorted(set(places))
    bricks = rows.occupancy.reshape(-1, BRICK_BYTES)
    data, ends = rows.distances.data.tobytes(), rows.distances.ends.tolist()
    starts = (rows.distances.ends - rows.distances.lengths).tolist()
    return {
        place: (brick.tobytes(), data[start:end])
        for place, brick, start, end in zip(places, bricks, starts, ends, strict=True)
    }


def _is_touched(change: Change, row_keys: Keys) -> bool:
    lows, shift = change.ranges[:, 0], row_shift("brick")
    at = np.searchsorted(lows, row_keys << shift, side="right") - 1
    highs = change.ranges[np.maximum(at, 0), 1]
    return bool(((at >= 0) & (((row_keys + 1) << shift) - 1 <= highs)).all())


class DistancesContract(StoreCase):
    """Objects 1 and 3 have distances, object 2 has none."""

    @pytest.fixture(params=CURVES)
    def band(self, request: pytest.FixtureRequest) -> Store:
        store = self.make(replace(GRID, curve=request.param), "brick")
        for object_id in PLACES:
            self.write(store, object_id)
        return store

    def rows(self, store: Store, object_id: int) -> Rows:
        ijk = blob(object_id, PLACES[object_id])
        if object_id == 2:
            return rows_of_voxels(ijk, store.grid, "brick")
        return with_distances(ijk, store.grid, "brick", seed=object_id)

    def write(self, store: Store, object_id: int, name: str = "") -> int:
        ijk = blob(object_id, PLACES[object_id])
        record = voxel_object(store.grid, ijk, name or f"{object_id}")
        return store.add(record, self.rows(store, object_id))

    def expected(self, store: Store, *object_ids: int) -> Content:
        found: Content = {}
        for object_id in object_ids:
            found |= _content_of(self.rows(store, object_id), object_id)
        return dict(sorted(found.items()))

    def test_scan_distances_as_written(self, band: Store) -> None:
        everything = self.expected(band, 1, 3)
        assert _content_of(band.scan(*EVERYWHERE, distances=True)) == everything
        assert any(not any(brick) for brick, _ in everything.values())
        keys = np.array(sorted({key for key, _ in everything}), dtype=np.int64)
        lows, highs = keys[::5].copy(), keys[2::5].copy()
        lows = lows[: len(highs)].copy()
        inside = [range(lo, hi + 1) for lo, hi in zip(lows.tolist(), highs.tolist(), strict=True)]
        assert _content_of(band.scan(lows, highs, distances=True)) == {
            place: row for place, row in everything.items() if any(place[0] in r for r in inside)
        }

    def test_lookup_distances_of_given_keys(self, band: Store) -> None:
        everything = self.expected(band, 1, 3)
        keys = np.arange(0, max(key for key, _ in everything) + 3, dtype=np.int64)[::3].copy()
        wanted = {place: row for place, row in everything.items() if place[0] % 3 == 0}
        assert _content_of(band.lookup(keys, distances=True)) == wanted
        assert _content_of(band.lookup_each(keys, distances=True)) == wanted

    def test_rows_of_distances_of_one_object(self, band: Store) -> None:
        for object_id in (1, 3):
            rows = band.rows_of(object_id, *EVERYWHERE, distances=True)
            assert _content_of(rows) == self.expected(band, object_id)
        assert _content_of(band.rows_of(2, *EVERYWHERE, distances=True)) == {}

    def test_scan_without_distances(self, band: Store) -> None:
        parts = [self.rows(band, object_id).occupied() for object_id in PLACES]
        keys = np.sort(np.concatenate([part.keys for part in parts]))
        rows = band.scan(*EVERYWHERE)
        assert rows.distances is None
        np.testing.assert_array_equal(rows.keys, keys)
        assert rows.occupancy.reshape(-1, BRICK_BYTES).any(axis=1).all()
        own = band.rows_of(1, *EVERYWHERE)
        np.testing.assert_array_equal(own.occupancy, parts[0].occupancy)
        assert band.lookup(np.unique(keys)).distances is None

    def test_count_includes_bricks_without_voxels(self, band: Store) -> None:
        n_rows = sum(len(self.rows(band, object_id)) for object_id in PLACES)
        assert band.count(*EVERYWHERE) == band.size().rows == band.quantiles(7).n_rows == n_rows
        assert n_rows > len(band.scan(*EVERYWHERE))
        band.remove(1)
        band.remove(3)
        assert band.count(*EVERYWHERE) == len(band.scan(*EVERYWHERE)) == len(self.rows(band, 2))

    def test_statement_hits_ignore_distance_rows(self, band: Store) -> None:
        """At voxels of a box around the objects, where most bricks of an object hold none."""
        box = np.argwhere(np.ones((36, 32, 32))) + np.array([4, 8, 8])
        voxels = np.random.default_rng(0).choice(box, 800, replace=False)
        order = Grid(1.0, (0, 0, 0), 3).encode(voxels & 7)
        addresses = (band.grid.encode(voxels) >> 9 << 9) | order
        frame = LocatedShell(np.zeros((len(voxels) + 1, 6)), addresses, 1.0, NO_KEYS)
        ordinals, ids = band.statement_hits(frame)
        found = {(*voxels[n].tolist(), i) for n, i in zip(ordinals, ids.tolist(), strict=True)}
        asked = set(map(tuple, voxels.tolist()))
        assert len(found) == len(ids) > 50
        assert found == {
            (*voxel, i)
            for i, place in PLACES.items()
            for voxel in blob(i, place).tolist()
            if tuple(voxel) in asked
        }

    def test_lookup_scan_no_keys_no_distances(self, band: Store) -> None:
        for empty in (
            band.lookup(NO_KEYS, distances=True),
            band.lookup_each(NO_KEYS, distances=True),
            band.scan(NO_KEYS, NO_KEYS, distances=True),
            band.rows_of(1, NO_KEYS, NO_KEYS, distances=True),
        ):
            assert _content_of(empty) == {}

    def test_objects_has_distances(self, band: Store) -> None:
        assert [obj.has_distances for obj in band.objects()] == [True, False, True]
        for obj in band.objects():
            rows = self.rows(band, obj.id)
            assert obj.distances_crc == parsing.distances_crc(rows)
            assert obj.rows_crc == parsing.rows_crc(rows.occupied())
            assert obj.attributes == {"made": True}

    def test_write_refused_leaves_no_distances(self, band: Store) -> None:
        before = _content_of(band.scan(*EVERYWHERE, distances=True))
        with pytest.raises(EnvironmentExistsError):
            self.write(band, 3, name="1")
        assert _content_of(band.scan(*EVERYWHERE, distances=True)) == before
        assert band.revision() == 3

    def test_remove_deletes_distances(self, band: Store) -> None:
        band.remove(1)
        assert _content_of(band.scan(*EVERYWHERE, distances=True)) == self.expected(band, 3)
        band.remove(2)
        assert _content_of(band.scan(*EVERYWHERE, distances=True)) == self.expected(band, 3)
        for change in band.changes():
            if change.id != 2:
                assert _is_touched(change, self.rows(band, change.id).keys)

    def test_replace_adds_and_removes_distances(self, band: Store) -> None:
        known, rows = band.object(1), self.rows(band, 1)
        voxels = band.rows_of(1, *EVERYWHERE)
        for new in (rows.occupied(), rows):
            band.replace(replace(known, revision=0), new)
            has_distances = new.distances is not None
            assert band.object(1).has_distances == has_distances
            wanted = self.expected(band, *([1, 3] if has_distances else [3]))
            assert _content_of(band.scan(*EVERYWHERE, distances=True)) == wanted
            for found, column in zip(band.rows_of(1, *EVERYWHERE), voxels, strict=True):
                np.testing.assert_array_equal(found, column)
            assert _is_touched(list(band.changes())[-1], rows.keys)

    def test_all_rows_pieces_with_distances(self, band: Store) -> None:
        found, measured = {}, {}
        for rows in all_rows(band, 7):
            assert len(rows) <= 7
            found.update(_content_of(rows))
            measured.update(_content_of(rows.measured()))
        voxels = self.rows(band, 2)
        bricks = voxels.occupancy.reshape(-1, BRICK_BYTES)
        without = zip(voxels.keys.tolist(), bricks, strict=True)
        everything = self.expected(band, 1, 3)
        assert measured == everything
        assert found == everything | {(key, 2): (brick.tobytes(), b"") for key, brick in without}

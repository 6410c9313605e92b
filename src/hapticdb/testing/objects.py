"""Tests of objects: writing, replacing, removing, each write in one transaction."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest

from hapticdb.errors import (
    ConflictError,
    EnvironmentExistsError,
    ObjectNotFoundError,
)
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.query.grouping import covering
from hapticdb.store.base import (
    Object,
    Store,
)
from hapticdb.testing.case import StoreCase
from hapticdb.testing.scenes import (
    EVERYWHERE,
    blob,
    kind,
    voxel_object,
    write_voxels,
)


class ObjectsContract(StoreCase):
    """Tests of the effect of an edit, and of the state after a refused edit."""

    def test_objects_return_as_written(self, store: Store) -> None:
        """Records come ordered by id, with the right revisions."""
        first, second = store.objects()
        assert (first.id, second.id) == (1, 2)
        assert store.object(2).name == "two"
        with pytest.raises(ObjectNotFoundError, match="no object 3"):
            store.object(3)
        assert (first.name, first.link, first.attributes) == ("one", "made", {"made": True})
        assert (first.revision, second.revision, store.revision()) == (1, 2, 2)
        np.testing.assert_array_equal(first.transform, np.eye(4))
        np.testing.assert_array_equal(
            first.bounds, voxel_object(store.grid, blob(1, (20, 20, 20))).bounds
        )

    def test_some_objects_and_outlines_are_those_of_all(self, store: Store) -> None:
        """Ids that no object has are passed over; an empty environment has empty outlines."""
        objects = store.objects()
        assert [obj.name for obj in store.objects([7, 2])] == ["two"]
        assert store.objects([]) == []
        found = store.outlines()
        assert list(found.names) == [obj.name for obj in objects]
        assert list(found.digests) == [obj.digest for obj in objects]
        assert found.ids.tolist() == [obj.id for obj in objects]
        assert found.revisions.tolist() == [obj.revision for obj in objects]
        np.testing.assert_array_equal(found.bounds, [obj.bounds for obj in objects])
        none = self.make(store.grid, store.layout, "fresh").outlines()
        assert (len(none.names), none.ids.shape, none.bounds.shape) == (0, (0,), (0, 2, 3))

    def test_the_same_part_is_not_written_twice(self, store: Store) -> None:
        """Link and name are a part's identity; the failed write leaves nothing."""
        before = store.size().rows
        with pytest.raises(EnvironmentExistsError):
            write_voxels(store, blob(5, (40, 40, 40)), "one")
        assert store.size().rows == before
        assert store.revision() == 2

    def test_loading_ends_as_single_writes_do(self, store: Store) -> None:
        """Rows, ids and revisions are equal, also if an error ends the loading."""
        fresh = self.make(store.grid, store.layout, "loaded")
        with contextlib.suppress(ZeroDivisionError), fresh.loading(), fresh.loading():
            write_voxels(fresh, blob(1, (20, 20, 20)), "one")
            write_voxels(fresh, blob(2, (24, 20, 20)), "two")
            raise ZeroDivisionError
        for found, expected in zip(fresh.scan(*EVERYWHERE), store.scan(*EVERYWHERE), strict=True):
            np.testing.assert_array_equal(found, expected)
        assert [obj.id for obj in fresh.objects()] == [1, 2]
        assert fresh.revision() == 2

    def test_an_id_is_kept_where_it_is_free(self, store: Store) -> None:
        """So objects that are copied to another store keep their ids."""
        ijk = blob(5, (40, 40, 40))
        rows = rows_of_voxels(ijk, *kind(store))
        nine = replace(voxel_object(store.grid, ijk, "nine"), id=9)
        assert store.add(nine, rows) == 9
        assert store.add(replace(nine, name="again"), rows) == 10
        assert write_voxels(store, ijk, "next") == 11

    def test_an_object_written_meanwhile_is_not_replaced(self, store: Store) -> None:
        """The writer with the old revision gets an error, and nothing is changed."""
        rows = rows_of_voxels(blob(7, (44, 30, 10)), *kind(store))
        seen = store.object(1)
        store.replace(seen, rows, covering(store))
        with pytest.raises(ConflictError, match="written by another meanwhile"):
            store.replace(seen, rows, covering(store))
        assert store.revision() == 3
        with pytest.raises(ObjectNotFoundError):
            store.replace(replace(seen, id=7), rows, covering(store))

    def test_remove_takes_one_object_and_leaves_the_others(self, store: Store) -> None:
        """Rows and record go, in one revision; the id is never used again."""
        store.remove(1, covering(store))
        assert [obj.id for obj in store.objects()] == [2]
        rows = store.scan(*EVERYWHERE)
        assert set(rows.ids.tolist()) == {2}
        assert len(rows) == len(rows_of_voxels(blob(2, (24, 20, 20)), *kind(store)))
        assert write_voxels(store, blob(1, (20, 20, 20)), "one") == 3
        store.remove(2, covering(store))
        with pytest.raises(ObjectNotFoundError):
            store.remove(2, covering(store))

    def test_removed_parts_are_known_until_they_are_there_again(self, store: Store) -> None:
        """They are listed by their file; another file has none."""
        link = store.object(1).link
        assert store.removed(link) == set()
        store.remove(1, covering(store))
        store.remove(2, covering(store))
        assert store.removed(link) == {"one", "two"}
        assert store.removed(f"{link}.other") == set()
        write_voxels(store, blob(1, (20, 20, 20)), "one")
        assert store.removed(link) == {"two"}

    def test_replace_moves_the_rows(self, store: Store) -> None:
        """Old rows go, new ones come, the id stays."""
        ijk = blob(7, (44, 30, 10))
        new = voxel_object(store.grid, ijk, "one")
        moved = Object(**{**vars(new), "id": 1})
        rows = rows_of_voxels(ijk, *kind(store))
        store.replace(moved, rows, covering(store))
        found = store.scan(*EVERYWHERE)
        np.testing.assert_array_equal(found.keys[found.ids == 1], rows.keys)
        np.testing.assert_array_equal(store.objects()[0].bounds, new.bounds)
        assert store.objects()[0].revision == 3

    def test_changes_name_the_keys_touched(self, store: Store) -> None:
        """Every voxel key written lies in a range of its change."""
        changes = list(store.changes())
        assert [(c.revision, c.action, c.id) for c in changes] == [(1, "add", 1), (2, "add", 2)]
        keys = store.grid.encode(blob(2, (24, 20, 20)))
        ranges = changes[1].ranges
        inside = (keys[:, None] >= ranges[:, 0]) & (keys[:, None] <= ranges[:, 1])
        assert inside.any(axis=1).all()
        store.remove(1, covering(store))
        assert [c.action for c in store.changes(since=2)] == ["remove"]

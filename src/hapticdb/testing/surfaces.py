"""Tests of surfaces: one for each shape, which comes and goes with the objects that have it."""

from dataclasses import replace

import pytest

from hapticdb.errors import EnvironmentExistsError, ReadOnlyError
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.query.grouping import covering
from hapticdb.store.base import Object, Rows, Store
from hapticdb.testing.case import StoreCase
from hapticdb.testing.scenes import blob, kind, voxel_object

BALL, CONE = bytes(range(256)) * 40, b"\0cone"
"""Surfaces, made up: a store never unpacks them."""


class SurfacesContract(StoreCase):
    """Objects 1 and 2 have no surface; 3 and 4 share the shape "ball", 5 is a "cone"."""

    def part(self, store: Store, digest: str, name: str) -> tuple[Object, Rows]:
        """Record and rows of an object of that shape."""
        ijk = blob(3, (30, 30, 30))
        record = replace(voxel_object(store.grid, ijk, name), digest=digest)
        return record, rows_of_voxels(ijk, *kind(store))

    @pytest.fixture
    def shapes(self, store: Store) -> Store:
        """The store with three more objects and two surfaces."""
        for digest, name, surface in (
            ("ball", "three", BALL), ("ball", "four", b"other bytes"), ("cone", "five", CONE),
        ):  # fmt: skip
            store.add(*self.part(store, digest, name), surface)
        return store

    def test_a_shape_is_written_once_however_many_objects_have_it(self, shapes: Store) -> None:
        """The first object's surface stays; what was not written is left out of an answer."""
        digests = ["ball", "cone", shapes.object(1).digest, "nothing"]
        assert shapes.surfaces(digests) == {"ball": BALL, "cone": CONE}
        assert shapes.surfaces(["cone"]) == {"cone": CONE}
        assert shapes.surfaces([]) == {}
        assert shapes.surface_digests() == {"ball", "cone"}
        size = shapes.size()
        assert (size.surfaces, size.surface_bytes) == (2, len(BALL) + len(CONE))

    def test_a_move_leaves_the_surface(self, shapes: Store) -> None:
        """A record with the same digest needs none."""
        for object_id, name in ((3, "three"), (5, "five")):
            record, rows = self.part(shapes, shapes.object(object_id).digest, name)
            shapes.replace(replace(record, id=object_id), rows, covering(shapes))
        assert shapes.surfaces(["ball", "cone"]) == {"ball": BALL, "cone": CONE}

    def test_a_surface_goes_with_the_last_object_that_has_it(self, shapes: Store) -> None:
        """By removal, or by another geometry, whose surface comes in the same write."""
        shapes.remove(3, covering(shapes))
        assert shapes.surface_digests() == {"ball", "cone"}
        record, rows = self.part(shapes, "cube", "four")
        shapes.replace(replace(record, id=4), rows, covering(shapes), b"cube")
        assert shapes.surfaces(["ball", "cube"]) == {"cube": b"cube"}
        shapes.remove(5, covering(shapes))
        assert shapes.surface_digests() == {"cube"}
        shapes.add(*self.part(shapes, "ball", "again"), BALL)
        assert shapes.surfaces(["ball"]) == {"ball": BALL}

    def test_a_refused_write_leaves_no_surface(self, shapes: Store) -> None:
        """It is written in the object's transaction."""
        with pytest.raises(EnvironmentExistsError):
            shapes.add(*self.part(shapes, "cube", "five"), b"cube")
        assert shapes.surface_digests() == {"ball", "cone"}

    def test_a_snapshot_keeps_a_surface_that_goes(self, shapes: Store) -> None:
        """Its readers see the surfaces of the objects that they see."""
        reader = self.reopen(shapes)
        with reader.snapshot():
            assert reader.object(5).digest == "cone"
            shapes.remove(5, covering(shapes))
            assert reader.surfaces(["cone"]) == {"cone": CONE}
        assert reader.surfaces(["cone"]) == {}
        reader.close()

    def test_a_missing_surface_is_added_without_a_revision(self, shapes: Store) -> None:
        """An object must have its digest; one that is there stays."""
        bare, revision = shapes.object(1).digest, shapes.revision()
        for digest in (bare, "cone", "nothing"):
            shapes.add_surface(digest, b"later")
        assert shapes.surfaces([bare, "cone", "nothing"]) == {bare: b"later", "cone": CONE}
        assert shapes.revision() == revision
        reader = self.reopen(shapes)
        if reader.is_read_only:
            with pytest.raises(ReadOnlyError):
                reader.add_surface(shapes.object(2).digest, b"later")
        reader.close()

"""Tests of writing: objects, their surfaces, kept pairs; each write is one transaction."""

import contextlib
import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from contract.case import StoreCase, one_kind
from hapticdb.errors import (
    ConflictError,
    EnvironmentExistsError,
    ObjectNotFoundError,
    UsageError,
)
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.store.base import Object, Rows, Store
from hapticdb.store.pairs import Mark, PairRow, Rule
from hapticdb.verdicts import Kind
from voxels import EVERYWHERE, blob, kind, voxel_object, write_voxels

BALL, CONE = bytes(range(256)) * 40, b"\0cone"
"""Surfaces, made up: a store never unpacks them."""

PLACE = (0.1, -0.2, 1 / 3, 0.1, -0.2, 0.5)
FIRST = PairRow(1, 2, Kind.APART, 0.1, 0.1 + 2**-50, PLACE, "new", 2, "a setting")
SECOND = PairRow(1, 3, Kind.OVERLAPPING, 1e-3, None, PLACE, "new", 2, "a setting")


def change_to(store: Store, *rules: Rule) -> None:
    store.change_rules(lambda _: rules)


def made_up(store: Store) -> set[str]:
    return {digest for digest in store.surface_digests() if len(digest) < 64}


class WritingContract(StoreCase):
    @one_kind
    def test_objects_as_written(self, store: Store) -> None:
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

    @one_kind
    def test_objects_and_outlines_of_some_ids(self, store: Store) -> None:
        objects = store.objects()
        assert [obj.name for obj in store.objects([7, 2])] == ["two"]
        assert store.objects([]) == []
        found = store.outlines()
        assert list(found.names) == [obj.name for obj in objects]
        assert list(found.digests) == [obj.digest for obj in objects]
        assert found.ids.tolist() == [obj.id for obj in objects]
        assert found.revisions.tolist() == [obj.revision for obj in objects]
        np.testing.assert_array_equal(found.bounds, [obj.bounds for obj in objects])
        none = self.make(*kind(store)).outlines()
        assert (len(none.names), none.ids.shape, none.bounds.shape) == (0, (0,), (0, 2, 3))

    def test_write_duplicate_part_refused(self, store: Store) -> None:
        before = store.size().rows
        with pytest.raises(EnvironmentExistsError):
            write_voxels(store, blob(5, (40, 40, 40)), "one")
        assert store.size().rows == before
        assert store.revision() == 2

    def test_loading_equals_single_writes(self, store: Store) -> None:
        fresh = self.make(*kind(store))
        with contextlib.suppress(ZeroDivisionError), fresh.loading(), fresh.loading():
            write_voxels(fresh, blob(1, (20, 20, 20)), "one")
            write_voxels(fresh, blob(2, (24, 20, 20)), "two")
            raise ZeroDivisionError
        for found, expected in zip(fresh.scan(*EVERYWHERE), store.scan(*EVERYWHERE), strict=True):
            np.testing.assert_array_equal(found, expected)
        assert [obj.id for obj in fresh.objects()] == [1, 2]
        assert fresh.revision() == 2

    def test_add_assigns_free_id(self, store: Store) -> None:
        ijk = blob(5, (40, 40, 40))
        rows = rows_of_voxels(ijk, *kind(store))
        nine = replace(voxel_object(store.grid, ijk, "nine"), id=9)
        assert store.add(nine, rows) == 9
        assert store.add(replace(nine, name="again"), rows) == 10
        assert write_voxels(store, ijk, "next") == 11

    def test_replace_stale_record_conflict(self, store: Store) -> None:
        rows = rows_of_voxels(blob(7, (44, 30, 10)), *kind(store))
        seen = store.object(1)
        store.replace(seen, rows)
        with pytest.raises(ConflictError, match="written by another meanwhile"):
            store.replace(seen, rows)
        assert store.revision() == 3
        with pytest.raises(ObjectNotFoundError):
            store.replace(replace(seen, id=7), rows)

    def test_remove_one_object(self, store: Store) -> None:
        store.remove(1)
        assert [obj.id for obj in store.objects()] == [2]
        rows = store.scan(*EVERYWHERE)
        assert set(rows.ids.tolist()) == {2}
        assert len(rows) == len(rows_of_voxels(blob(2, (24, 20, 20)), *kind(store)))
        assert write_voxels(store, blob(1, (20, 20, 20)), "one") == 3
        store.remove(2)
        with pytest.raises(ObjectNotFoundError):
            store.remove(2)

    @one_kind
    def test_removed_parts_until_added_again(self, store: Store) -> None:
        link = store.object(1).link
        assert store.removed(link) == set()
        store.remove(1)
        store.remove(2)
        assert store.removed(link) == {"one", "two"}
        assert store.removed(f"{link}.other") == set()
        write_voxels(store, blob(1, (20, 20, 20)), "one")
        assert store.removed(link) == {"two"}

    def test_replace_moves_rows(self, store: Store) -> None:
        ijk = blob(7, (44, 30, 10))
        new = voxel_object(store.grid, ijk, "one")
        moved = Object(**{**vars(new), "id": 1})
        rows = rows_of_voxels(ijk, *kind(store))
        store.replace(moved, rows)
        found = store.scan(*EVERYWHERE)
        np.testing.assert_array_equal(found.keys[found.ids == 1], rows.keys)
        np.testing.assert_array_equal(store.objects()[0].bounds, new.bounds)
        assert store.objects()[0].revision == 3

    def moved(self, store: Store) -> Iterator[tuple[Object, Rows]]:
        for object_id in (1, 2):
            ijk = blob(7, (44, 30, 10 + object_id))
            new = voxel_object(store.grid, ijk, "")
            yield (
                replace(store.object(object_id), bounds=new.bounds),
                rows_of_voxels(ijk, *kind(store)),
            )

    def test_replace_all_one_transaction(self, store: Store) -> None:
        reader, seen = self.reopen(store), []

        def made() -> Iterator[tuple[Object, Rows]]:
            for one in self.moved(store):
                yield one
                seen.append((reader.revision(), [obj.revision for obj in reader.objects()]))

        store.replace_all(made)
        assert seen == [(2, [1, 2])] * 2
        assert [obj.revision for obj in reader.objects()] == [3, 4]
        changes = [(c.revision, c.action, c.id) for c in reader.changes(since=2)]
        assert changes == [(3, "move", 1), (4, "move", 2)]
        for record, rows in self.moved(store):
            np.testing.assert_array_equal(store.object(record.id).bounds, record.bounds)
            np.testing.assert_array_equal(store.rows_of(record.id, *EVERYWHERE).keys, rows.keys)
        reader.close()

    @pytest.mark.parametrize("k", [0, 1, 2])
    def test_replace_all_failure_rolls_back(self, store: Store, k: int) -> None:
        before = store.scan(*EVERYWHERE)

        def made() -> Iterator[tuple[Object, Rows]]:
            yield from itertools.islice(self.moved(store), k)
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            store.replace_all(made)
        store = self.reopen(store)
        for found, expected in zip(store.scan(*EVERYWHERE), before, strict=True):
            np.testing.assert_array_equal(found, expected)
        assert [obj.revision for obj in store.objects()] == [1, 2]
        assert (store.revision(), len(list(store.changes()))) == (2, 2)

    def test_changes_touched_keys(self, store: Store) -> None:
        changes = list(store.changes())
        assert [(c.revision, c.action, c.id) for c in changes] == [(1, "add", 1), (2, "add", 2)]
        keys = store.grid.encode(blob(2, (24, 20, 20)))
        ranges = changes[1].ranges
        inside = (keys[:, None] >= ranges[:, 0]) & (keys[:, None] <= ranges[:, 1])
        assert inside.any(axis=1).all()
        store.remove(1)
        assert [c.action for c in store.changes(since=2)] == ["remove"]

    def part(self, store: Store, digest: str, name: str) -> tuple[Object, Rows]:
        ijk = blob(3, (30, 30, 30))
        record = replace(voxel_object(store.grid, ijk, name), digest=digest)
        return record, rows_of_voxels(ijk, *kind(store))

    @pytest.fixture
    def shapes(self, store: Store) -> Store:
        for digest, name, surface in (
            ("ball", "three", BALL), ("ball", "four", b"other bytes"), ("cone", "five", CONE),
        ):  # fmt: skip
            store.add(*self.part(store, digest, name), surface)
        return store

    @one_kind
    def test_surfaces_shared_shape_written_once(self, shapes: Store) -> None:
        assert shapes.surfaces(["ball", "cone", "nothing"]) == {"ball": BALL, "cone": CONE}
        assert shapes.surfaces(["cone"]) == {"cone": CONE}
        assert shapes.surfaces([]) == {}
        assert made_up(shapes) == {"ball", "cone"}
        held = shapes.surfaces(sorted(shapes.surface_digests()))
        size = shapes.size()
        assert (size.surfaces, size.surface_bytes) == (4, sum(map(len, held.values())))

    @one_kind
    def test_surfaces_unchanged_by_move(self, shapes: Store) -> None:
        for object_id, name in ((3, "three"), (5, "five")):
            record, rows = self.part(shapes, shapes.object(object_id).digest, name)
            shapes.replace(replace(record, id=object_id), rows)
        assert shapes.surfaces(["ball", "cone"]) == {"ball": BALL, "cone": CONE}

    @one_kind
    def test_surfaces_deleted_with_last_object(self, shapes: Store) -> None:
        shapes.remove(3)
        assert made_up(shapes) == {"ball", "cone"}
        record, rows = self.part(shapes, "cube", "four")
        shapes.replace(replace(record, id=4), rows, b"cube")
        assert shapes.surfaces(["ball", "cube"]) == {"cube": b"cube"}
        shapes.remove(5)
        assert made_up(shapes) == {"cube"}
        shapes.add(*self.part(shapes, "ball", "again"), BALL)
        assert shapes.surfaces(["ball"]) == {"ball": BALL}

    @one_kind
    def test_surfaces_refused_write_leaves_none(self, shapes: Store) -> None:
        with pytest.raises(EnvironmentExistsError):
            shapes.add(*self.part(shapes, "cube", "five"), b"cube")
        assert made_up(shapes) == {"ball", "cone"}

    @one_kind
    def test_surfaces_snapshot_isolation(self, shapes: Store) -> None:
        reader = self.reopen(shapes)
        with reader.snapshot():
            assert reader.object(5).digest == "cone"
            shapes.remove(5)
            assert reader.surfaces(["cone"]) == {"cone": CONE}
        assert reader.surfaces(["cone"]) == {}
        reader.close()

    @one_kind
    def test_pairs_in_order(self, store: Store) -> None:
        revision = store.revision()
        assert list(store.pairs()) == []
        store.put_pairs([SECOND, FIRST])
        assert list(store.pairs()) == [FIRST, SECOND]
        changed = SECOND._replace(kind=Kind.TOUCHING, at_most=0.0, status="changed", revision=3)
        store.put_pairs([changed], [(1, 2), (7, 8)])
        assert list(store.pairs()) == [changed]
        store.put_pairs([], [(1, 3)])
        assert list(store.pairs()) == []
        assert store.revision() == revision

    @one_kind
    def test_put_pairs_later_revision_wins(self, store: Store) -> None:
        store.put_pairs([FIRST])
        store.put_pairs([FIRST._replace(kind=Kind.TOUCHING, revision=1)])
        assert list(store.pairs()) == [FIRST]

    @one_kind
    def test_put_pairs_mark_of_last_writer(self, store: Store) -> None:
        assert store.pairs().mark == Mark()
        mine = store.put_pairs([FIRST], was=Mark())
        assert mine is not None
        assert store.pairs().mark == mine
        assert store.put_pairs([SECOND], [(7, 8)], Mark(), Mark("a setting", 9)) is None
        theirs = store.pairs().mark
        assert theirs not in {mine, Mark(), Mark("a setting", 9)}
        assert store.put_pairs([], was=theirs, now=Mark("a setting", 9)) == Mark("a setting", 9)
        assert store.put_pairs([], was=Mark("a setting", 9), now=Mark("another", 2)) is not None
        assert store.pairs().mark == Mark("another", 2)
        store.accept_pair(1, 2, "a press fit", "ball cone")
        kept = store.pairs()
        assert kept.mark == Mark("another", 2)
        assert [row[:2] for row in kept] == [(1, 2), (1, 3)]
        assert [[row[:2] for row in part] for part in kept.parted({3})] == [[(1, 3)], [(1, 2)]]

    @one_kind
    def test_accept_pair_outlasts_new_measurement(self, store: Store) -> None:
        store.put_pairs([FIRST])
        store.accept_pair(1, 2, "a press fit", "ball cone")
        store.accept_pair(4, 5, "nothing", "at all")
        store.put_pairs([FIRST._replace(at_least=0.2)])
        accepted = FIRST._replace(at_least=0.2, because="a press fit", shapes="ball cone")
        assert list(store.pairs()) == [accepted]
        store.accept_pair(1, 2, None, None)
        assert list(store.pairs()) == [FIRST._replace(at_least=0.2)]

    @one_kind
    def test_pairs_snapshot_isolation(self, store: Store) -> None:
        store.put_pairs([FIRST])
        reader = self.reopen(store)
        with reader.snapshot():
            assert list(reader.pairs()) == [FIRST]
            store.put_pairs([SECOND])
            assert list(reader.pairs()) == [FIRST]
        assert list(reader.pairs()) == [FIRST, SECOND]
        reader.close()

    @one_kind
    def test_change_rules_order_and_replacement(self, store: Store) -> None:
        revision = store.revision()
        assert store.rules() == ()
        meant = Rule(
            "bolts/*", "*", "meant", (Kind.OVERLAPPING, Kind.NOT_KNOWN), 3e-4, "thr\u00e9ads"
        )
        others = Rule("a", "b,c", "apart", (), 0.002), Rule("b", "x=1", "ignore", because="")
        change_to(store, meant, *others)
        assert store.rules() == (meant, *others)
        change_to(store, *others)
        for wrong in (
            meant._replace(length=float("inf")), meant._replace(kinds=()),
            others[0]._replace(length=None), others[0]._replace(kinds=(Kind.INSIDE,)),
        ):  # fmt: skip
            with pytest.raises(UsageError, match="rule 2"):
                change_to(store, meant, wrong)
        assert store.rules() == others
        store.change_rules(lambda old: [meant, *old])
        assert store.rules() == (meant, *others)
        assert store.revision() == revision

"""What every engine must pass: the contract suite, and scenes with a closed form.

An engine's tests subclass `StoreContract` and say how a store is made and opened again::

    class TestMyStore(StoreContract):
        def make(self, grid, layout, name="environment"):
            return MyStore.create(..., grid, layout)

        def reopen(self, store):
            return MyStore.open(store.url)

Needs pytest.
"""

import contextlib
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from hapticdb.errors import (
    ConflictError,
    EnvironmentExistsError,
    ObjectNotFoundError,
    UsageError,
)
from hapticdb.grid import CurveName, Grid
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.query.grouping import object_ranges
from hapticdb.store.base import (
    Covering,
    Frame,
    Keys,
    Layout,
    Object,
    Store,
    SupportsStatement,
    SupportsWatch,
    row_shift,
)

KINDS: list[tuple[Layout, CurveName]] = [
    ("voxel", "z"),
    ("voxel", "hilbert"),
    ("voxel", "lexicographic"),
    ("brick", "z"),
    ("brick", "hilbert"),
]
"""Every layout with every curve that it can have."""
NOTICED_S = 10.0
"""Patience with a notification, on a machine that does much else."""


def write_voxels(store: Store, ijk: NDArray[np.int64], name: str = "voxels") -> int:
    """Write voxels (n, 3) as an object of no file; returns its id."""
    return store.add(voxel_object(store.grid, ijk, name), rows_of_voxels(ijk, *_kind(store)))


def voxel_object(grid: Grid, ijk: NDArray[np.int64], name: str = "voxels") -> Object:
    """Record of an object made of voxels (n, 3)."""
    bounds = np.array(grid.origin) + grid.voxel_size * np.stack([ijk.min(0), ijk.max(0) + 1])
    return Object(
        name=name,
        link="made",
        digest=f"{len(ijk)} voxels",
        transform=np.eye(4),
        voxels=len(ijk),
        bounds=bounds,
        attributes={"made": True},
    )


def floor_voxels(grid: Grid, depth: int = 8, width: int = 32) -> NDArray[np.int64]:
    """Voxels (n, 3) of a solid floor: its top is the plane between k = side/2 - 1 and side/2."""
    middle = grid.side // 2
    half = min(width // 2, middle)
    across = np.arange(middle - half, middle + half)
    down = np.arange(max(middle - depth, 0), middle)
    return np.stack(np.meshgrid(across, across, down, indexing="ij"), axis=-1).reshape(-1, 3)


def is_noticed(watcher: SupportsWatch) -> bool:
    """Whether a commit comes to be noticed: on a server, as soon as its notification is here."""
    deadline = time.monotonic() + NOTICED_S
    while not watcher.has_changed():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.0005)
    return True


def _kind(store: Store) -> tuple[Grid, Layout]:
    return store.grid, store.layout


def _covering(store: Store) -> Covering:
    def ranges(obj: Object) -> list[tuple[int, int]]:
        found = object_ranges(store.grid, store.layout, obj.bounds)
        return list(zip(found.lows.tolist(), found.highs.tolist(), strict=True))

    return ranges


class StoreContract:
    """Tests of one engine, over every layout and curve. Subclass and override two methods."""

    def make(self, grid: Grid, layout: Layout, name: str = "environment") -> Store:
        """Make a new store; another name, another one beside it."""
        raise NotImplementedError

    def reopen(self, store: Store) -> Store:
        """Open the same environment by a second connection."""
        raise NotImplementedError

    @pytest.fixture(params=KINDS, ids="-".join)
    def store(self, request: pytest.FixtureRequest) -> Store:
        """Two overlapping blobs of voxels, ids 1 and 2, in a grid of 64^3."""
        layout, curve = request.param
        store = self.make(Grid(0.01, (-0.3, 0.1, 0.2), 6, curve), layout)
        write_voxels(store, blob(1, (20, 20, 20)), "one")
        write_voxels(store, blob(2, (24, 20, 20)), "two")
        return store

    @pytest.fixture
    def plain(self, store: Store) -> dict[int, set[int]]:
        """What the store holds, as row key -> ids."""
        found: dict[int, set[int]] = {}
        for object_id, ijk in ((1, blob(1, (20, 20, 20))), (2, blob(2, (24, 20, 20)))):
            for key in (store.grid.encode(ijk) >> row_shift(store.layout)).tolist():
                found.setdefault(key, set()).add(object_id)
        return found

    def test_lookup_finds_every_row_of_a_key_and_no_other(
        self, store: Store, plain: dict[int, set[int]]
    ) -> None:
        """Both forms of asking for keys."""
        keys = np.arange(0, max(plain) + 3, dtype=np.int64)[::3].copy()
        expected = [(k, i) for k in keys.tolist() for i in sorted(plain.get(k, ()))]
        asking: list[Callable[[Keys], object]] = [store.lookup, store.lookup_each]
        for ask in asking:
            rows = ask(keys)
            assert sorted(zip(rows.keys.tolist(), rows.ids.tolist(), strict=True)) == expected  # type: ignore[attr-defined]

    def test_scan_reads_closed_ranges_in_order(
        self, store: Store, plain: dict[int, set[int]]
    ) -> None:
        """Also ranges of one key, and many at once."""
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
        """Each brick's 512 bits."""
        if store.layout == "voxel":
            assert not store.lookup(np.zeros(1, dtype=np.int64)).occupancy.size
            return
        written = rows_of_voxels(blob(1, (20, 20, 20)), *_kind(store))
        rows = store.scan(written.keys[:1].copy(), written.keys[-1:].copy())
        mine = rows.occupancy.reshape(-1, 64)[rows.ids == 1]
        np.testing.assert_array_equal(mine, written.occupancy.reshape(-1, 64))

    def test_nothing_asked_is_nothing_found(self, store: Store) -> None:
        """Empty arrays cannot be bound by every engine."""
        none = np.empty(0, dtype=np.int64)
        assert len(store.lookup(none)) == len(store.scan(none, none)) == 0
        assert len(store.lookup_each(none)) == store.count(none, none) == 0

    def test_objects_return_as_written(self, store: Store) -> None:
        """Records, ordered by id, revisions counted."""
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

    def test_the_same_part_is_not_written_twice(self, store: Store) -> None:
        """Link and name are a part's identity; the failed write leaves nothing."""
        before = store.size().rows
        with pytest.raises(EnvironmentExistsError):
            write_voxels(store, blob(5, (40, 40, 40)), "one")
        assert store.size().rows == before
        assert store.revision() == 2

    def test_rows_of_leaves_the_others_out(self, store: Store) -> None:
        """Of two objects that overlap."""
        everywhere = [np.array([b], dtype=np.int64) for b in (0, 2**62)]
        written = rows_of_voxels(blob(2, (24, 20, 20)), *_kind(store))
        rows = store.rows_of(2, *everywhere)
        np.testing.assert_array_equal(rows.keys, written.keys)
        np.testing.assert_array_equal(rows.occupancy, written.occupancy)
        assert set(rows.ids.tolist()) == {2}
        assert not len(store.rows_of(3, *everywhere))

    def test_loading_ends_as_single_writes_do(self, store: Store) -> None:
        """Rows, ids and revisions; also when it is left by an error."""
        fresh = self.make(store.grid, store.layout, "loaded")
        with contextlib.suppress(ZeroDivisionError), fresh.loading(), fresh.loading():
            write_voxels(fresh, blob(1, (20, 20, 20)), "one")
            write_voxels(fresh, blob(2, (24, 20, 20)), "two")
            raise ZeroDivisionError
        everywhere = [np.array([b], dtype=np.int64) for b in (0, 2**62)]
        for found, expected in zip(fresh.scan(*everywhere), store.scan(*everywhere), strict=True):
            np.testing.assert_array_equal(found, expected)
        assert [obj.id for obj in fresh.objects()] == [1, 2]
        assert fresh.revision() == 2

    def test_an_id_is_kept_where_it_is_free(self, store: Store) -> None:
        """What moves house keeps its ids."""
        ijk = blob(5, (40, 40, 40))
        rows = rows_of_voxels(ijk, *_kind(store))
        nine = replace(voxel_object(store.grid, ijk, "nine"), id=9)
        assert store.add(nine, rows) == 9
        assert store.add(replace(nine, name="again"), rows) == 10
        assert write_voxels(store, ijk, "next") == 11

    def test_an_object_written_meanwhile_is_not_replaced(self, store: Store) -> None:
        """Whoever read it before is told, and nothing is changed."""
        rows = rows_of_voxels(blob(7, (44, 30, 10)), *_kind(store))
        seen = store.object(1)
        store.replace(seen, rows, _covering(store))
        with pytest.raises(ConflictError, match="written by another meanwhile"):
            store.replace(seen, rows, _covering(store))
        assert store.revision() == 3
        with pytest.raises(ObjectNotFoundError):
            store.replace(replace(seen, id=7), rows, _covering(store))

    def test_remove_takes_one_object_and_leaves_the_others(self, store: Store) -> None:
        """Rows and record go, in one revision; the id is never used again."""
        store.remove(1, _covering(store))
        assert [obj.id for obj in store.objects()] == [2]
        rows = store.scan(*(np.array([b], dtype=np.int64) for b in (0, 2**62)))
        assert set(rows.ids.tolist()) == {2}
        assert len(rows) == len(rows_of_voxels(blob(2, (24, 20, 20)), *_kind(store)))
        assert write_voxels(store, blob(1, (20, 20, 20)), "one") == 3
        store.remove(2, _covering(store))
        with pytest.raises(ObjectNotFoundError):
            store.remove(2, _covering(store))

    def test_removed_parts_are_known_until_they_are_there_again(self, store: Store) -> None:
        """By the name of their file; of another file none."""
        link = store.object(1).link
        assert store.removed(link) == set()
        store.remove(1, _covering(store))
        store.remove(2, _covering(store))
        assert store.removed(link) == {"one", "two"}
        assert store.removed(f"{link}.other") == set()
        write_voxels(store, blob(1, (20, 20, 20)), "one")
        assert store.removed(link) == {"two"}

    def test_replace_moves_the_rows(self, store: Store) -> None:
        """Old rows go, new ones come, the id stays."""
        ijk = blob(7, (44, 30, 10))
        new = voxel_object(store.grid, ijk, "one")
        moved = Object(**{**vars(new), "id": 1})
        rows = rows_of_voxels(ijk, *_kind(store))
        store.replace(moved, rows, _covering(store))
        found = store.scan(*(np.array([b], dtype=np.int64) for b in (0, 2**62)))
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
        store.remove(1, _covering(store))
        assert [c.action for c in store.changes(since=2)] == ["remove"]

    def test_a_snapshot_sees_one_revision(self, store: Store) -> None:
        """Another connection's commit shows after it, and changes the version."""
        reader = self.reopen(store)
        before = reader.size().rows
        with reader.snapshot():
            assert len(reader.objects()) == 2
            store.remove(1, _covering(store))
            assert len(reader.objects()) == 2
            assert reader.size().rows == before
            version = reader.version()
        assert len(reader.objects()) == 1
        assert reader.version() != version
        reader.close()

    def test_a_commit_of_another_is_noticed_once(self, store: Store) -> None:
        """Of every kind of write; a rolled-back one hides none that comes after it."""
        reader = self.reopen(store)
        if not isinstance(reader, SupportsWatch):
            return
        reader.watch()
        assert not reader.has_changed()
        rows = rows_of_voxels(blob(7, (44, 30, 10)), *_kind(store))
        with pytest.raises(EnvironmentExistsError):
            write_voxels(store, blob(3, (20, 20, 20)), "one")
        writes: list[Callable[[], object]] = [
            lambda: write_voxels(store, blob(3, (20, 20, 20)), "three"),
            lambda: store.replace(store.object(1), rows, _covering(store)),
            lambda: store.remove(2, _covering(store)),
        ]
        for write in writes:
            write()
            assert is_noticed(reader)
            assert not reader.has_changed()
        reader.close()

    def test_none_of_many_commits_is_missed(self, store: Store) -> None:
        """Each after it was committed; and those of one moment together."""
        reader = self.reopen(store)
        if not isinstance(reader, SupportsWatch):
            return
        voxel = np.array([[1, 2, 3]])
        for n in range(100):
            if n % 10 == 0:
                reader.watch()
            write_voxels(store, voxel, f"{n}")
            assert is_noticed(reader)
            assert reader.revision() == n + 3
        for n in range(5):
            write_voxels(store, voxel, f"again {n}")
        assert is_noticed(reader)
        reader.close()

    def test_reading_neither_hides_a_commit_nor_invents_one(self, store: Store) -> None:
        """Though what was read holds the commit already."""
        reader = self.reopen(store)
        if not isinstance(reader, SupportsWatch):
            return
        reader.watch()
        everywhere = [np.array([b], dtype=np.int64) for b in (0, 2**62)]
        for _ in range(3):
            reader.scan(*everywhere)
            reader.objects()
            assert not reader.has_changed()
        store.remove(1, _covering(store))
        assert set(reader.scan(*everywhere).ids.tolist()) == {2}
        assert len(reader.objects()) == 1
        assert is_noticed(reader)
        reader.close()

    def test_a_commit_during_a_snapshot_is_noticed_after_it(self, store: Store) -> None:
        """Inside, asking is refused: nothing changes there."""
        reader = self.reopen(store)
        if not isinstance(reader, SupportsWatch):
            return
        reader.watch()
        with reader.snapshot():
            assert len(reader.objects()) == 2
            store.remove(1, _covering(store))
            with pytest.raises(UsageError, match="inside a snapshot nothing changes"):
                reader.has_changed()
            assert len(reader.objects()) == 2
        assert is_noticed(reader)
        reader.close()

    @pytest.mark.parametrize("resolution", [1, 3, 7, 100, 5000])
    def test_quantiles_follow_definition_2(self, store: Store, resolution: int) -> None:
        """Bound i is the key of rank ceil(i N / v) among all rows, ties counted one by one."""
        rows = store.scan(*(np.array([b], dtype=np.int64) for b in (0, 2**62)))
        keys = np.sort(rows.keys)
        bounds, n_rows, _ = store.quantiles(resolution)
        ranks = [max(-(-i * len(keys) // resolution), 1) for i in range(resolution + 1)]
        assert n_rows == len(keys)
        assert bounds.tolist() == [int(keys[rank - 1]) for rank in ranks]

    def test_kept_quantiles_are_never_stale(self, store: Store) -> None:
        """After a write they are computed anew."""
        store.analyze(10)
        kept = store.quantiles(10)
        assert kept.source == "kept"
        store.remove(1, _covering(store))
        anew = store.quantiles(10)
        assert anew.source == "computed"
        assert anew.n_rows < kept.n_rows

    def test_freshness_counts_the_writes_since(self, store: Store) -> None:
        """Unknown before, none right after, one after a removal."""
        assert store.freshness(10).revision is None
        store.analyze(10)
        assert store.freshness(10) == (2, 0, 0)
        store.remove(1, _covering(store))
        assert store.freshness(10)[:2] == (2, 1)
        store.analyze(10)
        assert store.freshness(10)[:2] == (3, 0)

    def test_costs_are_kept_by_machine(self, store: Store) -> None:
        """Figures return as saved."""
        assert store.costs("here") is None
        store.save_costs("here", {"row": 0.25, "row.spread": 0.5})
        assert store.costs("here") == {"row": 0.25, "row.spread": 0.5}
        assert store.costs("there") is None

    def test_an_environment_is_told_from_another(self) -> None:
        """However it was opened, and however alike the other is."""
        grid = Grid(0.01, (0, 0, 0), 5)
        one, other = self.make(grid, "brick"), self.make(grid, "brick", "other")
        again = self.reopen(one)
        assert one.identity == again.identity != other.identity
        again.close()
        one.discard()
        other.discard()

    def test_an_empty_environment_answers(self) -> None:
        """No rows, no objects, no revision."""
        store = self.make(Grid(0.01, (0, 0, 0), 5), "brick")
        assert store.revision() == store.size().rows == len(store.objects()) == 0
        assert not list(store.changes())
        assert store.quantiles(10)[1] == 0
        store.discard()

    def test_figure_3_finds_the_hits_and_leaves_out_the_excluded(self, store: Store) -> None:
        """EXISTS and force() inside the engine, where it can."""
        if not isinstance(store, SupportsStatement):
            return
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
        frame = Frame(placed, keys, 1000.0, none)
        ordinals, ids = store.statement_hits(frame)
        assert sorted(zip(ordinals.tolist(), ids.tolist(), strict=True)) == [(0, 1), (0, 2), (1, 1)]
        np.testing.assert_allclose(store.statement(frame)[:3], [0, 0, 4.0])
        without = frame._replace(exclude=np.array([1], dtype=np.int64))
        np.testing.assert_allclose(store.statement(without)[:3], [0, 0, 2.0])
        nothing = frame._replace(exclude=np.array([1, 2], dtype=np.int64))
        assert not store.statement(nothing).any()
        assert not len(store.statement_hits(nothing)[0])


def blob(seed: int, center: tuple[int, int, int], radius: int = 8) -> NDArray[np.int64]:
    """Distinct voxels (n, 3) around a centre: dense inside, random at the rim."""
    rng = np.random.default_rng(seed)
    span = np.arange(-radius, radius + 1)
    offsets = np.stack(np.meshgrid(span, span, span, indexing="ij"), axis=-1).reshape(-1, 3)
    distance = np.linalg.norm(offsets, axis=1)
    inside = distance < rng.uniform(radius / 2, radius, len(offsets))
    found: NDArray[np.int64] = offsets[inside] + np.array(center)
    return found

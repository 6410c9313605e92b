"""Tests of a store beside others: snapshots, threads, closing, and the commits of others."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from children import TIMEOUT
from contract.case import StoreCase, one_kind
from hapticdb.errors import DatabaseError, EnvironmentExistsError, ReadOnlyError, UsageError
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.store.base import Store
from voxels import EVERYWHERE, blob, is_noticed, kind, write_voxels


class SharingContract(StoreCase):
    @one_kind
    def test_snapshot_one_revision(self, store: Store) -> None:
        reader = self.reopen(store)
        before = reader.size().rows
        with reader.snapshot():
            assert len(reader.objects()) == 2
            store.remove(1)
            assert len(reader.objects()) == 2
            assert reader.size().rows == before
            version = reader.version()
        assert len(reader.objects()) == 1
        assert reader.version() != version
        reader.close()

    @one_kind
    def test_store_other_thread_refused(self, store: Store) -> None:
        with (
            ThreadPoolExecutor(1) as thread,
            pytest.raises(UsageError, match="belongs to the thread that opened it"),
        ):
            thread.submit(store.objects).result(TIMEOUT)
        assert len(store.objects()) == 2

    @one_kind
    def test_store_closed(self, store: Store) -> None:
        store.close()
        with pytest.raises(DatabaseError):
            store.objects()

    @one_kind
    def test_store_read_only_refuses_writes(self, store: Store) -> None:
        reader = self.reopen(store)
        writes: list[Callable[[], object]] = [
            lambda: write_voxels(reader, blob(3, (20, 20, 20)), "three"),
            lambda: reader.save_costs("here", {"row": 0.25}),
            lambda: reader.put_pairs([]),
        ]
        for write in writes:
            with pytest.raises(ReadOnlyError):
                write()
        assert store.revision() == 2
        assert store.costs("here") is None
        reader.close()

    @one_kind
    def test_has_changed_once_per_commit(self, store: Store) -> None:
        reader = self.reopen(store)
        reader.watch()
        assert not reader.has_changed()
        rows = rows_of_voxels(blob(7, (44, 30, 10)), *kind(store))
        with pytest.raises(EnvironmentExistsError):
            write_voxels(store, blob(3, (20, 20, 20)), "one")
        writes: list[Callable[[], object]] = [
            lambda: write_voxels(store, blob(3, (20, 20, 20)), "three"),
            lambda: store.replace(store.object(1), rows),
            lambda: store.remove(2),
        ]
        for write in writes:
            write()
            assert is_noticed(reader)
            assert not reader.has_changed()
        reader.close()

    @one_kind
    def test_has_changed_no_commit_missed(self, store: Store) -> None:
        reader = self.reopen(store)
        voxel = np.array([[1, 2, 3]])
        for n in range(30):
            if n % 10 == 0:
                reader.watch()
            write_voxels(store, voxel, f"{n}")
            assert is_noticed(reader)
            assert reader.revision() == n + 3
        for n in range(5):
            write_voxels(store, voxel, f"again {n}")
        assert is_noticed(reader)
        reader.close()

    @one_kind
    def test_has_changed_independent_of_reads(self, store: Store) -> None:
        reader = self.reopen(store)
        reader.watch()
        for _ in range(3):
            reader.scan(*EVERYWHERE)
            reader.objects()
            assert not reader.has_changed()
        store.remove(1)
        assert set(reader.scan(*EVERYWHERE).ids.tolist()) == {2}
        assert len(reader.objects()) == 1
        assert is_noticed(reader)
        reader.close()

    @one_kind
    def test_has_changed_after_snapshot(self, store: Store) -> None:
        """Inside the snapshot `has_changed` is refused, because no commit is visible there."""
        reader = self.reopen(store)
        reader.watch()
        with reader.snapshot():
            assert len(reader.objects()) == 2
            store.remove(1)
            with pytest.raises(UsageError, match="inside a snapshot nothing changes"):
                reader.has_changed()
            assert len(reader.objects()) == 2
        assert is_noticed(reader)
        reader.close()

"""Tests of a store beside others: snapshots, threads, closing, and the commits of others."""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np
import pytest

from hapticdb.errors import DatabaseError, EnvironmentExistsError, ReadOnlyError, UsageError
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.store.base import Rows, Store, SupportsWatch
from hapticdb.store.covering import covering
from hapticdb.store.threads import NOBODY, this_thread
from hapticdb.testing.scenes import EVERYWHERE, StoreCase, blob, everything, kind, write_voxels

ANSWER_S = 60.0
"""Seconds to wait for another thread. A larger value only delays the failure of a test."""


Result = TypeVar("Result")


def _in_another_thread(call: Callable[[], Result]) -> Result:
    """Run a call in a thread of its own; returns its result or raises its error."""
    with ThreadPoolExecutor(1) as threads:
        return threads.submit(call).result(ANSWER_S)


NOTICED_S = 10.0
"""Seconds to wait for a notification of a commit. A larger value only delays a test's failure."""


def is_noticed(watcher: SupportsWatch) -> bool:
    """Whether a commit is noticed in time; on a server its notification takes a moment."""
    deadline = time.monotonic() + NOTICED_S
    while not watcher.has_changed():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.0005)
    return True


class SharingContract(StoreCase):
    """Tests of a store's owner thread, and of the commits of others that it reads and notices."""

    def test_a_snapshot_sees_one_revision(self, store: Store) -> None:
        """Another connection's commit appears after the snapshot, and changes the version."""
        reader = self.reopen(store)
        before = reader.size().rows
        with reader.snapshot():
            assert len(reader.objects()) == 2
            store.remove(1, covering(store))
            assert len(reader.objects()) == 2
            assert reader.size().rows == before
            version = reader.version()
        assert len(reader.objects()) == 1
        assert reader.version() != version
        reader.close()

    def test_a_store_belongs_to_the_thread_that_opened_it(self, store: Store) -> None:
        """Another thread is refused, and the first can go on."""
        with pytest.raises(UsageError, match="belongs to the thread that opened it"):
            _in_another_thread(store.objects)
        assert len(store.objects()) == 2

    def test_a_store_is_handed_from_thread_to_thread(self, store: Store) -> None:
        """In between nobody owns it, as in a pool."""
        expected = everything(store)
        store.give_to(NOBODY)
        with pytest.raises(UsageError, match="belongs to the thread that opened it"):
            store.objects()

        def borrowed() -> Rows:
            store.give_to(this_thread())
            found = everything(store)
            store.give_to(NOBODY)
            return found

        for found, wanted in zip(_in_another_thread(borrowed), expected, strict=True):
            np.testing.assert_array_equal(found, wanted)
        store.give_to(this_thread())
        assert len(store.objects()) == 2

    def test_a_closed_store_says_so(self, store: Store) -> None:
        """Each call is refused."""
        assert not store.is_closed
        store.close()
        assert store.is_closed
        with pytest.raises(DatabaseError):
            store.objects()

    def test_a_store_opened_to_read_refuses_to_write(self, store: Store) -> None:
        """It refuses to write objects and cost figures."""
        reader = self.reopen(store)
        if reader.is_read_only:
            with pytest.raises(ReadOnlyError):
                write_voxels(reader, blob(3, (20, 20, 20)), "three")
            with pytest.raises(ReadOnlyError):
                reader.save_costs("here", {"row": 0.25})
        assert store.revision() == 2
        assert store.costs("here") is None
        reader.close()

    def test_a_commit_of_another_is_noticed_once(self, store: Store) -> None:
        """Every kind of write is noticed. A rolled-back write hides no later commit."""
        self.need("watch")
        reader = self.reopen(store)
        assert isinstance(reader, SupportsWatch)
        reader.watch()
        assert not reader.has_changed()
        rows = rows_of_voxels(blob(7, (44, 30, 10)), *kind(store))
        with pytest.raises(EnvironmentExistsError):
            write_voxels(store, blob(3, (20, 20, 20)), "one")
        writes: list[Callable[[], object]] = [
            lambda: write_voxels(store, blob(3, (20, 20, 20)), "three"),
            lambda: store.replace(store.object(1), rows, covering(store)),
            lambda: store.remove(2, covering(store)),
        ]
        for write in writes:
            write()
            assert is_noticed(reader)
            assert not reader.has_changed()
        reader.close()

    def test_none_of_many_commits_is_missed(self, store: Store) -> None:
        """Single commits are noticed one by one, and several quick commits together."""
        self.need("watch")
        reader = self.reopen(store)
        assert isinstance(reader, SupportsWatch)
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

    def test_reading_neither_hides_a_commit_nor_invents_one(self, store: Store) -> None:
        """The read returned the commit already, but `has_changed` still reports it."""
        self.need("watch")
        reader = self.reopen(store)
        assert isinstance(reader, SupportsWatch)
        reader.watch()
        for _ in range(3):
            reader.scan(*EVERYWHERE)
            reader.objects()
            assert not reader.has_changed()
        store.remove(1, covering(store))
        assert set(reader.scan(*EVERYWHERE).ids.tolist()) == {2}
        assert len(reader.objects()) == 1
        assert is_noticed(reader)
        reader.close()

    def test_a_commit_during_a_snapshot_is_noticed_after_it(self, store: Store) -> None:
        """Inside the snapshot `has_changed` is refused, because no commit is visible there."""
        self.need("watch")
        reader = self.reopen(store)
        assert isinstance(reader, SupportsWatch)
        reader.watch()
        with reader.snapshot():
            assert len(reader.objects()) == 2
            store.remove(1, covering(store))
            with pytest.raises(UsageError, match="inside a snapshot nothing changes"):
                reader.has_changed()
            assert len(reader.objects()) == 2
        assert is_noticed(reader)
        reader.close()

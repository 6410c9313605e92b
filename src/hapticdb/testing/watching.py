"""Tests of watching: every commit of others is noticed, and nothing else."""

import time
from collections.abc import Callable

import numpy as np
import pytest

from hapticdb.errors import (
    EnvironmentExistsError,
    UsageError,
)
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.query.grouping import covering
from hapticdb.store.base import (
    Store,
    SupportsWatch,
)
from hapticdb.testing.case import StoreCase
from hapticdb.testing.scenes import (
    EVERYWHERE,
    blob,
    kind,
    write_voxels,
)

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


class WatchContract(StoreCase):
    """Tests of the capability `watch`."""

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

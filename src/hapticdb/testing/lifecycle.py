"""Tests of a store's life: snapshots, threads, closing, opening to read only."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np
import pytest

from hapticdb.errors import (
    DatabaseError,
    ReadOnlyError,
    UsageError,
)
from hapticdb.query.grouping import covering
from hapticdb.store.base import (
    Rows,
    Store,
)
from hapticdb.store.threads import NOBODY, this_thread
from hapticdb.testing.case import StoreCase
from hapticdb.testing.scenes import (
    blob,
    everything,
    write_voxels,
)

ANSWER_S = 60.0
"""Seconds to wait for another thread. A larger value only delays the failure of a test."""


Result = TypeVar("Result")


def _in_another_thread(call: Callable[[], Result]) -> Result:
    """Run a call in a thread of its own; returns its result or raises its error."""
    with ThreadPoolExecutor(1) as threads:
        return threads.submit(call).result(ANSWER_S)


class LifecycleContract(StoreCase):
    """Tests of a store's owner thread, and of the commits of others that a store reads."""

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

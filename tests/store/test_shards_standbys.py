"""Shards with standbys: what they answer, what is asked of their primaries, and what stops."""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

import contextlib
import threading
import time
from collections.abc import Iterator
from typing import cast

import numpy as np
import pytest

from frozen import frozen
from hapticdb.errors import ShardAwayError
from hapticdb.store.connect import open_store
from hapticdb.store.postgres.shards.store import ShardedStore
from hapticdb.testing import write_voxels
from spread import HIGH, LOW, Spread, spread  # noqa: F401 - a fixture
from standbys import pair  # noqa: F401 - a fixture

EVERYWHERE = np.array([0]), np.array([2**62])


@contextlib.contextmanager
def reading(url: str) -> Iterator[ShardedStore]:
    with contextlib.closing(open_store(url, read_only=True)) as store:
        assert isinstance(store, ShardedStore)
        yield store


def ids_of(store: ShardedStore) -> list[int]:
    return sorted(store.scan(*EVERYWHERE).ids.tolist())


def answers_from_a_standby(store: ShardedStore) -> list[bool]:
    shards = store._shards
    return [shards.connection(n).is_standby for n in range(2)]


def test_what_prefers_standbys_reads_the_rows_of_a_shard_from_its_standby(spread: Spread) -> None:
    with reading(spread.url_of_standbys) as store, reading(spread.url) as other:
        assert ids_of(store) == ids_of(other) == [1, 2]
        assert answers_from_a_standby(store) == [False, True]
        assert answers_from_a_standby(other) == [False, False]
        told = store.shards()
        assert [shard.behind for shard in told] == [None, 0]


def test_a_writer_writes_to_the_primary_wherever_it_would_read(spread: Spread) -> None:
    with contextlib.closing(open_store(spread.url_of_standbys)) as store:
        write_voxels(store, HIGH, "third")
        assert answers_from_a_standby(cast("ShardedStore", store)) == [False, False]
        assert ids_of(cast("ShardedStore", store)) == [1, 2, 3]


def test_a_standby_that_lacks_what_the_coordinator_names_is_not_believed(spread: Spread) -> None:
    with reading(spread.url_of_standbys) as store:
        assert ids_of(store) == [1, 2]
        with spread.pair.paused():
            spread.write("third")
            assert store.shards()[1].behind == 1
            assert ids_of(store) == [1, 2, 3]
            assert answers_from_a_standby(store) == [False, False]
            partial = store.scan_partly(*EVERYWHERE)
            assert not len(partial.away) or 3 not in partial.rows.ids


def test_a_standby_is_asked_again_after_a_while(
    spread: Spread, monkeypatch: pytest.MonkeyPatch
) -> None:
    with reading(spread.url_of_standbys) as store:
        with spread.pair.paused():
            spread.write("third")
            assert ids_of(store) == [1, 2, 3]
        spread.pair.await_replay()
        assert answers_from_a_standby(store) == [False, False]
        monkeypatch.setitem(store._shards._back_at, 1, 0.0)  # as if `AT_PRIMARY_S` had passed
        assert ids_of(store) == [1, 2, 3]
        assert answers_from_a_standby(store) == [False, True]


def test_a_snapshot_reads_on_where_its_standby_is_behind(spread: Spread) -> None:
    with spread.pair.paused():
        spread.write("third")
        with reading(spread.url_of_standbys) as store, store.snapshot():
            assert ids_of(store) == [1, 2, 3]


def test_rows_are_read_from_a_standby_while_the_primary_is_away(spread: Spread) -> None:
    with reading(spread.url_of_standbys) as store:
        spread.pair.primary.kill()
        assert ids_of(store) == [1, 2]
        with reading(spread.url) as other:  # without a preference, the one that answers
            assert ids_of(other) == [1, 2]
        with pytest.raises(ShardAwayError, match=r"shard 2 \(.*the primary cannot be reached"):
            spread.write("third")


def test_rows_that_only_a_primary_has_are_refused_while_it_is_away(spread: Spread) -> None:
    with reading(spread.url_of_standbys) as store:
        assert ids_of(store) == [1, 2]
        with spread.pair.paused():
            spread.write("third")
            spread.pair.primary.kill()
            with pytest.raises(ShardAwayError, match=r"shard 2 \("):
                store.scan(*EVERYWHERE)
            partial = store.scan_partly(*EVERYWHERE)
            assert partial.rows.ids.tolist() == [1]
            assert len(partial.away)


def test_partial_reads_turn_to_the_primary_and_back(
    spread: Spread, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Shard 2 is never left out for longer than it takes to connect to another of its servers."""
    with reading(spread.url_of_standbys) as store:
        with spread.pair.paused():
            spread.write("third")
            until_whole(store, [1, 2, 3])
            assert answers_from_a_standby(store) == [False, False]
        spread.pair.await_replay()
        shards = store._shards
        monkeypatch.setitem(shards._back_at, 1, 0.0)
        end = time.monotonic() + 60
        while not answers_from_a_standby(store)[1]:
            assert time.monotonic() < end
            partial = store.scan_partly(*EVERYWHERE)
            assert sorted(partial.rows.ids.tolist()) == [1, 2, 3]


def test_partial_reads_do_not_wait_for_a_standby_that_hangs(spread: Spread) -> None:
    with reading(f"{spread.url_of_standbys}&connect_timeout=600") as store:
        until_whole(store, [1, 2])
        assert answers_from_a_standby(store) == [False, True]
        with frozen(spread.pair.standby):
            assert len(store.scan_partly(*EVERYWHERE).away)
            until_whole(store, [1, 2])
            assert answers_from_a_standby(store) == [False, False]


def until_whole(store: ShardedStore, ids: list[int]) -> None:
    end = time.monotonic() + 60
    while True:
        partial = store.scan_partly(*EVERYWHERE)
        if not len(partial.away):
            break
        assert time.monotonic() < end
        time.sleep(0.01)
    assert sorted(partial.rows.ids.tolist()) == ids


@pytest.mark.long
def test_readers_of_standbys_see_whole_objects_while_others_write(spread: Spread) -> None:
    """Each object spans both shards: a reader sees its rows on both, or on neither."""
    both, ending = np.concatenate([LOW, HIGH]), threading.Event()

    def write_on() -> None:
        with contextlib.closing(open_store(spread.url)) as store:
            for n in range(60):
                write_voxels(store, both, f"both {n}")
                time.sleep(0.01 * (n % 5))
        ending.set()

    writer = threading.Thread(target=write_on, daemon=True)
    writer.start()
    with reading(spread.url_of_standbys) as store:
        seen = last = 0
        while not ending.is_set():
            ids, counts = np.unique(store.scan(*EVERYWHERE).ids, return_counts=True)
            assert (counts[ids > 2] == 2).all()
            assert len(ids) >= last
            last, seen = len(ids), seen + 1
        assert ids_of(store)[-1] == 62
    writer.join(60)
    assert seen

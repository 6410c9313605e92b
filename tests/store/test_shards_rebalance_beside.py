"""Borders between shards move while others read, write and rebalance."""

import contextlib
import threading
from collections.abc import Callable

import numpy as np
import pytest

from children import PATIENCE
from hapticdb.errors import AccessError, BusyError, OutdatedError, ShardAwayError
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.store.base import CELL_SHIFT, row_shift
from hapticdb.store.postgres.connecting import connection
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.shards.borders import carrying, rebalancing
from hapticdb.store.postgres.shards.borders.moves import Move
from hapticdb.store.postgres.shards.store import ShardedStore
from hapticdb.store.sharding import RebalanceProgress
from hapticdb.testing.scenes import (
    everything,
    write_voxels,
)
from rebalanced import (  # noqa: F401 - a fixture among them
    GRID,
    assert_only_own_rows,
    contents,
    listed,
    made,
    replace,
    shape,
    small_batches,
)
from servers import Place
from sharded import ShardedServers

pytestmark = pytest.mark.usefixtures("small_batches")


def test_readers_and_a_writer_beside_it_see_whole_objects(sharded_place: Place) -> None:
    url = sharded_place()
    troubles: list[BaseException] = []
    ending = threading.Event()
    n_read = [0, 0, 0]
    n_outdated = [0, 0, 0]
    shapes = [shape(1000), shape(3000), shape(4000)]
    with made(url) as store:
        before = everything(store)
        others = {i: before.keys[before.ids == i].tolist() for i in np.unique(before.ids).tolist()}
        known = [rows_of_voxels(s, GRID, "brick").keys.tolist() for s in shapes]

        def read(number: int) -> None:
            with contextlib.closing(ShardedStore.open(url, read_only=True)) as mine:
                while not ending.is_set():
                    inside = mine.snapshot() if number else contextlib.nullcontext()
                    try:
                        with inside:
                            rows = everything(mine)
                            again = everything(mine) if number else rows
                    except OutdatedError:
                        n_outdated[number] += 1
                        continue
                    assert listed(rows) == listed(again)
                    assert rows.keys[rows.ids == 5].tolist() in known
                    for object_id, keys in others.items():
                        assert object_id == 5 or rows.keys[rows.ids == object_id].tolist() == keys
                    n_read[number] += 1

        def write() -> None:
            with contextlib.closing(ShardedStore.open(url)) as mine:
                n = 0
                while not ending.is_set():
                    n += 1
                    replace(mine, 5, shapes[n % 3])

        def run(work: Callable[..., None], *args: int) -> None:
            try:
                work(*args)
            except BaseException as error:  # noqa: BLE001 - the test raises it
                troubles.append(error)
                ending.set()

        threads = [threading.Thread(target=run, args=(read, n)) for n in range(3)]
        threads.append(threading.Thread(target=run, args=(write,)))
        for thread in threads:
            thread.start()
        try:
            mover, n_batches = store._rebalancer, 0
            number = mover._begun()
            for cells in ((0, 20, 40), (0, 0, 10), (0, 50, 60)):
                wanted = np.array(cells, dtype=np.int64) << CELL_SHIFT
                while not ending.is_set() and mover._moved(wanted, number) is not None:
                    n_batches += 1
                mover._deleted(number)
            store.rebalance()
        finally:
            ending.set()
            for thread in threads:
                thread.join(PATIENCE)
        assert troubles == []
        assert n_batches > 20
        assert min(n_read) > 0
        after = everything(store)
        for object_id, keys in others.items():
            assert object_id == 5 or after.keys[after.ids == object_id].tolist() == keys
        assert after.keys[after.ids == 5].tolist() in known


def test_a_snapshot_keeps_its_rows_until_it_ends(sharded_place: Place) -> None:
    url = sharded_place()
    with made(url) as store, contextlib.closing(ShardedStore.open(url, read_only=True)) as other:
        store.give_to(0)
        with other.snapshot():
            rows = listed(everything(other))

            def work() -> None:
                store.give_to(threading.get_ident())
                store.rebalance()

            ended = threading.Thread(target=work)
            ended.start()
            moved = "SELECT count(*) FROM shard, distribution WHERE first_key < %s AND epoch > %s"
            with contextlib.closing(ShardedStore.open(url, read_only=True)) as third:
                for _ in range(int(PATIENCE / 0.05)):
                    if third.connection.rows(moved, (64 << CELL_SHIFT, 5)) == [(3,)]:
                        break
                    ended.join(0.05)
            assert listed(everything(other)) == rows
            assert ended.is_alive()
        ended.join(PATIENCE)
        assert not ended.is_alive()
        assert listed(everything(other)) == rows


def test_a_snapshot_that_lasts_too_long_learns_that_its_rows_have_gone(
    sharded_place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rebalancing, "SNAPSHOT_SECONDS", 0.0)
    url = sharded_place()
    with made(url) as store, contextlib.closing(ShardedStore.open(url, read_only=True)) as other:
        rows = listed(everything(other))
        with other.snapshot():
            store.rebalance()
            with pytest.raises(OutdatedError):
                everything(other)
        assert listed(everything(other)) == rows


@pytest.mark.parametrize("limit", [1, 7, 50])
def test_rows_read_piece_by_piece_miss_none_as_borders_move(
    sharded_place: Place, limit: int
) -> None:
    url = sharded_place()
    with made(url) as store, contextlib.closing(ShardedStore.open(url, read_only=True)) as other:
        before = everything(store)
        mover = store._rebalancer
        number = mover._begun()
        places = [(0, 20, 40), (0, 1, 64), (0, 0, 0), (0, 64, 64), (0, 30, 31)]
        key, object_id, n_asked = -1, 0, 0
        found: list[tuple[int, int]] = []
        while len(rows := other.checker().rows_after(key, object_id, limit)):
            key, object_id = int(rows.keys[-1]), int(rows.ids[-1])
            found += zip(rows.keys.tolist(), rows.ids.tolist(), strict=True)
            if n_asked % max(100 // limit, 1) == 0:
                wanted = np.array(places[n_asked % 5], dtype=np.int64) << CELL_SHIFT
                mover._moved(wanted, number)  # one batch of it
            n_asked += 1
        assert found == list(zip(before.keys.tolist(), before.ids.tolist(), strict=True))


# --- refused ------------------------------------------------------------------------------------


def test_a_second_rebalance_at_the_same_time_is_refused(sharded_place: Place) -> None:
    url = sharded_place()
    with made(url) as store, contextlib.closing(ShardedStore.open(url)) as other:
        refusals: list[str] = []

        def second(_: RebalanceProgress) -> None:
            if not refusals:
                with pytest.raises(BusyError) as caught:
                    other.rebalance()
                refusals.append(str(caught.value))

        store.rebalance(second)
        assert "is being rebalanced by another" in refusals[0]
        assert "\n" not in refusals[0]
        assert other.rebalance().moved_rows == 0


def test_a_rebalance_that_has_lost_its_lock_changes_nothing_more(sharded_place: Place) -> None:
    url = sharded_place()
    with made(url) as store, contextlib.closing(ShardedStore.open(url)) as other:
        before = contents(store)
        mine, later = store._rebalancer, other._rebalancer
        old = mine._begun()
        wanted = np.array([0, 20, 40], dtype=np.int64) << CELL_SHIFT
        while mine._moved(wanted, old) is not None:
            pass
        state = mine._state()
        # the later one moves all rows back to the first shard, where copies still lie
        number = later._begun()
        back = np.array([0, 64, 64], dtype=np.int64) << CELL_SHIFT
        while later._moved(back, number) is not None:
            pass
        with pytest.raises(BusyError, match="another rebalance has begun"):
            mine._moved(wanted, old)
        shard = mine._shards.connection(0)
        with pytest.raises(BusyError, match="another rebalance has begun"):
            mine._delete(shard, mine._row_ends(state.borders)[0], state.epoch, old)
        carrier = carrying.Carrier("brick", row_shift("brick"), old)
        move = Move(1, 0, 20 << CELL_SHIFT, 40 << CELL_SHIFT, is_from_top=False)
        with pytest.raises(BusyError, match="another rebalance has begun"):
            carrier.carry(mine._shards.connection(1), shard, move, state.epoch)
        assert contents(store) == before


def test_only_the_owner_rebalances(sharded_place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ServerConnection, "is_owner", lambda _: False)
    with (
        contextlib.closing(ShardedStore.create(sharded_place(), GRID)) as store,
        pytest.raises(AccessError, match="only the owner"),
    ):
        store.rebalance()


def test_an_import_into_an_empty_environment_comes_first(sharded_place: Place) -> None:
    url = sharded_place()
    with (
        contextlib.closing(ShardedStore.create(url, GRID)) as store,
        contextlib.closing(ShardedStore.open(url)) as other,
        store.loading(),
    ):
        write_voxels(store, shape(1))
        with pytest.raises(BusyError, match="being imported into"):
            other.rebalance()


def test_it_goes_on_when_a_shard_is_back(
    sharded_place: Place, sharded_servers: ShardedServers, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "RECONNECT_SECONDS", 0.1)
    with made(sharded_place()) as store:
        before = contents(store)
        n_told = 0

        def kill_the_third(_: RebalanceProgress) -> None:
            nonlocal n_told
            n_told += 1
            if n_told == 2:
                sharded_servers.shards[2].kill()

        with pytest.raises(ShardAwayError, match="shard 3"):
            store.rebalance(kill_the_third)
        sharded_servers.shards[2].start()
        assert contents(store) == before
        report = store.rebalance()
        assert contents(store) == before
        assert report.moved_rows
        assert_only_own_rows(sharded_servers, store)

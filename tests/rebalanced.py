"""A scene that lies on one of three shards, to be spread over all; its rows, read in every way."""

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import psycopg
import pytest
from psycopg import sql

from hapticdb import Grid
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.query.grouping import object_ranges
from hapticdb.store.base import Keys, Layout, Rows, row_shift
from hapticdb.store.postgres.shards.borders import carrying, rebalancing
from hapticdb.store.postgres.shards.store import ShardedStore
from hapticdb.testing.scenes import (
    blob,
    covering,
    everything,
    voxel_object,
    with_distances,
    write_voxels,
)
from sharded import ShardedServers

GRID = Grid(0.01, (0.0, 0.0, 0.0), 8)
"""512 cells; the scene is in the first 64 of them, which are all on the first shard."""
N_OBJECTS = 24
TABLES: dict[Layout, tuple[str, ...]] = {"voxel": ("voxel",), "brick": ("brick", "band")}


@pytest.fixture
def small_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(carrying, "BATCH_ROWS", {"voxel": 500, "brick": 20, "band": 60})
    monkeypatch.setattr(rebalancing, "DELETED_ROWS", 100)
    monkeypatch.setattr(rebalancing, "PAUSE_SECONDS", 0.0)


def shape(seed: int) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Voxels of an object somewhere in the first 64 cells."""
    rng = np.random.default_rng(seed)
    return blob(seed, tuple(rng.integers(10, 118, 3).tolist()))


@contextlib.contextmanager
def made(
    url: str, layout: Layout = "brick", *, distances: bool = False, grid: Grid = GRID
) -> Iterator[ShardedStore]:
    """An environment of `N_OBJECTS` objects, of which some were replaced and some removed."""
    with contextlib.closing(ShardedStore.create(url, grid, layout, distances=distances)) as store:
        for seed in range(N_OBJECTS):
            if distances:
                rows = with_distances(shape(seed), grid, layout, seed)
                store.add(voxel_object(grid, shape(seed), str(seed)), rows)
            else:
                write_voxels(store, shape(seed), str(seed))
        store.remove(3, covering(store))
        replace(store, 5, shape(1000))
        yield store


def replace(store: ShardedStore, object_id: int, voxels: Keys) -> None:
    record = voxel_object(store.grid, voxels, str(object_id))
    kept = {"id": object_id, "revision": store.object(object_id).revision}
    rows = rows_of_voxels(voxels, store.grid, store.layout)
    store.replace(record.__class__(**{**vars(record), **kept}), rows, covering(store))


Contents = dict[str, tuple[list[Any], ...]]


def listed(rows: Rows) -> tuple[list[Any], ...]:
    band = [] if rows.distances is None else [rows.distances.data.tobytes()]
    return rows.keys.tolist(), rows.ids.tolist(), [rows.occupancy.tobytes()], band


def contents(store: ShardedStore) -> Contents:
    """All rows, by every way to read them."""
    rows = everything(store)
    distinct = np.unique(rows.keys)
    found = {
        "scan": listed(rows),
        "partly": listed(store.scan_partly(np.array([0]), np.array([2**62])).rows),
        "lookup": listed(store.lookup(distinct)),
        "each": listed(store.lookup_each(distinct[::25])),
        "after": listed(store.checker().rows_after(-1, 0, 1 << 20)),
        "few after": listed(store.checker().rows_after(int(distinct[7]), 1, 50)),
        "count": ([store.count(np.array([0]), np.array([2**62]))],),
    }
    for obj in store.objects():
        ends = object_ranges(store.grid, store.layout, obj)
        found[f"object {obj.id}"] = listed(store.rows_of(obj.id, ends.lows, ends.highs))
    if store.wants_distances:
        found["band"] = listed(store.scan(np.array([0]), np.array([2**62]), distances=True))
        found["band of 1"] = listed(
            store.rows_of(1, np.array([0]), np.array([2**62]), distances=True)
        )
    return found


def on_shards(servers: ShardedServers, store: ShardedStore, text: str) -> list[Any]:
    """Answers of each shard's server to one statement."""
    found = []
    for server in servers.shards:
        with psycopg.connect(server.conninfo(), autocommit=True) as asked:
            name = sql.Identifier(store.name)
            asked.execute(sql.SQL("SET search_path = {}").format(name))
            found.append(asked.execute(text.encode()).fetchall())
    return found


def row_borders(store: ShardedStore) -> list[int]:
    """First row key of each shard, and one above all keys."""
    ((firsts,),) = store.connection.rows("SELECT array_agg(first_key ORDER BY number) FROM shard")
    return [first >> row_shift(store.layout) for first in firsts] + [2**62]


def assert_only_own_rows(servers: ShardedServers, store: ShardedStore) -> None:
    """Each shard holds rows inside its borders only, and lists their versions."""
    ends = row_borders(store)
    for table in TABLES[store.layout]:
        for at, keys in enumerate(on_shards(servers, store, f"SELECT z_val FROM {table}")):
            assert all(ends[at] <= key < ends[at + 1] for (key,) in keys), (table, at)
        unlisted = f"SELECT id, version FROM {table} EXCEPT SELECT id, version FROM written"
        assert on_shards(servers, store, unlisted) == [[], [], []]

"""An environment on a coordinator and three shards passes the contract suite."""

import pytest

from capabilities import ENGINE_LACKS, STORE_LACKS
from hapticdb import Grid
from hapticdb.store.base import Layout, Store
from hapticdb.store.postgres.shards.store import ShardedStore
from hapticdb.testing import EngineContract, StoreContract
from servers import Place


class TestShardedStore(StoreContract):
    lacks = STORE_LACKS["PostgreSQL on shards"]

    @pytest.fixture(autouse=True)
    def _place(self, sharded_place: Place) -> None:
        self.place = sharded_place
        self.urls: dict[str, str] = {}

    def make(self, grid: Grid, layout: Layout, name: str = "environment") -> Store:
        self.urls[name] = self.place()
        return ShardedStore.create(self.urls[name], grid, layout)

    def reopen(self, store: Store) -> Store:
        return ShardedStore.open(store.url, read_only=True)


class TestShardedEngine(EngineContract):
    lacks = ENGINE_LACKS["PostgreSQL on shards"]

    @pytest.fixture(autouse=True)
    def _place(self, sharded_place: Place) -> None:
        self.place = sharded_place

    def url(self) -> str:
        return self.place()

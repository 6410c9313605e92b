"""An environment read through a server passes the contract suite, on SQLite and on PostgreSQL."""

from collections.abc import Callable
from pathlib import Path
from typing import cast

import pytest

from hapticdb.grid import Grid
from hapticdb.store.base import Layout, Store
from hapticdb.store.connect import create_store, open_store
from hapticdb.testing import StoreContract
from remote.device_server import DeviceServer
from remote.pairs import WrittenHereReadThere

LACKS = frozenset({"statement", "caches", "server", "grouping threshold"})


class RemoteContract(StoreContract):
    lacks = LACKS
    server: DeviceServer
    opened: list[Store]

    def place(self, name: str) -> str:
        raise NotImplementedError

    def make(self, grid: Grid, layout: Layout, name: str = "environment") -> Store:
        url = self.place(name)
        own = create_store(url, grid, layout)
        return self.kept(cast("Store", WrittenHereReadThere(own, self.server.url(url))))

    def reopen(self, store: Store) -> Store:
        assert isinstance(store, WrittenHereReadThere)
        return self.kept(open_store(store.remote_url))

    def kept(self, store: Store) -> Store:
        self.opened.append(store)
        return store

    def close_all(self) -> None:
        for store in self.opened:
            store.close()


class TestSQLiteBehindAServer(RemoteContract):
    @pytest.fixture(autouse=True)
    def _server(self, device_server: DeviceServer, tmp_path: Path) -> "object":
        self.server, self.opened, self.folder = device_server, [], tmp_path
        yield
        self.close_all()

    def place(self, name: str) -> str:
        return str(self.folder / f"{name}.db")


class TestPostgresBehindAServer(RemoteContract):
    @pytest.fixture(autouse=True)
    def _server(self, device_server: DeviceServer, place: Callable[[], str]) -> "object":
        self.server, self.opened, self.another = device_server, [], place
        yield
        self.close_all()

    def place(self, name: str) -> str:  # noqa: ARG002 - each is another schema
        return self.another()

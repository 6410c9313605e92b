"""The toy engine passes the contract: docs/extending.md shows this file."""

import itertools
import os

import pytest

from hapticdb import Grid
from hapticdb.store.base import Layout, Store
from hapticdb.testing import EngineContract, StoreContract
from toy_engine import ENGINE

numbers = itertools.count()


def new_url(name: str) -> str:
    return f"memory://{os.getpid()}-{next(numbers)}-{name}"


class TestMemoryStore(StoreContract):
    lacks = frozenset({"statement", "caches", "watch"})

    def make(self, grid: Grid, layout: Layout, name: str = "environment") -> Store:
        return ENGINE.create(new_url(name), grid, layout)

    def reopen(self, store: Store) -> Store:
        return ENGINE.open(store.url, read_only=True)


@pytest.mark.usefixtures("toy_is_installed")
class TestMemoryEngine(EngineContract):
    lacks = frozenset({"grant", "backup"})

    def url(self) -> str:
        return new_url("engine")

"""What the contract's tests share: an environment of one engine with two objects in it."""

from collections.abc import Callable

import pytest

from hapticdb.grid import CurveName, Grid
from hapticdb.store.base import Layout, Store, row_shift
from hapticdb.store.connect import create_store, open_store
from voxels import KINDS, blob, write_voxels

one_kind = pytest.mark.parametrize("store", [("brick", "z")], ids=["brick-z"], indirect=True)
"""Of tests of objects, surfaces, pairs and commits, which are the same over all kinds of rows."""


class Case:
    """Tests of one engine; the module of a subclass has the fixture `new_url`."""

    @pytest.fixture(autouse=True)
    def _new_url(self, new_url: Callable[[], str]) -> None:
        self.new_url = new_url

    def make(self, grid: Grid, layout: Layout = "brick") -> Store:
        """An empty store; another one at each call."""
        return create_store(self.new_url(), grid, layout)


class StoreCase(Case):
    """A store of one engine with two objects in it, over every layout and curve."""

    def reopen(self, store: Store) -> Store:
        """The same environment by a second connection, to read."""
        return open_store(store.url, read_only=True)

    @pytest.fixture(params=KINDS, ids="-".join)
    def store(self, request: pytest.FixtureRequest) -> Store:
        """Two overlapping blobs of voxels, ids 1 and 2, in a grid of 64^3."""
        kind: tuple[Layout, CurveName] = request.param
        store = self.make(Grid(0.01, (-0.3, 0.1, 0.2), 6, kind[1]), kind[0])
        write_voxels(store, blob(1, (20, 20, 20)), "one")
        write_voxels(store, blob(2, (24, 20, 20)), "two")
        return store

    @pytest.fixture
    def plain(self, store: Store) -> dict[int, set[int]]:
        """Contents of the store, as row key -> ids."""
        found: dict[int, set[int]] = {}
        for object_id, ijk in ((1, blob(1, (20, 20, 20))), (2, blob(2, (24, 20, 20)))):
            for key in (store.grid.encode(ijk) >> row_shift(store.layout)).tolist():
                found.setdefault(key, set()).add(object_id)
        return found

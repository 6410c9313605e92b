"""Parts that all tests of a store share: how it is made, what it holds, what its engine lacks."""

import pytest

from hapticdb.grid import Grid
from hapticdb.store.base import Layout, Store, row_shift
from hapticdb.testing.scenes import KINDS, blob, write_voxels


class Case:
    """Tests of one engine, which may lack capabilities."""

    lacks: frozenset[str] = frozenset()
    """Keys of `STORE_CAPABILITIES` or `ENGINE_CAPABILITIES`, whose tests are skipped."""

    def need(self, capability: str) -> None:
        """Skip a test where the engine says that it lacks a capability."""
        if capability in self.lacks:
            pytest.skip(f"{type(self).__name__}: the engine lacks the capability {capability!r}")


class StoreCase(Case):
    """A store of one engine with two objects in it, over every layout and curve."""

    def make(self, grid: Grid, layout: Layout, name: str = "environment") -> Store:
        """Make a new store; each name gives another store in the same place."""
        raise NotImplementedError

    def reopen(self, store: Store) -> Store:
        """Open the same environment by a second connection."""
        raise NotImplementedError

    @pytest.fixture(params=KINDS, ids="-".join)
    def store(self, request: pytest.FixtureRequest) -> Store:
        """Two overlapping blobs of voxels, ids 1 and 2, in a grid of 64^3."""
        layout, curve = request.param
        store = self.make(Grid(0.01, (-0.3, 0.1, 0.2), 6, curve), layout)
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

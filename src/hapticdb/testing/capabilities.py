"""Tests of the capabilities that only some engines have; an engine without one skips its tests."""

from typing import Any

import numpy as np
import pytest

from hapticdb.grid import Grid
from hapticdb.store.base import (
    LocatedShell,
    Store,
    SupportsCaches,
    SupportsStatement,
    SupportsWatch,
)
from hapticdb.testing.case import StoreCase
from hapticdb.testing.scenes import (
    everything,
)

STORE_CAPABILITIES: dict[str, Any] = {
    "statement": SupportsStatement,
    "caches": SupportsCaches,
    "watch": SupportsWatch,
}
"""Capabilities that only some stores have: the protocol of each, by its name in
`StoreContract.lacks`."""


class CapabilitiesContract(StoreCase):
    """Tests of all capabilities except `watch`."""

    @pytest.mark.parametrize("capability", sorted(STORE_CAPABILITIES))
    def test_the_engine_has_what_it_does_not_say_to_lack(self, capability: str) -> None:
        """The engine also lacks what `lacks` names, so no test is skipped without need."""
        store = self.make(Grid(0.01, (0, 0, 0), 5), "brick")
        has_it = isinstance(store, STORE_CAPABILITIES[capability])
        store.discard()
        assert has_it != (capability in self.lacks)

    def test_figure_3_finds_the_hits_and_leaves_out_the_excluded(self, store: Store) -> None:
        """The statements use EXISTS and force() inside the engine, if it has the capability."""
        self.need("statement")
        assert isinstance(store, SupportsStatement)
        both = np.array([[22, 20, 20], [16, 20, 20], [60, 60, 60]], dtype=np.int64)
        keys = store.grid.encode(both)
        if store.layout == "brick":
            places = both & 7
            order = Grid(1.0, (0, 0, 0), 3).encode(places)
            keys = (keys >> 9 << 9) | order
        placed = np.zeros((4, 6))
        placed[:3, :3] = store.grid.centers(both) - np.array([0.0, 0.0, 0.002])
        placed[:3, 5] = 1.0
        none = np.empty(0, dtype=np.int64)
        frame = LocatedShell(placed, keys, 1000.0, none)
        ordinals, ids = store.statement_hits(frame)
        assert sorted(zip(ordinals.tolist(), ids.tolist(), strict=True)) == [(0, 1), (0, 2), (1, 1)]
        np.testing.assert_allclose(store.statement(frame)[:3], [0, 0, 4.0])
        without = frame._replace(exclude=np.array([1], dtype=np.int64))
        np.testing.assert_allclose(store.statement(without)[:3], [0, 0, 2.0])
        far_apart, many = np.array([1, 1 << 40]), np.arange(2, 9000)
        for others, force in ((far_apart, 2.0), (many, 4.0), (many + 7, 4.0)):
            without = frame._replace(exclude=others)
            np.testing.assert_allclose(store.statement(without)[:3], [0, 0, force])
            left_out = set(store.statement_hits(without)[1].tolist())
            assert left_out == {1, 2} - set(others.tolist())
        nothing = frame._replace(exclude=np.array([1, 2], dtype=np.int64))
        assert not store.statement(nothing).any()
        assert not len(store.statement_hits(nothing)[0])

    def test_caches_are_emptied_without_a_row_lost(self, store: Store) -> None:
        """Reads return the same rows."""
        self.need("caches")
        assert isinstance(store, SupportsCaches)
        before = everything(store)
        store.drop_caches()
        for found, expected in zip(everything(store), before, strict=True):
            np.testing.assert_array_equal(found, expected)

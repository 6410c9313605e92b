"""A store whose round trips fail now and then; a module, so that another process can import it."""

import contextlib
import os
import time
from collections.abc import Iterator
from typing import Any, cast

import numpy as np

from hapticdb.errors import BusyError, ConnectionLostError, DatabaseError, StuckError
from hapticdb.store.base import Store

ROUND_TRIPS = {"revision", "changes", "scan", "lookup"}
ERRORS: list[type[DatabaseError]] = [ConnectionLostError, BusyError, StuckError]
GRACE = 5.0
"""Seconds after opening without errors, so that sessions can start; then round trips may fail."""


class Erring:
    """A store whose round trips fail now and then."""

    def __init__(self, store: Store, share: float, seed: int) -> None:
        self._store = store
        self._share = share
        self._rng = np.random.default_rng([seed, os.getpid(), time.monotonic_ns()])
        self._begun = time.monotonic()

    def _travel(self) -> None:
        if time.monotonic() > self._begun + GRACE and self._rng.random() < self._share:
            kind = ERRORS[self._rng.integers(len(ERRORS))]
            raise kind(f"{self._store.url}: an error was injected")

    @contextlib.contextmanager
    def snapshot(self) -> Iterator[None]:
        self._travel()
        with self._store.snapshot():
            yield

    def has_changed(self) -> bool:
        return bool(cast("Any", self._store).has_changed())

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - whatever the store has
        found = getattr(self._store, name)
        if name not in ROUND_TRIPS:
            return found

        def travelled(*given: Any) -> Any:  # noqa: ANN401 - whatever it takes
            self._travel()
            return found(*given)

        return travelled


def erring(store: Store, share: float, seed: int) -> Store:
    """A wrapper of stores for the argument `wrap` of `ResidentCells`."""
    return cast("Store", Erring(store, share, seed))

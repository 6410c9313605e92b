"""A store that is slow, fails and disconnects, as a real one may; repeatable by its seed."""

import contextlib
import functools
import itertools
import time
from collections.abc import Callable, Iterator
from typing import Any, cast

import numpy as np

from hapticdb.errors import BusyError, ConnectionLostError, DatabaseError, StuckError
from hapticdb.store.base import Store

ROUND_TRIPS = {"revision", "changes", "scan", "lookup", "costs", "quantiles", "size", "object"}
ERRORS: list[type[DatabaseError]] = [ConnectionLostError, BusyError, StuckError]
Wait = Callable[[float], None]
_openings = itertools.count()


class Troubled:
    """Passes calls to another store, with delays and errors.

    Each round trip takes `latency` and a random part of `jitter`, seconds, and fails with the
    probability `errors`. `wait` lets seconds pass. Each store
    opened in a process gets other random numbers.
    """

    def __init__(
        self,
        store: Store,
        *,
        latency: float = 0.0,
        jitter: float = 0.0,
        errors: float = 0.0,
        seed: int = 0,
        wait: Wait = time.sleep,
    ) -> None:
        self._store = store
        self._latency, self._jitter, self._errors = latency, jitter, errors
        self._rng = np.random.default_rng([seed, next(_openings)])
        self._wait = wait

    def _travel(self) -> None:
        if self._latency or self._jitter:
            self._wait(self._latency + float(self._rng.uniform(0, self._jitter)))
        if self._rng.random() < self._errors:
            kind = ERRORS[self._rng.integers(len(ERRORS))]
            raise kind(f"{self._store.url} failed: try again")

    @contextlib.contextmanager
    def snapshot(self) -> Iterator[None]:
        self._travel()
        with self._store.snapshot():
            yield

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - whatever the store has
        found = getattr(self._store, name)
        if name not in ROUND_TRIPS:
            return found

        @functools.wraps(found)
        def travelled(*given: Any, **named: Any) -> Any:  # noqa: ANN401 - whatever it takes
            self._travel()
            return found(*given, **named)

        return travelled


def troubled(store: Store, **trouble: Any) -> Store:  # noqa: ANN401 - see `Troubled`
    """Wrap a store; `functools.partial` of this function can be sent to another process."""
    return cast("Store", Troubled(store, **trouble))


def refuse(store: Store) -> Store:
    """Fail with an error that a database raises."""
    store.close()
    raise DatabaseError(f"{store.url} is not for us: ask another")


def refuse_strangely(store: Store) -> Store:
    """Fail with an error that no caller expects."""
    store.close()
    raise ZeroDivisionError(store.url)

"""A store that stands in for one on two servers, of which the second may be away."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np

from hapticdb.errors import OutdatedError, ShardAwayError
from hapticdb.store.base import Keys, Rows, Store, row_shift
from hapticdb.store.batches import PartialRows

SHARD = "shard 2 (server2)"


class Halved:
    """Passes calls to another store; the upper half of its keys is away while a file exists.

    Parameters
    ----------
    store : Store
        The store that answers.
    away : str
        While this file exists, the upper half of the keys cannot be read.
    is_silent : bool
        `shards_away` never names a shard, as if it went and came unnoticed.

    Attributes
    ----------
    n_refused : int
        Statements so far of which a part was away.
    n_outdated : int
        So many of the next statements raise `OutdatedError`.
    """

    def __init__(self, store: Store, *, away: str, is_silent: bool = False) -> None:
        self._store = store
        self._away = Path(away)
        self._is_silent = is_silent
        self.first_key = first_key_above(store)
        self.n_refused = self.n_outdated = 0

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - whatever the store has
        return getattr(self._store, name)

    def watch(self) -> None:
        cast("Any", self._store).watch()

    def has_changed(self) -> bool:
        return bool(cast("Any", self._store).has_changed())

    @contextlib.contextmanager
    def snapshot(self) -> Iterator[None]:
        with self._store.snapshot():
            yield

    def shards_away(self) -> tuple[str, ...]:
        return (SHARD,) if self._away.exists() and not self._is_silent else ()

    def scan_partly(self, lows: Keys, highs: Keys, *, distances: bool = False) -> PartialRows:
        if self.n_outdated:
            self.n_outdated -= 1
            raise OutdatedError("moved: read again")
        away = np.empty((0, 2), dtype=np.int64)
        if self._away.exists():
            above = highs >= self.first_key
            away = np.stack([np.maximum(lows, self.first_key), highs], axis=1)[above]
            below = lows < self.first_key
            lows, highs = lows[below], np.minimum(highs, self.first_key - 1)[below]
            self.n_refused += bool(len(away))
        return PartialRows(self._store.scan(lows, highs, distances=distances), away)

    def scan(self, lows: Keys, highs: Keys, *, distances: bool = False) -> Rows:
        self._check(highs)
        return self._store.scan(lows, highs, distances=distances)

    def lookup(self, keys: Keys, *, distances: bool = False) -> Rows:
        self._check(keys)
        return self._store.lookup(keys, distances=distances)

    def _check(self, keys: Keys) -> None:
        if self._away.exists() and (keys >= self.first_key).any():
            raise ShardAwayError(f"{SHARD} of {self._store.url} is away: try again")


def first_key_above(store: Store) -> int:
    """First row key of the upper half of an environment."""
    return int(1 << (3 * store.grid.bits - 1 - row_shift(store.layout)))


def halved(store: Store, **given: Any) -> Store:  # noqa: ANN401 - see `Halved`
    """Wrap a store; `functools.partial` of this function can be sent to another process."""
    return cast("Store", Halved(store, **given))

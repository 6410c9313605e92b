"""Cells of an environment whose rows several servers hold ("shards"), when some do not answer."""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import ShardAwayError
from hapticdb.store.base import NO_KEYS, Keys, Rows, Store
from hapticdb.store.batches import PartialRows

ASK_AGAIN = (0.05, 0.5)
"""Seconds until cells of a shard that was away are asked for again: first and greatest pause; the
pause doubles each time. Larger: fewer statements that fail; cells come back later."""


@runtime_checkable
class SupportsPartialScan(Protocol):
    """An engine whose environments may have rows on several servers."""

    def scan_partly(self, lows: Keys, highs: Keys, *, distances: bool = False) -> PartialRows:
        """Rows as of `Store.scan`, of the shards that answer, and the ranges of those that do not.

        An answer also shows that the environment's first server answers: without it there is no
        answer, but an error as of `Store.scan`. A shard that is away raises no error here.
        """

    def shards_away(self) -> tuple[str, ...]:
        """Names of the shards that are away now, as "shard 2 (server2)"; no round trip."""


def shards_away(store: Store) -> tuple[str, ...]:
    """Names of a store's shards that are away now; () if all its rows are on one server."""
    return store.shards_away() if isinstance(store, SupportsPartialScan) else ()


class AnsweringShards:
    """Lookups in those shards of a store that answer; all rows, if they are on one server.

    Attributes
    ----------
    is_short : bool
        Whether rows that a lookup asked for are on shards that are away.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self.grid, self.layout = store.grid, store.layout
        self.is_short = False

    def lookup(self, keys: Keys, *, distances: bool = False) -> Rows:
        """Rows of distinct ascending keys (U,)."""
        if not isinstance(self._store, SupportsPartialScan):
            return self._store.lookup(keys, distances=distances)
        rows, away = self._store.scan_partly(keys, keys, distances=distances)
        self.is_short = self.is_short or len(away) > 0
        return rows


def meeting(away: NDArray[np.int64], lows: Keys, highs: Keys) -> NDArray[np.bool_]:
    """Whether closed ranges lows..highs (n,) meet any of the ranges (A, 2): (n,).

    The ranges (A, 2) are closed, ascending and disjoint; the others may have any order.
    """
    if not len(away):
        return np.zeros(len(lows), dtype=np.bool_)
    first = np.searchsorted(away[:, 1], lows)  # the first range that does not end before
    begins = away[np.minimum(first, len(away) - 1), 0]
    return np.asarray((first < len(away)) & (begins <= highs))


def away_error(store: Store, n_cells: int) -> ShardAwayError:
    """The error of work that needs all cells, of which `n_cells` are on shards that are away."""
    names = " and ".join(shards_away(store)) or "a shard"
    is_one = len(shards_away(store)) < 2
    return ShardAwayError(
        f"{names} of {store.url} {'is' if is_one else 'are'} away, with {n_cells} of the cells "
        "that are needed here: try again when the server answers"
    )


class AwayCells:
    """Cells that were asked for when their shard was away, and when they are asked for again.

    They are asked for again after a pause, or as soon as other shards are away than before.

    Parameters
    ----------
    clock : callable
        Returns seconds.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._cells = NO_KEYS
        self._names: tuple[str, ...] = ()
        self._pause, self._at_most = ASK_AGAIN
        self._again_at = 0.0

    def __len__(self) -> int:
        """Count the cells that are not asked for now."""
        return len(self._cells)

    def note(self, asked: Keys, is_away: NDArray[np.bool_], names: tuple[str, ...]) -> None:
        """Note which of the cells asked for (n,) were away (n,), and the shards that are away."""
        if not len(self._cells) and not is_away.any():
            if len(asked):
                self._pause = ASK_AGAIN[0]
            return
        if not len(self._cells):
            self._again_at = self._clock() + self._pause
            self._pause = min(2 * self._pause, self._at_most)
            self._names = names
        others = self._cells[~np.isin(self._cells, asked)]
        self._cells = np.union1d(others, asked[is_away])

    def is_due(self, names: tuple[str, ...]) -> bool:
        """Whether cells may be asked for again; names : of the shards that are away now."""
        if not len(self._cells):
            return False
        return names != self._names or self._clock() >= self._again_at

    def release(self, names: tuple[str, ...]) -> None:
        """Let all cells be asked for again, if that is due."""
        if self.is_due(names):
            if names != self._names:
                self._pause = ASK_AGAIN[0]
            self._cells = NO_KEYS

    def forget(self) -> None:
        """Let all cells be asked for again: the connection is a new one."""
        self._cells, self._pause = NO_KEYS, ASK_AGAIN[0]

    def without(self, cells: Keys) -> Keys:
        """Those of cells (n,) that may be asked for now, in their order."""
        return cells[~np.isin(cells, self._cells)] if len(self._cells) else cells

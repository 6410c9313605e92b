"""Cells that are known to be empty: they take no slot, but an entry of the directory each."""

from collections.abc import Iterable

import numpy as np

from hapticdb.store.base import NO_KEYS, Keys


class EmptyCells:
    """Cells known to be empty, in the order in which they came.

    Parameters
    ----------
    limit : int
        So many at most.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._cells: dict[int, None] = {}

    def __len__(self) -> int:
        """Count the cells."""
        return len(self._cells)

    def keys(self) -> Keys:
        """All of them, (n,) int64, oldest first."""
        return np.fromiter(self._cells, np.int64, len(self._cells))

    def add(self, cells: Iterable[int]) -> None:
        """Note cells, for which `forget_for` has made room."""
        self._cells.update(dict.fromkeys(cells))

    def discard(self, cells: Iterable[int]) -> None:
        """Forget cells, where they are known."""
        for cell in cells:
            self._cells.pop(cell, None)

    def forget_for(self, n_new: int, urgent: Keys) -> Keys:
        """Forget cells so that `n_new` others have room; returns the forgotten ones.

        None where there is room. Else the oldest leave, an eighth of the limit more than must so
        that this is seldom needed. Urgent cells (U,), most urgent first, leave only where the
        others are too few, and then from the least urgent on.
        """
        surplus = len(self._cells) + n_new - self._limit
        if surplus <= 0:
            return NO_KEYS
        known = self.keys()
        others = known[~np.isin(known, urgent)]
        kept_longest = urgent[::-1][np.isin(urgent[::-1], known)]
        n_leaving = max(surplus, min(surplus + self._limit // 8, len(others)))
        leaving = np.concatenate([others, kept_longest])[:n_leaving]
        self.discard(leaving.tolist())
        return leaving

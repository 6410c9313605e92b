"""Cells that are known to be empty: each takes an entry of the directory, but no slot."""

from collections.abc import Iterable

import numpy as np

from hapticdb.store.base import NO_KEYS, Keys


class EmptyCells:
    """Cells known to be empty, oldest first.

    Parameters
    ----------
    limit : int
        Greatest number of cells.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._cells: dict[int, None] = {}

    def __len__(self) -> int:
        """Count the cells."""
        return len(self._cells)

    def keys(self) -> Keys:
        """All cells, (n,) int64, oldest first."""
        return np.fromiter(self._cells, np.int64, len(self._cells))

    def add(self, cells: Iterable[int]) -> None:
        """Add cells, after `forget_for` has made room for them."""
        self._cells.update(dict.fromkeys(cells))

    def discard(self, cells: Iterable[int]) -> None:
        """Remove cells; unknown ones are ignored."""
        for cell in cells:
            self._cells.pop(cell, None)

    def forget_for(self, n_new: int, urgent: Keys) -> Keys:
        """Remove cells so that `n_new` others have room; returns the removed ones.

        If there is room, no cell is removed. Otherwise the oldest leave, and an eighth of the limit
        more than necessary, so that this happens seldom. Urgent cells (U,), most urgent first,
        leave only if the other cells are not enough; the least urgent ones leave first.
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

"""Which cells a client has read lately: those it wants to hear of when they change."""

from collections import deque

import numpy as np

from hapticdb.protocol.cells import Asked
from hapticdb.store.base import CELL_SHIFT, Change, Keys

MOST_BATCHES = 64
"""Scans that are remembered, of up to 256 cells each. Larger: more cells are pushed after a change,
which the client may have forgotten."""
MOST_TOUCHED = 1 << 14
"""Cells of a change up to which they are looked up. Larger: a change of much of the environment
takes longer before it is told."""


class RecentCells:
    """Cells that the last scans of one client have read.

    Parameters
    ----------
    shift : int
        Bits of a cell's key below it, in keys of rows.
    """

    def __init__(self, shift: int) -> None:
        self._shift = shift
        self._batches: deque[tuple[Keys, Keys]] = deque(maxlen=MOST_BATCHES)
        self.distances = False

    def note(self, asked: Asked) -> None:
        """Remember what a scan has asked for."""
        if asked.distances != self.distances:
            self._batches.clear()
            self.distances = asked.distances
        if len(asked.lows):
            self._batches.append((asked.lows >> self._shift, asked.highs >> self._shift))

    def copy(self) -> "RecentCells":
        """Copy them as they are now, for another thread: `note` may be called meanwhile."""
        made = RecentCells(self._shift)
        made._batches = self._batches.copy()
        made.distances = self.distances
        return made

    def touched(self, changes: list[Change], at_most: int) -> Keys:
        """Keys on the curve (n,), ascending, of the remembered cells in the ranges of changes.

        The cells that were read last come first if there are too many.
        """
        spans = [change.ranges >> CELL_SHIFT for change in changes]
        n_cells = sum(int((span[:, 1] - span[:, 0] + 1).sum()) for span in spans)
        found: list[Keys] = [np.empty(0, dtype=np.int64)]
        if not n_cells or n_cells > MOST_TOUCHED:
            return found[0]
        pieces = [np.arange(a, b + 1) for span in spans for a, b in span.tolist()]
        left = np.unique(np.concatenate(pieces))
        for lows, highs in reversed(self._batches):
            at = np.searchsorted(lows, left, side="right") - 1
            is_read = (at >= 0) & (left <= highs[np.maximum(at, 0)])
            # two ranges that share a cell make the lows repeat, not descend
            found.append(left[is_read])
            left = left[~is_read]
            at_most -= int(is_read.sum())
            if at_most <= 0 or not len(left):
                break
        found[-1] = found[-1][: len(found[-1]) + min(at_most, 0)]
        return np.sort(np.concatenate(found))

"""Cells of an environment, read from its store into slots of a cell table."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.resident import cell_table as kernels
from hapticdb.query.grouping import group_spans
from hapticdb.query.quantiles import QuantileVector
from hapticdb.resident.costs import costs_at_start
from hapticdb.resident.table import CellTable
from hapticdb.store.base import CELL_SHIFT, Keys, Store, row_shift


class CellsRead(NamedTuple):
    """Result of one statement.

    is_empty (n,) : whether each cell has no voxel; n_rows : rows read; n_ranges : ranges queried.
    """

    is_empty: NDArray[np.bool_]
    n_rows: int
    n_ranges: int


class CellSource:
    """Reads cells of one environment, a batch by one statement.

    The cells of a batch are grouped into ranges by cost, as in the strategy `cbgroup`: a gap is
    scanned if that costs no more than another descent of the index on this database.

    Parameters
    ----------
    store : Store
        A connection; it may be replaced by another one to the same environment.
    exclude : (E,) int64
        Ids of objects that are left out of all cells.
    clock : callable
        Returns seconds, to time round trips at the start.
    may_measure : bool
        Whether there is time at the start to measure the cost of statements.
    """

    def __init__(
        self, store: Store, exclude: Keys, clock: Callable[[], float], *, may_measure: bool
    ) -> None:
        self.store = store
        self.exclude = exclude
        self._quantiles = QuantileVector.of(store)
        may_measure = may_measure and self._quantiles.n_rows > 0
        self._costs = costs_at_start(store, clock, may_measure=may_measure)

    def read(self, cells: Keys, table: CellTable, slots: Keys) -> CellsRead:
        """Read cells (n,), distinct, by one statement into slots (n,) that no frame can read."""
        grid, shift = self.store.grid, row_shift(self.store.layout)
        on_curve = np.empty(len(cells), dtype=np.int64)
        kernels.curve_keys_of_cells(cells, grid.bits, grid.curve_code, on_curve)
        order = np.argsort(on_curve)
        on_curve = on_curve[order]
        lows = on_curve << (CELL_SHIFT - shift)
        highs = ((on_curve + 1) << (CELL_SHIFT - shift)) - 1
        ranges = group_spans(lows, highs, self._quantiles, self._costs)
        rows = self.store.scan(*ranges)
        words, masks = table.cells.words, table.cells.masks
        words[slots] = 0
        masks[slots] = 0
        kernels.fill_cells(
            rows.keys, rows.ids, rows.occupancy, self.exclude, on_curve, slots[order], grid.bits,
            grid.curve_code, shift, words, masks,
        )  # fmt: skip
        return CellsRead(masks[slots] == 0, len(rows), len(ranges.lows))

"""Cells of an environment, read from its store into slots of a cell table."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import DatabaseError
from hapticdb.kernels.field.packing import unpack
from hapticdb.kernels.resident import cell_table as kernels
from hapticdb.kernels.resident.cells import UNKNOWN
from hapticdb.kernels.resident.near_voxels import mark_near_voxels
from hapticdb.paper.calibration import calibrate
from hapticdb.paper.cost_model import CostModel, machine_name
from hapticdb.paper.grouping import cbgroup
from hapticdb.paper.quantiles import QuantileVector
from hapticdb.resident.table import CellTable
from hapticdb.store.base import (
    CELL_SHIFT,
    Keys,
    Rows,
    Store,
    row_shift,
)
from hapticdb.store.urls import scheme_of
from hapticdb.user_cache import content_of, entry_of, keep

ROWS_AT_ONCE = 1024
"""Rows with distances unpacked together, into a megabyte. Larger: fewer calls; smaller: the values
are merged while they are still in the processor's cache."""

FAR = 2e-3
"""Greatest round trip (s) for a calibration at the start, of thousands of round trips. Larger:
slower starts."""
ROUND_TRIPS = 3
"""Number of timed round trips; the shortest counts."""


class CellSource:
    """Reads cells of one environment, a batch by one statement.

    The cells of a batch are grouped into ranges by cost, as in the strategy `cbgroup`: a gap is
    scanned if this costs no more than another descent of the index on this database.

    store, exclude : a connection, and ids (E,) of the excluded objects, ascending; others may take
    their places; clock : returns seconds, to time round trips at the start; may_measure : there is
    time at the start to measure the cost of statements.
    """

    def __init__(
        self, store: Store, exclude: Keys, clock: Callable[[], float], *, may_measure: bool
    ) -> None:
        self.store = store
        self.exclude = exclude
        self._quantiles = QuantileVector.of(store)
        may_measure = may_measure and self._quantiles.n_rows > 0
        self._costs = costs_at_start(store, clock, may_measure=may_measure)

    def read(
        self, cells: Keys, table: CellTable, slots: Keys
    ) -> tuple[NDArray[np.bool_], int, int]:
        """Read cells (n,), distinct, by one statement into slots (n,) outside of the directory.

        Returns whether each has no voxel and no distances (n,), rows read, and ranges queried.
        """
        grid, shift = self.store.grid, row_shift(self.store.layout)
        on_curve = kernels.curve_keys_of_cells(cells, grid.bits, grid.curve_code)
        # one ascending scan of the index; the ranges must be disjoint and ascending
        order = np.argsort(on_curve)
        on_curve = on_curve[order]
        lows = on_curve << (CELL_SHIFT - shift)
        highs = ((on_curve + 1) << (CELL_SHIFT - shift)) - 1
        words, masks, payload = table.cells.words, table.cells.masks, table.cells.payload
        costs = self._costs if payload is None else self._costs.with_distances
        # joined ranges contain cells that nobody requested; their rows are dropped below
        ranges = cbgroup(lows, highs, self._quantiles, costs)
        rows = self.store.scan(*ranges, distances=payload is not None)
        cells_of_rows = rows.keys >> (CELL_SHIFT - shift)
        # a row beyond the last requested cell would index past the end; the comparison rejects it
        at = np.minimum(np.searchsorted(on_curve, cells_of_rows), len(on_curve) - 1)
        is_included = (on_curve[at] == cells_of_rows) & ~np.isin(rows.ids, self.exclude)
        row_slots = np.where(is_included, slots[order][at], UNKNOWN)
        # slots come back with the bits of an earlier cell
        words[slots] = 0
        masks[slots] = 0
        kernels.fill_cells(
            rows.keys, row_slots, rows.occupancy, grid.bits, grid.curve_code, words, masks
        )
        if payload is not None:
            self._fill_distances(rows, row_slots, payload, masks)
            mark_near_voxels(slots, payload, masks, words, table.cells.near)
        return masks[slots] == 0, len(rows), len(ranges.lows)

    def _fill_distances(
        self,
        rows: Rows,
        row_slots: Keys,
        payload: NDArray[np.uint8],
        masks: NDArray[np.uint64],
    ) -> None:
        """Write the distances of rows into the slots (R,) of their cells.

        Raises DatabaseError if packed distances are damaged.
        """
        grid, slot = self.store.grid, -1
        for at in range(0, len(rows), ROWS_AT_ONCE):
            part = rows.part(at, at + ROWS_AT_ONCE)
            if part.distances is None:
                raise DatabaseError(f"{self.store.url} has given no distances: import it again")
            slots = row_slots[at : at + ROWS_AT_ONCE]
            try:
                values = unpack(part.distances.data, part.distances.ends, slots >= 0)
            except ValueError as error:
                raise DatabaseError(
                    f"{self.store.url} is damaged ({error}): run 'hapticdb check {self.store.url}'"
                ) from None
            slot = kernels.fill_distances(
                part.keys, slots, values, grid.bits, grid.curve_code, slot, payload, masks
            )


def costs_at_start(
    store: Store, clock: Callable[[], float], *, may_measure: bool = True
) -> CostModel:
    """Cost model from the store's figures for this machine, or else from measurement.

    A measurement takes 0.4 s, and stays in the user's cache for the environment as it is now.
    clock : returns seconds, to time a round trip; may_measure : whether there is time for a
    measurement, and a row to measure. If not, or if a round trip takes longer than `FAR`, all parts
    cost the same: results are equal, ranges less efficient.
    """
    if (stored := CostModel.stored(store, machine_name())) is not None:
        return stored
    where = store.url if scheme_of(store.url) else Path(store.url).absolute()
    # by revision: another number of rows has other costs
    entry = entry_of("costs", str(where), store.revision(), machine_name())
    if (content := content_of(entry)) is not None:
        return CostModel.from_figures(json.loads(content))
    if not may_measure or _round_trip(store, clock) > FAR:
        return CostModel.of_equal_parts()
    costs = calibrate(store)
    keep(entry, json.dumps(costs.figures()).encode())
    return costs


def _round_trip(store: Store, clock: Callable[[], float]) -> float:
    """Seconds until the store answers a small query."""
    times = []
    for _ in range(ROUND_TRIPS):
        started = clock()
        store.revision()
        times.append(clock() - started)
    # the shortest: other work of the machine delays the rest
    return min(times)

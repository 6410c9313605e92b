"""Statistics and costs of an opened database, for grouping by cost."""

from contextlib import suppress

from hapticdb.errors import DatabaseError
from hapticdb.paper.calibration import calibrate
from hapticdb.paper.cost_model import CostModel, machine_name
from hapticdb.paper.quantiles import DEFAULT_RESOLUTION, QuantileVector
from hapticdb.store.base import Store

STALE = 0.2
"""Writes since the statistics, as a share of the objects, after which they are renewed."""


class QueryFigures:
    """Quantile vector and cost model of a store, read or measured at their first use."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._quantiles: QuantileVector | None = None
        self._costs: CostModel | None = None
        self._n_objects: int | None = None

    def both(self) -> tuple[QuantileVector, CostModel]:
        """Quantile vector and cost model; fitting the latter takes less than a second."""
        if self._quantiles is None or not self._quantiles.n_rows:  # another may have added rows
            self._quantiles = QuantileVector.of(self._store, DEFAULT_RESOLUTION)
        if not self._quantiles.n_rows:
            return self._quantiles, CostModel.of_equal_parts()
        if self._costs is None:
            self._costs = CostModel.stored(self._store, machine_name()) or calibrate(self._store)
        return self._quantiles, self._costs

    def analyze(self) -> QuantileVector:
        """Recompute the store's statistics, even if they are up to date."""
        self._store.analyze(DEFAULT_RESOLUTION, anew=True)
        self._quantiles = QuantileVector.of(self._store, DEFAULT_RESOLUTION)
        return self._quantiles

    def calibrate(self, *, keep: bool, cold: bool) -> CostModel:
        """Measure the costs; see `hapticdb.environment.Environment.calibrate`."""
        costs = calibrate(self._store, cold=cold)
        if keep and not self._store.is_read_only:
            self._store.save_costs(machine_name(), costs.figures())
        self._costs = costs
        return costs

    def rows_changed(self) -> None:
        """Invalidate the statistics; recompute them after many writes, if possible."""
        self._quantiles = None
        with suppress(DatabaseError):
            n_writes = self._store.freshness(DEFAULT_RESOLUTION).changes
            if self._n_objects is None:
                self._n_objects = len(self._store.objects())
            if n_writes > STALE * self._n_objects:
                self._store.analyze(DEFAULT_RESOLUTION)
                self._n_objects = None

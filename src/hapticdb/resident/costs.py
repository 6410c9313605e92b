"""Cost model for statements that fetch cells, found at the start without a long wait."""

from collections.abc import Callable

from hapticdb.query.calibration import calibrate
from hapticdb.query.cost_model import CostModel, machine_name
from hapticdb.store.base import Store

FAR = 2e-3
"""Greatest round trip (s) at which a calibration, which takes thousands of round trips, is done at
the start. Larger: slower starts."""
ASKED = 3
"""Number of timed round trips; the shortest counts."""


def costs_at_start(
    store: Store, clock: Callable[[], float], *, may_measure: bool = True
) -> CostModel:
    """Cost model from the figures that the store keeps for this machine, or else from measurement.

    Parameters
    ----------
    store : Store
        An environment.
    clock : callable
        Returns seconds, to time a round trip.
    may_measure : bool
        Whether there is time for a measurement, and a row to measure. If not, or if a round trip
        takes longer than `FAR`, all parts cost the same: results are equal, ranges less efficient.
    """
    kept = store.costs(machine_name())
    if kept:
        return CostModel.from_figures(kept)
    if may_measure and _round_trip(store, clock) <= FAR:
        return calibrate(store)
    return CostModel.of_equal_parts()


def _round_trip(store: Store, clock: Callable[[], float]) -> float:
    """Seconds until the store answers a small query."""
    times = []
    for _ in range(ASKED):
        started = clock()
        store.revision()
        times.append(clock() - started)
    return min(times)

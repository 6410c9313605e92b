"""What statements for cells cost: how those who fetch learn it without keeping anybody waiting."""

from collections.abc import Callable

from hapticdb.query.calibration import calibrate
from hapticdb.query.cost_model import CostModel, machine_name
from hapticdb.store.base import Store

FAR = 2e-3
"""Seconds of a round trip: more, and the thousands of a calibration keep a start waiting."""
ASKED = 3
"""Round trips that are timed; the shortest counts."""


def costs_at_start(
    store: Store, clock: Callable[[], float], *, may_measure: bool = True
) -> CostModel:
    """Figures that the store keeps for this machine, or else what may be measured.

    Parameters
    ----------
    store : Store
        An environment.
    clock : callable
        Seconds, by which a round trip is timed.
    may_measure : bool
        Whether there is time for that, and a row. Without them, and where a round trip takes longer
        than `FAR`, all parts cost the same: right all the same, and joined with less skill.
    """
    kept = store.costs(machine_name())
    if kept:
        return CostModel.from_figures(kept)
    if may_measure and _round_trip(store, clock) <= FAR:
        return calibrate(store)
    return CostModel.of_equal_parts()


def _round_trip(store: Store, clock: Callable[[], float]) -> float:
    """Seconds until the store answers a small question."""
    times = []
    for _ in range(ASKED):
        started = clock()
        store.revision()
        times.append(clock() - started)
    return min(times)

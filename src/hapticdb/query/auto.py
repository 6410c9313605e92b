"""The strategy `auto`: one lookup of all keys, or a scan of ranges if few ranges hold many keys."""

from collections.abc import Callable

from hapticdb.query.cost_model import CostModel
from hapticdb.query.grouping import Ranges, cbgroup
from hapticdb.query.quantiles import QuantileVector
from hapticdb.store.base import Keys, Store

DEFAULT_THRESHOLD = 1024
"""Distinct keys of a frame from which `auto` groups, on engines that set no number of their own.

Measured on SQLite. A smaller value groups more frames whose lookup would have been faster; a larger
one leaves more large frames to a lookup that is up to 1.1 times slower than their ranges."""
KEYS_PER_RANGE = 2
"""Mean keys of a range from which `auto` scans ranges. A larger value scans fewer frames: a range
costs more than a key of a lookup, so ranges of one key each would be slower."""


def grouping_threshold(store: Store) -> int | None:
    """Distinct keys of a frame from which `auto` groups on this engine.

    None where it never groups, because a lookup reads each leaf page only once anyway.
    """
    threshold: int | None = getattr(store, "grouping_threshold", DEFAULT_THRESHOLD)
    return threshold


def ranges_worth_scanning(
    keys: Keys,
    threshold: int | None,
    quantiles_and_costs: Callable[[], tuple[QuantileVector, CostModel]],
) -> Ranges | None:
    """Decide how `auto` asks for a frame.

    The decision depends on the frame alone, not on frames before it. `quantiles_and_costs` is
    called only where the frame is grouped: a small frame never waits for a calibration.

    Parameters
    ----------
    keys : (U,) int64
        Distinct row keys, ascending.
    threshold : int or None
        As `grouping_threshold` gives it.
    quantiles_and_costs : callable
        Returns the quantile vector and the cost model.

    Returns
    -------
    Ranges or None
        Ranges of CBGroup to scan; None where the keys are to be looked up.
    """
    if threshold is None or len(keys) < threshold:
        return None
    ranges = cbgroup(keys, *quantiles_and_costs())
    return ranges if KEYS_PER_RANGE * len(ranges.lows) <= len(keys) else None

"""Figures of a force over time or along a way: ripple, steps, overshoot, limit cycles."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

CYCLE_N = 0.1
"""Least force, N peak to peak, of a limit cycle. Smaller: a decaying oscillation may be taken for a
limit cycle."""
CYCLE_SHARE = 0.7
"""Least share of its size that an oscillation keeps from one window to the next to be a limit
cycle. Larger: a slowly decaying oscillation counts as stable."""


def ripple(values: ArrayLike) -> float:
    """Standard deviation over mean; infinite for values whose mean is 0 or less."""
    array = np.asarray(values, dtype=np.float64)
    mean = float(array.mean())
    return float(array.std()) / mean if mean > 0.0 else float("inf")


def largest_step(values: ArrayLike, apart: int = 1) -> float:
    """Greatest change between samples (M,) or (M, 3) that are at most `apart` samples apart."""
    array = np.asarray(values, dtype=np.float64)
    array = array.reshape(len(array), -1)
    steps = [
        np.linalg.norm(array[n:] - array[:-n], axis=1).max(initial=0.0)
        for n in range(1, min(apart, len(array) - 1) + 1)
    ]
    return float(max(steps, default=0.0))


def overshoot(values: ArrayLike, steady: float) -> float:
    """How far the largest value exceeds the steady one, as a share of the steady one."""
    if not steady > 0.0:
        return float("inf")
    return float(np.max(np.asarray(values))) / steady - 1.0


def is_limit_cycle(values: ArrayLike, window: int) -> bool:
    """Whether an oscillation stays that no longer has a reason.

    values (M,): a force, N, while hand and scene are at rest; the last two windows of `window`
    samples count. A limit cycle is larger than `CYCLE_N` in the last one, peak to peak, and keeps
    at least `CYCLE_SHARE` of its size from the window before. A number that is not finite counts
    as a limit cycle, too.
    """
    array = np.asarray(values, dtype=np.float64)
    if not np.isfinite(array).all():
        return True
    before, last = np.ptp(array[-2 * window : -window]), np.ptp(array[-window:])
    return bool(last > CYCLE_N and last > CYCLE_SHARE * before)

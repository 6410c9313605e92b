"""How much a client may ask for: rates, sizes, numbers and times, each with its reason.

docs/serving.md has these figures in a table, and a test compares them.
"""

import time
from collections.abc import Callable

MIB = 1 << 20
"""Bytes of a MiB."""


class TokenBucket:
    """Limits a rate: amounts that come evenly pass, and so does a burst that is not too large.

    Parameters
    ----------
    rate : float
        Amount that may pass each second, on average.
    burst : float
        Amount that may pass at once after a pause.
    clock : callable
        Seconds that only grow.
    """

    def __init__(
        self, rate: float, burst: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.rate = rate
        self.burst = burst
        self._clock = clock
        self._left = burst
        self._at = clock()

    def take(self, amount: float = 1.0) -> bool:
        """Take an amount, if there is enough; returns whether there was."""
        self._fill()
        if amount > self._left:
            return False
        self._left -= amount
        return True

    def wait(self, amount: float = 1.0) -> float:
        """Seconds until that amount can be taken; infinite if it never can."""
        if amount > self.burst:
            return float("inf")
        self._fill()
        return max(amount - self._left, 0.0) / self.rate

    def _fill(self) -> None:
        now = self._clock()
        self._left = min(self.burst, self._left + (now - self._at) * self.rate)
        self._at = now

"""Limits of a client's requests; docs/serving.md has a table, and a test compares them."""

import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """Limits of one server, for a dozen people on one machine: average rates, and bursts."""

    browsers: int = 32
    browsers_per_second: float = 10.0
    browsers_at_once: float = 40.0
    messages_per_second: float = 200.0
    messages_at_once: float = 400.0
    bytes_per_second: float = 256.0 * 1024
    bytes_at_once: float = 1024.0 * 1024
    bad_messages: int = 100
    throttled_seconds: float = 10.0
    idle_seconds: float = 3600.0
    sign_ins_per_second: float = 1.0
    sign_ins_at_once: float = 10.0
    form_bytes: int = 2048
    connections: int = 512
    silent: int = 128
    request_seconds: float = 10.0
    fragments: int = 64
    pings_per_second: float = 2.0
    pings_at_once: float = 20.0
    stop_seconds: float = 5.0


class TokenBucket:
    """Token bucket: an average rate a second, and a burst after a pause."""

    def __init__(
        self, rate: float, burst: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.rate = rate
        self.burst = burst
        self._clock = clock
        self._left = burst
        self._at = clock()

    def take(self, amount: float = 1.0) -> bool:
        """Take an amount, if available; returns whether it was."""
        self._fill()
        if amount > self._left:
            return False
        self._left -= amount
        return True

    def wait(self, amount: float = 1.0) -> float:
        """Seconds until an amount is available; infinite above the burst."""
        if amount > self.burst:
            return float("inf")
        self._fill()
        return max(amount - self._left, 0.0) / self.rate

    def _fill(self) -> None:
        now = self._clock()
        self._left = min(self.burst, self._left + (now - self._at) * self.rate)
        self._at = now

"""Rates."""

import pytest

from hapticdb.server.limits import TokenBucket


class Clock:
    """A clock that a test moves."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def test_a_flood_passes_at_the_rate_after_the_burst() -> None:
    clock = Clock()
    bucket = TokenBucket(100.0, 10.0, clock)
    passed = 0
    for _ in range(10_000):
        clock.now += 0.001
        passed += bucket.take()
    assert passed == pytest.approx(10 + 1000, abs=2)


def test_the_wait_is_as_long_as_the_missing_amount_takes() -> None:
    clock = Clock()
    bucket = TokenBucket(100.0, 10.0, clock)
    assert bucket.take(10.0)
    assert bucket.wait(5.0) == pytest.approx(0.05)
    assert bucket.wait(11.0) == float("inf")
    clock.now += bucket.wait(5.0) + 1e-9
    assert bucket.take(5.0)

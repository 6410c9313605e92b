"""The hand of a hosted session between arrivals."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hapticdb.kernels.period.following import LONGEST_GAP_NS, STRETCH, follow_arrivals
from hapticdb.kernels.records.hand import HAND
from hapticdb.kernels.records.session import SLOT

MS = 1_000_000
"""Nanoseconds of a millisecond."""


class Followed:
    """A hand that starts at x = 0 and is told where to go."""

    def __init__(self, gap_ms: float) -> None:
        self.slot = np.zeros(1, SLOT)[0]
        self.hand = np.zeros(1, HAND)[0]
        self.slot.gap = round(gap_ms * MS)
        self.slot.segment.seconds = 1e-9
        for pose in (self.hand.quaternion, self.slot.segment.start[3:], self.slot.segment.end[3:]):
            pose[0] = 1.0

    def arrive(self, now: int, x: float, *, turn: float = 0.0) -> None:
        self.slot.hand_pose[:] = (x, 0.0, 0.0, math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2))
        self.slot.hand_time = now
        self.slot.hand_sequence += 2

    def at(self, now: int) -> float:
        follow_arrivals(self.slot, self.hand, now)
        return float(self.hand.position[0])


def test_followed_hand_constant_speed_then_rest() -> None:
    hand = Followed(gap_ms=40.0)
    hand.arrive(1000 * MS, 0.01)
    way = STRETCH * 40.0
    heights = [hand.at(round((1000 + share * way) * MS)) for share in (0.0, 0.25, 0.5, 1.0, 7.0)]
    assert heights == pytest.approx([0.0, 0.0025, 0.005, 0.01, 0.01], abs=1e-9)
    assert hand.hand.velocity[0] == 0.0


def test_followed_hand_constant_rotation() -> None:
    hand = Followed(gap_ms=40.0)
    hand.arrive(1000 * MS, 0.0, turn=0.4)
    hand.at(1000 * MS)
    hand.at(1025 * MS)
    assert 2.0 * math.atan2(hand.hand.quaternion[3], hand.hand.quaternion[0]) == pytest.approx(0.2)
    assert hand.hand.velocity[5] == pytest.approx(0.4 / 0.05)


@given(
    gaps=st.lists(st.integers(5, 100), min_size=2, max_size=20),
    steps=st.lists(st.floats(0.0, 0.01), min_size=20, max_size=20),
)
def test_followed_hand_continuous_without_overshoot(gaps: list[int], steps: list[float]) -> None:
    hand, now, x, last = Followed(gap_ms=33.0), 1000, 0.0, 0.0
    for gap, step in zip(gaps, steps, strict=False):
        x += step
        hand.arrive(now * MS, x)
        for _ in range(gap):
            place = hand.at(now * MS)
            assert last - 1e-12 <= place <= x + 1e-12
            assert place - last <= 0.05  # of a way of 0.2 at most
            last, now = place, now + 1
    delay = round(STRETCH * LONGEST_GAP_NS / MS)
    assert hand.at((now + delay) * MS) == pytest.approx(x, abs=1e-12)


def test_followed_hand_skips_torn_pose() -> None:
    hand = Followed(gap_ms=40.0)
    hand.arrive(1000 * MS, 0.01)
    hand.slot.hand_sequence += 1
    assert hand.at(1100 * MS) == 0.0
    hand.slot.hand_sequence += 1
    hand.at(1100 * MS)
    assert hand.at(1200 * MS) == pytest.approx(0.01)

"""The poses and velocities that a hand may have: the kernel, with the JIT and without."""

import math

import numpy as np
import pytest

from hapticdb.kernels.hand.handle import FARTHEST, is_somewhere

BEYOND = [math.nan, math.inf, -math.inf, 1e308, -1.001 * FARTHEST]


@pytest.mark.parametrize("number", BEYOND)
def test_a_reading_beyond_all_rooms_is_no_place(number: float) -> None:
    for at in range(18):
        numbers = np.zeros(18)
        numbers[at] = number
        pose = np.vstack([numbers[:12].reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
        assert not is_somewhere(pose, numbers[12:])


def test_a_reading_at_the_bound_is_a_place() -> None:
    for number in (0.0, FARTHEST, -FARTHEST):
        assert is_somewhere(np.full((4, 4), number), np.full(6, number))

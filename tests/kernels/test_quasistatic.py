"""The quasi-static coupling on closed-form distances."""

import numpy as np
import pytest

from closed_forms import Hand, field_of, plane, punch

ONSET = 1.5
"""Voxels at which contact begins."""


@pytest.mark.parametrize("size", [0.005, 0.0005, 0.000116])
@pytest.mark.parametrize("depth", [0.002, 0.005, 0.010])
def test_force_is_stiffness_times_depth_at_every_voxel_size(size: float, depth: float) -> None:
    hand = Hand(
        field_of(plane([0.0, 0.0, 1.0]), size), punch(3, 4.0 * size), [0.0, 0.0, 3.0 * size]
    )
    hand.advance()
    hand.move([0.0, 0.0, ONSET * size - depth])
    force = hand.rest(100)
    # distances are stored in steps of h / 254 voxels
    assert force[2] == pytest.approx(1000.0 * depth, rel=0.01, abs=1000.0 * size * 2.75 / 508)
    assert np.hypot(force[0], force[1]) < 1e-6


def test_the_force_is_exactly_zero_when_free() -> None:
    hand = Hand(field_of(plane([0.0, 0.0, 1.0]), 0.005), punch(3, 0.004), [0.0, 0.0, 0.03])
    assert (hand.advance() == 0.0).all()
    hand.move([0.0, 0.0, 0.0])
    assert hand.rest(30)[2] > 7.0
    hand.move([0.01, 0.0, 0.03])
    hand.rest(30)
    assert (hand.sent.wrench == 0.0).all()
    assert (hand.tool.position == hand.hand.position).all()

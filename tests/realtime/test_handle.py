"""The handle: scale, clutch, and where the hand is in the scene."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hapticdb.errors import UsageError
from hapticdb.kernels.coupling import HAND, HAND_VELOCITY, IS_STALE
from hapticdb.kernels.motion import poses_of
from hapticdb.realtime.devices import Reading
from hapticdb.realtime.handle import Handle
from realtime.worlds import turned

Floats = NDArray[np.float64]
SEEDS = st.integers(0, 2**32 - 1)
few = settings(max_examples=50, deadline=None)
SCALES = st.sampled_from([0.01, 0.5, 1.0, 3.0, 100.0])


def reading(rng: np.random.Generator, buttons: int = 0) -> Reading:
    return Reading(turned(rng, rng.uniform(-0.5, 0.5, 3)), rng.normal(size=6), buttons)


def pose(hand: Floats) -> Floats:
    out = np.empty((1, 4, 4))
    poses_of(hand[None, :7].copy(), out)
    found: Floats = out[0]
    return found


@few
@given(SEEDS)
def test_without_scale_and_clutch_the_handle_is_where_the_hand_is_exactly(seed: int) -> None:
    rng = np.random.default_rng(seed)
    handle, hand = Handle(), np.zeros(HAND)
    handle.start(reading(rng), hand)
    for _ in range(5):
        given_ = reading(rng, int(rng.integers(8)))
        handle.follow(given_, hand)
        np.testing.assert_array_equal(hand[:3], given_.pose[:3, 3])
        np.testing.assert_array_equal(hand[HAND_VELOCITY:IS_STALE], given_.velocity)
        np.testing.assert_allclose(pose(hand), given_.pose, atol=1e-14)


@few
@given(SEEDS, SCALES)
def test_positions_and_speeds_are_scaled_and_turns_are_not(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    handle, hand = Handle(scale=scale), np.zeros(HAND)
    handle.start(reading(rng), hand)
    given_ = reading(rng)
    handle.follow(given_, hand)
    np.testing.assert_allclose(hand[:3], scale * given_.pose[:3, 3])
    np.testing.assert_allclose(pose(hand)[:3, :3], given_.pose[:3, :3], atol=1e-14)
    np.testing.assert_allclose(hand[7:10], scale * given_.velocity[:3])
    np.testing.assert_allclose(hand[10:13], given_.velocity[3:])


@few
@given(SEEDS, SCALES)
def test_nothing_jumps_when_the_clutch_opens_and_closes(seed: int, scale: float) -> None:
    """However far the hand went and turned meanwhile."""
    rng = np.random.default_rng(seed)
    handle, hand = Handle(scale=scale, clutch=1), np.zeros(HAND)
    handle.start(reading(rng), hand)
    for _ in range(20):  # errors do not add up
        handle.follow(reading(rng), hand)
        before = hand.copy()
        for _ in range(3):
            handle.follow(reading(rng, buttons=0b10), hand)
            assert handle.is_open
            np.testing.assert_array_equal(hand[:7], before[:7])
            assert not hand[7:13].any()
        released = reading(rng)
        handle.follow(released, hand)
        assert not handle.is_open
        np.testing.assert_allclose(hand[:3], before[:3], atol=1e-12 * scale)
        np.testing.assert_allclose(pose(hand), pose(before), atol=1e-12 * max(scale, 1.0))
        np.testing.assert_allclose(hand[7:10], scale * released.velocity[:3])


@few
@given(SEEDS, SCALES)
def test_after_the_clutch_the_handle_moves_as_the_hand_does(seed: int, scale: float) -> None:
    """By the same way, scaled, and the same turn, about the world's axes."""
    rng = np.random.default_rng(seed)
    handle, hand = Handle(scale=scale, clutch=0), np.zeros(HAND)
    handle.start(reading(rng), hand)
    handle.follow(reading(rng, buttons=1), hand)
    first, second = reading(rng), reading(rng)
    handle.follow(first, hand)
    before = hand.copy()
    handle.follow(second, hand)
    way = second.pose[:3, 3] - first.pose[:3, 3]
    np.testing.assert_allclose(hand[:3] - before[:3], scale * way, atol=1e-12 * scale)
    turn = second.pose[:3, :3] @ first.pose[:3, :3].T
    np.testing.assert_allclose(pose(hand)[:3, :3], turn @ pose(before)[:3, :3], atol=1e-12)


@few
@given(SEEDS, SCALES)
def test_a_handle_starts_where_it_is_told_to(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    start = turned(rng, rng.uniform(-1, 1, 3))
    handle, hand = Handle(scale=scale, start=start), np.zeros(HAND)
    first = reading(rng)
    for _ in range(2):  # a second start begins anew
        handle.start(first, hand)
        np.testing.assert_allclose(pose(hand), start, atol=1e-12 * max(scale, 1.0))
        assert not hand[7:13].any()
        handle.follow(reading(rng), hand)


def test_other_buttons_leave_the_clutch_alone() -> None:
    handle, hand = Handle(clutch=2), np.zeros(HAND)
    rng = np.random.default_rng(0)
    handle.start(reading(rng), hand)
    handle.follow(reading(rng, buttons=0b1011), hand)
    assert not handle.is_open
    handle.follow(reading(rng, buttons=0b0100), hand)
    assert handle.is_open


@pytest.mark.parametrize("scale", [0.0, -1.0, math.nan, math.inf])
def test_a_scale_is_a_positive_number(scale: float) -> None:
    with pytest.raises(UsageError, match="give a number above 0"):
        Handle(scale=scale)


@pytest.mark.parametrize("clutch", [-1, 31])
def test_a_clutch_is_a_button(clutch: int) -> None:
    with pytest.raises(UsageError, match="give 0 to 30"):
        Handle(clutch=clutch)


def test_a_start_is_rigid() -> None:
    with pytest.raises(UsageError, match="rigid"):
        Handle(start=2.0 * np.eye(4))

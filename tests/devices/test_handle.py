"""The handle: scale, clutch, and the map from the hand's pose to the scene."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hapticdb.devices.handle import Hand, Handle
from hapticdb.devices.protocol import Reading
from hapticdb.errors import UsageError
from hapticdb.kernels.records.hand import HAND
from hapticdb.kernels.records.layout import pose_numbers
from hapticdb.poses import poses_of
from session.worlds import turned

Floats = NDArray[np.float64]
SEEDS = st.integers(0, 2**32 - 1)
few = settings(max_examples=20, deadline=None)
SCALES = st.sampled_from([0.01, 0.5, 1.0, 3.0, 100.0])


def reading(rng: np.random.Generator, buttons: int = 0) -> Reading:
    return Reading(turned(rng, rng.uniform(-0.5, 0.5, 3)), rng.normal(size=6), buttons)


def pose(hand: Hand) -> Floats:
    found: Floats = poses_of(pose_numbers(hand)[None])[0]
    return found


@few
@given(SEEDS)
def test_handle_identity_follows_hand_exactly(seed: int) -> None:
    rng = np.random.default_rng(seed)
    handle, hand = Handle(), np.zeros((), HAND)
    handle.start(reading(rng), hand)
    for _ in range(5):
        given_ = reading(rng, int(rng.integers(8)))
        handle.follow(given_, hand)
        np.testing.assert_array_equal(hand["position"], given_.pose[:3, 3])
        np.testing.assert_array_equal(hand["velocity"], given_.velocity)
        np.testing.assert_allclose(pose(hand), given_.pose, atol=1e-14)


@few
@given(SEEDS, SCALES)
def test_handle_scales_positions_not_rotations(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    handle, hand = Handle(scale=scale), np.zeros((), HAND)
    handle.start(reading(rng), hand)
    given_ = reading(rng)
    handle.follow(given_, hand)
    np.testing.assert_allclose(hand["position"], scale * given_.pose[:3, 3])
    np.testing.assert_allclose(pose(hand)[:3, :3], given_.pose[:3, :3], atol=1e-14)
    np.testing.assert_allclose(hand["velocity"][:3], scale * given_.velocity[:3])
    np.testing.assert_allclose(hand["velocity"][3:], given_.velocity[3:])


@few
@given(SEEDS, SCALES)
def test_handle_clutch_continuous(seed: int, scale: float) -> None:
    """Nothing jumps, however far the hand moved and turned while the clutch was open."""
    rng = np.random.default_rng(seed)
    handle, hand = Handle(scale=scale, clutch=1), np.zeros((), HAND)
    handle.start(reading(rng), hand)
    for _ in range(20):  # over many changes of the clutch errors must not add up
        handle.follow(reading(rng), hand)
        before = hand.copy()
        for _ in range(3):
            handle.follow(reading(rng, buttons=0b10), hand)
            assert hand["is_open"]
            np.testing.assert_array_equal(pose_numbers(hand), pose_numbers(before))
            assert not hand["velocity"].any()
        released = reading(rng)
        handle.follow(released, hand)
        assert not hand["is_open"]
        np.testing.assert_allclose(hand["position"], before["position"], atol=1e-12 * scale)
        np.testing.assert_allclose(pose(hand), pose(before), atol=1e-12 * max(scale, 1.0))
        np.testing.assert_allclose(hand["velocity"][:3], scale * released.velocity[:3])


@few
@given(SEEDS, SCALES)
def test_handle_after_clutch_follows_scaled_motion(seed: int, scale: float) -> None:
    """The handle moves by the scaled way and the same turn, in the world's axes."""
    rng = np.random.default_rng(seed)
    handle, hand = Handle(scale=scale, clutch=0), np.zeros((), HAND)
    handle.start(reading(rng), hand)
    handle.follow(reading(rng, buttons=1), hand)
    first, second = reading(rng), reading(rng)
    handle.follow(first, hand)
    before = hand.copy()
    handle.follow(second, hand)
    way = second.pose[:3, 3] - first.pose[:3, 3]
    np.testing.assert_allclose(
        hand["position"] - before["position"], scale * way, atol=1e-12 * scale
    )
    turn = second.pose[:3, :3] @ first.pose[:3, :3].T
    np.testing.assert_allclose(pose(hand)[:3, :3], turn @ pose(before)[:3, :3], atol=1e-12)


@few
@given(SEEDS, SCALES)
def test_handle_given_start_pose(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    start = turned(rng, rng.uniform(-1, 1, 3))
    handle, hand = Handle(scale=scale, start=start), np.zeros((), HAND)
    first = reading(rng)
    for _ in range(2):  # a second start discards the first
        handle.start(first, hand)
        np.testing.assert_allclose(pose(hand), start, atol=1e-12 * max(scale, 1.0))
        assert not hand["velocity"].any()
        handle.follow(reading(rng), hand)


def lost(rng: np.random.Generator, bad: float, at: int, buttons: int = 0) -> Reading:
    """A reading in which one number is not finite."""
    found = reading(rng, buttons)
    if at < 12:
        found.pose.ravel()[at] = bad
    else:
        found.velocity[at - 12] = bad
    return found


@few
@given(SEEDS, SCALES, st.sampled_from([math.nan, math.inf]), st.integers(0, 17))
def test_handle_ignores_non_finite_readings(seed: int, scale: float, bad: float, at: int) -> None:
    """Such readings have no effect, also while the clutch is open and when it closes."""
    rng = np.random.default_rng(seed)
    handles = [Handle(scale=scale, clutch=0) for _ in range(2)]
    hands = [np.zeros((), HAND) for _ in range(2)]
    first = reading(rng)
    for handle, hand in zip(handles, hands, strict=True):
        handle.start(first, hand)
    for buttons in rng.integers(2, size=30).tolist():
        for _ in range(int(rng.integers(3))):
            handles[0].follow(lost(rng, bad, at, int(rng.integers(2))), hands[0])
            assert math.isnan(hands[0]["position"][0])
            hands[1]["position"][0], kept = math.nan, hands[1]["position"][0]
            assert hands[0].tobytes() == hands[1].tobytes()
            hands[1]["position"][0] = kept
        given_ = reading(rng, buttons)
        for handle, hand in zip(handles, hands, strict=True):
            handle.follow(given_, hand)
            assert np.isfinite(pose_numbers(hand)).all()
            assert np.isfinite(hand["velocity"]).all()
        assert hands[0] == hands[1]


@few
@given(SEEDS, st.integers(0, 17), st.booleans())
def test_handle_starts_at_first_finite_reading(seed: int, at: int, is_placed: bool) -> None:
    rng = np.random.default_rng(seed)
    start = turned(rng, rng.uniform(-1, 1, 3)) if is_placed else None
    handle, hand = Handle(start=start), np.zeros((), HAND)
    handle.start(lost(rng, math.nan, at), hand)
    handle.follow(lost(rng, math.inf, at), hand)
    assert math.isnan(hand["position"][0])
    first = reading(rng)
    handle.follow(first, hand)
    np.testing.assert_allclose(pose(hand), first.pose if start is None else start, atol=1e-12)
    assert np.isfinite(pose_numbers(hand)).all()
    assert np.isfinite(hand["velocity"]).all()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"scale": 0.0}, "give a number above 0"),
        ({"scale": math.inf}, "give a number above 0"),
        ({"clutch": -1}, "give 0 to 30"),
        ({"clutch": 31}, "give 0 to 30"),
        ({"start": 2.0 * np.eye(4)}, "rigid"),
    ],
)
def test_handle_bad_options(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        Handle(**wrong)

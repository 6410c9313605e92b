"""Motion of hands: the kernels compared with closed forms, with the JIT and without."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hapticdb.kernels.motion import play, pull, survey, sway
from hapticdb.poses import quaternion_of, rotation_of

quaternions = (
    st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)


@given(quaternions, quaternions, st.floats(0.0, 1.0))
@settings(max_examples=50, deadline=None)
def test_turns_take_the_shorter_way_and_take_it_evenly(
    q: NDArray[np.float64], p: NDArray[np.float64], share: float
) -> None:
    knots = np.array([[0.0, 0, 0, 0, *q], [2.0, 1, 2, 3, *p]])
    pose, velocity = np.eye(4), np.zeros(6)
    play(2.0 * share, knots, pose, velocity)
    assert np.allclose(pose[:3, 3], share * np.array([1.0, 2.0, 3.0]))
    whole = 2.0 * math.acos(min(1.0, abs(float(q @ p))))
    turned = abs(float(quaternion_of(pose[:3, :3])[0] @ q))
    assert math.isclose(2.0 * math.acos(min(1.0, turned)), share * whole, abs_tol=1e-6)
    if share < 1.0:
        assert math.isclose(np.linalg.norm(velocity[3:]), whole / 2.0, abs_tol=1e-6)


def test_one_wave_is_a_sine() -> None:
    waves = np.zeros((6, 1, 4))
    waves[0] = 0.5, 3.0, 0.0, 0.0
    waves[5] = 1.2, 2.0, 0.0, 0.0
    pose, velocity = np.eye(4), np.zeros(6)
    sway(0.7, waves, np.eye(4), pose, velocity)
    angle = 1.2 * math.sin(1.4)
    assert np.allclose(pose[:3, 3], [0.5 * math.sin(2.1), 0, 0])
    assert np.allclose(pose[:2, 0], [math.cos(angle), math.sin(angle)])
    assert np.allclose(velocity, [1.5 * math.cos(2.1), 0, 0, 0, 0, 2.4 * math.cos(1.4)])
    assert np.allclose(survey(waves, 2.0 * math.pi, 400), [0.5, 1.5, 2.4], rtol=1e-3)


@given(quaternions)
@settings(max_examples=20, deadline=None)
def test_a_body_at_the_hand_stays_there(q: NDArray[np.float64]) -> None:
    hand = np.eye(4)
    hand[:3, :3], hand[:3, 3] = rotation_of(q)[0], (1.0, 2.0, 3.0)
    body = np.concatenate([[1.0, 2.0, 3.0], quaternion_of(hand[:3, :3])[0], np.zeros(6)])
    pose, velocity = np.eye(4), np.zeros(6)
    still = np.zeros(6)
    pull(20, 1e-4, 2e-3, 0.0, hand, still, still, (0.1, 1e-4), (300.0, 0.3), body, pose, velocity)
    assert np.allclose(pose, hand, atol=1e-12)
    assert np.allclose(velocity, 0.0, atol=1e-9)

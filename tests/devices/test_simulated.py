"""The simulated device: how it follows the hand, and when and how strongly a wrench acts."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from devices.test_scripted import SetClock
from hapticdb.devices.protocol import Reading
from hapticdb.devices.scripted import Player
from hapticdb.devices.simulated import SimulatedDevice
from hapticdb.errors import UsageError
from hapticdb.poses import quaternion_of, rotation_of


class Still:
    """A hand at the pose that the test sets."""

    def __init__(self) -> None:
        self.pose, self.velocity, self.buttons = np.eye(4), np.zeros(6), 0

    def read(self) -> Reading:
        return Reading(self.pose, self.velocity, self.buttons)

    def apply(self, wrench: NDArray[np.float64]) -> None:
        raise AssertionError(f"the person feels the device, not this: {wrench}")


def run(device: SimulatedDevice, clock: SetClock, seconds: float, rate: float = 1000.0) -> Reading:
    """Read at a rate in hertz for some seconds; return the last reading."""
    start = clock.now
    for n in range(1, round(seconds * rate) + 1):
        clock.now = start + n / rate
        reading = device.read()
    return reading


def angle_between(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(2.0 * np.arccos(min(1.0, abs(quaternion_of(a.T @ b)[0][0]))))


def energy(reading: Reading, hand: Still) -> float:
    """Kinetic energy of the default device and energy of its spring, in joules."""
    x = reading.pose[:3, 3] - hand.pose[:3, 3]
    v, w = reading.velocity[:3], reading.velocity[3:]
    angle = angle_between(reading.pose[:3, :3], hand.pose[:3, :3])
    return float(0.5 * (0.1 * v @ v + 1e-4 * w @ w + 300.0 * x @ x + 0.3 * angle * angle))


@given(
    st.lists(st.floats(-0.3, 0.3), min_size=3, max_size=3),
    st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).filter(
        lambda q: np.linalg.norm(q) > 0.1
    ),
)
@settings(max_examples=8, deadline=None)
def test_simulated_device_dissipates_to_hand(position: list[float], q: list[float]) -> None:
    clock, hand = SetClock(), Still()
    device = SimulatedDevice(hand, clock=clock)
    device.read()
    hand.pose = np.eye(4)
    hand.pose[:3, 3] = position
    hand.pose[:3, :3] = rotation_of(np.array(q) / np.linalg.norm(q))[0]
    last = energy(device.read(), hand)
    for _ in range(60):
        now = energy(run(device, clock, 0.01), hand)
        assert now <= last * (1.0 + 1e-6) + 1e-12
        last = now
    rested = device.read()
    assert np.allclose(rested.pose, hand.pose, atol=1e-5)
    assert np.allclose(rested.velocity, 0.0, atol=1e-4)


def test_simulated_device_step_response_closed_form() -> None:
    clock, hand = SetClock(), Still()
    device = SimulatedDevice(hand, clock=clock)
    device.read()
    hand.pose = np.eye(4)
    hand.pose[0, 3] = 0.01
    w = np.sqrt(300.0 / 0.1)
    for _ in range(50):
        x = run(device, clock, 0.001).pose[0, 3]
        t = clock.now
        assert x == pytest.approx(0.01 * (1.0 - (1.0 + w * t) * np.exp(-w * t)), abs=3e-5)


def test_simulated_device_latency() -> None:
    clock, hand = SetClock(), Still()
    device = SimulatedDevice(hand, latency=0.005, clock=clock)
    device.read()
    device.apply(np.array([1.0, 0, 0, 0, 0, 0.01]))
    assert run(device, clock, 0.0049, 10_000).velocity.tolist() == [0.0] * 6
    moved = run(device, clock, 0.0006, 10_000)
    # 1 N acts on 0.1 kg for half a millisecond
    assert moved.velocity[0] == pytest.approx(0.005, rel=0.05)
    assert moved.velocity[5] == pytest.approx(0.05, rel=0.05)


def test_simulated_device_wrench_order() -> None:
    clock, hand = SetClock(), Still()
    device = SimulatedDevice(hand, latency=0.002, grip=0.0, clock=clock)
    device.read()
    for force in (1.0, -1.0, 0.0):
        device.apply(np.array([force, 0, 0, 0, 0, 0]))
        clock.now += 0.001
    # one read applies all three: 1 ms forwards, 1 ms backwards, then no force
    clock.now = 0.010
    reading = device.read()
    assert reading.velocity[0] == pytest.approx(0.0, abs=1e-12)
    assert reading.pose[0, 3] == pytest.approx(0.001**2 / 0.1, rel=1e-6)


def test_simulated_device_force_cap() -> None:
    clock, hand = SetClock(), Still()
    device = SimulatedDevice(hand, clock=clock)
    device.read()
    device.apply(np.array([30.0, 40.0, 0, 0, 0, -5.0]))
    rested = run(device, clock, 1.0)
    assert np.allclose(rested.pose[:3, 3], [4.2 / 300.0, 5.6 / 300.0, 0.0], atol=1e-6)
    assert angle_between(np.eye(3), rested.pose[:3, :3]) == pytest.approx(0.2 / 0.3, abs=1e-4)


def test_simulated_device_long_pause_skipped() -> None:
    clock, hand = SetClock(), Still()
    device = SimulatedDevice(hand, grip=0.0, latency=0.0, clock=clock)
    device.read()
    device.apply(np.array([1.0, 0, 0, 0, 0, 0]))
    clock.now = 100.0
    # one read counts at most 50 ms, at 10 m/s^2
    assert device.read().velocity[0] == pytest.approx(0.5, rel=1e-3)


def test_simulated_device_buttons_and_end_of_hand() -> None:
    hand = Still()
    device = SimulatedDevice(hand)
    hand.buttons = 5
    assert device.read().buttons == 5
    assert not device.is_over
    clock = SetClock()
    scripted = SimulatedDevice(Player([0.0, 1.0], [np.eye(4)] * 2, clock=clock), clock=clock)
    for clock.now, is_over in ((0.0, False), (0.5, False), (1.1, True)):
        scripted.read()
        assert scripted.is_over == is_over


@pytest.mark.parametrize(
    "wrong", [{"mass": 0.0}, {"grip": -1.0}, {"latency": float("nan")}, {"mass": 1e-6}]
)
def test_simulated_device_bad_parameters(wrong: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        SimulatedDevice(Still(), **wrong)

"""The force of proxies over time: blended in, held, and let fall."""

import numpy as np
import pytest
from numpy.typing import NDArray

from hapticdb.client.proxy_force import FADE, HOLD, OLDEST, ProxyForce
from hapticdb.protocol.contacts import (
    FINE,
    IS_LOOSE,
    IS_WAITING,
    PLANE,
    UNIT,
    ProxyState,
    ProxyTerms,
)

Floats = NDArray[np.float64]
SIZE, PERIOD, STEP = 0.005, 0.01, 1e-3
TERMS = ProxyTerms(
    "a", (0.0, 0.0, 0.0), SIZE, 1000.0, 0.025, 7.0, 0.035, 5e4, SIZE, 1.5 * SIZE, PERIOD
)
STILL = np.zeros(6)
SERIES = 1000.0 * 5e4 / 5.1e4
"""Stiffness of spring and contact in series, N/m."""


def hand(z: float) -> Floats:
    return np.array([0.0, 0.0, z, 1.0, 0.0, 0.0, 0.0])


def proxy(surface: float = 0.0, sent: float = 0.0, flags: int = 0, n_planes: int = 1) -> ProxyState:
    """A point tool at rest on a level plane: contact begins at z = surface."""
    planes = np.zeros(n_planes, PLANE)
    planes["normal"][:, 2], planes["along"][:, 0], planes["weight"] = UNIT, 127, 1
    planes["depth"] = round(surface / SIZE / FINE)
    return ProxyState(
        1, 0, 1, sent, 0.0, sent, flags, SIZE, np.zeros(3), np.eye(4)[0], np.zeros(3),
        np.eye(4)[0], np.zeros(6), np.zeros((6, 6)), 1000.0, 0.025, planes,
    )  # fmt: skip


def fed(force: ProxyForce, until: float, z: float, begin: float = 0.0) -> Floats:
    """Forces (M,) while proxies arrive in time, a millisecond apart."""
    forces = []
    for n in range(round(begin / STEP), round(until / STEP)):
        now = n * STEP
        if n % round(PERIOD / STEP) == 0:
            force.take(proxy(sent=now), now)
        forces.append(force.wrench(hand(z), STILL, now)[2])
    return np.array(forces)


def test_the_force_is_that_of_both_springs_in_series() -> None:
    assert fed(ProxyForce(TERMS), 0.2, -2e-3)[-1] == pytest.approx(2e-3 * SERIES, rel=1e-3)


def test_nothing_pulls_beside_the_surface() -> None:
    force = ProxyForce(TERMS)
    fed(force, 0.2, -2e-3)
    assert not fed(force, 0.3, 1e-3, begin=0.2)[round(PERIOD / STEP) + 1 :].any()


def test_without_proxies_the_force_holds_and_then_falls_to_zero() -> None:
    force = ProxyForce(TERMS)
    full = fed(force, 0.2, -2e-3)[-1]
    last = 0.19  # the last arrival
    for n in range(200, 300):
        now = n * STEP
        felt = force.wrench(hand(-2e-3), STILL, now)[2]
        late = now - last - PERIOD - HOLD
        assert felt == pytest.approx(full * min(max(1.0 - late / FADE, 0.0), 1.0), abs=0.02)
    assert felt == 0.0
    assert not force.told.is_fresh


def test_the_force_does_not_jump_back_when_proxies_come_again() -> None:
    force = ProxyForce(TERMS)
    full = fed(force, 0.2, -2e-3)[-1]
    for n in range(200, 300):
        force.wrench(hand(-2e-3), STILL, n * STEP)
    forces = fed(force, 0.4, -2e-3, begin=0.3)
    assert np.abs(np.diff(forces)).max() < 2.0 * full * STEP / FADE
    assert forces[-1] == pytest.approx(full, rel=1e-3)


def test_a_proxy_that_waited_too_long_is_not_used() -> None:
    force = ProxyForce(TERMS)
    assert not force.take(proxy(sent=0.0), OLDEST + 0.01)
    assert not force.take(proxy(sent=1.0, flags=IS_WAITING), 1.0)
    assert force.take(proxy(sent=1.0), 1.0)


def test_a_new_proxy_is_blended_in_over_a_period() -> None:
    force = ProxyForce(TERMS)
    before = fed(force, 0.2, -2e-3)[-1]
    force.take(proxy(surface=-1e-3, sent=0.2), 0.2)
    forces = [force.wrench(hand(-2e-3), STILL, 0.2 + n * STEP)[2] for n in range(12)]
    after = 1e-3 * SERIES
    expected = [after + max(1.0 - n / 10.0, 0.0) * (before - after) for n in range(12)]
    assert forces == pytest.approx(expected, abs=0.02)


def test_a_tool_that_lies_in_something_feels_nothing() -> None:
    force = ProxyForce(TERMS)
    for n in range(100):
        force.take(proxy(sent=n * STEP, flags=IS_LOOSE), n * STEP)
        assert not force.wrench(hand(-2e-3), STILL, n * STEP).any()


def test_a_hand_without_a_place_feels_less_and_less() -> None:
    force = ProxyForce(TERMS)
    full = fed(force, 0.2, -2e-3)[-1]
    nowhere = np.full(7, np.nan)
    felt = [force.wrench(nowhere, STILL, 0.2 + n * STEP)[2] for n in range(1, 40)]
    assert felt[0] < full
    assert np.diff(felt).max() <= 0.0
    assert felt[-1] == 0.0


def test_damping_acts_along_the_force_and_never_pulls() -> None:
    force = ProxyForce(TERMS, damping=100.0)
    full = fed(force, 0.2, -2e-3)[-1]
    away = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    force.take(proxy(sent=0.2), 0.2)
    assert force.wrench(hand(-2e-3), away, 0.2)[2] == 0.0
    assert force.wrench(hand(-2e-3), -0.01 * away, 0.2)[2] == pytest.approx(full + 1.0)
    assert force.wrench(hand(-2e-3), -away, 0.2)[2] == pytest.approx(2.0 * full)


def test_damping_leaves_the_torque_as_it_is() -> None:
    """The handle is half a voxel beside the tool's centre, so the force has a moment about it."""
    terms = TERMS._replace(center=(SIZE / 2.0, 0.0, 0.0))
    plain, damped = ProxyForce(terms), ProxyForce(terms, damping=100.0)
    for force in (plain, damped):
        fed(force, 0.2, -2e-3)
    down = np.array([0.0, 0.0, -0.01, 0.0, 0.0, 0.0])
    expected = plain.wrench(hand(-2e-3), down, 0.2)
    found = damped.wrench(hand(-2e-3), down, 0.2)
    assert found[2] == pytest.approx(expected[2] + 1.0)
    assert abs(expected[4]) > 1e-3
    assert found[3:] == pytest.approx(expected[3:])

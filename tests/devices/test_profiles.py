"""Device profiles, and the rule that says how stiff a session may be."""

import math
import pickle
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hapticdb.devices import stability
from hapticdb.devices.profiles import (
    PROFILES,
    SCRIPTED,
    UNKNOWN,
    DeviceProfile,
    profile_named,
    profile_of,
)
from hapticdb.devices.scripted import RandomHand
from hapticdb.devices.simulated import SimulatedDevice
from hapticdb.devices.vendors.force_dimension import ForceDimensionDevice
from hapticdb.devices.vendors.haply import HaplyDevice
from hapticdb.devices.vendors.openhaptics import OpenHapticsDevice
from hapticdb.errors import UsageError

RATES = st.floats(10.0, 20_000.0)
DELAYS = st.floats(0.0, 0.1)
profiles = st.builds(
    DeviceProfile,
    st.just("any"),
    st.floats(0.1, 50.0),
    st.floats(10.0, 10_000.0),
    st.floats(0.0, 50.0),
    mass=st.none() | st.floats(0.01, 2.0),
    own_damping=st.floats(0.0, 10.0),
)


def test_profile_named_any_spelling() -> None:
    assert profile_named("Premium 1.5") is PROFILES["premium-1.5"]
    assert profile_named("OMEGA") is PROFILES["omega"]
    with pytest.raises(UsageError, match=r"no device profile 'omeag': give touch, omni, .*sigma"):
        profile_named("omeag")


def test_profile_of_unopened_devices() -> None:
    assert profile_of(RandomHand((0, 0, 0))) is SCRIPTED
    assert profile_of(OpenHapticsDevice()) == PROFILES["touch"]
    assert profile_of(OpenHapticsDevice(profile=PROFILES["desktop"])).cap == 7.9
    omega = profile_of(ForceDimensionDevice(profile=PROFILES["omega"]))
    assert (omega.cap, omega.stiffness, omega.torque_cap) == (12.0, 5000.0, 0.2)
    assert profile_of(ForceDimensionDevice()).cap == 7.0
    assert profile_of(pickle.loads(pickle.dumps(HaplyDevice()))).cap == 7.0  # noqa: S301 - its own
    assert profile_of(object()) is UNKNOWN
    with pytest.raises(UsageError, match=r"\.profile is of the type str; give a hapticdb"):
        profile_of(SimpleNamespace(profile="omega"))


def test_profile_of_simulated_device() -> None:
    hand = RandomHand((0, 0, 0))
    device = SimulatedDevice(hand, mass=0.2, grip=450.0, max_force=5.0, latency=0.002)
    profile = profile_of(device)
    assert (profile.cap, profile.torque_cap, profile.delay) == (5.0, 0.2, 0.002)
    assert profile.first_stiffness == 1000.0
    assert stability.hand_damping(profile) == pytest.approx(2.0 * math.sqrt(450.0 * 0.2))
    assert profile_of(SimulatedDevice(hand, max_force=0.0)).cap > 0.0


def test_device_profile_bad_numbers() -> None:
    wrong: dict[str, Any] = {"cap": 0, "turn_stiffness": math.nan, "damping": math.inf, "delay": -1}
    for field, value in wrong.items():
        with pytest.raises(UsageError, match=f"profile desktop: {field} "):
            replace(PROFILES["desktop"], **{field: value})
    for asked in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(UsageError, match=r"a stiffness of .* N/m: give 1 or more"):
            stability.limit_stiffness(PROFILES["omni"], 1000.0, asked)


# -- the rule -------------------------------------------------------------------------------------


def test_stable_stiffness_closed_form() -> None:
    """0.4 (b + 0.6 sqrt(100 m)) / (T/2 + t_d), by hand."""
    profile = DeviceProfile("mine", 10.0, 1e5, 5.0, mass=0.09, own_damping=0.2)
    # 0.6 sqrt(9) = 1.8; (0.2 + 1.8) * 0.4 = 0.8; at 1 kHz and 1 ms: 0.8 / 1.5 ms
    assert stability.stable_stiffness(profile, 1000.0, 1e-3) == pytest.approx(1600.0 / 3.0)
    assert stability.stable_stiffness(profile, 5000.0, 0.0) == pytest.approx(8000.0)
    assert stability.hand_damping(profile) == pytest.approx(1.8)


def test_limit_stiffness_message() -> None:
    desktop = PROFILES["desktop"]
    found = stability.limit_stiffness(desktop, 1000.0, 3000.0, 1e-3)
    assert found.stiffness == pytest.approx(0.4 * 0.6 * math.sqrt(4.5) / 1.5e-3)
    assert "3000 N/m lowered to 339.4 N/m: at 1 kHz and 1 ms" in str(found.lowered)
    found = stability.limit_stiffness(desktop, 10_000.0, 3000.0, 0.0)
    assert found.stiffness == 1000.0
    assert "the most that the profile desktop allows" in str(found.lowered)
    assert "0.045 kg assumed" in str(stability.limit_stiffness(PROFILES["omega"], 500.0).lowered)


def test_limit_stiffness_scripted_hand_unlimited() -> None:
    assert stability.limit_stiffness(SCRIPTED, 10.0).stiffness == 1000.0
    assert stability.limit_stiffness(SCRIPTED, 10.0, 1e5).stiffness == 1e5


@given(profiles, RATES, DELAYS, st.floats(1.0, 1e5))
def test_limit_stiffness_upper_bounds(
    profile: DeviceProfile, rate: float, delay: float, asked: float
) -> None:
    found = stability.limit_stiffness(profile, rate, asked, delay)
    stable = 0.4 * (profile.own_damping + stability.hand_damping(profile)) / (0.5 / rate + delay)
    assert found.stiffness == max(min(asked, profile.stiffness, stable), stability.SMALLEST)
    assert (found.lowered is None) == (found.stiffness == asked)

"""The numbers of a device's coupling, and that they are the device's at every scale."""

import math
from dataclasses import asdict, replace

import pytest

from hapticdb.devices.profiles import PROFILES, SCRIPTED, DeviceProfile
from hapticdb.devices.stability import limit_stiffness
from hapticdb.errors import UsageError
from hapticdb.session.coupling import Coupling

OMNI = PROFILES["omni"]


def test_coupling_settled_from_profile_or_given() -> None:
    found = Coupling().settled(OMNI, 10_000.0, 1.0, 0.1)
    assert (found.profile, found.stiffness, found.cap) == ("omni", 700.0, 3.3)
    # K (T / 2 + t_d), with a delay of one period
    assert found.damping == pytest.approx(700.0 * 1.5e-4)
    assert found.turn_stiffness == pytest.approx(700.0 * 0.1**2)
    assert found.torque_cap == pytest.approx(0.33)
    assert found.lowered is None
    given = Coupling(
        stiffness=500.0, cap=2.0, turn_stiffness=0.3, torque_cap=0.1, damping=1.0, delay=1e-4
    ).settled(OMNI, 10_000.0, 1.0, 0.1)
    assert (given.stiffness, given.cap, given.turn_stiffness) == (500.0, 2.0, 0.3)
    assert (given.torque_cap, given.damping, given.delay) == (0.1, 1.0, 1e-4)


def test_coupling_given_profile_wins() -> None:
    found = Coupling(profile=PROFILES["delta"]).settled(OMNI, 20_000.0, 1.0, 0.1)
    assert (found.profile, found.cap) == ("delta", 20.0)
    known = DeviceProfile("mine", 5.0, 600.0, 2.0, torque_cap=0.3, turn_stiffness=4.0)
    found = Coupling(profile=known).settled(OMNI, 20_000.0, 1.0, 0.1)
    assert (found.torque_cap, found.turn_stiffness) == (0.3, 4.0)


def test_coupling_stiffness_lowered_to_stable() -> None:
    found = Coupling(stiffness=650.0).settled(OMNI, 1000.0, 1.0, 0.1)
    allowed = limit_stiffness(OMNI, 1000.0, 650.0)
    assert found.stiffness == allowed.stiffness < 650.0
    assert found.lowered == allowed.lowered is not None
    assert found.requested_stiffness == 650.0
    assert found.turn_stiffness == pytest.approx(found.stiffness * 0.1**2)


def test_coupling_damping_of_device_limit() -> None:
    slow = Coupling(stiffness=1000.0).settled(
        replace(SCRIPTED, damping=5.0, delay=0.1), 100.0, 1.0, 0.1
    )
    assert slow.damping == 5.0


@pytest.mark.parametrize("scale", [0.01, 100.0])
def test_coupling_scale_invariant(scale: float) -> None:
    """The tool is S times as large in the scene, so its lever at the device is the same."""
    at_one = asdict(Coupling().settled(OMNI, 5000.0, 1.0, 0.1))
    found = asdict(Coupling().settled(OMNI, 5000.0, scale, 0.1 * scale))
    for name in ("stiffness", "cap", "turn_stiffness", "torque_cap", "damping"):
        assert found[name] == pytest.approx(at_one[name], rel=1e-12)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("stiffness", 0.0, "stiffness of 0.0 N/m: give a number above 0"),
        ("damping", -1.0, "damping of -1.0 N s/m: give 0 or more"),
        ("delay", math.inf, "delay of inf s: give 0 or more"),
    ],
)
def test_coupling_bad_values(name: str, value: float, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        Coupling(**{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize("scale", [0.1, 10.0])
def test_coupling_direct_caps_scale_invariant(scale: float) -> None:
    found = Coupling().direct(OMNI, scale, 0.1 * scale)
    assert (found.profile, found.cap) == ("omni", 3.3)
    assert found.torque_cap == pytest.approx(0.33)
    given = Coupling(cap=2.0, torque_cap=0.1, profile=PROFILES["delta"]).direct(OMNI, scale, 0.1)
    assert (given.profile, given.cap, given.torque_cap) == ("delta", 2.0, 0.1)

"""Direct rendering: what the device gets of a frame at the hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray

from hapticdb.kernels.hand.device_spring import DeviceSpring
from hapticdb.kernels.hand.direct import render
from hapticdb.kernels.hand.fading import IS_FADING, IS_HELD, RISE_FRAMES
from hapticdb.kernels.records.hand import RESULT, SERVO
from hapticdb.kernels.records.layout import views_of
from hapticdb.poses import rotation_of

Floats = NDArray[np.float64]
TERMS = DeviceSpring(
    stiffness=0.0, turn_stiffness=0.0, cap=5.0, turn_cap=0.4, damping=0.0, scale=2.0, radius=0.1,
    hold=0.02, fade=0.02,
)  # fmt: skip
CENTER = np.array([0.01, -0.02, 0.03])
DT = 1e-3
NUMBERS = st.lists(st.floats(-20.0, 20.0), min_size=6, max_size=6)


class Tool:
    """A hand at a turned pose, with a tool that feels what a test says."""

    def __init__(self) -> None:
        self.servo = np.zeros((), SERVO)
        views = views_of(self.servo)
        self.tool, self.hand, self.sent = views.tool, views.hand, views.sent
        self.hand.position[:] = (0.1, 0.2, 0.3)
        self.hand.quaternion[:] = (0.8, 0.0, 0.6, 0.0)
        self.felt = np.zeros((), RESULT)

    def evaluate(self, wrench: ArrayLike, unknown: int = 0) -> None:
        self.felt["wrench"], self.felt["hits"], self.felt["unknown"] = wrench, 3, unknown
        render(TERMS, CENTER, self.servo[()], self.felt[()], DT)

    def feel_long(self, wrench: ArrayLike, unknown: int = 0) -> Floats:
        """Wrench at the device after a time in which forces rise or fall to their end."""
        for _ in range(round(2.0 * (TERMS.hold + TERMS.fade) / DT)):
            self.evaluate(wrench, unknown)
        return np.array(self.sent.wrench)


@given(wrench=NUMBERS)
def test_direct_wrench_of_frame_up_to_caps(wrench: list[float]) -> None:
    """Force as in the scene; the torque about the handle's origin is the scene's over the scale."""
    tool = Tool()
    found = tool.feel_long(wrench)
    force, torque = np.array(wrench[:3]), np.array(wrench[3:])
    force *= min(1.0, TERMS.cap / max(float(np.linalg.norm(force)), 1e-300))
    most = TERMS.turn_cap * TERMS.scale
    torque *= min(1.0, most / max(float(np.linalg.norm(torque)), 1e-300))
    lever = rotation_of(tool.hand.quaternion)[0] @ CENTER
    expected = np.concatenate([force, (torque + np.cross(lever, force)) / TERMS.scale])
    np.testing.assert_allclose(found, expected, atol=1e-12)
    assert np.linalg.norm(found[:3]) <= TERMS.cap * (1.0 + 1e-12)
    assert tool.tool.felt.wrench.tolist() == wrench  # what is recorded has no cap
    assert (int(tool.sent.hits), int(tool.sent.marks)) == (3, 0)


def test_direct_force_ramps_up_from_zero() -> None:
    tool = Tool()
    rising = []
    for _ in range(30):
        tool.evaluate((0.0, 0.0, 3.0, 0.0, 0.0, 0.0))
        rising.append(float(tool.sent.wrench[2]))
    steps = np.diff([0.0, *rising])
    assert (steps >= 0.0).all()
    assert steps.max() <= 3.0 / RISE_FRAMES + 1e-12
    assert rising[0] == pytest.approx(3.0 * DT / TERMS.fade)
    assert rising[-1] == 3.0


@pytest.mark.parametrize("lost", ["unknown", "stale", "nowhere"])
def test_direct_force_fades_without_knowledge(lost: str) -> None:
    tool = Tool()
    full = tool.feel_long((0.0, 0.0, 3.0, 0.0, 0.0, 0.0))
    before = np.array(tool.tool.position)
    tool.hand.position[0] = np.nan if lost == "nowhere" else 0.5
    tool.hand.is_stale[()] = lost == "stale"
    unknown = 4 if lost == "unknown" else 0
    tool.evaluate(np.zeros(6), unknown)
    assert (tool.sent.wrench == full).all()
    assert int(tool.sent.marks) == IS_HELD
    assert not tool.feel_long(np.zeros(6), unknown).any()
    assert int(tool.sent.marks) == IS_HELD | IS_FADING
    assert (tool.tool.position == before).all()
    assert int(tool.sent.unknown) == unknown


def test_direct_force_fades_with_open_clutch() -> None:
    tool = Tool()
    assert tool.feel_long((0.0, 0.0, 3.0, 0.0, 0.0, 0.0))[2] == 3.0
    tool.hand.is_open[()] = True
    assert not tool.feel_long((0.0, 0.0, 3.0, 0.0, 0.0, 0.0)).any()

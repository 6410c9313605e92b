"""The wrench that the hand gets from the coupling: its point, limit, rise and fall."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from hapticdb import PointShell
from hapticdb.kernels.hand import coupling as kernels
from hapticdb.poses import quaternion_of, rotation_of
from realtime.coupled import SIDE, SIZE, Tool, World, box, numbers_in, punch
from realtime.worlds import block

Floats = NDArray[np.float64]
MIDDLE = SIDE // 2
FLOOR = block((MIDDLE - 12, MIDDLE - 12, MIDDLE - 4), (MIDDLE + 11, MIDDLE + 11, MIDDLE - 1))
RISE = 20
"""Number of frames of 1 ms in which a wrench rises from zero or falls to zero."""


@pytest.fixture
def floor() -> World:
    return World(FLOOR)


def rotation(vector: Floats) -> Floats:
    """Rotation (3, 3) by a turn vector (3,)."""
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle > 0.0 else np.zeros(3)
    quaternion = np.array([math.cos(0.5 * angle), *(math.sin(0.5 * angle) * axis)])
    found: Floats = rotation_of(quaternion)[0]
    return found


def turn_vector(matrix: Floats) -> Floats:
    q = quaternion_of(matrix)[0]
    q = q if q[0] >= 0.0 else -q
    sine = float(np.linalg.norm(q[1:]))
    return np.zeros(3) if sine == 0.0 else 2.0 * math.atan2(sine, q[0]) / sine * q[1:]


def share(tool: Tool) -> float:
    """Share of the full wrench that is sent to the hand."""
    full = tool.state.kept
    assert np.abs(full).max() > 0.0
    found = float(tool.sent.wrench @ full / (full @ full))
    np.testing.assert_allclose(tool.sent.wrench, found * full, atol=1e-15)
    return found


def shares(tool: Tool, n_frames: int) -> list[float]:
    found = []
    for _ in range(n_frames):
        tool.advance()
        found.append(share(tool))
    return found


def pressing(world: World) -> Tool:
    """A box that a hand presses on the floor; the wrench has fully risen."""
    tool = Tool(world, box((0.02, 0.02, 0.02)), (0.0, 0.0, 0.02))
    tool.hand.position[2] = 0.005
    tool.settle(0.3)
    assert tool.n_hits > 0
    assert share(tool) == 1.0
    return tool


# --- the point of the wrench ----------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(8))
def test_the_wrench_is_the_energys_gradient_at_the_handles_origin(floor: World, seed: int) -> None:
    """Work on the hand therefore equals the springs' loss of energy, for any centre of mass."""
    rng = np.random.default_rng(seed)
    flat = punch(3)
    center = rng.uniform(-0.05, 0.05, 3)
    shell = PointShell(flat.points, flat.normals, center, is_closed=False)
    tool = Tool(floor, shell, (0.0, 0.0, -0.6 * SIZE))
    tool.state.risen[()] = 1.0
    tool.hand.position[:] += rng.uniform(-0.1, 0.1, 3) * SIZE
    first = rotation(rng.uniform(-0.05, 0.05, 3) * SIZE / tool.body.radius)
    tool.hand.quaternion[:] = quaternion_of(first)[0]

    def energy(step: Floats) -> float:
        turned = rotation(step[3:]) @ first
        way = tool.hand.position + step[:3] + turned @ center - (tool.state.position + center)
        turn = turn_vector(turned)
        return float(0.5 * tool.body.spring * way @ way + 0.5 * tool.body.turn_spring * turn @ turn)

    tool.advance(0.0)
    assert tool.n_hits == len(shell)
    steps = 1e-6 * np.eye(6)
    gradient = np.array([(energy(step) - energy(-step)) / 2e-6 for step in steps])
    np.testing.assert_allclose(tool.sent.wrench, -gradient, rtol=1e-5, atol=1e-7)


# --- the limit of the wrench ----------------------------------------------------------------------


@pytest.mark.parametrize("speed", [5.0, 1e3])
def test_no_reading_makes_the_force_in_contact_larger_than_spring_and_clamp(
    floor: World, speed: float
) -> None:
    tool = pressing(floor)
    most = tool.body.spring * SIZE
    tool.hand.velocity[:3] = 0.0, 0.0, -speed
    tool.advance()
    assert tool.n_hits > 0
    assert np.linalg.norm(tool.sent.wrench[:3]) == pytest.approx(most, rel=0.1)
    assert np.linalg.norm(tool.sent.wrench[:3]) <= most * (1 + 1e-9)
    tool.hand.velocity[:] = 0.0, 0.0, 0.0, 0.0, 0.0, 100.0 * speed
    tool.advance()
    assert tool.n_hits > 0
    most_torque = most * tool.body.radius
    assert 0.4 * most_torque < np.linalg.norm(tool.sent.wrench[3:6]) <= most_torque * (1 + 1e-9)


def test_a_slow_hand_feels_all_of_the_damper(floor: World) -> None:
    """Below the limit the damper's force is sent unchanged."""
    tool = pressing(floor)
    at_rest = tool.sent.wrench[:3].copy()
    tool.hand.velocity[0] = 0.01
    tool.advance(1e-9)
    damped = at_rest[0] - tool.body.damping * 0.01
    assert tool.sent.wrench[0] == pytest.approx(damped, abs=1e-4)


# --- rise and fall --------------------------------------------------------------------------------


def test_a_session_that_starts_in_material_begins_softly(floor: World) -> None:
    tool = Tool(floor, box((0.02, 0.02, 0.02)), (0.0, 0.0, 0.0))
    tool.hand.position[2] = -0.001
    found = shares(tool, RISE + 10)
    assert found[:RISE] == pytest.approx(np.arange(1, RISE + 1) / RISE)
    assert found[RISE + 1 :] == [1.0] * 9


def test_a_start_in_free_space_leaves_the_first_contact_as_it_is(floor: World) -> None:
    tool = Tool(floor, box((0.02, 0.02, 0.02)), (0.0, 0.0, 0.02))
    tool.settle(0.03)
    tool.hand.position[2] = 0.005
    n_felt = 0
    for _ in range(100):
        tool.advance()
        if tool.n_hits:
            full = tool.state.kept
            assert tool.sent.wrench.tobytes() == full.tobytes()
            n_felt += 1
    assert n_felt > 50


@pytest.mark.parametrize(("n_held", "left"), [(10, 1.0), (30, 0.5), (60, 0.0)])
def test_after_a_hold_the_wrench_rises_from_where_it_fell_to(
    floor: World, n_held: int, left: float
) -> None:
    tool = pressing(floor)
    tool.hand.is_stale[()] = 1.0
    assert shares(tool, n_held)[-1] == pytest.approx(left)
    tool.hand.is_stale[()] = 0.0
    found = shares(tool, RISE + 10)
    rising = np.minimum(left + np.arange(1, RISE + 11) / RISE, 1.0)
    assert found == pytest.approx(rising)
    assert found[-1] == 1.0


def test_after_a_fall_no_period_however_long_raises_the_wrench_at_once(floor: World) -> None:
    tool = pressing(floor)
    tool.hand.is_stale[()] = 1.0
    tool.advance(1.0)
    assert not tool.sent.wrench.any()  # a fall counts the whole period
    tool.hand.is_stale[()] = 0.0
    found = []
    for _ in range(kernels.RISE_FRAMES + 1):
        tool.advance(1.0)
        found.append(share(tool))
    rising = np.arange(1, kernels.RISE_FRAMES + 1) / kernels.RISE_FRAMES
    assert found == pytest.approx([*rising, 1.0])


@pytest.mark.parametrize("is_held", [False, True])
def test_an_open_clutch_lets_the_hand_go_and_takes_it_again_softly(
    floor: World, *, is_held: bool
) -> None:
    tool = pressing(floor)
    tool.hand.is_open[()] = 1.0
    tool.hand.is_stale[()] = float(is_held)
    falling = shares(tool, RISE + 10)
    assert falling[: RISE // 2] == pytest.approx(1.0 - np.arange(1, 11) / RISE)
    assert (np.diff(falling[:RISE]) < 0.0).all()
    assert falling[RISE + 1 :] == pytest.approx([0.0] * 9, abs=1e-12)
    assert not tool.sent.wrench.any()
    tool.hand.is_open[()] = tool.hand.is_stale[()] = 0.0
    found = shares(tool, RISE + 10)
    assert found[:RISE] == pytest.approx(np.arange(1, RISE + 1) / RISE)
    assert found[-1] == 1.0


# --- NaN, infinities and absurd values ------------------------------------------------------------


@pytest.mark.parametrize("field", ["position", "quaternion", "velocity", "kept", "held_for"])
def test_a_state_that_is_not_finite_is_placed_anew(floor: World, field: str) -> None:
    shell = box((0.02, 0.02, 0.02))
    tool = pressing(floor)
    good = tool.servo["hand"].copy()
    tool.servo["tool"][field].flat[0] = math.nan
    tool.hand.position[0] = math.nan
    for _ in range(3):
        tool.advance()
        assert tool.flags & kernels.IS_HELD
        assert not tool.sent.wrench.any()
    tool.servo["hand"][()] = good
    fresh = Tool(floor, shell, good["position"])
    for n in range(50):
        if n == 10:
            tool.hand.position[2] = fresh.hand.position[2] = 0.03
        tool.advance()
        fresh.advance()
        if field in {"position", "quaternion"}:
            for same in ("position", "quaternion", "velocity", "kept", "held_for"):
                assert getattr(tool.state, same).tobytes() == getattr(fresh.state, same).tobytes()
            assert tool.sent.wrench.tobytes() == fresh.sent.wrench.tobytes()
        assert np.isfinite(numbers_in(tool.servo)).all()
    assert tool.state.position[2] > 0.02


@pytest.mark.parametrize("far", [-1e3, -1e6, -1e30, -1e38, 1e40, -1e60])
def test_one_absurd_place_of_the_hand_moves_the_tool_no_farther_than_its_steps(far: float) -> None:
    """Once the hand is back, the tool soon follows."""
    tool = Tool(World(), box((0.02, 0.02, 0.02)), (0.0, 0.0, 0.03))
    tool.settle(0.02)
    for n_frames in (1, 30):
        for _ in range(n_frames):
            before = tool.state.position.copy()
            tool.hand.position[2] = far
            tool.advance()
            moved = float(np.linalg.norm(tool.state.position - before))
            assert moved <= 0.5 * SIZE * tool.sent.n_steps * (1 + 1e-9)
        tool.hand.position[2] = 0.03
        tool.settle(1.0)
        np.testing.assert_allclose(tool.state.position, (0.0, 0.0, 0.03), atol=1e-6)


def test_a_hand_beyond_all_numbers_pushes_nothing(floor: World) -> None:
    """The pose is finite, but the way overflows: the wrench stays finite, the tool recovers."""
    tool = pressing(floor)
    good = tool.servo["hand"].copy()
    tool.hand.position[:] = 1e308, -1e308, 1e308
    tool.hand.velocity[:3] = -1e308
    for _ in range(3):
        tool.advance()
        assert np.isfinite(tool.sent.wrench).all()
    tool.servo["hand"][()] = good
    tool.settle(0.3)
    assert np.isfinite(numbers_in(tool.servo["tool"])).all()
    np.testing.assert_allclose(tool.state.position[:2], good["position"][:2], atol=SIZE)

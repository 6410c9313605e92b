"""Contact proxies beside the coupling that they stand for, on closed-form distances."""

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from closed_forms import (
    Field,
    Hand,
    corner,
    cylinder,
    field_of,
    plane,
    punch,
    wedge,
)
from hapticdb.kernels.hand.device_spring import contact_stiffness
from hapticdb.kernels.proxy.evaluate import PUSHING, RESULTS, WAY, evaluate
from hapticdb.kernels.proxy.linearize import linearize
from hapticdb.kernels.proxy.planes import ROW_COLUMNS
from hapticdb.kernels.records import CONTACT_MODEL, MOST_PLANES, pose_numbers
from hapticdb.kernels.rigid import product, quaternion_by

Floats = NDArray[np.float64]
Model = NDArray[np.void]
NEEDS_JIT = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="too slow without the JIT")
SIZE = 0.005
ONSET = 1.5 * SIZE
STIFFNESS = 1000.0
"""N/m of `closed_forms.SPRING`."""
POINT = np.zeros((1, 3))
UP = (0.0, 0.0, 1.0)


def model_of(hand: Hand) -> Model:
    """Proxy of a hand's last period."""
    model = np.zeros((), CONTACT_MODEL)
    rows = np.zeros((len(hand.shell.points), ROW_COLUMNS))
    linearize(
        hand.field.cells, 0, hand.shell, hand.field.place, hand.spring, hand.servo, hand.follower,
        hand.rows, rows, model,
    )  # fmt: skip
    return model


def evaluated(model: Model, at: Floats) -> Floats:
    """Result of a proxy with the handle at (7,)."""
    result = np.zeros(RESULTS)
    evaluate(model, np.ascontiguousarray(at), result)
    return result


def handle(hand: Hand) -> Floats:
    """Handle (7,) of a hand, a copy."""
    return pose_numbers(hand.servo["hand"]).copy()


def pressed(field: Field, points: Floats, at: Floats, above: Floats) -> Hand:
    """A hand at `at` that came from `above` it and rested."""
    hand = Hand(field, points, at + above)
    for share in np.linspace(1.0, 0.0, 60):
        hand.move(at + share * above)
    hand.rest(40)
    return hand


def turned(at: Floats, turn: Floats) -> Floats:
    """Handle (7,) after a turn (3,) about its origin."""
    after = at.copy()
    after[3:] = product(*quaternion_by(*turn), *at[3:])
    return after


def test_one_point_on_a_plane_is_two_springs_in_series() -> None:
    hand = pressed(
        field_of(plane(UP), SIZE), POINT, np.array([0, 0, ONSET - 2e-3]), 4e-3 * np.eye(3)[2]
    )
    model = model_of(hand)
    contact = float(contact_stiffness(hand.spring, SIZE))
    expected = STIFFNESS * contact / (STIFFNESS + contact)
    assert model["n_planes"] == 1
    assert model["stiffness"][2, 2] == pytest.approx(expected, rel=1e-3)
    others = model["stiffness"].copy()
    others[2, 2] = 0.0
    assert np.abs(others).max() < 1e-3 * expected
    assert model["wrench"][2] == pytest.approx(expected * 2e-3, rel=0.02)


def test_a_proxy_of_a_plane_is_the_coupling_however_far_the_hand_moves() -> None:
    field = field_of(plane((0.3, 0.1, 1.0)), SIZE)
    hand = pressed(field, POINT, np.array([0.0, 0.0, ONSET - 2e-3]), np.array([0.0, 0.0, 4e-3]))
    model = model_of(hand)
    for by in ([0.004, 0.0, 0.0], [0.0, -0.006, 0.001], [0.002, 0.002, -0.002]):
        position = np.array([0.0, 0.0, ONSET - 2e-3]) + by
        hand.move(position)
        force = hand.rest(3)
        assert evaluated(model, handle(hand))[:3] == pytest.approx(force, abs=0.06)


def test_a_contact_ends_where_the_hand_lifts_off() -> None:
    hand = pressed(
        field_of(plane(UP), SIZE),
        punch(3, SIZE),
        np.array([0, 0, ONSET - 2e-3]),
        4e-3 * np.eye(3)[2],
    )
    model = model_of(hand)
    at = handle(hand)
    at[2] = ONSET + 1e-3
    result = evaluated(model, at)
    assert not result[:6].any()
    assert result[PUSHING] == 0
    assert result[WAY] == pytest.approx(3e-3)


def test_a_free_tool_has_no_planes_and_says_how_far_it_may_move() -> None:
    hand = Hand(field_of(plane(UP), SIZE), POINT, [0.0, 0.0, 0.06])
    hand.rest(3)
    model = model_of(hand)
    assert model["n_planes"] == 0
    assert not model["wrench"].any()
    assert not model["stiffness"].any()
    assert 0.0 < model["trust"] <= 0.06 - ONSET


@NEEDS_JIT
@pytest.mark.parametrize("shape", ["plane", "cylinder", "corner"])
def test_the_stiffness_is_the_slope_of_the_coupling(shape: str) -> None:
    """Central differences of the coupling's wrench, by hands 20 um and 0.3 mrad apart."""
    points = punch(3, 0.6 * SIZE)
    points[:, 2] -= points[:, 2].mean()
    if shape == "plane":
        field, at = field_of(plane((0.2, 0.0, 1.0)), SIZE), np.array([0.0, 0.0, ONSET - 1e-3])
    elif shape == "cylinder":
        field, at = field_of(cylinder(0.06), SIZE), np.array([0.0, 0.0, 0.06 + ONSET - 2e-3])
        points = POINT
    else:
        field, at = field_of(corner(), SIZE), np.array([ONSET - 1e-3, 0.0, ONSET - 1.5e-3])
        points = np.array([[2.0 * SIZE, 0.0, 0.0], [0.0, 0.0, 2.0 * SIZE]])
    above = np.array([4e-3, 0.0, 4e-3]) if shape == "corner" else np.array([0.0, 0.0, 4e-3])
    hand = pressed(field, points, at, above)
    model = model_of(hand)
    first = handle(hand)
    center = hand.shell.center
    slope = np.zeros((6, 6))
    for axis in range(6):
        step = 2e-5 if axis < 3 else 3e-4
        ends = []
        for sign in (1.0, -1.0):
            way = np.zeros(6)
            way[axis] = sign * step
            after = turned(first, way[3:])
            # the turn is about the tool's centre
            shift = way[:3] + (lever(first, center) - lever(after, center))
            pose_numbers(hand.servo["hand"])[:3] = first[:3] + shift
            pose_numbers(hand.servo["hand"])[3:] = after[3:]
            hand.rest(40)
            wrench = hand.sent.wrench.copy()
            wrench[3:] -= np.cross(lever(handle(hand), center), wrench[:3])
            ends.append(wrench)
        slope[:, axis] = -(ends[0] - ends[1]) / (2.0 * step)
    scale = np.array([1.0, 1.0, 1.0, SIZE, SIZE, SIZE])
    unit = np.outer(scale, scale)
    error = np.abs((slope - model["stiffness"]) / unit).max()
    assert error < 0.06 * np.abs(slope / unit).max()


def lever(at: Floats, center: Floats) -> Floats:
    """Lever from the handle's origin to the tool's centre (3,)."""
    w, v = at[3], at[4:]
    return np.asarray(center + 2.0 * np.cross(v, np.cross(v, center) + w * center))


@NEEDS_JIT
def test_the_stiffness_is_symmetric_and_softer_than_the_spring() -> None:
    hand = pressed(
        field_of(corner(), SIZE), punch(7, 0.6 * SIZE), np.array([4.0 * SIZE, 0.0, ONSET - 1e-3]),
        np.array([0.0, 0.0, 4e-3]),
    )  # fmt: skip
    stiffness = model_of(hand)["stiffness"]
    assert (stiffness == stiffness.T).all()
    values = np.linalg.eigvalsh(stiffness[:3, :3])
    assert values[0] > -1e-6 * STIFFNESS
    assert values[-1] <= STIFFNESS * (1.0 + 1e-9)


@NEEDS_JIT
def test_many_points_become_few_planes_that_keep_force_and_tilt() -> None:
    points = punch(17, 0.6 * SIZE)
    hand = pressed(
        field_of(plane(UP), SIZE), points, np.array([0, 0, ONSET - 2e-3]), 4e-3 * np.eye(3)[2]
    )
    model = model_of(hand)
    assert 4 <= model["n_planes"] <= MOST_PLANES
    at = handle(hand)
    force = evaluated(model, at)
    assert force[2] == pytest.approx(float(hand.sent.wrench[2]), rel=5e-3)
    assert np.abs(force[3:6]).max() < 2e-3
    # the face resists a tilt with the whole turning spring
    tilt = evaluated(model, turned(at, np.array([0.02, 0.0, 0.0])))
    assert tilt[3] == pytest.approx(-0.02 * hand.spring.turn_stiffness, rel=0.1)


def slid(hand: Hand, path: Floats, period: int) -> tuple[Floats, Floats]:
    """Forces of the coupling and of proxies (M, 3) along a path, a proxy every `period`."""
    exact, near = np.zeros_like(path), np.zeros_like(path)
    model = model_of(hand)
    for n, place in enumerate(path):
        exact[n] = hand.move(place)
        near[n] = evaluated(model, handle(hand))[:3]
        if n % period == period - 1:
            model = model_of(hand)
    return exact, near


@NEEDS_JIT
@pytest.mark.parametrize(("speed", "bound"), [(0.05, 0.03), (0.2, 0.12)])
def test_a_proxy_goes_round_a_convex_edge(speed: float, bound: float) -> None:
    """RMS error of proxies at 100 Hz as a share of the force; a plane alone has 3 times as much."""
    depth, reach = 0.8 * SIZE, ONSET - 0.8 * SIZE
    angles = np.arange(0.0, np.pi / 2, speed * 1e-3 / reach) - np.pi / 4
    ways = np.arange(0.02, 0.0, -speed * 1e-3)
    down = np.array([np.sin(np.pi / 4), 0.0, -np.cos(np.pi / 4)])
    round_it = reach * np.stack([np.sin(angles), 0.0 * angles, np.cos(angles)], axis=1)
    before = round_it[0] + ways[:, None] * down * np.array([-1.0, 1.0, 1.0])
    after = round_it[-1] + ways[::-1, None] * down
    path = np.vstack([before, round_it, after])
    field = field_of(wedge(np.pi / 2), SIZE)
    out = np.array([-np.sin(np.pi / 4), 0.0, np.cos(np.pi / 4)])
    hand = pressed(field, POINT, path[0], 6e-3 * out)
    exact, near = slid(hand, path, period=10)
    error = float(np.sqrt(((exact - near) ** 2).sum(axis=1).mean()))
    force = float(np.sqrt((exact**2).sum(axis=1).mean()))
    assert force > 0.8 * STIFFNESS * depth
    assert error < bound * force


def test_a_depth_beyond_the_onset_gives_no_nan() -> None:
    """Only a wrong server sends one: there is no surface behind the surface."""
    field = field_of(plane(UP), SIZE)
    model = model_of(pressed(field, POINT, np.array([0, 0, ONSET - 2e-3]), 4e-3 * np.eye(3)[2]))
    at = model["hand"].copy()
    for depth in np.linspace(0.5, 4.0, 8) * SIZE:
        model["depths"][0], model["bends"][0] = depth, 4.0 / SIZE
        for by in ([0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.01, 0.0, 0.008], [-0.02, 0.01, 0.02]):
            moved = at.copy()
            moved[:3] += by
            assert np.isfinite(evaluated(model, moved)).all()


@NEEDS_JIT
@pytest.mark.parametrize("turn_stiffness", [0.5, 0.005])
def test_the_stiffness_stays_the_springs_where_a_tool_bulges_away(turn_stiffness: float) -> None:
    """Below the cap and at it, on a round rod as thin as a voxel, at a lever."""
    field, points = field_of(cylinder(SIZE), SIZE), np.array([[0.0, 0.0, -0.03], [0.0, 0.0, 0.03]])
    at = np.array([0.0, 0.0, SIZE + ONSET + 0.03])
    hand = Hand(field, points, at + 2e-3 * np.eye(3)[2], turn_stiffness=turn_stiffness, cap=2.0)
    for down in np.linspace(-2e-3, 20e-3, 120):
        hand.move(at - down * np.eye(3)[2])
        spring = np.repeat([STIFFNESS, turn_stiffness], 3)
        shares = model_of(hand)["stiffness"] / np.sqrt(np.outer(spring, spring))
        assert np.abs(np.linalg.eigvalsh(shares)).max() < 1.0 + 1e-6
    assert np.linalg.norm(hand.sent.wrench[:3]) == pytest.approx(2.0)

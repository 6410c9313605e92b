"""The measures of the feel on hands whose force is known, and the scenes and persons they use."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from hapticdb import PointShell
from hapticdb.bench.feel import sliding, stability
from hapticdb.bench.feel.couplings import STIFFNESS, Grasp, Side, Terms, drive, posed, straight
from hapticdb.bench.feel.ground import Ground
from hapticdb.bench.feel.person import FIRM, LIGHT, Grip, Person, step_matrix
from hapticdb.bench.feel.scenes import (
    FILLING,
    Scene,
    concave_corner,
    convex_edge,
    cylinder,
    hole,
    plane,
    plate,
    slope_axes,
)
from hapticdb.bench.feel.sliding import ABOVE, way_round_edge
from hapticdb.bench.feel.tools import flat_tool

Floats = NDArray[np.float64]
AXES = slope_axes(20.0)


class Instant(NamedTuple):
    """What a known law may depend on: N/m, m, m, m/s."""

    k: float
    depth: float
    along: float
    speed: float


Law = Callable[[Instant], float]


class KnownHand:
    """A hand over a plane whose normal force is a function of depth and way."""

    def __init__(self, shell: PointShell, pose: Floats, terms: Terms, law: Law) -> None:
        self.normal = shell.normals[0]
        self.start = pose[:3, 3].copy()
        self.terms, self.law, self.tool = terms, law, self.start

    def step(self, pose: Floats, velocity: Floats) -> Floats:
        way = pose[:3, 3] - self.start
        height = float(way @ self.normal)
        along = float(np.linalg.norm(way - height * self.normal))
        depth = -ABOVE - height
        speed = -float(velocity[:3] @ self.normal)
        instant = Instant(self.terms.stiffness, depth, along, speed)
        force = self.law(instant) if depth > 0.0 else 0.0
        return np.asarray(force * self.normal)

    def placed(self, points: Floats) -> Floats:
        return points + self.tool


def side_of(law: Law) -> Side:
    """A side whose hands have a known force."""

    def grasp(_: Ground, shell: PointShell, pose: Floats, terms: Terms) -> KnownHand:
        return KnownHand(shell, pose, terms, law)

    made: Grasp = grasp
    return Side("known", 0.0, made, distances=False)


SPRING = side_of(lambda now: now.k * now.depth)


def test_an_ideal_spring_reaches_every_target_of_a_led_hand(tmp_path: Path) -> None:
    assert sliding.ripple_of_sessions(SPRING, tmp_path, 1)["values"] == pytest.approx(
        [0.0] * 3, abs=1e-9
    )
    found, _ = sliding.press(SPRING, tmp_path, 0.005)
    assert found["forces"] == pytest.approx([2.0, 5.0, 10.0])
    entering = sliding.step_on_entering(SPRING, tmp_path, 0)["values"]
    assert entering == pytest.approx([STIFFNESS * 0.01 / 1000.0])
    lifted, pressed = sliding.lift_and_press(SPRING, tmp_path)
    assert lifted["values"] == [0.0]
    assert pressed["values"] == pytest.approx([1.0], abs=0.02)


def test_a_law_with_a_known_ripple_has_that_ripple(tmp_path: Path) -> None:
    """A wave of 10 % and 2 mm along the way."""
    waves = side_of(lambda now: now.k * now.depth * (1 + 0.1 * math.sin(1e3 * np.pi * now.along)))
    found = sliding.ripple_of_sessions(waves, tmp_path, 0)
    assert found["values"] == pytest.approx([0.1 / math.sqrt(2.0)] * 3, rel=0.02)
    assert (found["unfelt"], found["slides"]) == (0, 8)


def test_a_damper_that_holds_a_hand_back_is_seen_at_lift_off(tmp_path: Path) -> None:
    sticky = side_of(lambda now: now.k * now.depth + 5.0 * now.speed)
    lifted, pressed = sliding.lift_and_press(sticky, tmp_path)
    assert lifted["values"] == pytest.approx([-5.0 * 0.2], abs=0.25)
    assert pressed["values"][0] < 0.0


def test_the_tap_of_an_ideal_spring_overshoots_as_its_oscillator_does(tmp_path: Path) -> None:
    """The arm stops suddenly: a mass between grip and wall, integrated in tiny steps."""
    found, _ = stability.tap(SPRING_FROM_TAP, tmp_path)
    grip, depth, speed = FIRM, -stability.TAP_HEIGHT, stability.TAP_SPEED
    x, v, dt, peak = depth, 0.0, 1e-6, 0.0
    damping = grip.damping + 0.2
    for n in range(round(stability.TAP_SECONDS / dt)):
        target = min(-stability.TAP_HEIGHT + speed * n * dt, stability.TAP_DEPTH)
        rate = speed if target < stability.TAP_DEPTH else 0.0
        pull = grip.stiffness * (target - x) + grip.damping * rate - damping * v
        v += dt * (pull - STIFFNESS * max(x, 0.0)) / 0.1
        x += dt * v
        peak = max(peak, STIFFNESS * x)
    steady = STIFFNESS * grip.stiffness / (STIFFNESS + grip.stiffness) * stability.TAP_DEPTH
    assert found["steady"] == pytest.approx(steady, rel=1e-3)
    # the spring is sampled at 1 kHz, which adds half a period of delay
    assert found["values"][0] == pytest.approx(peak / steady - 1.0, abs=0.05)


def grasp_from_tap(_: Ground, shell: PointShell, pose: Floats, terms: Terms) -> KnownHand:
    """A spring whose hand starts higher than the other measures' hands."""
    higher = stability.TAP_HEIGHT - ABOVE
    return KnownHand(
        shell, posed(pose[:3, 3] - higher * shell.normals[0]), terms, lambda now: now.k * now.depth
    )


SPRING_FROM_TAP = Side("known", 0.0, grasp_from_tap, distances=False)


# --- the stiffest wall ----------------------------------------------------------------------------


def spectral_radius(grip: Grip, stiffness: float, period: float, n_late: int) -> float:
    """Of one period of a mass, its grip and a sampled, delayed spring: above 1, it diverges."""
    step = step_matrix(grip, period)
    size = 2 + n_late
    matrix = np.zeros((size, size))
    matrix[:2, :2] = step[:, :2]
    if n_late:
        matrix[:2, 2] = step[:, 2]
        for n in range(2, size - 1):
            matrix[n, n + 1] = 1.0
        matrix[size - 1, 0] = -stiffness
    else:
        matrix[:2, 0] -= stiffness * step[:, 2]
    return float(np.abs(np.linalg.eigvals(matrix)).max())


@pytest.mark.parametrize(("grip", "n_late"), [(LIGHT, 0), (LIGHT, 2), (FIRM, 1), (FIRM, 2)])
def test_the_stiffest_wall_is_where_the_eigenvalues_say(
    grip: Grip, n_late: int, tmp_path: Path
) -> None:
    """Near the limit an oscillation decays so slowly that it counts as a limit cycle."""
    low, high = 50.0, 50_000.0
    for _ in range(40):
        middle = math.sqrt(low * high)
        stable = spectral_radius(grip, middle, 1e-3, n_late) < 1.0
        low, high = (middle, high) if stable else (low, middle)
    scene = plane("wall", AXES)
    with Ground.of_scenes(tmp_path, [scene], 0.005, distances=False) as ground:
        stand = sliding.stand_on(SPRING, ground, scene)

        def is_stable(stiffness: float) -> bool:
            terms = Terms(stiffness, 1000.0, n_late * 1e-3)
            return stability.rests(SPRING, ground, stand, grip, terms)

        found = stability.stiffest(is_stable)
    assert 0.8 * low < found < 1.02 * low


def test_the_stiffest_is_found_between_its_bounds() -> None:
    assert stability.stiffest(lambda k: k < 1234.0) == pytest.approx(1234.0, rel=0.02)
    assert stability.stiffest(lambda k: k > 0.0) == stability.STIFFEST
    assert stability.stiffest(lambda k: k < 0.0) == 0.0


# --- a person -------------------------------------------------------------------------------------


def test_a_person_is_stepped_exactly() -> None:
    """Two half periods are one period, and a free mass falls as Galileo says."""
    whole, half = step_matrix(LIGHT, 1e-2), step_matrix(LIGHT, 5e-3)
    state = np.array([0.1, -0.2, 3.0, 0.05, 0.4])
    middle = half @ state
    again = np.array([*middle, 3.0, 0.05 + 0.4 * 5e-3, 0.4])
    assert half @ again == pytest.approx(whole @ state, rel=1e-12)
    free = step_matrix(Grip("none", 0.0, 0.0), 1e-4)
    assert free[0, 2] == pytest.approx(0.5 * 1e-8 / 0.1, rel=1e-3)


def test_a_force_acts_after_its_delay() -> None:
    person = Person(FIRM, 1e-3, 2e-3, np.zeros(3))
    places = []
    for n in range(4):
        person.move(np.array([0.0, 0.0, 1.0 if n == 0 else 0.0]), np.zeros(3))
        places.append(person.position[2])
    assert places[:2] == [0.0, 0.0]
    assert places[2] > 0.0


# --- scenes and ways ------------------------------------------------------------------------------


def distance_to(triangles: Floats, point: Floats) -> float:
    """Distance from a point (3,) to triangles (T, 3, 3), by all their points, edges and faces."""
    least = math.inf
    for a, b, c in triangles:
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal)
        foot = point - (point - a) @ normal * normal
        inside = all(
            np.cross(q - p, foot - p) @ normal >= -1e-12 for p, q in ((a, b), (b, c), (c, a))
        )
        if inside:
            least = min(least, float(np.linalg.norm(point - foot)))
        for p, q in ((a, b), (b, c), (c, a)):
            share = np.clip((point - p) @ (q - p) / ((q - p) @ (q - p)), 0.0, 1.0)
            least = min(least, float(np.linalg.norm(point - p - share * (q - p))))
    return least


@pytest.mark.parametrize(
    "scene",
    [plane("plane", AXES), cylinder(20.0, AXES), convex_edge(AXES), concave_corner(AXES)],
    ids=lambda scene: str(scene.name),
)
def test_a_scene_has_the_distances_that_it_says(scene: Scene) -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(0.1, 4.0, (20, 3)) * (1.0, 1.0, 1.0)
    if scene.name == "convex edge":
        points[:10, 0] *= -1.0  # over the upper face
    assert scene.distance is not None
    exact = scene.distance(points)
    found = [distance_to(scene.triangles, scene.axes @ point) for point in points]
    assert found == pytest.approx(exact.tolist(), abs=2e-4 * 2)


def test_a_plate_is_closed_and_a_sheet_is_flat() -> None:
    assert len(plate("plate", 0.5, AXES, 10.0).triangles) == 12
    sheet = plate("sheet", 0.0, AXES, 10.0)
    assert np.abs(sheet.triangles @ AXES[:, 2]).max() < 1e-12
    assert len(hole(12.0, AXES).triangles) == 8


def test_a_filled_scene_leaves_no_voxel_free_below_its_surface(tmp_path: Path) -> None:
    scene = plane("floor", AXES, FILLING, half=8.0)
    with Ground.of_scenes(tmp_path, [scene], 0.005, distances=False) as ground:
        shell = flat_tool(5, ground.size, scene.axes)
        for depth in np.linspace(0.05, 2.5, 20):
            place = ground.origins["floor"] - depth * ground.size * AXES[:, 2]
            assert len(ground.environment.touch(shell, posed(place)).hits) == 25


def test_a_flat_tool_lies_along_its_surface() -> None:
    shell = flat_tool(17, 0.005, AXES)
    assert len(shell) == 289
    assert np.abs(shell.points @ AXES[:, 2]).max() < 1e-15
    assert shell.normals @ AXES[:, 2] == pytest.approx(np.ones(289))


@pytest.mark.parametrize("radius", [0.0055, -0.002, 0.0])
def test_a_way_round_an_edge_keeps_its_distance(radius: float) -> None:
    path, outward = way_round_edge(radius, 0.02)
    assert np.linalg.norm(outward, axis=1) == pytest.approx(np.ones(len(path)))
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 1.2 * sliding.SPEED / 1000.0
    if radius > 0.0:
        edge = convex_edge(np.eye(3))
        assert edge.distance is not None
        assert edge.distance(path) == pytest.approx(np.full(len(path), radius))


def test_a_hand_is_led_along_its_way() -> None:
    path = straight(np.zeros(3), np.array([0.0, 0.0, -0.01]), 0.05)
    shell = flat_tool(1, 0.005, np.eye(3))
    way = drive(KnownHand(shell, posed(path[0]), Terms(), lambda now: now.speed), path)
    assert len(way.forces) == len(path) == 201
    assert way.forces[-1] == pytest.approx([0.0, 0.0, 0.05])

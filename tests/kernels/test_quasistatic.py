"""The quasi-static coupling on closed-form distances."""

import math
from typing import Any

import numba
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize

import naive_field
from closed_forms import (
    UPRIGHT,
    Field,
    Hand,
    corner,
    cylinder,
    field_of,
    hole,
    moved,
    plane,
    plate,
    punch,
    sheet,
    wedge,
)
from draws import is_every
from hapticdb.kernels.hand import quasistatic
from hapticdb.kernels.hand.device_spring import contact_stiffness
from hapticdb.kernels.hand.fading import IS_HELD
from hapticdb.kernels.rigid import product, quaternion_by

Floats = NDArray[np.float64]
NEEDS_JIT = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="too slow without the JIT")
ONSET = 1.5
"""Voxels at which contact begins."""
SIZE = 0.005
STORED = 2.75 / 508
"""Voxels by which a stored distance may be wrong."""


def unit(vector: Any) -> Floats:  # noqa: ANN401 - anything array-like
    direction: Floats = np.asarray(vector, float) / np.linalg.norm(vector)
    return direction


def facing(normal: Floats) -> Floats:
    """Quaternion that turns +z to a unit vector."""
    return unit([1.0 + normal[2], -normal[1], normal[0], 0.0])


def steps_of(forces: Floats) -> float:
    """Largest change of a force (M, 3) from one period to the next, N."""
    return float(np.linalg.norm(np.diff(forces, axis=0), axis=1).max())


def pressed(field: Field, points: Floats, at: Floats, way: Floats, **spring: float) -> Hand:
    """A hand that has come to `at` from `at` - `way`, in 60 periods, and rested."""
    hand = Hand(field, points, at - way, **spring)
    hand.advance()
    for share in np.linspace(0.0, 1.0, 60):
        hand.move(at - (1.0 - share) * way)
    hand.rest(20)
    return hand


@pytest.mark.parametrize("size", [0.005, 0.0005, 0.000116])
@pytest.mark.parametrize("depth", [0.002, 0.005, 0.010])
def test_coupling_force_is_stiffness_times_depth(size: float, depth: float) -> None:
    at, way = np.array([0.0, 0.0, ONSET * size - depth]), np.array([0.0, 0.0, -3.0 * size - depth])
    force = pressed(field_of(plane([0.0, 0.0, 1.0]), size), punch(3, 4.0 * size), at, way).advance()
    assert force[2] == pytest.approx(1000.0 * depth, rel=0.01, abs=1000.0 * size * STORED)
    assert math.hypot(force[0], force[1]) < 1e-6


def test_coupling_force_cap() -> None:
    at, way = np.array([0.0, 0.0, -0.03]), np.array([0.0, 0.0, -0.06])
    field = field_of(plane([0.0, 0.0, 1.0]), SIZE)
    assert pressed(field, punch(3, 0.004), at, way, cap=8.0).advance()[2] == pytest.approx(8.0)


def test_coupling_force_zero_in_free_space() -> None:
    hand = Hand(field_of(plane([0.0, 0.0, 1.0]), SIZE), punch(3, 0.004), [0.0, 0.0, 0.03])
    assert (hand.advance() == 0.0).all()
    hand.move([0.0, 0.0, 0.0])
    assert hand.rest(30)[2] > 7.0
    hand.move([0.01, 0.0, 0.03])
    hand.rest(30)
    assert (hand.sent.wrench == 0.0).all()
    assert (hand.tool.position == hand.hand.position).all()


@NEEDS_JIT
@pytest.mark.parametrize("normal", [(0, 0, 1), (0.087, 0, 1), (0.364, 0, 1), (1, 0, 1), (3, -2, 4)])
@pytest.mark.parametrize("n_across", [3, 10])
def test_coupling_plane_ripple(normal: tuple[float, float, float], n_across: int) -> None:
    up = unit(normal)
    along = unit(np.cross(up, [1.0, 0.3, 0.1]))
    field, points = field_of(plane(up), SIZE), punch(n_across, 0.015 / n_across)
    for depth, most in ((0.0005, 0.02), (0.002, 0.01), (0.010, 0.002)):
        at = up * (ONSET * SIZE - depth)
        hand = Hand(field, points, at + 0.02 * up, facing(up))
        hand.advance()
        hand.move(at - 0.02 * along)
        hand.rest(20)
        sliding = [hand.move(at + x * along) @ up for x in np.arange(-0.02, 0.02, 1e-4)]
        assert np.std(sliding) / np.mean(sliding) <= most
        assert np.abs(np.diff(sliding)).max() <= 0.05


@NEEDS_JIT
@pytest.mark.parametrize("size", [0.005, 0.0005])
def test_coupling_convex_edge_smooth_and_outward(size: float) -> None:
    """The hand goes round a right angle at constant depth below the surface of contact."""
    depth = 0.3 * size
    reach = ONSET * size - depth
    slopes = np.repeat([-np.pi / 4.0, np.pi / 4.0], 300)
    turns = np.arange(-np.pi / 4.0, np.pi / 4.0, min(1e-4, size / 10.0) / reach)
    slopes = np.insert(slopes, 300, turns)
    way = np.concatenate([np.arange(-300, 0), np.zeros(len(turns)), np.arange(300)])
    normals = np.stack([np.sin(slopes), np.zeros(len(slopes)), np.cos(slopes)], axis=1)
    along = np.stack([np.cos(slopes), np.zeros(len(slopes)), -np.sin(slopes)], axis=1)
    path = reach * normals + (0.02 * size * way)[:, None] * along
    field = field_of(wedge(np.pi / 2.0), size)
    hand = pressed(field, np.zeros((1, 3)), path[0], -3.0 * size * normals[0])
    forces = np.array([hand.move(at) for at in path])
    assert steps_of(forces) <= 0.05
    outward = (forces * normals).sum(axis=1)
    assert (outward > 0.0).all()
    aside = np.linalg.norm(forces - outward[:, None] * normals, axis=1)
    assert (aside / np.linalg.norm(forces, axis=1)).max() <= 0.20


@NEEDS_JIT
@pytest.mark.parametrize("size", [0.005, 0.0005])
@pytest.mark.parametrize("n_across", [1, 3])
def test_coupling_corner_stable(size: float, n_across: int) -> None:
    """Gauss-Newton alone overshoots here as soon as force over voxel size exceeds stiffness."""
    hand = Hand(
        field_of(corner(), size), punch(n_across, 0.5 * size), [6.0 * size, 0.0, 6.0 * size],
        turn_stiffness=2.0,
    )  # fmt: skip
    hand.advance()
    way = np.linspace(6.0 * size, -0.004, 400)
    forces = np.array([hand.move([x, 0.0, x]) for x in way])
    step = math.sqrt(2.0) * abs(way[1] - way[0])
    # one larger step remains where the corner is first noticed
    assert steps_of(forces) <= max(1000.0 * step * 1.1, 0.15)
    rested = hand.rest(20)
    assert np.abs(hand.rest(3) - rested).max() < 1e-9
    assert hand.follower["share"] == 1.0


@NEEDS_JIT
def test_coupling_corner_least_energy() -> None:
    """Against a general minimiser of the same energy over the same spline."""
    points, target = punch(3, 0.004), np.array([-0.001, 0.0005, 0.0005])
    field = field_of(corner(), SIZE)
    hand = pressed(field, points, target, np.array([-0.03, 0.0, -0.03]), turn_stiffness=2.0)
    force = hand.rest(30)
    payload = field.cells.payload
    assert payload is not None
    stiffness = contact_stiffness(hand.spring, SIZE)

    def depth(point: Floats) -> float:
        at = (point - field.place.x) / SIZE
        cell = tuple(int(n) for n in at // 32)
        slot = slot_in(field, cell)
        if slot == 0:
            return 0.0
        u, _ = naive_field.spline(payload[slot], at - 32 * (at // 32))
        return SIZE * max(ONSET - u, 0.0)

    def energy(pose: Floats) -> float:
        position, turn = 1e-3 * pose[:3], 1e-2 * pose[3:]
        w, x, y, z = quaternion_by(*turn)
        total = naive_field.capped(float(np.linalg.norm(target - position)), 1000.0, 24.0)
        total += naive_field.capped(float(np.linalg.norm(turn)), 2.0, 1.2)
        for point in points:
            _, px, py, pz = product(*product(w, x, y, z, 0.0, *point), w, -x, -y, -z)
            total += 0.5 * stiffness * depth(position + np.array([px, py, pz])) ** 2
        return 1e3 * total

    start = np.concatenate([1e3 * hand.tool.position, 1e2 * 2.0 * hand.tool.quaternion[1:]])
    best = minimize(energy, start, method="Nelder-Mead", options={"maxiter": 400})
    assert energy(start) <= best.fun * 1.01
    np.testing.assert_allclose(force, 1000.0 * (1e-3 * best.x[:3] - target), atol=0.05)


def slot_in(field: Field, cell: tuple[int, ...]) -> int:
    """Slot of a cell, found by looking through the directory."""
    key = (cell[0] << 32) | (cell[1] << 16) | cell[2]
    return int(field.cells.slots[0][field.cells.keys[0] == key][0])


@NEEDS_JIT
def test_coupling_wrench_scale_invariant() -> None:
    wrenches = []
    for scale in (1.0, 0.1, 100.0):
        hand = Hand(
            field_of(plane([0.3, 0.0, 1.0]), SIZE * scale), punch(3, 0.004 * scale),
            [0.0, 0.0, 0.03 * scale], scale=scale, damping=5.0,
        )  # fmt: skip
        hand.advance()
        sent = []
        for n in range(400):
            angle = 0.15 * math.sin(n / 30.0)
            hand.hand.quaternion[:] = [math.cos(angle), 0.0, math.sin(angle), 0.0]
            hand.move(scale * np.array([7.5e-6 * n, 0.0, 0.03 - 0.035 * math.sin(n / 127.0)]))
            sent.append(hand.sent.wrench.copy())
        wrenches.append(np.array(sent))
    assert np.abs(wrenches[0]).max() > 5.0
    for other in wrenches[1:]:
        np.testing.assert_allclose(other, wrenches[0], rtol=1e-6, atol=1e-9)


@NEEDS_JIT
def test_coupling_damping_along_force_never_pulls() -> None:
    field = field_of(plane([0.0, 0.0, 1.0]), SIZE)
    forces = []
    for damping in (0.0, 20.0):
        hand = Hand(field, punch(3, 0.004), [0.0, 0.0, 0.02], damping=damping)
        hand.advance()
        way = np.concatenate([np.linspace(0.02, 0.0, 200), np.linspace(0.0, 0.02, 200)])
        forces.append(np.array([hand.move([0.0, 0.0, z])[2] for z in way]))
    plain, damped = forces
    np.testing.assert_allclose((damped - plain)[150:200], 20.0 * 0.02 / 0.199, rtol=1e-3)
    np.testing.assert_allclose((damped - plain)[210:250], -20.0 * 0.02 / 0.199, rtol=1e-3)
    assert (damped >= 0.0).all()


@NEEDS_JIT
@pytest.mark.parametrize(("frequency", "acts"), [(40.0, True), (3.0, False)])
def test_coupling_guard_softens_oscillation(frequency: float, acts: bool) -> None:
    hand = Hand(field_of(plane([0.0, 0.0, 1.0]), SIZE), punch(3, 0.004), [0.0, 0.0, 0.02])
    hand.advance()
    flags = 0
    for n in range(1000):
        hand.move([0.0, 0.0, 0.004 + 0.001 * math.sin(2e-3 * math.pi * frequency * n)])
        flags |= int(hand.sent.marks)
    assert bool(flags & quasistatic.IS_SOFTER) == acts
    assert (hand.follower["share"] < 1.0) == acts


@NEEDS_JIT
def test_coupling_stops_at_unknown_cells() -> None:
    field = field_of(plane([0.0, 0.0, 1.0]), SIZE, (4, 1, 4))
    at, way = np.array([0.0, 0.0, 0.004]), np.array([0.0, 0.0, -0.02])
    hand = pressed(field, punch(3, 0.004), at, way)
    before = float(hand.advance()[2])
    for _ in range(15):
        hand.move([0.0, 0.2, 0.004])
        assert hand.sent.unknown > 0
        assert hand.sent.marks & IS_HELD
        assert hand.missed["n_cells"] > 0
    assert hand.sent.wrench[2] == before
    hand.rest(60)
    assert (hand.sent.wrench == 0.0).all()
    assert hand.tool.position[1] < 16 * SIZE


def shake(
    field: Field, normal: Floats, half: float, size: float, rng: np.random.Generator
) -> float:
    """Drive a random tool at a wall about the origin; nearest point to the wall, voxels.

    It is negative once a point has passed.
    """
    points = rng.normal(size=(rng.integers(1, 40), 3))
    lengths = np.linalg.norm(points, axis=1)[:, None]
    points *= rng.uniform(0.5, 8.0) * size / lengths
    points -= points.mean(axis=0)
    radius = float(np.linalg.norm(points, axis=1).max())
    side = float(rng.choice([-1.0, 1.0]))
    at = side * normal * (radius + 3.0 * size + half)
    hand = Hand(field, points, at, cap=8.0, turn_stiffness=1e3 * radius**2 + 1e-9, turn_cap=0.1)
    hand.advance()
    step = 1e-3 * 10.0 ** rng.uniform(math.log10(0.5), math.log10(20.0))
    way, spin = unit(0.4 * rng.normal(size=3) - side * normal), 0.3 * rng.normal(size=3)
    turn, nearest, edge = np.array(UPRIGHT), math.inf, 20.0 * size
    for _ in range(40):
        at = at + step * way
        if np.abs(at).max() > edge:
            way, at = unit(0.3 * edge * rng.normal(size=3) - at), np.clip(at, -edge, edge)
        turn = unit(product(*quaternion_by(*spin), *turn))
        hand.hand.quaternion[:] = turn
        hand.move(at)
        nearest = min(nearest, float((side * (hand.placed @ normal) - half).min()) / size)
    return nearest


def walls(n_walls: int, n_tools: int, seed: int) -> list[float]:
    """Nearest distances of random tools to random sheets and half-voxel plates."""
    rng, found = np.random.default_rng(seed), []
    for n in range(n_walls):
        size, normal = (0.005, 0.0005)[n % 2], unit(rng.normal(size=3))
        half = 0.25 * size * (n // 2 % 2)
        shift = rng.uniform(-0.5, 0.5) * size * normal
        wall = sheet(normal) if half == 0.0 else plate(normal, 2.0 * half)
        field = field_of(moved(wall, shift), size)
        offset = float(shift @ normal)
        place = field.place._replace(
            x=field.place.x - shift[0], y=field.place.y - shift[1], z=field.place.z - shift[2]
        )
        assert abs(offset) <= size
        found += [
            shake(field._replace(place=place), normal, half, size, rng) for _ in range(n_tools)
        ]
    return found


@NEEDS_JIT
def test_coupling_never_crosses_sheet_or_plate() -> None:
    assert min(walls(8, 8, 1)) > 0.9


@NEEDS_JIT
@pytest.mark.long
def test_coupling_many_tools_never_cross_sheet_or_plate() -> None:
    assert min(walls(200 if is_every() else 40, 10, 2)) > 0.9


def globe(radius: float) -> Floats:
    """400 points on a sphere, nearer to one another than its radius over five."""
    k = np.arange(400)
    height, angle = 1.0 - (2.0 * k + 1.0) / 400.0, 2.39996 * k
    flat = np.sqrt(1.0 - height * height)
    return radius * np.stack([flat * np.cos(angle), flat * np.sin(angle), height], axis=1)


@NEEDS_JIT
@pytest.mark.parametrize("seed", range(6))
def test_coupling_tool_across_sheet_comes_free_smoothly(seed: int) -> None:
    rng = np.random.default_rng(seed)
    size, normal = (0.005, 0.0005)[seed % 2], unit(rng.normal(size=3))
    start = rng.uniform(-2.5, 2.5) * size * normal
    hand = Hand(field_of(sheet(normal), size), globe(3.0 * size), start, cap=8.0)
    hand.advance()
    assert hand.sent.marks & quasistatic.IS_INSIDE
    for n in range(300):
        assert np.abs(hand.move(start + normal * size * n / 15.0)).max() == 0.0
    assert (hand.tool.position == hand.hand.position).all()
    for n in range(300):
        hand.move(start + normal * size * (20.0 - n / 7.5))
    assert (hand.placed @ normal).min() > 0.9 * size
    assert hand.sent.wrench[:3] @ normal > 0.0


@NEEDS_JIT
@pytest.mark.parametrize("clearance", [0.05, 0.5])
def test_coupling_peg_free_within_clearance(clearance: float) -> None:
    size, radius = 0.001, 0.010
    angle = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(40)], axis=1)
    points = np.concatenate([ring + np.array([0.0, 0.0, z]) for z in np.linspace(-0.008, 0.008, 7)])
    hand = Hand(field_of(hole(radius + (ONSET + clearance) * size), size), points, np.zeros(3))
    hand.advance()
    for n in range(100):
        assert (hand.move([0.0, 0.0, 0.005 * math.sin(n / 10.0)]) == 0.0).all()
    forces = np.array([hand.move([2e-5 * n, 0.0, 0.0]) for n in range(100)])
    assert -forces[-1, 0] == pytest.approx(1000.0 * (99 * 2e-5 - clearance * size), abs=0.05)
    assert np.abs(forces[:, 1]).max() < 1e-9
    assert steps_of(forces) <= 0.021


@NEEDS_JIT
@pytest.mark.parametrize("size", [0.005, 0.0005])
def test_coupling_snap_off_edge_bounded_steps(size: float) -> None:
    """The hand goes out through the side of a right angle, deep below its top."""
    slope, down = unit([1.0, 0.0, 1.0]), unit([1.0, 0.0, -1.0])  # of the face on the left
    start = -6.0 * size * slope + (2.5 - ONSET) * size * down
    field = field_of(wedge(np.pi / 2.0), size)
    hand = pressed(field, np.zeros((1, 3)), start, 6.0 * size * down)
    step = min(5e-5, 0.05 * size)
    forces, stretches, flags = [hand.advance()], [], 0
    for way in np.arange(0.0, 12.0 * size, step):
        forces.append(hand.move(start + way * slope))
        flags |= int(hand.sent.marks)
        stretches.append(float(np.linalg.norm(hand.hand.position - hand.tool.position)))
    snap = -1000.0 * np.diff(stretches).min()
    assert (snap > 2.0) == bool(flags & quasistatic.IS_SNAPPING) == (size == 0.005)
    assert steps_of(np.array(forces)) <= 1.0 + 1000.0 * step + 1e-9
    assert (hand.rest(50) == 0.0).all()


@NEEDS_JIT
@pytest.mark.parametrize("ground", ["plane", "corner"])
def test_coupling_passive_at_rest(ground: str) -> None:
    """A mass of a light grip, pressed on with 3 N; the maximum of energy of each window falls."""
    mass, grip, stiffness, dt, pieces = 0.1, 1.0, 1000.0, 1e-3, 10
    up = np.array([0.0, 0.0, 1.0]) if ground == "plane" else unit([1.0, 0.0, 1.0])
    field = field_of(plane(up) if ground == "plane" else corner(), SIZE)
    hand = Hand(
        field, punch(1, SIZE), 3.0 * SIZE * up / up.max(),
        damping=stiffness * dt / 2.0, turn_stiffness=2.0,
    )  # fmt: skip
    hand.advance()
    position, velocity = hand.hand.position.copy(), np.zeros(3)
    energies = []
    for _ in range(1500):
        force = hand.move(position)
        stretch = float(np.linalg.norm(hand.hand.position - hand.tool.position))
        spring = stiffness * float(hand.follower["share"])  # the guard may have lowered it
        energy = 0.5 * mass * float(velocity @ velocity) + 0.5 * spring * stretch**2
        energies.append(energy + 3.0 * float(position @ up))
        for _ in range(pieces):
            velocity = velocity + dt / pieces / mass * (force - 3.0 * up - grip * velocity)
            position = position + dt / pieces * velocity
    windows = np.array(energies).reshape(-1, 100).max(axis=1)
    assert (np.diff(windows) <= 1e-9).all()
    assert windows[0] - windows[-1] > 1e-3
    assert np.linalg.norm(velocity) < 1e-3


@NEEDS_JIT
def test_coupling_bounding_spheres_same_forces() -> None:
    """A broad tool comes from afar, slides, and leaves, over a plane and a cylinder."""
    points = punch(40, 0.002)
    cells = ((points - points.min(axis=0)) / np.ptp(points) * 255.0).astype(np.int64)
    codes = sum(((cells[:, a] >> b) & 1) << (3 * b + a) for a in range(3) for b in range(8))
    points = points[np.argsort(codes, kind="stable")]  # as in shells made from files
    ways = [(0.0, 0.0, 0.03 * (1.0 - s)) for s in np.linspace(0.0, 1.0, 40)]
    ways += [(0.03 * s, 0.0, 0.0) for s in np.linspace(0.0, 1.0, 40)]
    for distance, height in ((plane([0.0, 0.0, 1.0]), 0.0), (cylinder(0.1), 0.1)):
        field, at = field_of(distance, SIZE), np.array([0.0, 0.0, height + 1.5 * SIZE - 0.004])
        forces = []
        for is_large in (False, True):
            hand = Hand(field, points, at + ways[0])
            hand.follower["is_large"] = is_large
            hand.advance()
            forces.append(np.array([hand.move(at + way) for way in ways]))
        assert forces[0].any()
        np.testing.assert_allclose(forces[1], forces[0], atol=1e-9)

"""The wrench against closed forms: cases 1, 2, 5 and 8, averaging."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray

import hapticdb
from hapticdb import Environment, Grid, PointShell
from hapticdb.paper.cost_model import CostModel, machine_name
from hapticdb.paper.strategies import STRATEGIES, Strategy
from hapticdb.store.base import Layout
from session.worlds import random_shell
from voxels import blob, floor_voxels, write_voxels

K = 1000.0
SIZE = 0.005
BINARY = 2.0**-8
MIDDLE = 32
ROUNDING = 1e-12
"""Newtons and newton metres. Forces here are some N; sums have some hundred terms."""
Array = NDArray[np.float64]
UP = (0.0, 0.0, 1.0)
few = settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
strategies = pytest.mark.parametrize("strategy", STRATEGIES)


def grid_of(size: float) -> Grid:
    """64^3 voxels about the world's origin, which is a vertex of the grid."""
    low = -MIDDLE * size
    return Grid(size, (low, low, low), 6)


def scene_of(
    path: Path, *objects: NDArray[np.int64], size: float = SIZE, layout: Layout = "brick"
) -> Environment:
    env = hapticdb.create(path, grid_of(size), layout=layout)
    for n, ijk in enumerate(objects):
        write_voxels(env.store, ijk, f"object {n + 1}")
    env.store.save_costs(machine_name(), CostModel.of_equal_parts().figures())
    return env


@pytest.fixture(scope="module", params=["brick", "voxel"])
def floor(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Environment]:
    path = tmp_path_factory.mktemp("floor") / "e.db"
    with scene_of(path, floor_voxels(grid_of(SIZE)), layout=request.param) as env:
        yield env


@pytest.fixture(scope="module")
def binary_floor(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Environment]:
    path = tmp_path_factory.mktemp("floor") / "e.db"
    with scene_of(path, floor_voxels(grid_of(BINARY)), size=BINARY) as env:
        yield env


def shell_of(
    points: ArrayLike, normals: ArrayLike = UP, center: ArrayLike = (0, 0, 0)
) -> PointShell:
    """Shell of points (N, 3); one normal may serve them all."""
    placed = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    return PointShell(
        points=placed,
        normals=np.broadcast_to(np.asarray(normals, dtype=np.float64), placed.shape).copy(),
        center=np.asarray(center, dtype=np.float64),
    )


def at(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Array:
    """Pose that only shifts."""
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


# --- case 1 -------------------------------------------------------------------------------------


@strategies
@few
@given(part=st.integers(1, 8 * 256))
@example(part=128)  # half a voxel: the tangent plane
@example(part=256)  # a border: the upper voxel's, where the law is at its peak
@example(part=257)
@example(part=8 * 256)
def test_tangent_plane_sawtooth_on_floor(
    binary_floor: Environment, strategy: Strategy, part: int
) -> None:
    """F_z = K max(0, u - s (ceil(u / s) - 1) - s / 2), of peak K s / 2."""
    depth = part * BINARY / 256
    touch = binary_floor.touch(shell_of([0.3 * BINARY, 0.6 * BINARY, -depth]), np.eye(4), strategy)
    within = depth - BINARY * (math.ceil(depth / BINARY) - 1)
    assert touch.force[2] == pytest.approx(K * max(0.0, within - BINARY / 2), abs=ROUNDING)
    assert touch.force[2] <= K * BINARY / 2 + ROUNDING
    assert not touch.force[:2].any()
    assert touch.hits.tolist() == [0]
    assert touch.contacts.tolist() == ([0] if within > BINARY / 2 else [])


def test_tangent_plane_point_on_voxel_border(binary_floor: Environment) -> None:
    """No hit at z = 0; a hit at the underside of the floor, and none a hair below that."""
    for height, is_hit in ((0.0, False), (-8 * BINARY, True), (-8 * BINARY - 2.0**-20, False)):
        touch = binary_floor.touch(shell_of([0, 0, height]), np.eye(4))
        assert touch.hits.tolist() == ([0] if is_hit else [])


# --- case 2, averaging --------------------------------------------------------------------------


def punch(n_points: int, spacing: float = 0.0031) -> Array:
    """Points (N, 3) of a flat punch, symmetric about the z axis."""
    side = math.isqrt(n_points)
    if side * side == n_points:
        along = (np.arange(side) - (side - 1) / 2) * spacing
        across = along
    else:
        along = (np.arange(n_points // 2) - (n_points // 2 - 1) / 2) * spacing
        across = np.array([-0.5, 0.5]) * spacing
    xy = np.stack(np.meshgrid(along, across, indexing="ij"), axis=-1).reshape(-1, 2)
    return np.column_stack([xy, np.zeros(len(xy))])


@strategies
@pytest.mark.parametrize(("n_points", "force"), [(4, 6.0), (9, 13.5), (10, 15.0), (100, 15.0)])
def test_tangent_plane_punch_averaged_from_ten_points(
    floor: Environment, strategy: Strategy, n_points: int, force: float
) -> None:
    """u = 4 mm, s = 5 mm: 1.5 N a point; torque 0 about the middle, e F about e aside."""
    points = punch(n_points)
    touch = floor.touch(shell_of(points), at(z=-0.004), strategy)
    assert len(touch.contacts) == n_points
    np.testing.assert_allclose(touch.force, [0, 0, force], atol=ROUNDING)
    np.testing.assert_allclose(touch.torque, 0, atol=ROUNDING)
    aside = floor.touch(shell_of(points, center=(0.02, 0, 0)), at(z=-0.004), strategy)
    np.testing.assert_allclose(aside.force, touch.force, atol=0)
    np.testing.assert_allclose(aside.torque, [0, 0.02 * force, 0], atol=ROUNDING)


@pytest.mark.parametrize(
    ("n_deep", "n_shallow", "divisor"), [(8, 1, 1.0), (8, 2, 1.0), (8, 12, 2.0), (1, 29, 3.0)]
)
@strategies
def test_tangent_plane_average_over_hits(
    floor: Environment, strategy: Strategy, n_deep: int, n_shallow: int, divisor: float
) -> None:
    """Shallow points hit above the tangent plane; free ones do not count."""
    heights = [-0.004] * n_deep + [-0.001] * n_shallow + [0.002] * 7
    points = np.column_stack([np.full(len(heights), 0.0012), np.zeros(len(heights)), heights])
    touch = floor.touch(shell_of(points), np.eye(4), strategy)
    assert len(touch.hits) == n_deep + n_shallow
    assert len(touch.contacts) == n_deep
    force = 1.5 * n_deep / divisor
    np.testing.assert_allclose(touch.force, [0, 0, force], atol=ROUNDING)
    np.testing.assert_allclose(touch.torque, [0, -0.0012 * force, 0], atol=ROUNDING)


# --- case 5 -------------------------------------------------------------------------------------


def mirrored(vectors: Array) -> Array:
    """Each row with its images in the planes x = 0 and y = 0, image by image."""
    signs = np.array([[1, 1, 1], [-1, 1, 1], [1, -1, 1], [-1, -1, 1]], dtype=np.float64)
    images: Array = (vectors[None] * signs[:, None]).reshape(-1, 3)
    return images


def test_tangent_plane_centred_peg_no_lateral_force(tmp_path: Path) -> None:
    """The peg is wider than the hole by less than half a voxel on each side."""
    floor = floor_voxels(grid_of(SIZE))
    is_wall = (np.abs(floor[:, :2] + 0.5 - MIDDLE) > 4).any(axis=1)
    env = scene_of(tmp_path / "e.db", floor[is_wall])
    rng = np.random.default_rng(5)
    along, down = rng.uniform(0.1, 3.9, 60) * SIZE, rng.uniform(-7.9, 4, 60) * SIZE
    face = np.full(60, 4.8 * SIZE)
    points = np.concatenate([np.stack([face, along, down], 1), np.stack([along, face, down], 1)])
    normals = np.repeat([[-1.0, 0, 0], [0, -1.0, 0]], 60, axis=0)
    shell = shell_of(mirrored(points), mirrored(normals), (0, 0, -3 * SIZE))
    for strategy in STRATEGIES:
        touch = env.touch(shell, np.eye(4), strategy)
        assert len(touch.contacts) > 100
        np.testing.assert_allclose(touch.force, 0, atol=ROUNDING)
        np.testing.assert_allclose(touch.torque, 0, atol=ROUNDING)
        aside = env.touch(shell, at(x=0.1 * SIZE), strategy)
        assert aside.force[0] < -1e-3  # pushed back to the middle


# --- case 8 -------------------------------------------------------------------------------------


def quarter_turn(axis: int) -> Array:
    """90 degrees about an axis through the world's origin, exact."""
    a, b = (axis + 1) % 3, (axis + 2) % 3
    turn = np.zeros((3, 3))
    turn[axis, axis] = turn[b, a] = 1.0
    turn[a, b] = -1.0
    return turn


def off_borders(points: Array) -> bool:
    """No point is so near a voxel's face that a rounding error could move it across."""
    scaled = points / SIZE
    return bool((np.abs(scaled - np.round(scaled)) > 1e-9).all())


def tilted(seed: int) -> Array:
    """Rigid pose: a random rotation about a position near the world's origin."""
    rng = np.random.default_rng(seed)
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    pose = at(*rng.normal(size=3) * SIZE)
    pose[:3, :3] = q * np.linalg.det(q)
    return pose


BLOB = blob(3, (30, 34, 31))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_tangent_plane_rotation_equivariant(tmp_path: Path, axis: int) -> None:
    """Tool and environment are turned together, by 90 degrees about a vertex of the grid."""
    turn = quarter_turn(axis)
    turned = np.round((BLOB + 0.5 - MIDDLE) @ turn.T - 0.5 + MIDDLE).astype(np.int64)
    before = scene_of(tmp_path / "a.db", BLOB)
    after = scene_of(tmp_path / "b.db", turned)
    whole = np.eye(4)
    whole[:3, :3] = turn
    for seed, n_points in ((1, 6), (2, 200)):
        shell, pose = random_shell(seed, n_points, 8.0, SIZE), tilted(seed)
        assert off_borders(shell.points @ pose[:3, :3].T + pose[:3, 3])
        plain = before.touch(shell, pose, "maxgap")
        moved = after.touch(shell, whole @ pose, "maxgap")
        assert moved.hits.tolist() == plain.hits.tolist()
        assert np.abs(plain.force).max() > 1e-3
        np.testing.assert_allclose(moved.force, turn @ plain.force, atol=ROUNDING)
        np.testing.assert_allclose(moved.torque, turn @ plain.torque, atol=ROUNDING)

"""Tools with thin walls under the distance law, and the share by which their two sides differ."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from bands import band_rows
from hapticdb import PointShell
from kernels.test_distance_law import (
    ORIGIN,
    PLANE_AT,
    SIZE,
    UP,
    Merged,
    frame,
    grid_of,
    on_rows,
    sheet,
)

Array = NDArray[np.float64]
K_S = 1000.0 * SIZE
"""Force of a point that is felt one voxel deep, N."""
STEP = 1e-3
"""Step of a slide, voxels: a jump is much larger than what a continuous force changes over it."""
STEEPEST = 40.0
"""Most that a point's force may change over a voxel, in K s. The share changes by at most 20 in a
voxel, at a depth of at most 1.5."""


def scene_of(*triangles: list[list[float]]) -> Merged:
    return Merged([band_rows(np.array(ORIGIN) + SIZE * np.array(triangles), grid_of())])


@cache
def tilted(degrees: float) -> tuple[Merged, Array]:
    """A square through (32, 32, 32.3), turned about x and then about z, and its turn (3, 3)."""
    a, b = np.deg2rad(degrees), np.deg2rad(0.7 * degrees)
    x = np.array([[1.0, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    z = np.array([[np.cos(b), -np.sin(b), 0], [np.sin(b), np.cos(b), 0], [0, 0, 1.0]])
    turn = z @ x
    corners = np.array([[-20.0, -20, 0], [20, -20, 0], [20, 20, 0], [-20, 20, 0]]) @ turn.T
    corners += np.array([32.0, 32, 32.3])
    return scene_of(corners[[0, 1, 2]].tolist(), corners[[0, 2, 3]].tolist()), turn


def plate(xy: Array, u: float, thickness: float) -> tuple[Array, Array]:
    """Points and inward normals of both sides of a plate, u above the sheet of `sheet`."""
    near = np.column_stack([xy, np.full(len(xy), PLANE_AT + u)])
    far = near + thickness * UP
    return np.concatenate([near, far]), np.concatenate(
        [UP.repeat(len(xy), 0), -UP.repeat(len(xy), 0)]
    )


@settings(max_examples=60, deadline=None)
@given(
    thickness=st.floats(0.2, 3.0),
    u=st.floats(0.7, 1.5),
    n_points=st.sampled_from([1, 4, 50]),
    seed=st.integers(0, 1000),
)
def test_distance_law_plate_near_side_only(
    thickness: float, u: float, n_points: int, seed: int
) -> None:
    """F = K s (delta - u) a point, averaged over the near side."""
    xy = np.random.default_rng(seed).uniform(20.0, 40.0, (n_points, 2))
    felt = frame(sheet(), *plate(xy, u, thickness))
    wanted = K_S * (1.5 - u) * n_points / max(1.0, n_points / 10.0)
    assert felt[2] == pytest.approx(wanted, abs=0.03 * K_S * min(n_points, 10))
    assert felt[0] == felt[1] == 0.0


def test_distance_law_back_facing_point_no_contact() -> None:
    """The far side: a hit has depth 0, and what is no hit is not felt."""
    points = np.array([[30.2, 30.3, PLANE_AT + 0.8], [30.2, 30.3, PLANE_AT + 1.2]])
    shell = PointShell(np.array(ORIGIN) + SIZE * points, -UP.repeat(2, 0), np.zeros(3))
    felt, pairs = on_rows(sheet(), grid_of(), shell, np.eye(4), [])
    assert not felt[0].any()
    assert felt[1].tolist() == [0]
    assert felt[2].tolist() == [0.0]
    assert not felt[4].size
    assert pairs.tolist() == []


def test_distance_law_point_on_surface() -> None:
    """The interpolant's gradient is 0 there; the slope ahead of the point is not."""
    for u in (0.5, 0.3, 0.2):
        felt = frame(sheet(), np.array([[30.2, 30.3, PLANE_AT + u]]), UP)
        assert K_S * 0.95 <= felt[2] <= K_S * 1.5
        away = frame(sheet(), np.array([[30.2, 30.3, PLANE_AT + u + 0.3]]), -UP)
        assert not away[:3].any()


@pytest.mark.parametrize("degrees", [0.0, 5.0, 20.0, 45.0])
@pytest.mark.parametrize(("side", "most"), [(3, 0.02), (10, 0.01), (17, 0.01)])
def test_distance_law_sliding_plane_ripple(degrees: float, side: int, most: float) -> None:
    """std / mean of the normal force at constant depths; 9, 100 and 289 points."""
    scene, turn = tilted(degrees)
    across = np.arange(side) * (10.0 / (side - 1)) - 5.0
    flat = np.stack(np.meshgrid(across, across), axis=-1).reshape(-1, 2)
    normals = (UP @ turn.T).repeat(side * side, 0)
    for depth in (0.1, 0.45, 0.8):
        forces = []
        for way in np.linspace(0.0, 3.0, 61):
            place = np.column_stack(
                [flat + np.array([way, 0.37 * way]), np.full(len(flat), 1.5 - depth)]
            )
            felt = frame(scene, place @ turn.T + [32.0, 32, 32.3], normals)
            forces.append(felt[:3] @ normals[0])
        assert np.std(forces) <= most * np.mean(forces)
        assert np.mean(forces) == pytest.approx(min(side * side, 10) * K_S * depth, rel=0.05)


CORNER = scene_of(
    [[8.0, 8, 20], [56, 8, 20], [8, 56, 20]],
    [[56.0, 8, 20], [56, 56, 20], [8, 56, 20]],
    [[20.0, 8, 8], [20, 56, 8], [20, 8, 56]],
    [[20.0, 56, 8], [20, 56, 56], [20, 8, 56]],
)
"""A concave corner along y of a floor z = 20 and a wall x = 20."""
EDGE = scene_of(
    [[8.0, 8, 20], [32, 8, 20], [8, 56, 20]],
    [[32.0, 8, 20], [32, 56, 20], [8, 56, 20]],
    [[32.0, 8, 8], [32, 56, 8], [32, 8, 20]],
    [[32.0, 56, 8], [32, 56, 20], [32, 8, 20]],
)
"""A convex edge along y at x = 32, z = 20."""


def steepest(scene: Merged, start: Array, end: Array, normal: Array) -> tuple[float, float]:
    """Largest change of a point's force over `STEP` on its way, and its largest force, in K s."""
    n_steps = int(np.linalg.norm(end - start) / STEP)
    forces = np.array(
        [frame(scene, (start + s * (end - start))[None], normal[None])[:3]
         for s in np.linspace(0.0, 1.0, n_steps)]
    )  # fmt: skip
    changes = np.linalg.norm(np.diff(forces, axis=0), axis=1)
    return float(changes.max()) / K_S, float(np.linalg.norm(forces, axis=1).max()) / K_S


@pytest.mark.parametrize(("height", "askew"), [(0.55, 0.5), (0.8, 0.0), (1.1, 0.5)])
def test_distance_law_bounded_steps_at_corner_and_edge(height: float, askew: float) -> None:
    normal = np.array([askew, 0.0, 1.0]) / np.hypot(askew, 1.0)
    for scene, first, last in ((CORNER, 20.2, 22.7), (EDGE, 30.5, 34.8)):
        start = np.array([first, 30.3, 20.0 + height])
        change, most = steepest(scene, start, np.array([last, 30.3, 20.0 + height]), normal)
        assert most > 0.3
        assert change <= STEEPEST * STEP

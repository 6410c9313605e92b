"""Spacing of points on a surface, and what is inside of it, against closed forms."""

from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticdb import PointShell
from hapticdb.errors import UsageError
from hapticdb.pointshell.coverage import Interior
from hapticdb.pointshell.orientation import CRACK, orient

Floats = NDArray[np.float64]


def places_on(triangles: Floats, steps: int = 40) -> Floats:
    """Positions all over triangles (F, 3, 3), on their corners and sides, too."""
    u, v = np.meshgrid(*[np.linspace(0.0, 1.0, steps)] * 2)
    u, v = u[u + v <= 1.0 + 1e-12], v[u + v <= 1.0 + 1e-12]
    weights = np.stack([1.0 - u - v, u, v], axis=1)
    return np.asarray(np.einsum("wc,fck->fwk", weights, triangles)).reshape(-1, 3)


def farthest(triangles: Floats, points: Floats) -> float:
    """Greatest distance from such a position to its nearest point."""
    places = places_on(triangles)
    apart = np.linalg.norm(places[:, None] - points[None], axis=2)
    return float(apart.min(axis=1).max())


@pytest.mark.parametrize("spacing", [0.02, 0.007])
def test_shell_spacing(spacing: float) -> None:
    box = trimesh.creation.box((0.1, 0.08, 0.06))
    shell = PointShell.from_mesh(box.vertices, box.faces, spacing=spacing)
    assert len(shell) == max(300, int(np.ceil(2.0 * box.area / (np.sqrt(3.0) * spacing**2))))
    real = np.sqrt(2.0 * box.area / (np.sqrt(3.0) * len(shell)))
    assert 0.5 * real < farthest(np.array(box.triangles), shell.points) < 1.5 * real
    fewer = PointShell.from_mesh(box.vertices, box.faces, 500, spacing=spacing)
    assert len(fewer) == min(500, len(shell))


@pytest.mark.parametrize("spacing", [0.0, -1.0, np.nan, np.inf])
def test_shell_bad_spacing(spacing: float) -> None:
    box = trimesh.creation.box((0.1, 0.08, 0.06))
    with pytest.raises(UsageError, match="spacing"):
        PointShell.from_mesh(box.vertices, box.faces, spacing=spacing)


def boxes(*many: tuple[float, float]) -> trimesh.Trimesh:
    """Cubes of an edge, each moved along x."""
    made = [trimesh.creation.box([edge] * 3) for edge, _ in many]
    for cube, (_, x) in zip(made, many, strict=True):
        cube.apply_translation((x, 0.0, 0.0))
    return trimesh.util.concatenate(made)


@given(places=st.lists(st.tuples(*[st.floats(-1.6, 1.6)] * 3), min_size=1, max_size=20))
def test_interior_closed_bodies_without_voids(places: list[Any]) -> None:
    # a cube with a void and a cube in the void; another overlaps it from the right
    many = boxes((2.0, 0.0), (1.2, 0.0), (0.4, 0.0), (1.0, 0.9))
    interior = Interior(orient(np.array(many.triangles)))
    asked = np.array(places)

    def in_cube(edge: float, x: float) -> NDArray[np.bool_]:
        return np.asarray((np.abs(asked - (x, 0.0, 0.0)) < 0.5 * edge).all(axis=1))

    body = in_cube(2.0, 0.0) & ~in_cube(1.2, 0.0) | in_cube(0.4, 0.0)
    # the right one begins at 0.4, in the void, which it fills up to 0.6
    expected = body | in_cube(1.0, 0.9)
    on_a_wall = np.zeros(len(asked), dtype=bool)
    for edge, x in ((2.0, 0.0), (1.2, 0.0), (0.4, 0.0), (1.0, 0.9)):
        on_a_wall |= (np.abs(np.abs(asked - (x, 0.0, 0.0)) - 0.5 * edge) < 1e-6).any(axis=1)
    depth = interior.holds(asked)
    overlap = in_cube(1.2, 0.0) & in_cube(1.0, 0.9)  # void and body: one each, neither counts
    sure = ~on_a_wall & ~overlap
    assert (depth[sure] == expected[sure]).all()


def test_interior_open_surface_empty() -> None:
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    assert Interior(orient(np.array(box.triangles)))
    torn = Interior(orient(np.array(box.triangles[:-1])))
    assert not torn
    assert not torn.holds(np.zeros((1, 3))).any()


@pytest.mark.parametrize(("off", "is_solid"), [(0.0, True), (0.5, True), (20.0, False)])
def test_interior_t_junctions(off: float, is_solid: bool) -> None:
    """The front of a cube ends at corners that the faces beside it lack, off by some cracks."""
    box, rng = trimesh.creation.box((1.0, 1.0, 1.0)), np.random.default_rng(3)
    triangles = list(np.array(box.triangles))
    for _ in range(5):
        a, b, c = triangles.pop(0)
        middle = a + rng.uniform(0.2, 0.8) * (b - a) + off * CRACK * np.sqrt(3.0) * (c - b)
        triangles += [np.array([a, middle, c]), np.array([middle, b, c])]
    turned = np.array(triangles) @ Rotation.random(random_state=rng).as_matrix().T
    backwards = rng.random(len(turned)) < 0.5
    turned[backwards] = turned[backwards, ::-1]
    surface = orient(turned)
    interior = Interior(surface)
    assert (bool(interior), surface.is_closed) == (is_solid, is_solid)
    places = rng.uniform(-0.28, 0.28, (50, 3))
    assert (interior.holds(places) == is_solid).all()
    assert not interior.holds(places + 2.0).any()

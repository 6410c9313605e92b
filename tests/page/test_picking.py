"""A click names the part that a ray meets first, as a search over all triangles does."""

from itertools import pairwise

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticdb.page.scene.facets import Facets
from hapticdb.page.scene.nodes import Member
from hapticdb.page.scene.picking import Targets
from hapticdb.page.scene.shapes import PartShape

SHAPES = [
    PartShape(Facets(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64)))
    for mesh in (
        trimesh.creation.icosphere(1, 0.3),
        trimesh.creation.box((0.5, 0.2, 0.1)),
        trimesh.creation.cylinder(0.1, 0.8, sections=12),
    )
]


def nearest(
    triangles: NDArray[np.float64], start: NDArray[np.float64], way: NDArray[np.float64]
) -> float:
    """Distance to the first of the triangles (n, 3, 3), or inf; Moeller and Trumbore 1997."""
    a, b, c = triangles.transpose(1, 0, 2)
    first, second = b - a, c - a
    across = np.cross(way, second)
    area = (first * across).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = ((start - a) * across).sum(axis=1) / area
        turned = np.cross(start - a, first)
        v = (way * turned).sum(axis=1) / area
        t = (second * turned).sum(axis=1) / area
        met = (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0)
    return float(np.min(t[met], initial=np.inf))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from([1e-3, 1.0, 1e3]))
def test_targets_first_equals_brute_force(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    members: dict[int, Member] = {}
    targets, triangles = Targets(members), {}
    for number in range(12):
        shape = PartShape(
            Facets(SHAPES[number % 3].facets.vertices * size, SHAPES[number % 3].facets.faces)
        )
        pose = np.eye(4)
        pose[:3, :3] = Rotation.random(random_state=rng).as_matrix()
        pose[:3, 3] = rng.uniform(-1, 1, 3) * size
        members[number] = Member(number, pose, shape.bounds(pose), (0, 0, 0), shape)
        triangles[number] = shape.facets.vertices[shape.facets.faces] @ pose[:3, :3].T + pose[:3, 3]
    hidden = set(rng.integers(0, 12, 3).tolist())
    for _ in range(10):
        start = rng.uniform(-4, 4, 3) * size
        way = rng.uniform(-1, 1, 3) * size - start
        way /= np.linalg.norm(way)
        reached = {i: nearest(t, start, way) for i, t in triangles.items() if i not in hidden}
        order = sorted(reached.values())
        found = targets.first(start, way, lambda i: i not in hidden)
        if found is None:
            assert order[0] == np.inf
        elif all(b - a > 1e-4 * size for a, b in pairwise(order[:2])):
            assert found.distance == pytest.approx(order[0], rel=1e-5)
            assert reached[found.id] == order[0]
            assert np.allclose(found.point, start + found.distance * way)


def test_targets_first_box_before_shape() -> None:
    box = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    members = {3: Member(3, np.eye(4), box, (0, 0, 0))}
    targets = Targets(members)
    found = targets.first([0.2, 0.1, 5.0], [0, 0, -2.0], lambda _: True)
    assert found is not None
    assert found.id == 3
    assert found.distance == pytest.approx(4.0)
    del members[3]
    targets.changed()
    assert targets.first([0.2, 0.1, 5.0], [0, 0, -2.0], lambda _: True) is None


def test_targets_first_thousands_of_shapes() -> None:
    members: dict[int, Member] = {}
    targets = Targets(members)
    for number in range(1500):  # Embree crashes when each has a device of its own
        shape = PartShape(SHAPES[1].facets)
        pose = np.eye(4)
        pose[2, 3] = -float(number)
        members[number] = Member(number, pose, shape.bounds(pose), (0, 0, 0), shape)
        assert shape.first_hit(np.array([0.01, 0.02, 5.0]), np.array([0.0, 0, -1])) is not None
    found = targets.first([0.01, 0.02, 5.0], [0, 0, -1], lambda i: i > 1000)
    assert found is not None
    assert found.id == 1001

"""Two triangles' distance lies between its bounds: no sample is nearer, and the places are real."""

from collections.abc import Iterator

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticdb.kernels.surfaces.triangle_bvh import TriangleBVH, triangle_bvh
from hapticdb.kernels.triangles.surface_distance import nearest, own_gap, own_slack

Floats = NDArray[np.float64]

COUNT = 60
"""Pairs of each kind and size."""
HERE = np.eye(4)[None]
SHARES = np.array(
    [(a / 12, b / 12, (12 - a - b) / 12) for a in range(13) for b in range(13 - a)]
)  # places of a triangle, its corners and edges among them


def kinds_of_pairs(rng: np.random.Generator) -> Iterator[tuple[str, Floats, Floats]]:
    """Pairs of triangles (n, 3, 3) about 1 in size, by kind."""
    a, b = rng.normal(size=(2, COUNT, 3, 3))
    yield "random", a, b
    yield "apart", a, b + 5.0
    yield "near", a, b - b.mean(axis=1, keepdims=True) + a.mean(axis=1, keepdims=True) + 0.01
    along = a[:, 0] + (a[:, 1] - a[:, 0]) * rng.random((COUNT, 1))
    sliver = a.copy()
    sliver[:, 2] = along + 1e-6 * rng.normal(size=(COUNT, 3))
    yield "sliver", sliver, b + 1.0
    segment, point = a.copy(), a.copy()
    segment[:, 2], point[:] = segment[:, 1], point[:, :1]
    yield "segment", segment, b + 1.0
    yield "point", point, b
    yield "segments", segment, np.roll(segment, 1, axis=0)
    flat, other = a * (1, 1, 0), b * (1, 1, 0)
    yield "parallel planes", flat, other + np.array([0.0, 0.0, 0.3])
    yield "coplanar", flat, other + np.array([4.0, 0.0, 0.0])
    yield "coplanar and overlapping", flat, other
    corner, edge = b.copy(), b.copy()
    corner[:, 0], edge[:, :2] = a[:, 0], a[:, :2]
    yield "shared corner", a, corner
    yield "shared edge", a, edge
    moved = 0.3 * rng.normal(size=(COUNT, 1, 3))
    yield "parallel edges", a, a + moved
    yield "almost parallel edges", a, a + moved + 1e-7 * rng.normal(size=(COUNT, 3, 3))
    yield "a hundred to one", a, 0.01 * b + rng.normal(size=(COUNT, 1, 3))


def one(triangle: Floats) -> TriangleBVH:
    return triangle_bvh(triangle[None], np.zeros(1, dtype=np.int64))


def from_triangle(places: Floats, triangle: Floats) -> float:
    """Distance of a place (3,) from a triangle (3, 3), by least squares on its barycentric shares.

    Solved on the face, each edge and each corner, of which the nearest one counts.
    """
    found = [np.linalg.norm(places - corner) for corner in triangle]
    for some in ([0, 1], [1, 2], [2, 0], [0, 1, 2]):
        base = triangle[some]
        shares = np.linalg.lstsq((base[1:] - base[0]).T, places - base[0], rcond=None)[0]
        if (shares >= 0.0).all() and shares.sum() <= 1.0:
            found.append(np.linalg.norm(base[0] + shares @ (base[1:] - base[0]) - places))
    return float(min(found))


@pytest.mark.parametrize("size", [1.0, 1e-3, 1e-4, 1e3])
def test_nearest_triangles_bounds(size: float) -> None:
    rng = np.random.default_rng(31)
    for kind, a, b in kinds_of_pairs(rng):
        for mine, other in zip(size * a, size * b, strict=True):
            found = nearest(one(mine), one(other), HERE, np.array([np.inf]))
            at_least, at_most = float(found.at_least[0]), float(found.at_most[0])
            samples = np.linalg.norm((SHARES @ mine)[:, None] - SHARES @ other, axis=2)
            assert 0.0 <= at_least <= samples.min() * (1.0 + 1e-12), kind
            assert at_least <= at_most <= at_least + 1e-9 * size, kind
            assert from_triangle(found.on_a[0], mine) <= 1e-9 * size, kind
            assert from_triangle(found.on_b[0], other) <= 1e-9 * size, kind
            assert np.linalg.norm(found.on_a[0] - found.on_b[0]) == pytest.approx(
                at_most, abs=1e-12 * size
            ), kind


def test_nearest_intersecting_triangles_zero() -> None:
    rng = np.random.default_rng(7)
    for _ in range(COUNT):
        mine, other = rng.normal(size=(2, 3, 3))
        # a place inside each, moved onto one another
        inside = rng.dirichlet((2.0, 2.0, 2.0), size=2)
        other += inside[0] @ mine - inside[1] @ other
        found = nearest(one(mine), one(other), HERE, np.array([np.inf]))
        assert found.at_least[0] == 0.0
        assert found.at_most[0] <= 1e-12


def brute(a: Floats, b: Floats) -> tuple[float, float]:
    """Bounds of the distance of all pairs, each measured alone."""
    pairs = [nearest(one(mine), one(other), HERE, np.array([np.inf])) for mine in a for other in b]
    return min(p.at_least[0] for p in pairs), min(p.at_most[0] for p in pairs)


def test_nearest_of_two_trees_equals_brute_force() -> None:
    rng = np.random.default_rng(3)
    for n in range(12):
        a = np.asarray(trimesh.creation.icosphere(1, radius=1.0).triangles)[: 5 + 4 * n]
        b = np.asarray(trimesh.creation.box((1.0, 2.0, 0.5)).triangles)
        pose = np.eye(4)
        pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
        pose[:3, 3] = rng.uniform(-2.0, 2.0, 3)
        placed = b @ pose[:3, :3].T + pose[:3, 3]
        mine, other = (triangle_bvh(t, np.zeros(len(t), dtype=np.int64)) for t in (a, b))
        found = nearest(mine, other, np.stack([pose, pose]), np.array([np.inf, np.inf]))
        at_least, at_most = brute(a, placed)
        assert np.allclose(found.at_least, at_least, rtol=0.0, atol=1e-12)
        assert np.allclose(found.at_most, at_most, rtol=0.0, atol=1e-12)
        limited = nearest(mine, other, pose[None], np.array([0.5 * at_least]))
        assert limited.at_least[0] == 0.5 * at_least
        assert limited.pairs[0].tolist() == [-1, -1]


def test_own_gap_lower_bound_of_rotated_boxes() -> None:
    rng = np.random.default_rng(12)
    grid = np.stack(np.meshgrid(*3 * [np.linspace(0.0, 1.0, 7)]), axis=-1).reshape(-1, 3)
    n_apart = 0
    for n in range(300):
        low = rng.uniform(-1.0, 1.0, (2, 3))
        boxes = np.stack([low, low + rng.uniform(0.0, 0.5, (2, 3))], axis=1)
        pose = np.eye(4)
        pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
        if n % 2:  # no exact rotation
            pose[:3, :3] @= np.eye(3) + rng.uniform(-1e-7, 1e-7, (3, 3))
        pose[:3, 3] = rng.uniform(-1.0, 1.0, 3)
        mine, other = (box[0] + grid * (box[1] - box[0]) for box in boxes)
        other = other @ pose[:3, :3].T + pose[:3, 3]
        samples = np.linalg.norm(mine[:, None] - other, axis=2)
        told = own_gap(boxes[:1], 0, boxes[1:], 0, pose, own_slack(pose, 5.0)) ** 0.5
        assert told <= samples.min()
        n_apart += told > 0.0
    assert n_apart > 100
    assert own_slack(np.eye(4), 5.0) == np.inf  # not turned
    assert own_slack(pose @ np.diag([2.0, 1.0, 1.0, 1.0]), 5.0) == np.inf  # stretched

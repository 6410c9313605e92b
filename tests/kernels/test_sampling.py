"""The kernels of sampling against slow, plain forms of the same."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hapticdb.kernels import sampling

Floats = NDArray[np.float64]


def line_triangle(origin: Floats, direction: Floats, triangle: Floats) -> float:
    """Signed distance to the crossing, by a linear system; NaN where there is none."""
    along, across = triangle[1] - triangle[0], triangle[2] - triangle[0]
    u, v, t = np.linalg.solve(np.stack((along, across, -direction), axis=1), origin - triangle[0])
    return float(t) if min(u, v) >= 0.0 and u + v <= 1.0 else np.nan


@given(seed=st.integers(0, 2**32), n=st.integers(1, 40))
@settings(max_examples=30, deadline=None)
def test_the_tree_counts_the_crossings_of_a_plain_loop(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    triangles = rng.normal(size=(n, 3, 3))
    bodies = rng.integers(0, 3, n)
    tree = sampling.triangle_tree(triangles, bodies)
    stack = np.empty(sampling.STACK, dtype=np.int64)
    for _ in range(5):
        origin, direction = rng.normal(size=3), rng.normal(size=3)
        for body in range(3):
            skip = int(rng.integers(n))
            found = sampling.crossings(origin, direction, body, skip, tree, stack)
            distances = np.array(
                [
                    line_triangle(origin, direction, triangles[f])
                    for f in range(n)
                    if bodies[f] == body and f != skip
                ]
            )
            assert tuple(found[:2]) == ((distances > 0.0).sum(), (distances < 0.0).sum())


def test_a_line_that_starts_on_another_triangle_is_no_witness() -> None:
    triangle = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])
    tree = sampling.triangle_tree(np.repeat(triangle, 2, axis=0), np.zeros(2, dtype=np.int64))
    stack = np.empty(sampling.STACK, dtype=np.int64)
    found = sampling.crossings(
        triangle[0].mean(axis=0), np.array([0.3, 0.4, 0.5]), 0, 0, tree, stack
    )
    assert tuple(found[:2]) == (-1, -1)


@given(seed=st.integers(0, 2**32), n_keep=st.integers(20, 50))
@settings(max_examples=15, deadline=None)
def test_elimination_drops_the_most_crowded_every_time(seed: int, n_keep: int) -> None:
    rng = np.random.default_rng(seed)
    points = np.concatenate((rng.random((80, 2)), np.zeros((80, 1))), axis=1)
    face_of = rng.integers(0, 2, 80).astype(np.int32)
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    reach = 0.6  # each sees many others: two that saw only one another would tie
    nearest = reach * (1.0 - (n_keep / 80) ** 1.5) * 0.65
    scale = np.where(face_of[:, None] == face_of, 1.0, 0.35)
    distances = np.linalg.norm(points[:, None] - points, axis=2)
    weights = np.maximum(1.0 - np.maximum(distances, nearest * scale) / (reach * scale), 0.0) ** 8
    np.fill_diagonal(weights, 0.0)
    alive = np.ones(80, dtype=bool)
    while alive.sum() > n_keep:
        load = np.where(alive, weights @ alive, -1.0)
        if load.max() < 1e-12:
            return  # none is crowded: any may go
        alive[np.argmax(load)] = False
    chosen = sampling.spread_points(points, face_of, normals, n_keep, reach)
    assert np.array_equal(chosen, np.flatnonzero(alive))


def test_points_piled_upon_one_another_are_still_thinned_in_time() -> None:
    points = np.random.default_rng(0).random((4000, 3)) * 1e-3
    chosen = sampling.spread_points(
        points, np.zeros(4000, dtype=np.int32), np.array([[0.0, 0.0, 1.0]]), 400, 1.0
    )
    assert len(np.unique(chosen)) == 400

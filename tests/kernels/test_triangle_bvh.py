"""The lines that find the inside of a surface, compared with slow, plain versions."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hapticdb.kernels.surfaces import triangle_bvh

Floats = NDArray[np.float64]


def line_triangle(origin: Floats, direction: Floats, triangle: Floats) -> float:
    """Signed distance to the crossing, by a linear system; NaN without a crossing."""
    along, across = triangle[1] - triangle[0], triangle[2] - triangle[0]
    u, v, t = np.linalg.solve(np.stack((along, across, -direction), axis=1), origin - triangle[0])
    return float(t) if min(u, v) >= 0.0 and u + v <= 1.0 else np.nan


@given(seed=st.integers(0, 2**32), n=st.integers(1, 40))
@settings(max_examples=30, deadline=None)
def test_crossings_equal_plain_loop(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    triangles = rng.normal(size=(n, 3, 3))
    bodies = rng.integers(0, 3, n)
    tree = triangle_bvh.triangle_bvh(triangles, bodies)
    stack = np.empty(triangle_bvh.STACK, dtype=np.int64)
    for _ in range(5):
        origin, direction = rng.normal(size=3), rng.normal(size=3)
        for body in range(3):
            skip = int(rng.integers(n))
            found = triangle_bvh.crossings(origin, direction, body, skip, tree, stack)
            distances = np.array(
                [
                    line_triangle(origin, direction, triangles[f])
                    for f in range(n)
                    if bodies[f] == body and f != skip
                ]
            )
            assert tuple(found[:2]) == ((distances > 0.0).sum(), (distances < 0.0).sum())


def test_crossings_line_on_coincident_triangle() -> None:
    triangle = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])
    tree = triangle_bvh.triangle_bvh(np.repeat(triangle, 2, axis=0), np.zeros(2, dtype=np.int64))
    stack = np.empty(triangle_bvh.STACK, dtype=np.int64)
    found = triangle_bvh.crossings(
        triangle[0].mean(axis=0), np.array([0.3, 0.4, 0.5]), 0, 0, tree, stack
    )
    assert tuple(found[:2]) == (-1, -1)

"""Distances at points of a resident cell, against a plain twin and the true distance."""

from typing import Any

import numba
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import naive_field
from bands import steps_of
from hapticdb.kernels.field import spline as kernels
from hapticdb.kernels.field.lattice import CELL_SIDE, CELL_VALUES

INSIDE = st.floats(1.0, 30.0)
RADIUS = 9.3
"""Voxels, of a ball about the cell's middle: its surface alone is stored."""


def ball() -> NDArray[np.uint8]:
    """Payload (1, 34^3) of a cell with that ball."""
    steps = np.arange(-1, CELL_SIDE - 1) + 0.5 - 16.0
    centers = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return steps_of(np.abs(np.linalg.norm(centers, axis=1) - RADIUS)).reshape(1, CELL_VALUES)


BALL = ball()


@numba.njit  # type: ignore[untyped-decorator]
def read(payload: Any, x: Any, y: Any, z: Any) -> Any:  # noqa: ANN401 - numba's types
    """All that the field's kernels say at a point: a caller for leaves that are inlined."""
    return (
        kernels.spline(payload, 0, x, y, z),
        kernels.lower_bound(payload, 0, x, y, z),
        kernels.nearest_bound(payload, 0, x, y, z),
    )


@given(INSIDE, INSIDE, INSIDE)
@settings(max_examples=50)
def test_spline_value_and_gradient_equal_plain(x: float, y: float, z: float) -> None:
    found, _, _ = read(BALL, x, y, z)
    u, gradient = naive_field.spline(BALL[0], np.array([x, y, z]))
    np.testing.assert_allclose(found[0], u, atol=1e-12)
    np.testing.assert_allclose(found[1:], gradient, atol=1e-12)


@given(INSIDE, INSIDE, INSIDE)
def test_spline_lower_bound_of_distance(x: float, y: float, z: float) -> None:
    true = abs(float(np.linalg.norm([x - 16.0, y - 16.0, z - 16.0])) - RADIUS)
    _, bound, nearest = read(BALL, x, y, z)
    assert 0.0 <= nearest <= bound <= true + 1e-12


def test_bound_in_free_block_is_lower_bound() -> None:
    """Surface points leave all centres of a brick, and those around it, beyond h."""
    rng = np.random.default_rng(1)
    points = rng.uniform(-4.0, 12.0, (20_000, 3))
    nearest = points - (np.clip(np.round(points - 0.5), -1, 8) + 0.5)
    allowed = points[np.linalg.norm(nearest, axis=1) > 2.75]
    for point in rng.uniform(0.0, 8.0, (200, 3)):
        bound = kernels.bound_in_free_block(*point, np.int64(3))
        assert np.linalg.norm(allowed - point, axis=1).min() >= bound

"""Near voxels of a cell, and interpolation in it, against brute force."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from banded import steps_to
from hapticdb.kernels.field.distance_law import REACH
from hapticdb.kernels.field.lattice import BEYOND, CELL_SIDE, CELL_VALUES, STEPS, VOXELS_A_STEP
from hapticdb.kernels.resident.near_voxels import MOST_EIGHTHS, mark_near_voxels

Floats = NDArray[np.float64]
Steps = NDArray[np.uint8]
Marks = NDArray[np.bool_]
EVERYWHERE = (1 << 64) - 1


def near_of(
    values: Steps, words: NDArray[np.uint32] | None = None, mask: int = EVERYWHERE
) -> Marks:
    """Near voxels (32, 32, 32) of a cell with those distances (34^3,), in slot 1 of 2."""
    payload = np.full((2, CELL_VALUES), BEYOND, dtype=np.uint8)
    payload[1] = values
    occupied = np.zeros((2, 1024), dtype=np.uint32)
    if words is not None:
        occupied[1] = words
    near = np.full((2, 1024), 0xFFFFFFFF, dtype=np.uint32)  # of a cell that was here before
    masks = np.array([0, mask], dtype=np.uint64)
    mark_near_voxels(np.array([1]), payload, masks, occupied, near)
    assert (near[0] == 0xFFFFFFFF).all()
    bits = (near[1][:, None] >> np.arange(32, dtype=np.uint32)) & 1
    marks: Marks = bits.astype(bool).reshape(32, 32, 32)
    return marks


def least_distances(values: Steps) -> tuple[Floats, Floats]:
    """Least interpolated distance in each voxel (32, 32, 32), and least stored one around it."""
    u = np.minimum(values, STEPS).reshape((CELL_SIDE,) * 3) * VOXELS_A_STEP
    least = np.full((32, 32, 32), np.inf)
    stored = least.copy()
    for step in product((-1, 0, 1), repeat=3):
        # the place half a step away is the mean of the centres at 0 or at the step, on each axis
        corners = [
            u[tuple(slice(1 + c * s, 33 + c * s) for c, s in zip(corner, step, strict=True))]
            for corner in product((0, 1), repeat=3)
        ]
        least = np.minimum(least, sum(corners) / 8)
        stored = np.minimum(stored, corners[-1])
    return least, stored


def field_of(seed: int) -> Steps:
    """Distances to points, to planes askew, or any numbers."""
    rng = np.random.default_rng(seed)
    if seed % 3 == 0:
        return steps_to(
            rng.uniform(-2.0, 34.0, (rng.integers(1, 30), 3)), np.array([-1] * 3), 34
        ).ravel()
    if seed % 3 == 1:
        across = rng.normal(size=(2, 3))
        across /= np.linalg.norm(across, axis=1)[:, None]
        places = np.stack(np.meshgrid(*[np.arange(-0.5, 33.0)] * 3, indexing="ij"), axis=-1)
        away = np.abs(places @ across.T - across @ rng.uniform(8.0, 24.0, 3)).min(axis=-1)
        return np.where(away > 2.75, BEYOND, away / VOXELS_A_STEP + 0.5).astype(np.uint8).ravel()
    return rng.integers(rng.integers(0, 250), 256, CELL_VALUES).astype(np.uint8)


@given(st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=60)
def test_near_voxels_miss_no_point_in_reach(seed: int) -> None:
    """And none is marked whose 27 centres are all out of reach."""
    values = field_of(seed)
    near, (least, stored) = near_of(values), least_distances(values)
    assert not (~near & (least <= REACH)).any()
    assert not (near & (stored > REACH)).any()


@pytest.mark.parametrize("axis", [0, 1, 2])
@given(offset=st.floats(5.0, 18.0), slope=st.floats(-0.7, 0.7))
@settings(deadline=None, max_examples=20)
def test_near_voxels_beside_plane_exact(axis: int, offset: float, slope: float) -> None:
    """One side of a plane: the distances fall along each axis in one direction."""
    places = np.stack(np.meshgrid(*[np.arange(-0.5, 33.0)] * 3, indexing="ij"), axis=-1)
    across = np.roll([1.0, slope, -0.3], axis)
    away = np.maximum((places @ across) / np.linalg.norm(across) - offset, 0.0)
    values = np.where(away > 2.75, BEYOND, away / VOXELS_A_STEP + 0.5).astype(np.uint8).ravel()
    near, (least, _) = near_of(values), least_distances(values)
    assert np.array_equal(near, least <= REACH)
    assert near.any()
    assert not near.all()


def test_near_voxels_occupied_or_without_mask() -> None:
    words = np.random.default_rng(0).integers(0, 1 << 32, 1024, dtype=np.uint32)
    far = np.full(CELL_VALUES, BEYOND, dtype=np.uint8)
    bits = (words[:, None] >> np.arange(32, dtype=np.uint32)) & 1
    assert np.array_equal(near_of(far, words).ravel(), bits.astype(bool).ravel())
    assert not near_of(np.zeros(CELL_VALUES, dtype=np.uint8), mask=0).any()


def test_near_voxels_rounding_within_reach() -> None:
    assert MOST_EIGHTHS * VOXELS_A_STEP / 8 < REACH - 1e-4
    assert (MOST_EIGHTHS + 1) * VOXELS_A_STEP / 8 > REACH + 1e-4

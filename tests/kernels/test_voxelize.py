"""Voxelizing, compared with the exact oracle in naive.py: random, degenerate and border cases."""

from fractions import Fraction

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hapticdb.kernels.surfaces.voxelize import (
    brick_voxels,
    count_voxels,
    mark_points,
    voxelize,
    voxelize_pieces,
)
from naive import Voxel, bricks_of_voxels, voxels_of_points, voxels_of_triangles

JIT = not numba.config.DISABLE_JIT
few = settings(max_examples=150 if JIT else 20, deadline=None)
Triangles = NDArray[np.float64]

# quarters often lie on voxels' faces, edges and vertices; the range exceeds the grid on both sides
quarters = st.integers(-8, 40).map(lambda n: n / 4)
corner = st.tuples(quarters, quarters, quarters)
triangle = st.tuples(corner, corner, corner)
triangles = st.lists(triangle, min_size=1, max_size=4).map(lambda rows: np.array(rows, np.float64))


def voxels(tris: Triangles, bits: int) -> set[Voxel]:
    """Voxels that the kernel marks, read from its bricks."""
    rows = brick_voxels(*voxelize(tris, bits)).tolist()
    found = {(i, j, k) for i, j, k in rows}
    assert len(found) == len(rows)
    return found


def numbers(rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Voxels (n, 3) as one number each, ascending."""
    return np.sort(rows @ np.array([1 << 42, 1 << 21, 1]))


def random_triangles(seed: int, count: int, size: float, edge: float) -> Triangles:
    """Triangles of about that size, with their middles anywhere in the grid."""
    rng = np.random.default_rng(seed)
    middles = rng.uniform(0, edge, (count, 1, 3))
    return middles + rng.uniform(-0.5, 0.5, (count, 3, 3)) * size


# --- equal to the oracle ------------------------------------------------------------------------


@few
@given(triangles)
def test_voxelize_lattice_triangles_equal_oracle(tris: Triangles) -> None:
    assert voxels(tris, 3) == voxels_of_triangles(tris.tolist(), 3)


@pytest.mark.parametrize(
    ("size", "count"), [(0.01, 300), (0.3, 300), (1, 200), (3, 100), (10, 40), (50, 6)]
)
def test_voxelize_random_triangles_equal_oracle(size: float, count: int) -> None:
    tris = random_triangles(7, count if JIT else 1 + count // 10, size, 64)
    for tri in tris:
        assert voxels(tri[None], 6) == voxels_of_triangles([tri.tolist()], 6)
    assert voxels(tris, 6) == voxels_of_triangles(tris.tolist(), 6)


@few
@given(triangle, st.permutations(range(3)), st.integers(0, 7), st.floats(0, 1))
def test_voxelize_degenerate_triangles_equal_oracle(
    tri: tuple[tuple[float, ...], ...], order: list[int], planes: int, between: float
) -> None:
    """Segments, points, and triangles in border planes, along the axes and oblique."""
    corners = np.array(tri)
    for axis in range(3):
        if planes >> axis & 1:
            corners[:, axis] = corners[0, axis]
    flat = corners[order]
    segment = np.array([corners[0], corners[1], corners[1]])[order]
    point = corners[[0, 0, 0]]
    split = np.array([corners[0], corners[1], np.round(4 * between) / 4 * corners[1]])[order]
    for tris in (flat, segment, point, split):
        assert voxels(tris[None], 3) == voxels_of_triangles([tris.tolist()], 3)


@few
@given(
    triangle,
    st.floats(0, 1),
    st.integers(-56, -4),
    st.tuples(*[st.floats(-1, 1)] * 3),
    st.permutations(range(3)),
)
def test_voxelize_slivers_equal_oracle(
    tri: tuple[tuple[float, ...], ...],
    between: float,
    exponent: int,
    aside: tuple[float, ...],
    order: list[int],
) -> None:
    """One corner is 2^-4 to 2^-56 voxel from the opposite side; bracketed near the tolerance."""
    a, b = np.array(tri[0]), np.array(tri[1])
    sliver = np.array([a, b, a + between * (b - a) + 2.0**exponent * np.array(aside)])[order]
    found = voxels(sliver[None], 3)
    assert voxels_of_triangles([sliver.tolist()], 3, Fraction(9, 10**10)) <= found
    assert found <= voxels_of_triangles([sliver.tolist()], 3, Fraction(11, 10**10))


@pytest.mark.parametrize("seed", range(3))
def test_voxelize_large_tilted_triangles_equal_oracle(seed: int) -> None:
    """They have more columns than one buffer and more bricks than a new table has room for."""
    rng = np.random.default_rng(seed)
    edge = 64.0 if JIT else 48.0
    tri = np.array([[edge, 0, 0], [0, edge, 0], [0, 0, edge]]) + rng.uniform(-3, 3, (3, 3))
    assert voxels(tri[None], 6) == voxels_of_triangles([tri.tolist()], 6)


@few
@given(st.lists(st.tuples(*[st.floats(-2, 18)] * 3) | corner, max_size=30))
def test_mark_points_equal_oracle(rows: list[tuple[float, ...]]) -> None:
    points = np.array(rows, np.float64).reshape(-1, 3)
    expected = bricks_of_voxels(voxels_of_points(rows, 4))
    keys, occupancy = mark_points(points, 4)
    assert {int(z): bits.tobytes() for z, bits in zip(keys, occupancy, strict=True)} == expected


# --- closed forms -------------------------------------------------------------------------------


def touched(low: float, high: float, side: int) -> NDArray[np.int64]:
    """Voxels of an axis whose closed boxes meet low..high."""
    return np.arange(max(int(np.ceil(low)) - 1, 0), min(int(np.floor(high)), side - 1) + 1)


@settings(max_examples=20 if JIT else 3, deadline=None)
@given(
    st.integers(11, 15 if JIT else 11),
    st.permutations(range(3)),
    st.tuples(*[st.integers(0, 12)] * 4),
    st.sampled_from([1, 7, 1 << 17]),
)
def test_voxelize_wide_rectangles_closed_form(
    bits: int, axes: list[int], halves: tuple[int, int, int, int], most: int
) -> None:
    """Between two layers or within one, and their sides so, too: all is in halves of a voxel."""
    side = 1 << bits
    layer, begin, end, width = (n / 2 for n in halves)
    low, high = np.array([begin, 3.0, layer]), np.array([side - end, 3.0 + width, layer])
    corners = np.empty((4, 3))
    corners[:, axes] = low
    corners[[1, 2], axes[0]] = high[0]
    corners[[2, 3], axes[1]] = high[1]
    pieces = voxelize_pieces(corners[[[0, 1, 2], [0, 2, 3]]], bits, most)
    found = [numbers(brick_voxels(keys, occupancy)) for _, keys, occupancy in pieces]
    spans = [touched(low[n], high[n], side) for n in np.argsort(axes)]
    expected = np.stack(np.meshgrid(*spans, indexing="ij"), axis=-1).reshape(-1, 3)
    np.testing.assert_array_equal(np.unique(np.concatenate(found)), numbers(expected))


@pytest.mark.parametrize(("axis", "layer"), [(0, 0), (1, 5), (2, 6)])
def test_voxelize_wide_triangle_between_layers(axis: int, layer: int) -> None:
    """Its corners are those of voxels, and so are points of its longest side."""
    width, height = 1024, 1024 if JIT else 4
    corners = np.array([[3, 2, layer], [3 + width, 2, layer], [3, 2 + height, layer]], np.float64)
    found = brick_voxels(*voxelize(np.roll(corners, axis, axis=1)[None], 11))
    i, j, k = np.indices((width + 2, height + 2, 2)) - np.array([1, 1, 1])[:, None, None, None]
    is_met = np.maximum(i, 0) * height + np.maximum(j, 0) * width <= width * height
    expected = np.stack([i + 3, j + 2, k + layer], axis=-1)[is_met & (k + layer >= 0)]
    np.testing.assert_array_equal(numbers(found), numbers(np.roll(expected, axis, axis=1)))


def test_voxelize_touch_tolerance() -> None:
    for gap, layers in ((5e-10, {3, 4}), (2e-9, {4})):
        flat = np.array([[[2, 2, 4 + gap], [5, 2, 4 + gap], [2, 5, 4 + gap]]])
        assert {k for _, _, k in voxels(flat, 3)} == layers


# --- what the result does not depend on ---------------------------------------------------------


def test_voxelize_independent_of_order_and_split() -> None:
    rng = np.random.default_rng(3)
    tris = np.concatenate(
        [random_triangles(n, 40 if JIT else 8, size, 64) for n, size in enumerate((0.1, 2, 9))]
    )
    keys, occupancy = voxelize(tris, 6)
    for _ in range(3):
        shuffled = tris[rng.permutation(len(tris))]
        again = voxelize(shuffled[:, rng.permutation(3)], 6)
        assert np.array_equal(keys, again[0])
        assert np.array_equal(occupancy, again[1])
        cuts = np.sort(rng.integers(0, len(tris), 4))
        united = set().union(*(voxels(part, 6) for part in np.split(shuffled, cuts)))
        assert united == voxels(tris, 6)


@few
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.01, 0.4, 3.0]))
def test_voxelize_far_end_of_largest_grid(seed: int, size: float) -> None:
    tris = random_triangles(seed, 3, size, 8) + (2.0**21 - 8)
    found = voxels(tris, 21)
    assert voxels_of_triangles(tris.tolist(), 21, Fraction(9, 10**10)) <= found
    assert found <= voxels_of_triangles(tris.tolist(), 21, Fraction(11, 10**10))


# --- sizes --------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", range(3))
def test_voxelize_needle_through_grid(axis: int) -> None:
    bits = 21 if JIT else 10
    needle = np.full((1, 3, 3), 3.5)
    needle[0, :, axis] = 0.25, 2.0**bits - 0.25, 7.0
    needle[0, 2, (axis + 1) % 3] = 3.75
    assert count_voxels(voxelize(needle, bits)[1]) == 2**bits


@pytest.mark.parametrize("far", [1e6, 1e30, 1e300])
def test_voxelize_huge_triangle_clipped(far: float) -> None:
    sheet = np.array([[[-far, -far, 5.5], [far, -far, 5.5], [0.0, far, 5.5]]])
    assert voxels(sheet, 3) == {(i, j, 5) for i in range(8) for j in range(8)}
    assert voxels(sheet + np.array([0, 0, 9.0]), 3) == set()
    assert voxels(np.full((1, 3, 3), -far), 3) == set()


def test_voxelize_no_triangles() -> None:
    keys, occupancy = voxelize(np.empty((0, 3, 3)), 10)
    assert keys.shape == (0,)
    assert occupancy.shape == (0, 64)
    assert count_voxels(occupancy) == 0
    assert brick_voxels(keys, occupancy).shape == (0, 3)


def test_mark_points_non_finite_or_outside() -> None:
    points = np.array([[np.nan, 1, 1], [np.inf, 1, 1], [8.0, 1, 1], [-1e-9, 1, 1], [1e300] * 3])
    assert len(mark_points(points, 3)[0]) == 0


# --- bricks -------------------------------------------------------------------------------------


def test_voxelize_sorted_bricks_z_order_bits() -> None:
    tris = random_triangles(5, 30 if JIT else 6, 20, 32)
    keys, occupancy = voxelize(tris, 5)
    expected = bricks_of_voxels(voxels_of_triangles(tris.tolist(), 5))
    assert keys.tolist() == list(expected)
    assert occupancy.tobytes() == b"".join(expected.values())
    assert keys.dtype == np.int64
    assert occupancy.dtype == np.uint8

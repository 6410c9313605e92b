"""Bands of distances, compared with distances by brute force at every centre of the grid."""

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from bands import band_of, distance_to_triangle
from hapticdb.kernels.field.lattice import BEYOND, HALF_WIDTH, VOXELS_A_STEP
from hapticdb.kernels.field.packing import unpack
from hapticdb.kernels.surfaces import distances
from hapticdb.kernels.surfaces.distances import BLOCK, BLOCK_BRICKS, PAIRS_OF_PIECE, band_pieces
from naive import z_order

JIT = not numba.config.DISABLE_JIT
few = settings(max_examples=40 if JIT else 2, deadline=None)
Floats = NDArray[np.float64]
seeds = st.integers(0, 2**32 - 1)
KINDS = ("small", "medium", "sliver", "line", "point", "flat", "huge")


def random_triangles(seed: int, kind: str, n: int, edge: float) -> Floats:
    """Triangles of a kind anywhere around a grid of that edge."""
    rng = np.random.default_rng(seed)
    size = {"small": 0.5, "medium": 6.0, "huge": 400.0}.get(kind, 12.0)
    middles = rng.uniform(-2.0, edge + 2.0, (n, 1, 3))
    corners = middles + rng.uniform(-size, size, (n, 3, 3))
    if kind == "sliver":
        corners[:, 2] = 0.3 * corners[:, 0] + 0.7 * corners[:, 1] + rng.normal(0, 1e-7, (n, 3))
    if kind == "line":
        corners[:, 2] = corners[:, rng.integers(0, 2)]
        corners[: n // 2, 1:, 0] = corners[: n // 2, :1, 0]
    if kind == "point":
        corners[:] = corners[:, :1]
    if kind == "flat":
        corners[:, :, rng.integers(0, 3)] = rng.integers(0, int(edge)) + rng.choice([0.0, 0.5])
    return corners[:, rng.permutation(3)]


def centres_of(brick: tuple[int, int, int]) -> Floats:
    """Centres (1000, 3) of a brick's row, voxels from the grid's origin."""
    axis = np.arange(-1, 9) + 0.5
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(grid + 8.0 * np.array(brick))


def check_against_brute_force(triangles: Floats, bits: int) -> None:
    """Every brick of the grid: right to half a step, and a row where there is a distance."""
    corners = np.broadcast_to(triangles, (len(triangles), 3, 3))  # points become triangles, too
    keys, data, ends = band_of(triangles, bits)
    rows = dict(zip(keys.tolist(), unpack(data, ends), strict=True))
    assert keys.tolist() == sorted(rows)
    side = max(1 << bits >> 3, 1)
    n_found = 0
    for brick in np.ndindex(side, side, side):
        centres = centres_of(brick)
        truth = np.min([distance_to_triangle(centres, one) for one in corners], axis=0)
        row = rows.get(z_order(*brick))
        if row is None:
            assert truth.min() > HALF_WIDTH - 1e-7
            continue
        n_found += 1
        near = row != BEYOND
        assert near.any()
        assert np.abs(row[near] * VOXELS_A_STEP - truth[near]).max() <= 0.5 * VOXELS_A_STEP + 1e-7
        assert (truth[~near] > HALF_WIDTH - 1e-7).all()
    assert n_found == len(keys)


@few
@given(seeds, st.sampled_from(KINDS))
def test_band_equals_brute_force(seed: int, kind: str) -> None:
    check_against_brute_force(random_triangles(seed, kind, 4 if JIT else 1, 16.0), 4)
    points = np.random.default_rng(seed).uniform(-4.0, 20.0, (1 + seed % 9, 1, 3))
    check_against_brute_force(points, 4)


@pytest.mark.parametrize("bits", [1, 2, 3])
def test_band_of_small_grids(bits: int) -> None:
    check_against_brute_force(random_triangles(1, "medium", 3, 2.0**bits), bits)


def test_band_of_triangles_beyond_grid() -> None:
    far = 1e5
    sheet = np.array([[[-far, -far, 5.3], [far, -far, 5.3], [0.0, far, 5.3]]])
    check_against_brute_force(sheet, 4)
    turned = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    check_against_brute_force(sheet @ turned, 4)


@pytest.mark.parametrize("far", [1e30, 1e300])
def test_band_of_huge_triangles_finite(far: float) -> None:
    sheet = np.array([[[-far, -far, 5.5], [far, -far, 5.5], [0.0, far, 5.5]]])
    assert len(band_of(sheet, 5)[0]) <= 64


@pytest.mark.skipif(not JIT, reason="too slow without the JIT")
@few
@given(seeds)
def test_band_independent_of_order_and_split(seed: int) -> None:
    rng = np.random.default_rng(seed)
    kinds = [random_triangles(seed, kind, 6, 140.0) for kind in KINDS]
    triangles = np.concatenate(kinds)
    whole = band_of(triangles, 7)
    for a, b in zip(band_of(triangles[rng.permutation(len(triangles))], 7), whole, strict=True):
        np.testing.assert_array_equal(a, b)
    least: dict[int, NDArray[np.uint8]] = {}
    for some in np.array_split(triangles, 3):
        keys, data, ends = band_of(some, 7)
        for key, row in zip(keys.tolist(), unpack(data, ends), strict=True):
            least[key] = np.minimum(least.get(key, row), row)
    assert whole[0].tolist() == sorted(least)
    np.testing.assert_array_equal(unpack(*whole[1:]), [least[key] for key in sorted(least)])


@pytest.mark.skipif(not JIT, reason="too slow without the JIT")
@few
@given(seeds)
def test_band_rows_agree_on_shared_centres(seed: int) -> None:
    """Also across the border of two blocks."""
    triangles = random_triangles(seed, "medium", 40, 24.0) + BLOCK - 12.0
    keys, data, ends = band_of(triangles, 7)
    steps = np.full((130, 130, 130), -1)
    at = {z_order(*brick): brick for brick in np.ndindex(16, 16, 16)}
    for key, row in zip(keys.tolist(), unpack(data, ends).reshape(-1, 10, 10, 10), strict=True):
        i, j, k = (8 * n for n in at[key])
        here = steps[i : i + 10, j : j + 10, k : k + 10]
        assert ((here == -1) | (here == row)).all()
        here[:] = row


@pytest.mark.skipif(not JIT, reason="too slow without the JIT")
def test_band_pieces_bounded_with_share() -> None:
    triangles = random_triangles(3, "medium", 60, 500.0)
    pieces = list(band_pieces(triangles, 9, rows=BLOCK_BRICKS))
    keys = np.concatenate([keys for _, keys, _, _ in pieces])
    shares = [share for share, *_ in pieces]
    assert len(pieces) > 5
    assert max(len(keys) for _, keys, _, _ in pieces) <= BLOCK_BRICKS
    assert (np.diff(keys) > 0).all()
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    np.testing.assert_array_equal(keys, band_of(triangles, 9)[0])


@pytest.mark.skipif(not JIT, reason="too slow without the JIT")
def test_band_pieces_bounded_within_block(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that an import that many triangles crowd into one block can be ended."""
    monkeypatch.setattr(distances, "TRIANGLES_AT_ONCE", 7000)
    one = random_triangles(3, "medium", 1, 40.0)
    shares = [share for share, *_ in band_pieces(np.repeat(one, 20_000, axis=0), 6)]
    assert len([share for share in shares if share == 0.0]) == 3
    assert len([share for share in shares if share > 0.0]) == 20_000 // PAIRS_OF_PIECE + 1
    for found, alone in zip(
        band_of(np.repeat(one, 20_000, axis=0), 6), band_of(one, 6), strict=True
    ):
        np.testing.assert_array_equal(found, alone)


def test_band_of_no_triangles() -> None:
    keys, data, ends = band_of(np.empty((0, 3, 3)), 5)
    assert (keys.shape, data.shape, ends.shape) == ((0,), (0,), (0,))
    assert len(band_of(np.full((1, 3, 3), -50.0), 5)[0]) == 0

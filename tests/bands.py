"""Distances to triangles by brute force, and the rows of a table of distances made from them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.grid import Grid
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.kernels.field.lattice import BEYOND, HALF_WIDTH, ROW_SIDE, ROW_VALUES, STEPS
from hapticdb.kernels.surfaces.distances import band_pieces
from hapticdb.kernels.surfaces.voxelize import brick_voxels, voxelize

Array = NDArray[np.float64]


def distance_to_segments(points: Array, start: Array, end: Array) -> Array:
    """Distance of points (n, 3) from segment start .. end (3,)."""
    way = end - start
    length = float(way @ way)
    share = np.clip((points - start) @ way / length, 0.0, 1.0) if length else np.zeros(len(points))
    found: Array = np.linalg.norm(points - start - share[:, None] * way, axis=1)
    return found


def distance_to_triangle(points: Array, triangle: Array) -> Array:
    """Distance (n,) of points (n, 3) from a triangle (3, 3): above its plane, or from its edges."""
    a, b, c = triangle
    found: Array = np.minimum.reduce(
        [distance_to_segments(points, *edge) for edge in ((a, b), (b, c), (c, a))]
    )
    normal = np.cross(b - a, c - a)
    if np.linalg.norm(normal) <= 1e-9 * max((b - a) @ (b - a), (c - a) @ (c - a)):
        return found
    normal = normal / np.linalg.norm(normal)
    sides = [np.cross(q - p, points - p) @ normal for p, q in ((a, b), (b, c), (c, a))]
    is_above = np.all([side >= 0.0 for side in sides], axis=0)
    return np.where(is_above, np.minimum(np.abs((points - a) @ normal), found), found)


class BandRows(NamedTuple):
    """Rows of one object: keys (R,) ascending, occupancy (64 R,), values (R, 1000) uint8.

    voxels (V, 3): the occupied ones; steps: the stored distances by centre, where not BEYOND.
    """

    keys: NDArray[np.int64]
    occupancy: NDArray[np.uint8]
    values: NDArray[np.uint8]
    voxels: NDArray[np.int64]
    steps: dict[tuple[int, int, int], int]


def steps_of(distances: Array) -> NDArray[np.uint8]:
    """Stored values of distances in voxels."""
    q = np.floor(distances * (STEPS / HALF_WIDTH) + 0.5)
    return np.where(distances > HALF_WIDTH, BEYOND, q).astype(np.uint8)


def band_rows(triangles: Array, grid: Grid) -> BandRows:
    """Rows of triangles (T, 3, 3), metres, on a grid of bricks."""
    placed = (triangles - np.array(grid.origin)) / grid.voxel_size
    low = np.floor((placed.reshape(-1, 3).min(axis=0) - HALF_WIDTH - 1) / 8).astype(int)
    high = np.floor((placed.reshape(-1, 3).max(axis=0) + HALF_WIDTH + 1) / 8).astype(int)
    first = 8 * low - 1
    spans = 8 * (high - low + 1) + 2
    index = np.indices(tuple(spans)).reshape(3, -1).T
    centres = index + first + 0.5
    nearest = np.full(len(centres), np.inf)
    for triangle in placed:
        box = np.stack([triangle.min(axis=0), triangle.max(axis=0)])
        is_near = ((centres > box[0] - 3) & (centres < box[1] + 3)).all(axis=1)
        found = distance_to_triangle(centres[is_near], triangle)
        nearest[is_near] = np.minimum(nearest[is_near], found)
    steps = steps_of(nearest).reshape(tuple(spans))
    voxels = brick_voxels(*voxelize(placed, grid.bits))
    bricks: dict[int, tuple[NDArray[np.uint8], NDArray[np.uint8]]] = {}
    at_rows = rows_of_voxels(voxels, grid, "brick")
    occupied = dict(zip(at_rows.keys.tolist(), at_rows.occupancy.reshape(-1, 64), strict=True))
    n_bricks = 1 << (grid.bits - 3)
    for brick in np.ndindex(*(high - low + 1)):
        ijk = low + brick
        if not ((ijk >= 0) & (ijk < n_bricks)).all():
            continue
        i, j, k = 8 * np.array(brick)
        values = steps[i : i + ROW_SIDE, j : j + ROW_SIDE, k : k + ROW_SIDE].reshape(ROW_VALUES)
        if (values != BEYOND).any():
            key = int(grid.encode((8 * ijk)[None])[0]) >> 9
            bricks[key] = (occupied.pop(key, np.zeros(64, dtype=np.uint8)), values)
    assert not occupied, "an occupied brick has no distances"
    keys = np.array(sorted(bricks), dtype=np.int64)
    inside = steps != BEYOND
    named = (np.argwhere(inside) + first).tolist()
    return BandRows(
        keys,
        np.concatenate([bricks[k][0] for k in keys.tolist()]),
        np.stack([bricks[k][1] for k in keys.tolist()]),
        voxels,
        {(i, j, k): q for (i, j, k), q in zip(named, steps[inside].tolist(), strict=True)},
    )


def band_of(
    triangles: NDArray[np.float64], bits: int
) -> tuple[NDArray[np.int64], NDArray[np.uint8], NDArray[np.int64]]:
    """Band of triangles or points: keys (R,), packed rows and their ends; see `band_pieces`."""
    pieces = list(band_pieces(triangles, bits))
    starts = np.cumsum([0] + [len(data) for _, _, data, _ in pieces])
    keys = [np.empty(0, dtype=np.int64), *(keys for _, keys, _, _ in pieces)]
    packed = [np.empty(0, dtype=np.uint8), *(data for _, _, data, _ in pieces)]
    ends = [ends + start for (_, _, _, ends), start in zip(pieces, starts, strict=False)]
    return (
        np.concatenate(keys),
        np.concatenate(packed),
        np.concatenate([np.empty(0, dtype=np.int64), *ends]),
    )

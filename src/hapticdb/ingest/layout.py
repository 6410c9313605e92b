"""Conversion between voxels and rows of the index table, by way of bricks in Z-order."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.grid import BRICK_BITS, Grid
from hapticdb.kernels import curves
from hapticdb.kernels.surfaces import voxelize
from hapticdb.store.base import BRICK_BYTES, NO_OCCUPANCY, Band, Keys, Layout, Rows

BRICKS_AT_ONCE = 1 << 15
"""Bricks of a batch, unpacked to voxels. A larger value takes more memory: 24 bytes a voxel."""


class Bricks(NamedTuple):
    """Voxels as bricks in Z-order, for any curve of the environment.

    keys (B,) int64, ascending, distinct; occupancy (B, 64) uint8: bit n, least significant first,
    is the brick's voxel of Z-order n by (i, j, k) modulo 8; distances: as in `Rows`.
    """

    keys: Keys
    occupancy: NDArray[np.uint8]
    distances: Band | None = None


def rows_of_bricks(bricks: Bricks, grid: Grid, layout: Layout) -> tuple[Rows, int]:
    """Rows of bricks in a layout and the grid's order, and the number of their voxels."""
    keys, occupancy, distances = bricks
    n_voxels = voxelize.count_voxels(occupancy)
    if layout == "voxel":
        keys = _voxel_keys(bricks, n_voxels, grid)
        return Rows(keys, np.zeros(len(keys), dtype=np.int64), NO_OCCUPANCY), n_voxels
    if grid.curve != "z":
        keys = _reordered(keys, grid.bits, curves.Z_ORDER, grid.curve_code)
        order = np.argsort(keys)
        keys, occupancy = keys[order], occupancy[order]
        distances = None if distances is None else distances.picked(order)
    ids = np.zeros(len(keys), dtype=np.int64)
    return Rows(keys, ids, occupancy.reshape(-1), distances), n_voxels


def _voxel_keys(bricks: Bricks, n_voxels: int, grid: Grid) -> Keys:
    """Keys (n_voxels,) of all voxels, ascending; unpacks `BRICKS_AT_ONCE` bricks at a time."""
    keys = np.empty(n_voxels, dtype=np.int64)
    at = 0
    for start in range(0, len(bricks.keys), BRICKS_AT_ONCE):
        some = slice(start, start + BRICKS_AT_ONCE)
        found = grid.encode(voxelize.brick_voxels(bricks.keys[some], bricks.occupancy[some]))
        keys[at : at + len(found)] = found
        at += len(found)
    keys.sort()
    return keys


def bricks_of_rows(rows: Rows, grid: Grid, layout: Layout) -> Bricks:
    """Bricks of one object's rows; the inverse of `rows_of_bricks`."""
    if layout == "voxel":
        return bricks_of_voxels(grid.decode(rows.keys), grid)
    keys = rows.keys
    if grid.curve != "z":
        keys = _reordered(keys, grid.bits, grid.curve_code, curves.Z_ORDER)
    order = np.argsort(keys)
    distances = None if rows.distances is None else rows.distances.picked(order)
    return Bricks(keys[order], rows.occupancy.reshape(-1, BRICK_BYTES)[order], distances)


def bricks_of_voxels(ijk: NDArray[np.int64], grid: Grid) -> Bricks:
    """Bricks of voxels (n, 3) inside the grid, in any order."""
    return Bricks(*voxelize.mark_points(ijk.astype(np.float64) + 0.5, grid.bits))


def rows_of_voxels(ijk: NDArray[np.int64], grid: Grid, layout: Layout) -> Rows:
    """Rows of voxels (n, 3) in any order, such as those of an analytic scene."""
    return rows_of_bricks(bricks_of_voxels(ijk, grid), grid, layout)[0]


def voxels_of_rows(rows: Rows, grid: Grid, layout: Layout) -> NDArray[np.int64]:
    """Voxels (n, 3) of one object's rows, in the order of their keys."""
    if layout == "voxel":
        return grid.decode(rows.keys)
    ijk = voxelize.brick_voxels(*bricks_of_rows(rows, grid, layout)[:2])
    return ijk[np.argsort(grid.encode(ijk))]


def merged(pieces: list[Bricks]) -> Bricks:
    """Union of bricks without distances; empties the list to save memory."""
    if len(pieces) == 1:
        return pieces.pop()
    keys = np.unique(np.concatenate([piece.keys for piece in pieces]))
    words = np.zeros((len(keys), BRICK_BYTES // 8), dtype=np.int64)
    while pieces:
        piece = pieces.pop()
        words[np.searchsorted(keys, piece.keys)] |= piece.occupancy.view(np.int64)
    return Bricks(keys, words.view(np.uint8))


def _reordered(keys: Keys, bits: int, curve: int, onto: int) -> Keys:
    """Brick keys converted to another curve, in the old order."""
    level = max(bits - BRICK_BITS, 0)
    return curves.encode(curves.decode(keys, level, curve), level, onto)

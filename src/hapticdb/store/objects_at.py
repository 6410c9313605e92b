"""Exact object ids of given voxels, by queries of the store."""

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.curves import Z_ORDER, encode
from hapticdb.kernels.field.lattice import HALF_WIDTH, ROW_SIDE, VOXELS_A_STEP
from hapticdb.kernels.field.packing import unpack
from hapticdb.store.base import BRICK_BYTES, BRICK_SHIFT, NO_KEYS, Keys, Rows, Store


def ids_of_voxels(store: Store, keys: Keys, exclude: Keys) -> NDArray[np.int64]:
    """Ids of the objects in voxels (n,), distinct and ascending, without those in `exclude` (E,).

    keys (n,) int64 : on the environment's curve, distinct and ascending.
    """
    if store.layout == "voxel":
        ids = np.unique(store.lookup(keys).ids)
    else:
        bricks, inverse = np.unique(keys >> BRICK_SHIFT, return_inverse=True)
        rows = store.lookup(bricks)
        voxel, row = _rows_of_bricks(rows, bricks[inverse])
        ids = np.unique(rows.ids[row[_is_in_voxel(store, rows, row, keys[voxel])]])
    return ids[~np.isin(ids, exclude)]


def ids_near_voxels(store: Store, keys: Keys, exclude: Keys, within: float) -> NDArray[np.int64]:
    """Ids of the objects with a surface near the centres of voxels (n,), distinct, ascending.

    Near: within the lesser of `within` voxels and the half width of the band, or in a voxel itself.
    Every object must have distances. Otherwise as `ids_of_voxels`.
    """
    bricks, inverse = np.unique(keys >> BRICK_SHIFT, return_inverse=True)
    rows = store.lookup(bricks, distances=True)
    band = rows.distances
    if band is None:
        return NO_KEYS
    values = unpack(band.data, band.ends)
    i, j, k = (store.grid.decode(keys) & 7).T
    # as `row_place`: a row begins one centre before its brick
    place = ((i + 1) * ROW_SIDE + j + 1) * ROW_SIDE + k + 1
    # rounded as `step_of` rounds what is stored
    step = int(min(within, HALF_WIDTH) / VOXELS_A_STEP + 0.5)
    voxel, row = _rows_of_bricks(rows, bricks[inverse])
    is_near = values[row, place[voxel]] <= step
    is_near |= _is_in_voxel(store, rows, row, keys[voxel])
    ids = np.unique(rows.ids[row[is_near]])
    return ids[~np.isin(ids, exclude)]


def _rows_of_bricks(rows: Rows, bricks: Keys) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Every brick (n,) with each of its rows, (P,): index in `bricks`, and index of the row."""
    first = np.searchsorted(rows.keys, bricks)
    last = np.searchsorted(rows.keys, bricks, side="right")
    brick = np.repeat(np.arange(len(bricks)), last - first)
    # index of the brick's first row, counted on within the brick
    row = np.arange(len(brick)) - np.repeat(np.cumsum(last - first) - last, last - first)
    return brick, row


def _is_in_voxel(store: Store, rows: Rows, row: NDArray[np.int64], keys: Keys) -> NDArray[np.bool_]:
    """Whether the bricks of rows (P,), given by index, contain the voxels of keys (P,)."""
    if store.grid.curve == "z":
        bit = keys & ((1 << BRICK_SHIFT) - 1)
    else:
        # bits within a brick are in z-order on either curve
        bit = encode(store.grid.decode(keys) & 7, 3, Z_ORDER)
    bytes_of = rows.occupancy[BRICK_BYTES * row + (bit >> 3)]
    return ((bytes_of >> (bit & 7).astype(np.uint8)) & 1).astype(np.bool_)

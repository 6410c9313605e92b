"""Which objects are in given voxels, exactly, by queries of the store."""

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.curves import Z_ORDER, encode
from hapticdb.store.base import BRICK_BYTES, BRICK_SHIFT, Keys, Store


def ids_of_voxels(store: Store, keys: Keys, exclude: Keys) -> NDArray[np.int64]:
    """Ids of the objects in voxels (n,), distinct and ascending.

    keys (n,) int64: of voxels on the environment's curve, distinct and ascending; exclude (E,) ids
    that are left out.
    """
    return np.unique(pairs_of_voxels(store, keys, exclude)[:, 1])


def pairs_of_voxels(store: Store, keys: Keys, exclude: Keys) -> NDArray[np.int64]:
    """Every voxel with every object in it, (P, 2): index in `keys`, and object id; ordered by both.

    The arguments are those of `ids_of_voxels`.
    """
    if store.layout == "voxel":
        rows = store.lookup(keys)
        pairs = np.stack([np.searchsorted(keys, rows.keys), rows.ids], axis=1)
    else:
        pairs = _pairs_in_bricks(store, keys)
    pairs = pairs[~np.isin(pairs[:, 1], exclude)]
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def _pairs_in_bricks(store: Store, keys: Keys) -> NDArray[np.int64]:
    bricks, inverse = np.unique(keys >> BRICK_SHIFT, return_inverse=True)
    rows = store.lookup(bricks)
    if store.grid.curve == "z":
        bits = keys & ((1 << BRICK_SHIFT) - 1)
    else:
        bits = encode(store.grid.decode(keys) & 7, 3, Z_ORDER)
    first = np.searchsorted(rows.keys, bricks[inverse])
    last = np.searchsorted(rows.keys, bricks[inverse], side="right")
    voxel = np.repeat(np.arange(len(keys)), last - first)
    row = np.arange(len(voxel)) - np.repeat(np.cumsum(last - first) - last, last - first)
    bit = bits[voxel]
    is_set = (rows.occupancy[BRICK_BYTES * row + (bit >> 3)] >> (bit & 7).astype(np.uint8)) & 1 > 0
    return np.stack([voxel[is_set], rows.ids[row[is_set]]], axis=1)

"""Distances to the surface of a part, beside its bricks: in pieces of bounded size."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hapticdb.ingest.layout import Bricks
from hapticdb.kernels.surfaces import distances
from hapticdb.store.base import BRICK_BYTES, Band, Keys

BYTES_A_ROW = 8 + 8 + BRICK_BYTES
"""Memory of a row with distances but for their packed bytes: its key, their end, its occupancy."""


def with_distances(
    bricks: Bricks,
    corners: NDArray[np.float64],
    bits: int,
    check_room: Callable[[int], None],
    progress: Callable[[float], None] | None = None,
) -> Bricks:
    """Bricks of a part with distances to its surface, and the bricks near it that it does not meet.

    bricks : those that the part meets; corners (T, 3, 3) of triangles, or (P, 1, 3) points of a
    cloud, in voxels from the grid's origin; check_room : called with the bytes that the result
    needs at least, raises if they are too many; progress : called with the share that is done.
    """
    keys: list[Keys] = []
    packed: list[NDArray[np.uint8]] = []
    ends: list[NDArray[np.int64]] = []
    n_rows, n_bytes = 0, 0
    for share, some, data, ends_of_some in distances.band_pieces(corners, bits):
        keys.append(some)
        packed.append(data)
        ends.append(ends_of_some + n_bytes)
        n_rows, n_bytes = n_rows + len(some), n_bytes + len(data)
        check_room(2 * (BYTES_A_ROW * n_rows + n_bytes))
        if progress is not None and share < 1.0:
            progress(share)
    if not keys:
        return Bricks(bricks.keys, bricks.occupancy, Band(np.empty(0, np.uint8), bricks.keys[:0]))
    near = np.concatenate(keys)
    occupancy = np.zeros((n_rows, BRICK_BYTES), dtype=np.uint8)
    occupancy[np.searchsorted(near, bricks.keys)] = bricks.occupancy
    return Bricks(near, occupancy, Band(np.concatenate(packed), np.concatenate(ends)))

"""Lossless packing of brick occupancies: a mask of the nonzero bytes, and these bytes.

Bit n of a mask of 64 bits, 8 bytes, least significant first, is 1 if byte n of the occupancy is not
0; then these bytes follow in order. Byte n is a cube of 2 x 2 x 2 voxels, so a surface through a
brick meets about 16 of the 64, in 24 bytes. An SQL expression finds the bit of a voxel by counting
the bits of the mask before it.

Bricks follow one another without lengths: a mask gives the number of its bytes. A mask of zeros
alone is a brick without a voxel; nothing is stored of it.
"""

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import BYTES, READ_BYTES, entry
from hapticdb.kernels.bits import lowest_bit

BYTES_OF_BRICK = 64
"""Bytes of an occupancy: a bit for each voxel."""
MASK_BYTES = BYTES_OF_BRICK // 8
"""Bytes of a mask."""


@entry(READ_BYTES, BYTES)
def unpack_kernel(data, out):
    """Unpack bricks, one after the other, into out (64 R,), initially zero -> bytes read, or -1.

    -1 if data (n,) ends before the last brick. Indices are unsigned, in two thirds of the time of
    signed ones, and 32 bits of the mask are read at once.
    """
    at, end = np.uint64(0), np.uint64(data.shape[0])
    for first in range(np.uint64(0), np.uint64(out.shape[0]), np.uint64(64)):
        follow = at + np.uint64(8)
        if follow > end:
            return np.int64(-1)
        for half in range(np.uint64(2)):
            mask = np.int64(0)
            for n in range(np.uint64(4)):
                byte = np.int64(data[at + np.uint64(4) * half + n])
                mask |= byte << np.int64(np.uint64(8) * n)
            while mask:
                # tested at each byte: a damaged mask may ask for more than there are
                if follow == end:
                    return np.int64(-1)
                place = np.uint64(32) * half + np.uint64(lowest_bit(mask))
                out[first + place] = data[follow]
                follow += np.uint64(1)
                mask &= mask - 1
        at = follow
    return np.int64(at)


def pack(occupancy: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Packed bytes (n,) of occupancies (64 R,), and the end of each brick in them (R,).

    A brick without a voxel has no bytes.
    """
    bricks = occupancy.reshape(-1, BYTES_OF_BRICK)
    is_held = bricks != 0
    masks = np.packbits(is_held, axis=1, bitorder="little")
    is_stored = np.hstack([np.repeat(is_held.any(axis=1)[:, None], MASK_BYTES, axis=1), is_held])
    ends = np.cumsum(is_stored.sum(axis=1, dtype=np.int64))
    return np.hstack([masks, bricks])[is_stored], ends


def unpack(data: bytes, n_bricks: int) -> NDArray[np.uint8]:
    """Occupancies (64 R,) of packed bricks, each with its mask; read-only.

    Raises
    ------
    ValueError
        If the data are not those of `n_bricks` bricks.
    """
    out = np.zeros(BYTES_OF_BRICK * n_bricks, np.uint8)
    if unpack_kernel(np.frombuffer(data, np.uint8), out) != len(data):
        raise ValueError(f"{len(data)} bytes are not {n_bricks} bricks")
    out.setflags(write=False)
    return out

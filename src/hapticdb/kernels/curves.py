"""Space-filling curves: voxel (i, j, k) <-> key, 1 to 21 bits an axis.

On every curve i is the most significant axis and k the least, and a key fills `3 * bits` bits of a
non-negative int64. Z-order (Morton 1966) interleaves the bits, ``... i1 j1 k1 i0 j0 k0``; the
Hilbert curve is Skilling's ("Programming the Hilbert curve", AIP Conf. Proc. 707, 2004). Both are
hierarchical: ``key >> 3`` is the key of the enclosing cube of twice the edge, on the same curve
with one bit less.
"""

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import INT, INTS, INTS2, entry, leaf

LEXICOGRAPHIC = 0
Z_ORDER = 1
HILBERT = 2


@leaf
def spread(x):
    """Bits of x, at most 21, moved apart to every third place."""
    x &= 0x1FFFFF
    x = (x | (x << 32)) & 0x1F00000000FFFF
    x = (x | (x << 16)) & 0x1F0000FF0000FF
    x = (x | (x << 8)) & 0x100F00F00F00F00F
    x = (x | (x << 4)) & 0x10C30C30C30C30C3
    return (x | (x << 2)) & 0x1249249249249249


@leaf
def compact(x):
    """Every third bit of x moved together: the inverse of `spread`."""
    x &= 0x1249249249249249
    x = (x | (x >> 2)) & 0x10C30C30C30C30C3
    x = (x | (x >> 4)) & 0x100F00F00F00F00F
    x = (x | (x >> 8)) & 0x1F0000FF0000FF
    x = (x | (x >> 16)) & 0x1F00000000FFFF
    return (x | (x >> 32)) & 0x1FFFFF


@leaf
def z_encode(i, j, k):
    """Z-order key of (i, j, k)."""
    return (spread(i) << 2) | (spread(j) << 1) | spread(k)


@leaf
def _hilbert_encode(i, j, k, bits):
    """Hilbert key of (i, j, k) on the curve of `bits` bits an axis."""
    for level in range(bits - 1, 0, -1):
        q = 1 << level
        p = q - 1
        if i & q:
            i ^= p
        if j & q:
            i ^= p
        else:
            t = (i ^ j) & p
            i ^= t
            j ^= t
        if k & q:
            i ^= p
        else:
            t = (i ^ k) & p
            i ^= t
            k ^= t
    j ^= i
    k ^= j
    t = 0
    for level in range(bits - 1, 0, -1):
        q = 1 << level
        if k & q:
            t ^= q - 1
    return z_encode(i ^ t, j ^ t, k ^ t)


@leaf
def _hilbert_decode(key, bits):
    """Voxel (i, j, k) of a Hilbert key on the curve of `bits` bits an axis."""
    i = compact(key >> 2)
    j = compact(key >> 1)
    k = compact(key)
    t = k >> 1
    k ^= j
    j ^= i
    i ^= t
    for level in range(1, bits):
        q = 1 << level
        p = q - 1
        if k & q:
            i ^= p
        else:
            t = (i ^ k) & p
            i ^= t
            k ^= t
        if j & q:
            i ^= p
        else:
            t = (i ^ j) & p
            i ^= t
            j ^= t
        if i & q:
            i ^= p
    return i, j, k


@leaf
def key_of(i, j, k, bits, curve):
    """Key of (i, j, k) on the curve of that code."""
    if curve == Z_ORDER:
        return z_encode(i, j, k)
    if curve == HILBERT:
        return _hilbert_encode(i, j, k, bits)
    return (i << (2 * bits)) | (j << bits) | k


@leaf
def voxel_of(key, bits, curve):
    """Voxel (i, j, k) of a key on the curve of that code."""
    if curve == Z_ORDER:
        return compact(key >> 2), compact(key >> 1), compact(key)
    if curve == HILBERT:
        return _hilbert_decode(key, bits)
    mask = (1 << bits) - 1
    return (key >> (2 * bits)) & mask, (key >> bits) & mask, key & mask


@entry(INTS2, INT, INT, INTS)
def encode_kernel(ijk, bits, curve, out):
    """Keys of voxels. ijk (N, 3) int64, inside the grid; out (N,) int64."""
    for n in range(ijk.shape[0]):
        out[n] = key_of(ijk[n, 0], ijk[n, 1], ijk[n, 2], bits, curve)


@entry(INTS, INT, INT, INTS2)
def decode_kernel(keys, bits, curve, out):
    """Voxels of keys. keys (N,) int64, inside the curve; out (N, 3) int64."""
    for n in range(keys.shape[0]):
        i, j, k = voxel_of(keys[n], bits, curve)
        out[n, 0] = i
        out[n, 1] = j
        out[n, 2] = k


def encode(ijk: NDArray[np.int64], bits: int, curve: int) -> NDArray[np.int64]:
    """Keys (N,) of voxels (N, 3), each coordinate in [0, 2^bits)."""
    voxels = np.ascontiguousarray(ijk, dtype=np.int64)
    out = np.empty(len(voxels), dtype=np.int64)
    encode_kernel(voxels, bits, curve, out)
    return out


def decode(keys: NDArray[np.int64], bits: int, curve: int) -> NDArray[np.int64]:
    """Voxels (N, 3) of keys (N,), each key in [0, 8^bits)."""
    values = np.ascontiguousarray(keys, dtype=np.int64)
    out = np.empty((len(values), 3), dtype=np.int64)
    decode_kernel(values, bits, curve, out)
    return out

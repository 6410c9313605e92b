"""The three curves: compared with bitwise definitions in plain Python, and their properties."""

from collections.abc import Callable
from itertools import product

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hapticdb.kernels.curves import HILBERT, LEXICOGRAPHIC, Z_ORDER, decode, encode
from naive import Voxel

JIT = not numba.config.DISABLE_JIT
few = settings(max_examples=300 if JIT else 60, deadline=None)
CURVES = {"lexicographic": LEXICOGRAPHIC, "z": Z_ORDER, "hilbert": HILBERT}
LAST = (1 << 21) - 1

# The Hilbert curve consists of eight copies of itself. For each copy, in the order of the path: its
# octant, the axis from which each of its own axes is taken, and which of its axes run backwards.
COPIES: list[tuple[Voxel, Voxel, Voxel]] = [
    ((0, 0, 0), (1, 2, 0), (0, 0, 0)),
    ((0, 0, 1), (1, 0, 2), (0, 0, 0)),
    ((0, 1, 1), (0, 1, 2), (0, 0, 0)),
    ((0, 1, 0), (2, 1, 0), (1, 0, 1)),
    ((1, 1, 0), (2, 1, 0), (0, 0, 0)),
    ((1, 1, 1), (0, 1, 2), (0, 0, 0)),
    ((1, 0, 1), (1, 0, 2), (1, 1, 0)),
    ((1, 0, 0), (1, 2, 0), (1, 0, 1)),
]


def lexicographic(key: int, bits: int) -> Voxel:
    """Voxel of a lexicographic key: k changes fastest, i slowest."""
    rest, k = divmod(key, 2**bits)
    i, j = divmod(rest, 2**bits)
    return i, j, k


def interleaved(key: int, bits: int) -> Voxel:
    """Voxel of a key whose bits are ... i1 j1 k1 i0 j0 k0."""
    places = range(bits)
    i, j, k = (sum((key >> (3 * n + axis) & 1) << n for n in places) for axis in (2, 1, 0))
    return i, j, k


def hilbert(key: int, bits: int) -> Voxel:
    """Voxel of a key on the path made of eight copies of the path of one bit less."""
    if bits == 0:
        return 0, 0, 0
    half = 1 << (bits - 1)
    octant, source, is_reversed = COPIES[key >> 3 * (bits - 1)]
    inner = hilbert(key & (8 ** (bits - 1) - 1), bits - 1)
    i, j, k = (
        octant[axis] * half + (half - 1 - inner[at] if is_reversed[axis] else inner[at])
        for axis, at in enumerate(source)
    )
    return i, j, k


DEFINITIONS: dict[int, Callable[[int, int], Voxel]] = {
    LEXICOGRAPHIC: lexicographic,
    Z_ORDER: interleaved,
    HILBERT: hilbert,
}
curves = pytest.mark.parametrize("curve", CURVES.values(), ids=CURVES.keys())


def cube(bits: int) -> NDArray[np.int64]:
    """Every voxel (8^bits, 3) in lexicographic order."""
    return np.array(list(product(range(1 << bits), repeat=3)), dtype=np.int64)


@curves
@pytest.mark.parametrize("bits", [1, 2, 3, 4])
def test_encode_small_grids_equal_definition(bits: int, curve: int) -> None:
    path = [DEFINITIONS[curve](key, bits) for key in range(8**bits)]
    assert encode(np.array(path), bits, curve).tolist() == list(range(8**bits))
    assert [tuple(v) for v in decode(np.arange(8**bits), bits, curve).tolist()] == path


@curves
@few
@given(bits=st.integers(1, 21), seed=st.integers(0, 2**32 - 1))
def test_decode_inverts_encode(bits: int, seed: int, curve: int) -> None:
    voxels = np.random.default_rng(seed).integers(0, 1 << bits, (8, 3)).tolist()
    keys = encode(np.array(voxels), bits, curve)
    assert keys.dtype == np.int64
    assert keys.min() >= 0
    assert int(keys.max()) < 8**bits
    assert decode(keys, bits, curve).tolist() == voxels
    assert [list(DEFINITIONS[curve](key, bits)) for key in keys.tolist()] == voxels


@curves
def test_encode_largest_grid_63_bits(curve: int) -> None:
    ends = np.array([0, 2**63 - 1], dtype=np.int64)
    voxels = decode(ends, 21, curve)
    assert ((voxels >= 0) & (voxels <= LAST)).all()
    np.testing.assert_array_equal(encode(voxels, 21, curve), ends)
    assert voxels[0].tolist() == [0, 0, 0]
    # the Hilbert curve ends beside its start, the others at the far corner
    assert voxels[1].tolist() == ([LAST, 0, 0] if curve == HILBERT else [LAST] * 3)


@curves
def test_encode_any_dtype_order_length(curve: int) -> None:
    voxels = cube(3)
    keys = encode(voxels, 3, curve)
    np.testing.assert_array_equal(encode(voxels.astype(np.int32), 3, curve), keys)
    np.testing.assert_array_equal(encode(np.asfortranarray(voxels), 3, curve), keys)
    np.testing.assert_array_equal(encode(voxels[::-2], 3, curve), keys[::-2])
    np.testing.assert_array_equal(decode(keys[::-2], 3, curve), voxels[::-2])
    np.testing.assert_array_equal(decode(keys.astype(np.uint16), 3, curve), voxels)
    assert encode(voxels[:0], 3, curve).shape == (0,)
    assert decode(keys[:0], 3, curve).shape == (0, 3)

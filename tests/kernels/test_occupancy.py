"""Packed occupancies of bricks: nothing is lost, empty bytes take nothing, damage does no harm."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hapticdb.kernels.field.occupancy import MASK_BYTES, pack, unpack

EMPTY = bytes(MASK_BYTES)
"""Mask of a brick without a voxel."""
few = settings(max_examples=50, deadline=None)


def bricks(seed: int) -> NDArray[np.uint8]:
    """Occupancies (9, 64): from full to empty."""
    rng = np.random.default_rng(seed)
    shares = np.array([1.0, 0.9, 0.5, 0.25, 0.1, 0.02, 0.0, 0.02, 0.0])[:, None]
    held = np.where(rng.random((9, 64)) < shares, rng.integers(1, 256, (9, 64)), 0)
    return held.astype(np.uint8)


def pieces(data: NDArray[np.uint8], ends: NDArray[np.int64]) -> list[bytes]:
    return [one.tobytes() for one in np.split(data, ends)[:-1]]


@few
@given(st.integers(0, 2**32 - 1))
def test_pack_occupancy_round_trip(seed: int) -> None:
    held = bricks(seed)
    packed = pieces(*pack(held.reshape(-1)))
    found = unpack(b"".join(one or EMPTY for one in packed), len(held))
    np.testing.assert_array_equal(found, held.reshape(-1))
    assert not found.flags.writeable


@few
@given(st.integers(0, 2**32 - 1))
def test_pack_occupancy_mask_and_bytes(seed: int) -> None:
    """By the definition: bit n of the mask, then the bytes that are not 0."""
    held = bricks(seed)
    for packed, brick in zip(pieces(*pack(held.reshape(-1))), held.tolist(), strict=True):
        mask = sum(1 << n for n, byte in enumerate(brick) if byte)
        rest = bytes(byte for byte in brick if byte)
        assert packed == (mask.to_bytes(MASK_BYTES, "little") + rest if mask else b"")


def test_pack_occupancy_no_bricks() -> None:
    data, ends = pack(np.empty(0, np.uint8))
    assert len(data) == len(ends) == 0
    assert unpack(b"", 0).size == 0


@few
@given(st.integers(0, 2**32 - 1), st.data())
def test_unpack_occupancy_wrong_length(seed: int, draw: st.DataObject) -> None:
    data = pack(bricks(seed)[:6].reshape(-1))[0].tobytes()
    n_kept = draw.draw(st.integers(0, len(data) - 1))
    for wrong in (data[:n_kept], data + b"\0"):
        with pytest.raises(ValueError, match="are not 6 bricks"):
            unpack(wrong, 6)


@few
@given(st.binary(max_size=300), st.integers(0, 5))
def test_unpack_occupancy_arbitrary_bytes(data: bytes, n_bricks: int) -> None:
    try:
        found = unpack(data, n_bricks)
    except ValueError:
        return
    again = pieces(*pack(found))
    assert sum(len(one) or MASK_BYTES for one in again) <= len(data)

"""Packed rows of distances: nothing is lost, little is stored, and damaged bytes do no harm."""

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from bands import steps_of
from hapticdb.kernels.field import lattice
from hapticdb.kernels.field.packing import MOST_ROW_BYTES, pack, unpack

JIT = not numba.config.DISABLE_JIT
few = settings(max_examples=100 if JIT else 8, deadline=None)
Values = NDArray[np.uint8]
seeds = st.integers(0, 2**32 - 1)


def centres() -> NDArray[np.float64]:
    """Centres of a row (1000, 3), from the brick's first one, in the order of the row."""
    axis = np.arange(-1.0, 9.0)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)


def of_planes(seed: int, n: int) -> Values:
    """Rows of the distances to one, two or three planes through the brick."""
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(n):
        normals = rng.normal(size=(rng.integers(1, 4), 3))
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        away = np.abs(centres() @ normals.T - rng.uniform(-2.0, 9.0, len(normals)))
        rows.append(steps_of(away.min(axis=1)))
    return np.array(rows)


def random_rows(seed: int) -> Values:
    """Rows from nothing but noise to nothing but BEYOND."""
    rng = np.random.default_rng(seed)
    noise = rng.integers(0, 256, (6, 1000))
    rare = rng.random((6, 1000)) < np.array([1.0, 0.5, 0.1, 0.01, 0.001, 0.0])[:, None]
    return np.where(rare, noise, lattice.BEYOND).astype(np.uint8)


def check_round_trip(rows: Values) -> None:
    data, ends = pack(rows)
    assert data.dtype == np.uint8
    assert ends.dtype == np.int64
    assert len(data) == (ends[-1] if len(ends) else 0)
    sizes = np.diff(ends, prepend=0)
    assert (sizes > 0).all()
    assert (sizes <= MOST_ROW_BYTES).all()
    np.testing.assert_array_equal(unpack(data, ends), rows)


@few
@given(seeds)
def test_pack_round_trip_noise_and_planes(seed: int) -> None:
    check_round_trip(np.concatenate([random_rows(seed), of_planes(seed, 3)]))


def test_pack_round_trip_each_residual() -> None:
    """A row of 255 but for one value has residuals of that value and its opposite."""
    rows = np.full((256, 1000), lattice.BEYOND, np.uint8)
    rows[np.arange(256), 555] = np.arange(256)
    check_round_trip(rows if JIT else rows[[0, 1, 126, 127, 128, 129, 254, 255]])


def test_pack_largest_row() -> None:
    """Residuals of 128 at every place, and masks that differ from those before."""
    x, y, z = np.indices((10, 10, 10)).reshape(3, -1)
    most = (x + y + z) % 2 * 128 + (x * 64 + y * 16 + z * 4)
    check_round_trip(most.astype(np.uint8)[None])


def test_pack_no_rows() -> None:
    data, ends = pack(np.empty((0, 1000), np.uint8))
    assert (data.shape, ends.shape) == ((0,), (0,))
    assert unpack(data, ends).shape == (0, 1000)


def test_pack_size_of_flat_surfaces() -> None:
    beyond = np.full((1, 1000), lattice.BEYOND, np.uint8)
    assert len(pack(beyond)[0]) <= 4
    assert len(pack(steps_of(np.abs(centres()[:, 1] - 3.3))[None])[0]) <= 30
    assert len(pack(of_planes(1, 20))[0]) < 20 * 600


@pytest.mark.parametrize("at_once", [1, 3])
def test_pack_rows_independent_of_batch(monkeypatch: pytest.MonkeyPatch, at_once: int) -> None:
    rows = np.concatenate([random_rows(1), of_planes(2, 3)])
    whole = pack(rows)
    monkeypatch.setattr("hapticdb.kernels.field.packing.ROWS_AT_ONCE", at_once)
    for a, b in zip(pack(rows), whole, strict=True):
        np.testing.assert_array_equal(a, b)


def test_unpack_wanted_rows_only() -> None:
    rows = of_planes(4, 5)
    data, ends = pack(rows)
    data[ends[1] : ends[2]] = 255  # row 2 is damaged, and not wanted
    wanted = np.array([True, False, False, True, True])
    np.testing.assert_array_equal(unpack(data, ends, wanted)[wanted], rows[wanted])
    with pytest.raises(ValueError, match="row 2 of 5 packed rows of distances is damaged"):
        unpack(data, ends)


def is_read_or_told(data: Values, ends: NDArray[np.int64]) -> None:
    try:
        assert unpack(data, ends).shape == (len(ends), 1000)
    except ValueError as error:
        assert "is damaged" in str(error)  # noqa: PT017 - either outcome is right


@few
@given(seeds)
def test_unpack_changed_bytes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = np.concatenate([of_planes(seed, 2), random_rows(seed)[2:]])
    data, ends = pack(rows)
    places = rng.integers(0, len(data), rng.integers(1, 9))
    data[places] = rng.integers(0, 256, len(places))
    is_read_or_told(data, ends)


@few
@given(st.binary(max_size=3 * MOST_ROW_BYTES), st.lists(st.integers(-(2**62), 2**62), max_size=4))
def test_unpack_arbitrary_bytes(data: bytes, ends: list[int]) -> None:
    blob = np.frombuffer(data, np.uint8)
    near = np.array([end % (len(data) + 3) for end in ends], np.int64)
    for some in (np.array(ends, np.int64), near, np.sort(near)):
        is_read_or_told(blob, some)


@pytest.mark.parametrize("change", ["shorter", "longer", "bits left over"])
def test_unpack_row_of_wrong_length(change: str) -> None:
    data, ends = pack(np.full((1, 1000), lattice.BEYOND, np.uint8))
    if change == "shorter":
        data, ends = data[:-1], ends - 1
    elif change == "longer":
        data, ends = np.append(data, np.uint8(0)), ends + 1
    else:
        data[-1] |= 128
    with pytest.raises(ValueError, match="row 0 of 1"):
        unpack(data, ends)

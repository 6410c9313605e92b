"""Packed geometry returns bit for bit; damaged bytes end in one line, and take no memory."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from hapticdb.mesh.surface_packing import HEADER, pack, unpack

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Geometry = tuple[Floats, Ints | None, NDArray[np.uint8] | None]
SHADES = st.sampled_from([st.just(7), st.sampled_from([0, 255]), st.integers(0, 255)])
FINITE = st.floats(allow_nan=False, allow_infinity=False)
FEW = st.sampled_from([0.0, -0.0, 1.0, 0.001, 5e-324, -1.7e308])


@st.composite
def geometries(draw: st.DrawFn) -> Geometry:
    """Vertices, many of them alike; any triangles of them, or none; colours, or none."""
    n = draw(st.integers(0, 300))
    vertices = draw(arrays(np.float64, (n, 3), elements=st.one_of(FINITE, FEW)))
    faces = None
    if draw(st.booleans()):
        n_faces = draw(st.integers(0, 40)) if n else 0
        faces = draw(arrays(np.int64, (n_faces, 3), elements=st.integers(0, max(n - 1, 0))))
    if draw(st.booleans()):
        return vertices, faces, None
    shape = (n if faces is None else len(faces), 4)
    return vertices, faces, draw(arrays(np.uint8, shape, elements=draw(SHADES)))


@settings(max_examples=200, deadline=None)
@given(geometries(), st.sampled_from([0.0, 1e-5, 5e-324]))
def test_pack_geometry_round_trip(geometry: Geometry, chord: float) -> None:
    """The chord error is last, so that surfaces without one are as before."""
    vertices, faces, colours = geometry
    packed = pack(vertices, faces, colours, chord)
    found, corners, painted, told = unpack(packed)
    assert told == chord
    without = pack(vertices, faces, colours)
    assert packed[: len(without)] == without
    assert len(packed) - len(without) == (8 if chord else 0)
    np.testing.assert_array_equal(painted, colours)
    assert found.tobytes() == np.ascontiguousarray(vertices).tobytes()
    assert found.shape == vertices.shape
    np.testing.assert_array_equal(corners, faces)


def ball(n: int) -> tuple[Floats, Ints]:
    """Points of a sphere in n rings of n, and the triangles between them."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, n), np.linspace(0, np.pi, n), indexing="ij")
    points = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], axis=-1)
    first = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1)
    corners = first[:, None] + np.array([0, 1, n, 1, n + 1, n])
    return points.reshape(-1, 3), corners.reshape(-1, 3)


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_unpack_geometry_damaged_bytes(data: st.DataObject) -> None:
    """Never a position that is no number, nor a triangle of a vertex that is not there."""
    vertices, faces = ball(9)
    colours = np.arange(4 * len(faces), dtype=np.uint8).reshape(-1, 4) // 64
    is_mesh = data.draw(st.booleans())
    chord = data.draw(st.sampled_from([0.0, 1e-5]))
    painted = colours if is_mesh else None
    whole = bytearray(pack(vertices, faces if is_mesh else None, painted, chord))
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(whole) - 1))
        whole[at] ^= data.draw(st.integers(1, 255))
    damaged = bytes(whole[: data.draw(st.integers(0, len(whole)))])
    try:
        found, corners, painted, chord = unpack(damaged)
    except ValueError:
        return
    assert 0.0 <= chord < np.inf
    assert np.isfinite(found).all()
    assert corners is None or not corners.size or 0 <= corners.min() <= corners.max() < len(found)
    assert painted is None or len(painted) == len(found if corners is None else corners)


@pytest.mark.parametrize("n_faces", [0, 1 << 40, (1 << 64) - 1])
@pytest.mark.parametrize("n_vertices", [1 << 20, 1 << 40, (1 << 64) - 1])
def test_unpack_geometry_header_allocates_nothing(n_vertices: int, n_faces: int) -> None:
    packed = pack(*ball(9))
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match="a surface"):
            unpack(HEADER.pack(n_vertices, n_faces) + packed[HEADER.size :])
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()

"""Binary format of a part's surface in a database: geometry, colours, chord error; lossless.

Byte planes (bytes of equal weight side by side) of the positions, and of the differences between
the corners of successive triangles, compressed by zlib. Measured on all shapes of three assemblies
of 44,000 to 180,000 triangles: 2.7, 3.5 and 4.8 bytes a triangle. Differences of positions would
take 0.3 more, lzma 0.3 to 0.5 less and ten times as long; the distinct values of each axis, sorted,
0.8 to 0.9 less and twice the code. Unpacking takes a quarter of a second for a million triangles.

Colours follow in a zlib stream of their own: a palette, and a palette index for each triangle. The
chord error comes last. Both are optional.
"""

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

Vertices = NDArray[np.float64]
Faces = NDArray[np.int64]
Colours = NDArray[np.uint8]

HEADER = struct.Struct("<QQ")
"""Numbers of vertices and of triangles; `CLOUD` instead of triangles for a point cloud."""
COUNT = struct.Struct("<Q")
"""Number of colours in the palette, before its zlib stream."""
CHORD = struct.Struct("<d")
"""Chord error, metres. A block of colours is longer, so a rest of this length is a chord error."""
CLOUD = (1 << 64) - 1
LEVEL = 6
"""zlib level. Larger: hardly smaller, and much slower to pack."""
MOST_RATIO = 1032
"""Greatest expansion of a zlib stream (https://zlib.net/zlib_tech.html)."""


def pack(
    vertices: Vertices, faces: Faces | None, colours: Colours | None = None, chord: float = 0.0
) -> bytes:
    """Pack vertices (V, 3), and faces (F, 3) with indices 0 .. V - 1, None for a point cloud.

    colours : (F, 4), or (V, 4) of a point cloud; chord : chord error, metres, or 0.
    """
    n_faces = CLOUD if faces is None else len(faces)
    planes = [_planes(np.ascontiguousarray(vertices, dtype="<f8").view("<u8"), 8)]
    if faces is not None:
        planes.append(_planes(_differences(faces), _width(len(vertices))))
    packed = zlib.compress(b"".join(planes), LEVEL)
    painted = b"" if colours is None else _packed_colours(colours)
    last = CHORD.pack(chord) if chord else b""
    return HEADER.pack(len(vertices), n_faces) + packed + painted + last


def unpack(data: bytes) -> tuple[Vertices, Faces | None, Colours | None, float]:
    """Inverse of `pack`, read-only arrays; ValueError for other bytes."""
    if len(data) < HEADER.size:
        raise ValueError("a surface that is cut off")
    n_vertices, n_faces = HEADER.unpack_from(data)
    width = _width(n_vertices)
    split = 24 * n_vertices
    size = split + (0 if n_faces == CLOUD else 3 * width * n_faces)
    planes, rest = _inflated(data[HEADER.size :], size)
    n_colours = n_vertices if n_faces == CLOUD else n_faces
    colours = None
    if len(rest) > CHORD.size:
        colours, rest = _unpacked_colours(rest, n_colours)
    chord = _unpacked_chord(rest)
    vertices = _numbers(planes[:split], 8).view(np.float64)
    vertices.flags.writeable = False
    if not np.isfinite(vertices).all():
        raise ValueError("a surface with a position that is no number")
    if n_faces == CLOUD:
        return vertices, None, colours, chord
    faces = _sums(_numbers(planes[split:], width))
    faces.flags.writeable = False
    if faces.size and not (faces.min() >= 0 and faces.max() < n_vertices):
        raise ValueError("a surface with a triangle of a vertex that is not there")
    return vertices, faces, colours, chord


def _unpacked_chord(data: bytes) -> float:
    """Chord error, metres, of the last bytes; 0 for none."""
    if not data:
        return 0.0
    chord = float(CHORD.unpack(data)[0]) if len(data) == CHORD.size else 0.0
    if not 0.0 < chord < np.inf:
        raise ValueError("a surface of another length than it tells")
    return chord


def _inflated(data: bytes, size: int) -> tuple[bytes, bytes]:
    """Content of a zlib stream, `size` bytes, and the bytes after it; ValueError."""
    if size > MOST_RATIO * len(data):
        raise ValueError("a surface that tells of more than it holds")
    unpacking = zlib.decompressobj()
    try:
        found = unpacking.decompress(data, size)
    except zlib.error as error:
        raise ValueError(f"a surface that cannot be unpacked: {error}") from None
    if not unpacking.eof or len(found) != size:
        raise ValueError("a surface of another length than it tells")
    return found, unpacking.unused_data


def _packed_colours(colours: Colours) -> bytes:
    """Palette of colours (n, 4) and indices into it; all colours if over half are distinct."""
    whole = np.ascontiguousarray(colours).view("<u4").reshape(-1)
    palette, number = np.unique(whole, return_inverse=True)
    if 2 * len(palette) > len(whole):
        palette = whole
    content = palette.astype("<u4").view(np.uint8).reshape(-1, 4).T.tobytes()
    if len(palette) != len(whole):
        content += number.astype(_number_type(len(palette))).tobytes()
    return COUNT.pack(len(palette)) + zlib.compress(content, LEVEL)


def _unpacked_colours(data: bytes, n: int) -> tuple[Colours, bytes]:
    """Inverse of `_packed_colours` at the start of `data`, and the bytes after it."""
    (n_palette,) = COUNT.unpack_from(data)
    if n_palette > n:
        raise ValueError("a surface with more colours than triangles")
    kind = np.dtype(_number_type(n_palette))
    size = 4 * n_palette + (kind.itemsize * n if n_palette != n else 0)
    content, rest = _inflated(data[COUNT.size :], size)
    planes = np.frombuffer(content, np.uint8, 4 * n_palette).reshape(4, n_palette)
    colours = np.ascontiguousarray(planes.T)
    if n_palette != n:
        number = np.frombuffer(content, kind, n, 4 * n_palette)
        if number.size and number.max() >= n_palette:
            raise ValueError("a surface with a colour that is not there")
        colours = colours[number]
    colours.flags.writeable = False
    return colours, rest


def _number_type(n_palette: int) -> str:
    """Integer type of a palette index."""
    return "u1" if n_palette <= 1 << 8 else "<u2" if n_palette <= 1 << 16 else "<u4"


def _width(n_vertices: int) -> int:
    """Bytes of a difference of two vertex indices, with its sign."""
    return n_vertices.bit_length() // 8 + 1


def _differences(values: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Differences of successive rows, modulo 2^64, zigzag-encoded: sign in the lowest bit."""
    steps = np.diff(values, axis=0, prepend=np.zeros_like(values[:1]))
    return ((steps << 1) ^ (steps >> 63)).view(np.uint64)


def _sums(steps: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Inverse of `_differences`."""
    signed = ((steps >> np.uint64(1)) ^ -(steps & np.uint64(1))).view(np.int64)
    return np.cumsum(signed, axis=0)


def _planes(values: NDArray[np.uint64], width: int) -> bytes:
    """Byte planes 0 .. width - 1 of each column of values (n, 3), lowest byte first."""
    columns = np.ascontiguousarray(values.T, dtype="<u8").view(np.uint8).reshape(3, -1, 8)
    return np.ascontiguousarray(columns[:, :, :width].swapaxes(1, 2)).tobytes()


def _numbers(planes: bytes, width: int) -> NDArray[np.uint64]:
    """Inverse of `_planes`."""
    columns = np.frombuffer(planes, np.uint8).reshape(3, width, -1)
    values = np.zeros((columns.shape[2], 3, 8), np.uint8)
    values[:, :, :width] = columns.transpose(2, 0, 1)
    return values.view("<u8").reshape(-1, 3).astype(np.uint64, copy=False)

"""Lossless packing of a structured array's rows; compact if the columns change smoothly.

Each column is packed alone, its bits read as integers: second difference along the rows (modulo
2^bits), sign moved to the lowest bit, bytes of equal weight side by side, deflated at level 1.
Measured on 60 s of hand motion at 1 kHz, bytes a row: 160, against 179 with XOR to the previous
row, 168 with the first difference and 218 without a difference. Choosing the best of eleven forms
for each column would save 3 more.
"""

import zlib
from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

LEVEL = 1
"""Compression level of zlib. Larger: smaller files, slower packing."""


def pack(rows: NDArray[np.void]) -> bytes:
    """Pack rows (n,), n > 0: the packed size of each column as uint32, then the packed columns."""
    columns = [_packed(rows[name]) for name in _names(rows.dtype)]
    sizes = np.array([len(column) for column in columns], dtype="<u4")
    return sizes.tobytes() + b"".join(columns)


def unpack(
    content: bytes, n_rows: int, layout: np.dtype[np.void], names: Sequence[str]
) -> Iterator[NDArray[np.generic]]:
    """Unpack the columns `names` from the bytes of `pack`: arrays (n_rows, ...), in that order.

    Raises `ValueError` if the bytes are not those of `n_rows` rows.
    """
    every = _names(layout)
    sizes = np.frombuffer(content[: 4 * len(every)], dtype="<u4")
    ends = 4 * len(every) + np.concatenate([[0], np.cumsum(sizes, dtype=np.int64)])
    if len(sizes) != len(every) or ends[-1] != len(content):
        raise ValueError("the columns do not fill their chunk")
    places = dict(zip(every, pairwise(ends.tolist()), strict=True))
    for name in names:
        start, end = places[name]
        yield _unpacked(content[start:end], n_rows, layout[name])


def _names(layout: np.dtype[np.void]) -> tuple[str, ...]:
    return layout.names or ()


def _packed(column: NDArray[np.generic]) -> bytes:
    width = column.dtype.itemsize
    bits = np.ascontiguousarray(column).reshape(len(column), -1).view(f"<u{width}")
    for _ in range(2):
        bits = np.diff(bits, axis=0, prepend=np.zeros_like(bits[:1]))
    signs = -(bits >> (8 * width - 1))
    smooth: NDArray[np.generic] = (bits << 1) ^ signs
    return zlib.compress(smooth.view(np.uint8).reshape(len(column), -1).T.tobytes(), LEVEL)


def _unpacked(content: bytes, n_rows: int, layout: np.dtype[np.generic]) -> NDArray[np.generic]:
    n_bytes = n_rows * layout.itemsize
    stream = zlib.decompressobj()
    try:  # bounded, because a damaged stream could unpack to any size
        plain = stream.decompress(content, n_bytes + 1)
    except zlib.error as error:
        raise ValueError(str(error)) from error
    if len(plain) != n_bytes:
        raise ValueError(f"a column of {len(plain)} bytes or more instead of {n_bytes}")
    width = layout.base.itemsize
    planes = np.frombuffer(plain, dtype=np.uint8).reshape(-1, n_rows)
    smooth = np.ascontiguousarray(planes.T).view(f"<u{width}")
    bits = (smooth >> 1) ^ -(smooth & 1)
    for _ in range(2):
        bits = np.cumsum(bits, axis=0, dtype=bits.dtype)
    return bits.view(layout.base).reshape(n_rows, *layout.shape)

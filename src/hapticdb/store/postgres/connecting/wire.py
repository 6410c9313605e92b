"""Arrays in PostgreSQL's binary format, packed and read by NumPy without a Python loop.

A header (dimensions, flags, element type, length, lower bound), then the length and the value of
each element, all big-endian (array_send in arrayfuncs.c; for COPY the manual, "Binary Format").
"""

import struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.store.base import BRICK_BYTES, Band, LocatedShell, Rows

BYTEA, INT8, TEXT, FLOAT8 = 17, 20, 25, 701
INT8_ARRAY, FLOAT8_ARRAY = 1016, 1022
HEADER_BYTES = 20
_INT8S = np.dtype([("length", ">i4"), ("value", ">i8")])
_FLOAT8S = np.dtype([("length", ">i4"), ("value", ">f8")])
_STRIDE = _INT8S.itemsize

COPY_HEADER = b"PGCOPY\n\xff\r\n\0" + bytes(8)
COPY_TRAILER = b"\xff\xff"


class Parameter(NamedTuple):
    """A parameter of a statement: the OID of its type, and its binary form."""

    oid: int
    value: bytes


def int8(value: int) -> Parameter:
    """One bigint."""
    return Parameter(INT8, struct.pack(">q", value))


def float8(value: float) -> Parameter:
    """One double precision."""
    return Parameter(FLOAT8, struct.pack(">d", value))


def text(value: str) -> Parameter:
    """One text."""
    return Parameter(TEXT, value.encode())


def int8s(values: NDArray[np.int64]) -> Parameter:
    """Pack bigint[] from (n,): 120 us less than a list of 300 through the driver's own dumper."""
    return _array(values, INT8_ARRAY, INT8, _INT8S)


def _array(values: NDArray[Any], oid: int, of: int, kind: np.dtype[np.void]) -> Parameter:
    packed = np.empty(len(values), kind)
    packed["length"] = 8
    packed["value"] = values
    return Parameter(oid, struct.pack(">iiiii", 1, 0, of, len(values), 1) + packed.tobytes())


def shell(frame: LocatedShell) -> list[Parameter]:
    """Pack a located shell: keys, then six arrays of points and normals, centre, stiffness."""
    count = len(frame.addresses)
    return [
        int8s(frame.addresses),
        *(
            _array(frame.placed[:count, column], FLOAT8_ARRAY, FLOAT8, _FLOAT8S)
            for column in range(6)
        ),
        *(float8(float(x)) for x in (*frame.placed[count, :3], frame.stiffness)),
    ]


def read_int8(value: bytes) -> int:
    """Read one bigint."""
    return int.from_bytes(value, "big", signed=True)


def read_int8s(value: bytes | None) -> NDArray[np.int64]:
    """Read a bigint[] without NULLs; NULL itself gives an empty array."""
    if value is None or len(value) < HEADER_BYTES:
        return np.empty(0, np.int64)
    count = (len(value) - HEADER_BYTES) // _STRIDE
    return np.ndarray((count,), ">i8", value, HEADER_BYTES + 4, (_STRIDE,)).astype(np.int64)


def read_float8s(value: bytes) -> NDArray[np.float64]:
    """Read a double precision[] without NULLs."""
    count = (len(value) - HEADER_BYTES) // _STRIDE
    return np.ndarray((count,), ">f8", value, HEADER_BYTES + 4, (_STRIDE,)).astype(np.float64)


def copy_rows(rows: Rows, object_id: int) -> bytes:
    """Rows of an object, of `band` if they have distances, for COPY without header and trailer."""
    if rows.distances is not None:
        return _copy_band(rows.keys, rows.distances, object_id)
    has_bits = rows.occupancy.size > 0
    bits = (("bits_length", ">i4"), ("bits", f"V{BRICK_BYTES}")) if has_bits else ()
    packed = _begun(rows.keys, object_id, *bits)
    if has_bits:
        packed["bits_length"] = BRICK_BYTES
        packed["bits"] = np.ascontiguousarray(rows.occupancy).view(f"V{BRICK_BYTES}").reshape(-1)
    return packed.tobytes()


def _begun(keys: NDArray[np.int64], object_id: int, *last: tuple[str, str]) -> NDArray[np.void]:
    """Rows of COPY with key and id, but without the fields that follow."""
    first = [("fields", ">i2"), ("z_length", ">i4"), ("z_val", ">i8")]
    packed = np.empty(len(keys), [*first, ("id_length", ">i4"), ("id", ">i8"), *last])
    packed["fields"] = 2 + bool(last)
    packed["z_length"] = packed["id_length"] = 8
    packed["z_val"] = keys
    packed["id"] = object_id
    return packed


def _copy_band(keys: NDArray[np.int64], distances: Band, object_id: int) -> bytes:
    """Rows of the table `band`: what stands before each row's bytes, then these bytes."""
    lengths = distances.lengths
    heads = _begun(keys, object_id, ("distances_length", ">i4"))
    heads["distances_length"] = lengths
    size = heads.itemsize
    starts = distances.ends - lengths + size * np.arange(len(keys))
    is_data = np.ones(len(distances.data) + size * len(keys), dtype=np.bool_)
    is_data[starts[:, None] + np.arange(size)] = False
    packed = np.empty(len(is_data), np.uint8)
    packed[is_data] = distances.data
    packed[~is_data] = heads.view(np.uint8)
    return packed.tobytes()

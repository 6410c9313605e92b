"""From points to keys: place a shell in the grid and compute the row keys under its points."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import (
    FLOATS2,
    INTS,
    INTS2,
    READ_FLOATS,
    READ_FLOATS2,
    entry,
    inlined,
    leaf,
    maker,
    record_of,
)
from hapticdb.kernels.curves import Z_ORDER, compact, key_of, voxel_of, z_encode
from hapticdb.kernels.query.sorting import sorting_order
from hapticdb.kernels.records.rows import GRID
from hapticdb.kernels.resident.cells import spread_key
from hapticdb.kernels.rigid import is_rigid, moved, transform_of, turned

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Located(NamedTuple):
    """A shell placed in the grid.

    placed (N + 1, 6) : each point in metres and its normal, world frame, last the centre.
    addresses (2, N) : each point's address and slot, both -1 outside the grid. The address is the
    key
        on voxel rows, the brick's key << 9 | bit number on brick rows; the slot is the row key's
        place in `keys`.
    keys (U,) : distinct row keys, ascending.
    """

    placed: Floats
    addresses: Ints
    keys: Ints


LARGEST = 0x7FFFFFFFFFFFFFFF
"""Largest int64."""


@leaf
def center_of(x, origin, size):
    """Centre, on one axis, of the voxel around coordinate x, metres."""
    return origin + size * (np.floor((x - origin) / size) + 0.5)


@inlined
def place_shell(points, normals, center, transform, placed):
    """Transform points and normals, last the centre, into placed (N + 1, 6), world frame."""
    total = points.shape[0]
    for n in range(total):
        x, y, z = moved(transform, points[n, 0], points[n, 1], points[n, 2])
        placed[n, 0], placed[n, 1], placed[n, 2] = x, y, z
        x, y, z = turned(transform, normals[n, 0], normals[n, 1], normals[n, 2])
        placed[n, 3], placed[n, 4], placed[n, 5] = x, y, z
    x, y, z = moved(transform, center[0], center[1], center[2])
    placed[total, 0], placed[total, 1], placed[total, 2] = x, y, z
    placed[total, 3] = placed[total, 4] = placed[total, 5] = 0.0


@inlined
def address_of(placed, n, place):
    """Row key and address of point n of a shell (see `Located`); both -1 outside the grid."""
    x = np.floor((placed[n, 0] - place.x) / place.voxel)
    y = np.floor((placed[n, 1] - place.y) / place.voxel)
    z = np.floor((placed[n, 2] - place.z) / place.voxel)
    # tested as floats: NaN and coordinates beyond int64 fail here
    if not (0.0 <= x < place.side and 0.0 <= y < place.side and 0.0 <= z < place.side):
        return np.int64(-1), np.int64(-1)
    i, j, k = np.int64(x), np.int64(y), np.int64(z)
    key = key_of(i, j, k, place.bits, place.curve)
    row_key = key >> place.shift
    if place.shift == 0 or place.curve == Z_ORDER:
        return row_key, key  # a Z-order key ends in the bit number
    return row_key, (row_key << 9) | z_encode(i & 7, j & 7, k & 7)


@maker
def new_table(total):
    """Empty table for `number_of_key`, at most half full with `total` keys."""
    capacity = 16
    while capacity < 2 * total:
        capacity *= 2
    return np.full(capacity, -1, dtype=np.int32)


@inlined
def number_of_key(table, found, count, key):
    """Index of a row key in `found` (N,); a new key is appended at index `count`.

    table (capacity,) int32: open-addressing hash set of these indices, -1 if free.
    """
    at = spread_key(key, table.shape[0])  # at most half of the table is full
    while table[at] >= 0 and found[table[at]] != key:
        at = (at + 1) & (table.shape[0] - 1)
    if table[at] < 0:
        table[at] = count
        found[count] = key
    return table[at]


@maker
def sort_keys(found, count, addresses, keys):
    """Sort the first `count` of `found` into `keys`; renumber the points' slots in `addresses`."""
    order = sorting_order(found[:count])
    rank = np.empty(count, dtype=np.int32)
    for n in range(count):
        at = order[n]
        keys[n] = found[at]
        # inverse permutation: the points are renumbered in one pass
        rank[at] = n
    for n in range(addresses.shape[1]):
        if addresses[1, n] >= 0:
            addresses[1, n] = rank[addresses[1, n]]


@entry(
    READ_FLOATS2, READ_FLOATS2, READ_FLOATS, FLOATS2, record_of(GRID), FLOATS2, INTS2, INTS
)  # fmt: skip
def locate(points, normals, center, pose, grid, placed, addresses, keys):
    """Place a shell in the grid and collect the distinct row keys under its points.

    points, normals (N, 3) and center (3,), tool frame; pose (4, 4), world_from_tool. Fills the
    arrays of `Located`; keys has room for N, of which U are set. Returns U, or -1 if the pose is
    not rigid.
    """
    if not is_rigid(pose):
        return -1
    place_shell(points, normals, center, transform_of(pose), placed)
    place, total = grid[()], points.shape[0]
    table = new_table(total)
    found = np.empty(total, dtype=np.int64)
    count = 0
    last_key, last_number = -1, -1  # points next to each other in the shell often share a row
    for n in range(total):
        row_key, addresses[0, n] = address_of(placed, n, place)
        if row_key < 0:
            addresses[1, n] = -1
            continue
        if row_key != last_key:
            last_key = row_key
            last_number = number_of_key(table, found, count, row_key)
            count = max(count, last_number + 1)
        addresses[1, n] = last_number
    sort_keys(found, count, addresses, keys)
    return count


@leaf
def voxel_at(address, bits, curve, shift):
    """Voxel (i, j, k) of an address; see `Located`."""
    if shift == 0:
        return voxel_of(address, bits, curve)
    i, j, k = voxel_of(address >> 9, max(bits - 3, 0), curve)
    return (
        (i << 3) | compact((address & 511) >> 2),
        (j << 3) | compact((address & 511) >> 1),
        (k << 3) | compact(address & 511),
    )


@entry(INTS2, INTS, record_of(GRID))
def spans_of_keys(addresses, keys, grid):
    """Lowest and highest voxel key (2, U) of a shell's points under each row key.

    `addresses`, `keys` of `Located`.
    """
    bits, curve, shift = grid[()].bits, grid[()].curve, grid[()].shift
    spans = np.empty((2, keys.shape[0]), dtype=np.int64)
    for at in range(keys.shape[0]):
        spans[0, at] = LARGEST
        spans[1, at] = -1
    for n in range(addresses.shape[1]):
        at = addresses[1, n]
        if at < 0:
            continue
        key = addresses[0, n]
        # an address orders voxels by Z-order in the brick: other curves need the voxel's own key
        if shift > 0 and curve != Z_ORDER:
            i, j, k = voxel_at(key, bits, curve, shift)
            key = key_of(i, j, k, bits, curve)
        spans[0, at] = min(spans[0, at], key)
        spans[1, at] = max(spans[1, at], key)
    return spans

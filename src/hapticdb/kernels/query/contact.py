"""One frame in arrays: locate the shell's points in the grid, refine rows to hits, sum the wrench.

Every sum runs in the order of the shell's points and every product is written out, so that each
strategy, layout, curve and engine gives the same wrench bit for bit (numba contracts no
multiplication and addition without fastmath, which this package never sets).
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import (
    FLOAT,
    FLOATS,
    FLOATS2,
    INT,
    INTS,
    INTS2,
    NONE,
    READ_BYTES,
    READ_FLOATS,
    READ_FLOATS2,
    entry,
    inlined,
    leaf,
)
from hapticdb.kernels.curves import Z_ORDER, compact, key_of, voxel_of, z_encode
from hapticdb.kernels.law import (
    NOTHING_NEAR,
    TANGENT_PLANE,
    accumulate,
    average_into,
    depth_below_plane,
    reach,
    respond,
    sample_row,
)
from hapticdb.kernels.query.sorting import insert_distinct, sorting_order
from hapticdb.kernels.rigid import is_rigid, moved, transform_of, turned

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


Refined = tuple[Floats, Ints, Floats, Ints, Ints, Floats]
"""What `refine` returns.

wrench (6,): N and N m about the centre, world frame; hits (H,): indices of the shell's points
inside a voxel, ascending; depths (H,): depth of each hit in metres, 0 where the law feels nothing;
ids (I,): objects that the hits are in, ascending; apart (A,): points that the law feels although
they are no hits, ascending; apart_depths (A,): their depths in metres, above 0.
"""
NO_POINTS = np.empty(0, dtype=np.int64)
NO_DEPTHS = np.empty(0)


class Located(NamedTuple):
    """A shell placed in the grid, as `locate` returns it."""

    placed: Floats
    asked: Ints
    keys: Ints


LARGEST = 0x7FFFFFFFFFFFFFFF
"""Largest int64."""


@leaf
def center_of(x, origin, size):
    """Centre, on one axis, of the voxel that holds coordinate x, metres."""
    return origin + size * (np.floor((x - origin) / size) + 0.5)


@inlined
def place_shell(points, normals, center, transform, placed):
    """Write points and normals of a placed shell, last its centre, to placed (N + 1, 6), world."""
    total = points.shape[0]
    for n in range(total):
        x, y, z = moved(transform, points[n, 0], points[n, 1], points[n, 2])
        placed[n, 0] = x
        placed[n, 1] = y
        placed[n, 2] = z
        x, y, z = turned(transform, normals[n, 0], normals[n, 1], normals[n, 2])
        placed[n, 3] = x
        placed[n, 4] = y
        placed[n, 5] = z
    x, y, z = moved(transform, center[0], center[1], center[2])
    placed[total, 0] = x
    placed[total, 1] = y
    placed[total, 2] = z
    placed[total, 3] = placed[total, 4] = placed[total, 5] = 0.0


@inlined
def number_of_key(table, found, count, key):
    """Number of a row key: its place in found (N,). A new key is entered there as number `count`.

    table (capacity,) int32: an open-addressing set of those numbers, -1 where free.
    """
    # Fibonacci hashing (Knuth, volume 3, section 6.4) into a table at most half full
    at = ((key * 0x9E3779B97F4A7C1) >> 20) & (table.shape[0] - 1)
    while table[at] >= 0 and found[table[at]] != key:
        at = (at + 1) & (table.shape[0] - 1)
    if table[at] < 0:
        table[at] = count
        found[count] = key
    return table[at]


@inlined
def sort_keys(found, count, asked, keys):
    """Write the first `count` of the keys found in ascending order; renumber the points' slots."""
    order = sorting_order(found[:count])
    rank = np.empty(count, dtype=np.int32)
    for n in range(count):
        at = order[n]
        keys[n] = found[at]
        rank[at] = n
    for n in range(asked.shape[1]):
        if asked[1, n] >= 0:
            asked[1, n] = rank[asked[1, n]]


@entry(
    READ_FLOATS2,
    READ_FLOATS2,
    READ_FLOATS,
    FLOATS2,
    FLOATS,
    FLOAT,
    INT,
    INT,
    INT,
    FLOATS2,
    INTS2,
    INTS,
)
def locate_kernel(
    points, normals, center, pose, origin, size, bits, curve, shift, placed, asked, keys
):
    """`locate` into placed, asked and keys (N,); returns U, or -1 when the pose is not rigid."""
    if not is_rigid(pose):
        return -1
    place_shell(points, normals, center, transform_of(pose), placed)
    total = points.shape[0]
    ox, oy, oz = origin[0], origin[1], origin[2]
    side = float(1 << bits)
    capacity = 16
    while capacity < 2 * total:
        capacity *= 2
    table = np.full(capacity, -1, dtype=np.int32)
    found = np.empty(total, dtype=np.int64)
    count = 0
    last_key, last_number = -1, -1  # points next to each other in the shell often share a row
    for n in range(total):
        x = np.floor((placed[n, 0] - ox) / size)
        y = np.floor((placed[n, 1] - oy) / size)
        z = np.floor((placed[n, 2] - oz) / size)
        if not (0.0 <= x < side and 0.0 <= y < side and 0.0 <= z < side):
            asked[0, n] = -1
            asked[1, n] = -1
            continue
        i, j, k = np.int64(x), np.int64(y), np.int64(z)
        key = key_of(i, j, k, bits, curve)
        row_key = key >> shift
        if shift == 0 or curve == Z_ORDER:
            asked[0, n] = key  # a Z-order key ends in the bit number
        else:
            asked[0, n] = (row_key << 9) | z_encode(i & 7, j & 7, k & 7)
        if row_key != last_key:
            last_key = row_key
            last_number = number_of_key(table, found, count, row_key)
            count = max(count, last_number + 1)
        asked[1, n] = last_number
    sort_keys(found, count, asked, keys)
    return count


def locate(
    points: Floats,
    normals: Floats,
    center: Floats,
    pose: Floats,
    origin: Floats,
    size: float,
    bits: int,
    curve: int,
    shift: int,
) -> Located:
    """Place a shell in the grid and collect the distinct row keys that it asks for.

    points, normals (N, 3) and center (3,), tool frame; pose (4, 4), world_from_tool; origin (3,)
    and size in metres; shift 0 for voxel rows, 9 for brick rows.

    Returns
    -------
    placed : (N + 1, 6) float64
        Each point in metres and its normal, world frame; last the centre.
    asked : (2, N) int64
        Each point's address and slot. The address is the key on voxel rows, the brick's key << 9 |
        bit number on brick rows; the slot its row key's place in `keys`; both -1 outside the grid.
    keys : (U,) int64
        Distinct row keys, ascending.

    Raises
    ------
    ValueError
        When the pose is not rigid.

    Notes
    -----
    Few arrays cross into the kernel, and it writes into arrays made here: an array that a kernel
    returns costs 0.6 us, twice as much as an array that it is given.
    """
    total = points.shape[0]
    placed = np.empty((total + 1, 6))
    asked = np.empty((2, total), dtype=np.int64)
    keys = np.empty(total, dtype=np.int64)
    count = locate_kernel(
        points, normals, center, pose, origin, size, bits, curve, shift, placed, asked, keys
    )
    if count < 0:
        raise ValueError("a pose that is no rigid transform")
    return Located(placed, asked, keys[:count])


@leaf
def voxel_at(address, bits, curve, shift):
    """Voxel (i, j, k) of an address as `locate` gives it."""
    if shift == 0:
        return voxel_of(address, bits, curve)
    i, j, k = voxel_of(address >> 9, max(bits - 3, 0), curve)
    return (
        (i << 3) | compact((address & 511) >> 2),
        (j << 3) | compact((address & 511) >> 1),
        (k << 3) | compact(address & 511),
    )


@entry(INTS2, INTS, INT, INT, INT)
def spans_of_keys(asked, keys, bits, curve, shift):
    """Lowest and highest voxel key (2, U) that a shell asks for under each row key.

    asked, keys as `locate` returns them.
    """
    spans = np.empty((2, keys.shape[0]), dtype=np.int64)
    for at in range(keys.shape[0]):
        spans[0, at] = LARGEST
        spans[1, at] = -1
    for n in range(asked.shape[1]):
        at = asked[1, n]
        if at < 0:
            continue
        key = asked[0, n]
        if shift > 0 and curve != Z_ORDER:
            i, j, k = voxel_at(key, bits, curve, shift)
            key = key_of(i, j, k, bits, curve)
        spans[0, at] = min(spans[0, at], key)
        spans[1, at] = max(spans[1, at], key)
    return spans


@leaf
def rows_of_keys(keys, row_keys):
    """Where the rows of each asked key begin and end, (U,) int64 each.

    One merge of two ascending lists; rows of keys that were not asked for are the false hits.
    """
    total = keys.shape[0]
    starts = np.empty(total, dtype=np.int64)
    ends = np.empty(total, dtype=np.int64)
    n_rows = row_keys.shape[0]
    row = 0
    for n in range(total):
        key = keys[n]
        while row < n_rows and row_keys[row] < key:
            row += 1
        starts[n] = row
        while row < n_rows and row_keys[row] == key:
            row += 1
        ends[n] = row
    return starts, ends


@leaf
def counting_rows(row_ids, exclude):
    """Mask (R,) bool of the rows whose objects are not excluded."""
    counts = np.empty(row_ids.shape[0], dtype=np.bool_)
    for row in range(row_ids.shape[0]):
        counts[row] = True
    if exclude.shape[0] > 0:
        for row in range(row_ids.shape[0]):
            for n in range(exclude.shape[0]):
                if exclude[n] == row_ids[row]:
                    counts[row] = False
    return counts


@inlined
def has_voxel(occupancy, row, address):
    """Whether a row has the voxel of an address; always true for a voxel row (no occupancy)."""
    if occupancy.shape[0] == 0:
        return True
    return (occupancy[64 * row + ((address & 511) >> 3)] >> (address & 7)) & 1 != 0


@inlined
def distinct_ids(touched, row_ids, met, start):
    """Write the distinct ids of touched rows into met[start:], ascending -> number of ids."""
    count = np.int64(0)
    for row in range(row_ids.shape[0]):
        if touched[row]:
            count = insert_distinct(met, start, count, row_ids[row])
    return count


@entry(
    FLOATS2,
    INTS2,
    INTS,
    INTS,
    INTS,
    READ_BYTES,
    NONE,
    INTS,
    FLOATS,
    FLOAT,
    TANGENT_PLANE,
    FLOATS,
    INTS,
)
def refine_kernel(
    placed,
    asked,
    keys,
    row_keys,
    row_ids,
    occupancy,
    payload,
    exclude,
    origin,
    size,
    law,
    felt,
    met,
):
    """`refine` into felt (6 + N,) and met (N + R,) -> P, A and I.

    P points are hits, or felt, or both; A of them are felt only. felt takes the wrench and the P
    depths; met takes the P indices (~n for a point n that is no hit), then the I ids.
    """
    total = asked.shape[1]
    touched = np.zeros(row_ids.shape[0], dtype=np.bool_)
    starts, ends = rows_of_keys(keys, row_keys)
    counts = counting_rows(row_ids, exclude)
    ox, oy, oz = origin[0], origin[1], origin[2]
    mx, my, mz = placed[total, 0], placed[total, 1], placed[total, 2]
    fx = fy = fz = tx = ty = tz = weight = 0.0
    count = n_apart = np.int64(0)
    for n in range(total):
        at = asked[1, n]
        if at < 0:
            continue
        px, py, pz = placed[n, 0], placed[n, 1], placed[n, 2]
        is_hit = False
        sample = NOTHING_NEAR
        for row in range(starts[at], ends[at]):
            if not counts[row]:
                continue
            x, y, z = (px - ox) / size, (py - oy) / size, (pz - oz) / size
            sample = min(sample, sample_row(law, payload, row, x, y, z))
            if has_voxel(occupancy, row, asked[0, n]):
                is_hit = True
                touched[row] = True
        if not is_hit and not sample <= reach(law):
            continue
        nx, ny, nz = placed[n, 3], placed[n, 4], placed[n, 5]
        cx, cy, cz = center_of(px, ox, size), center_of(py, oy, size), center_of(pz, oz, size)
        depth, share = respond(law, is_hit, sample, px, py, pz, nx, ny, nz, cx, cy, cz, size)
        weight += share
        if is_hit or depth > 0.0:
            met[count] = n if is_hit else ~n
            felt[6 + count] = max(depth, 0.0)
            count += 1
            n_apart += not is_hit
        if depth > 0.0:
            fx, fy, fz, tx, ty, tz = accumulate(
                fx, fy, fz, tx, ty, tz, px, py, pz, nx, ny, nz, mx, my, mz, depth, law.stiffness
            )
    average_into(felt, weight, fx, fy, fz, tx, ty, tz)
    return count, n_apart, distinct_ids(touched, row_ids, met, count)


def refine(
    placed: Floats,
    asked: Ints,
    keys: Ints,
    row_keys: Ints,
    row_ids: Ints,
    occupancy: NDArray[np.uint8],
    payload: NDArray[np.uint8] | None,
    exclude: Ints,
    origin: Floats,
    size: float,
    law: Any,  # noqa: ANN401 - a NamedTuple that `kernels.law` knows
) -> Refined:
    """Drop the false hits of a frame's rows and sum the wrench of the points that are felt.

    placed, asked, keys as `locate` returns them; row_keys (R,) int64 ascending, row_ids (R,) int64,
    occupancy (64 R,) uint8, or empty for voxel rows; payload as the law reads it, or None;
    exclude (E,) int64; origin (3,) and size of a voxel, metres.
    """
    total = asked.shape[1]
    felt = np.empty(6 + total)
    met = np.empty(total + row_ids.shape[0], dtype=np.int64)
    n_points, n_apart, n_ids = refine_kernel(
        placed, asked, keys, row_keys, row_ids, occupancy, payload, exclude, origin, size, law,
        felt, met,
    )  # fmt: skip
    ids = met[n_points : n_points + n_ids]
    if n_apart == 0:
        return felt[:6], met[:n_points], felt[6 : 6 + n_points], ids, NO_POINTS, NO_DEPTHS
    points, depths = met[:n_points], felt[6 : 6 + n_points]
    is_hit = points >= 0
    return felt[:6], points[is_hit], depths[is_hit], ids, ~points[~is_hit], depths[~is_hit]


@entry(INTS2, INTS, INTS, INTS, READ_BYTES, INTS, INTS)
def pairs_of_hits(asked, keys, row_keys, row_ids, occupancy, exclude, hits):
    """Every (shell point, object) pair of a frame's hits, (P, 2) int64, ordered by both."""
    starts, ends = rows_of_keys(keys, row_keys)
    counts = counting_rows(row_ids, exclude)
    most = 0
    for h in range(hits.shape[0]):
        at = asked[1, hits[h]]
        most += ends[at] - starts[at]
    pairs = np.empty((most, 2), dtype=np.int64)
    count = 0
    for h in range(hits.shape[0]):
        n = hits[h]
        at = asked[1, n]
        for row in range(starts[at], ends[at]):
            if counts[row] and has_voxel(occupancy, row, asked[0, n]):
                pairs[count, 0] = n
                pairs[count, 1] = row_ids[row]
                count += 1
    return pairs[:count]


@entry(FLOATS2, INTS, INTS, FLOATS, FLOAT, INT, INT, INT, TANGENT_PLANE)
def wrench_of_addresses(placed, ordinals, addresses, origin, size, bits, curve, shift, law):
    """Wrench (6,) of hits given as ordinals (H,), ascending, and addresses (H,) int64.

    The paper's ``force(point, z_val)``: the voxel's centre comes from the address alone. For laws
    that read no payload.
    """
    ox, oy, oz = origin[0], origin[1], origin[2]
    last = placed.shape[0] - 1
    mx, my, mz = placed[last, 0], placed[last, 1], placed[last, 2]
    fx = fy = fz = tx = ty = tz = weight = 0.0
    for h in range(ordinals.shape[0]):
        i, j, k = voxel_at(addresses[h], bits, curve, shift)
        n = ordinals[h]
        px, py, pz = placed[n, 0], placed[n, 1], placed[n, 2]
        nx, ny, nz = placed[n, 3], placed[n, 4], placed[n, 5]
        cx = ox + size * (i + 0.5)
        cy = oy + size * (j + 0.5)
        cz = oz + size * (k + 0.5)
        depth, share = respond(law, True, NOTHING_NEAR, px, py, pz, nx, ny, nz, cx, cy, cz, size)
        weight += share
        if depth > 0.0:
            fx, fy, fz, tx, ty, tz = accumulate(
                fx, fy, fz, tx, ty, tz, px, py, pz, nx, ny, nz, mx, my, mz, depth, law.stiffness
            )
    wrench = np.empty(6)
    average_into(wrench, weight, fx, fy, fz, tx, ty, tz)
    return wrench


@entry(FLOATS2, INTS, FLOATS, FLOAT)
def depths_of_hits(placed, hits, origin, size):
    """Depths (H,) in metres of hits (H,) int64, 0 where the point is above its tangent plane."""
    depths = np.empty(hits.shape[0])
    ox, oy, oz = origin[0], origin[1], origin[2]
    for h in range(hits.shape[0]):
        n = hits[h]
        px, py, pz = placed[n, 0], placed[n, 1], placed[n, 2]
        nx, ny, nz = placed[n, 3], placed[n, 4], placed[n, 5]
        cx = center_of(px, ox, size)
        cy = center_of(py, oy, size)
        cz = center_of(pz, oz, size)
        depths[h] = max(depth_below_plane(px, py, pz, nx, ny, nz, cx, cy, cz), 0.0)
    return depths

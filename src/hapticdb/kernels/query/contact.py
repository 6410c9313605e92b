"""One frame in arrays: the shell's points located in the grid, rows refined to hits, the wrench.

Every sum runs in the order of the shell's points and every product is written out, so that each
strategy, layout, curve and engine gives the same wrench bit for bit (numba contracts no
multiplication and addition without fastmath, which this package never sets).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import (
    FLOAT,
    FLOATS,
    FLOATS2,
    INT,
    INTS,
    INTS2,
    READ_BYTES,
    READ_FLOATS,
    READ_FLOATS2,
    entry,
    leaf,
)
from hapticdb.kernels.curves import Z_ORDER, compact, key_of, voxel_of, z_encode
from hapticdb.kernels.query.sorting import insert_distinct, sorting_order

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Located(NamedTuple):
    """A shell placed in the grid, as `locate` returns it."""

    placed: Floats
    asked: Ints
    keys: Ints


LARGEST = 0x7FFFFFFFFFFFFFFF
"""Of an int64."""
AVERAGE_FROM = 10
"""Hits from which force and torque are averaged (McNeely et al. 1999, section 4.3)."""


@leaf
def contact_depth(px, py, pz, nx, ny, nz, cx, cy, cz):
    """Depth of a hit below its tangent plane, metres: (c - p) . n, not yet cut off at 0."""
    return (cx - px) * nx + (cy - py) * ny + (cz - pz) * nz


@leaf
def center_of(x, origin, size):
    """Centre, on one axis, of the voxel that holds coordinate x, metres."""
    return origin + size * (np.floor((x - origin) / size) + 0.5)


@leaf
def contact_force(nx, ny, nz, depth, stiffness):
    """Force of a contact (McNeely et al. 1999): F = K d n."""
    return stiffness * depth * nx, stiffness * depth * ny, stiffness * depth * nz


@leaf
def moment(rx, ry, rz, fx, fy, fz):
    """Torque of a force at a lever: r x F."""
    return ry * fz - rz * fy, rz * fx - rx * fz, rx * fy - ry * fx


@leaf
def average_into(out, n_hits, fx, fy, fz, tx, ty, tz):
    """Wrench into out (6+,): divided by a tenth of the hits when there are ten or more."""
    out[0] = fx
    out[1] = fy
    out[2] = fz
    out[3] = tx
    out[4] = ty
    out[5] = tz
    if n_hits >= AVERAGE_FROM:
        tenth = n_hits / 10.0
        for axis in range(6):
            out[axis] /= tenth


@leaf
def is_rigid(pose):
    """Whether a (4, 4) matrix is finite, a rotation to 1e-6, and has the last row 0 0 0 1."""
    for a in range(4):
        for b in range(4):
            if not np.isfinite(pose[a, b]):
                return False
    for b in range(3):
        if pose[3, b] != 0.0:
            return False
    if pose[3, 3] != 1.0:
        return False
    for a in range(3):
        for b in range(a, 3):
            dot = pose[0, a] * pose[0, b] + pose[1, a] * pose[1, b] + pose[2, a] * pose[2, b]
            if abs(dot - (1.0 if a == b else 0.0)) > 1e-6:
                return False
    det = (
        pose[0, 0] * (pose[1, 1] * pose[2, 2] - pose[1, 2] * pose[2, 1])
        - pose[0, 1] * (pose[1, 0] * pose[2, 2] - pose[1, 2] * pose[2, 0])
        + pose[0, 2] * (pose[1, 0] * pose[2, 1] - pose[1, 1] * pose[2, 0])
    )
    return det > 0.0


@leaf
def turn(a, b, c, x, y, z):
    """One coordinate of a turned vector: a row (a, b, c) of the rotation times (x, y, z)."""
    return a * x + b * y + c * z


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
    total = points.shape[0]
    if not is_rigid(pose):
        return -1
    # scalars: an array handed to a leaf, or a row of one, costs a counted reference each time
    a, b, c, u = pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]
    d, e, f, v = pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]
    g, h, m, w = pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]
    placed[total, 0] = turn(a, b, c, center[0], center[1], center[2]) + u
    placed[total, 1] = turn(d, e, f, center[0], center[1], center[2]) + v
    placed[total, 2] = turn(g, h, m, center[0], center[1], center[2]) + w
    placed[total, 3] = placed[total, 4] = placed[total, 5] = 0.0
    ox, oy, oz = origin[0], origin[1], origin[2]
    side = float(1 << bits)
    capacity = 16
    while capacity < 2 * total:
        capacity *= 2
    table = np.full(capacity, -1, dtype=np.int32)
    found = np.empty(total, dtype=np.int64)
    count = 0
    memo_key = -1
    memo_slot = -1
    for n in range(total):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        nx, ny, nz = normals[n, 0], normals[n, 1], normals[n, 2]
        wx = turn(a, b, c, px, py, pz) + u
        wy = turn(d, e, f, px, py, pz) + v
        wz = turn(g, h, m, px, py, pz) + w
        placed[n, 0] = wx
        placed[n, 1] = wy
        placed[n, 2] = wz
        placed[n, 3] = turn(a, b, c, nx, ny, nz)
        placed[n, 4] = turn(d, e, f, nx, ny, nz)
        placed[n, 5] = turn(g, h, m, nx, ny, nz)
        x = np.floor((wx - ox) / size)
        y = np.floor((wy - oy) / size)
        z = np.floor((wz - oz) / size)
        if not (0.0 <= x < side and 0.0 <= y < side and 0.0 <= z < side):
            asked[0, n] = -1
            asked[1, n] = -1
            continue
        i = np.int64(x)
        j = np.int64(y)
        k = np.int64(z)
        key = key_of(i, j, k, bits, curve)
        row_key = key >> shift
        if shift == 0 or curve == Z_ORDER:
            asked[0, n] = key  # a Z-order key ends in the bit number
        else:
            asked[0, n] = (row_key << 9) | z_encode(i & 7, j & 7, k & 7)
        if row_key != memo_key:
            # Fibonacci hashing (Knuth, volume 3, section 6.4) into a table at most half full
            at = ((row_key * 0x9E3779B97F4A7C1) >> 20) & (capacity - 1)
            while table[at] >= 0 and found[table[at]] != row_key:
                at = (at + 1) & (capacity - 1)
            if table[at] < 0:
                table[at] = count
                found[count] = row_key
                count += 1
            memo_key = row_key
            memo_slot = table[at]
        asked[1, n] = memo_slot
    order = sorting_order(found[:count])
    rank = np.empty(count, dtype=np.int32)
    for n in range(count):
        at = order[n]
        keys[n] = found[at]
        rank[at] = n
    for n in range(total):
        if asked[1, n] >= 0:
            asked[1, n] = rank[asked[1, n]]
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
    Few arrays cross, and results into arrays made here: one that a kernel returns costs twice the
    time (0.6 us) of one that it is given.
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

    One merge of two ascending lists; rows of keys that nobody asked for are the false hits.
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
    """Which rows count, (R,) bool: those of objects that are not excluded."""
    counts = np.empty(row_ids.shape[0], dtype=np.bool_)
    for row in range(row_ids.shape[0]):
        counts[row] = True
    if exclude.shape[0] > 0:
        for row in range(row_ids.shape[0]):
            for n in range(exclude.shape[0]):
                if exclude[n] == row_ids[row]:
                    counts[row] = False
    return counts


@entry(FLOATS2, INTS2, INTS, INTS, INTS, READ_BYTES, INTS, FLOATS, FLOAT, FLOAT, FLOATS, INTS)
def refine_kernel(
    placed, asked, keys, row_keys, row_ids, occupancy, exclude, origin, size, stiffness, felt, met
):
    """`refine` into felt (6 + N,) and met (N + R,); returns H and I."""
    total = asked.shape[1]
    touched = np.empty(row_ids.shape[0], dtype=np.bool_)
    for row in range(row_ids.shape[0]):
        touched[row] = False
    starts, ends = rows_of_keys(keys, row_keys)
    counts = counting_rows(row_ids, exclude)
    has_bits = occupancy.shape[0] > 0
    ox, oy, oz = origin[0], origin[1], origin[2]
    mx, my, mz = placed[total, 0], placed[total, 1], placed[total, 2]
    fx = fy = fz = tx = ty = tz = 0.0
    count = np.int64(0)
    for n in range(total):
        at = asked[1, n]
        if at < 0:
            continue
        byte = (asked[0, n] & 511) >> 3
        bit = asked[0, n] & 7
        is_hit = False
        for row in range(starts[at], ends[at]):
            if has_bits and not (occupancy[64 * row + byte] >> bit) & 1:
                continue
            if counts[row]:
                is_hit = True
                touched[row] = True
        if not is_hit:
            continue
        px, py, pz = placed[n, 0], placed[n, 1], placed[n, 2]
        nx, ny, nz = placed[n, 3], placed[n, 4], placed[n, 5]
        cx = center_of(px, ox, size)
        cy = center_of(py, oy, size)
        cz = center_of(pz, oz, size)
        depth = contact_depth(px, py, pz, nx, ny, nz, cx, cy, cz)
        met[count] = n
        felt[6 + count] = max(depth, 0.0)
        count += 1
        if depth > 0.0:
            x, y, z = contact_force(nx, ny, nz, depth, stiffness)
            fx += x
            fy += y
            fz += z
            x, y, z = moment(px - mx, py - my, pz - mz, x, y, z)
            tx += x
            ty += y
            tz += z
    average_into(felt, count, fx, fy, fz, tx, ty, tz)
    n_ids = np.int64(0)
    for row in range(row_ids.shape[0]):
        if touched[row]:
            n_ids = insert_distinct(met, count, n_ids, row_ids[row])
    return count, n_ids


def refine(
    placed: Floats,
    asked: Ints,
    keys: Ints,
    row_keys: Ints,
    row_ids: Ints,
    occupancy: NDArray[np.uint8],
    exclude: Ints,
    origin: Floats,
    size: float,
    stiffness: float,
) -> tuple[Floats, Ints, Floats, Ints]:
    """Drop the false hits of a frame's rows and sum the wrench of the rest.

    placed, asked, keys as `locate` returns them; row_keys (R,) int64 ascending, row_ids (R,) int64,
    occupancy (64 R,) uint8 or empty for voxel rows; exclude (E,) int64; stiffness in N/m.

    Returns
    -------
    wrench : (6,) float64
        Force in N and torque in N m about the centre, world frame.
    hits : (H,) int64
        Indices of the shell's points inside a voxel, ascending.
    depths : (H,) float64
        Metres below each hit's tangent plane, 0 above it.
    ids : (I,) int64
        Objects that the hits are in, ascending.
    """
    total = asked.shape[1]
    felt = np.empty(6 + total)
    met = np.empty(total + row_ids.shape[0], dtype=np.int64)
    n_hits, n_ids = refine_kernel(
        placed, asked, keys, row_keys, row_ids, occupancy, exclude, origin, size, stiffness,
        felt, met,
    )  # fmt: skip
    return felt[:6], met[:n_hits], felt[6 : 6 + n_hits], met[n_hits : n_hits + n_ids]


@entry(INTS2, INTS, INTS, INTS, READ_BYTES, INTS, INTS)
def pairs_of_hits(asked, keys, row_keys, row_ids, occupancy, exclude, hits):
    """Every (shell point, object) pair of a frame's hits, (P, 2) int64, ordered by both."""
    starts, ends = rows_of_keys(keys, row_keys)
    counts = counting_rows(row_ids, exclude)
    has_bits = occupancy.shape[0] > 0
    most = 0
    for h in range(hits.shape[0]):
        at = asked[1, hits[h]]
        most += ends[at] - starts[at]
    pairs = np.empty((most, 2), dtype=np.int64)
    count = 0
    for h in range(hits.shape[0]):
        n = hits[h]
        at = asked[1, n]
        byte = (asked[0, n] & 511) >> 3
        bit = asked[0, n] & 7
        for row in range(starts[at], ends[at]):
            if counts[row] and not (has_bits and not (occupancy[64 * row + byte] >> bit) & 1):
                pairs[count, 0] = n
                pairs[count, 1] = row_ids[row]
                count += 1
    return pairs[:count]


@entry(FLOATS2, INTS, INTS, FLOATS, FLOAT, INT, INT, INT, FLOAT)
def wrench_of_addresses(placed, ordinals, addresses, origin, size, bits, curve, shift, stiffness):
    """Wrench (6,) of hits given as ordinals (H,), ascending, and addresses (H,) int64.

    The paper's ``force(point, z_val)``: the voxel's centre comes from the address alone.
    """
    ox, oy, oz = origin[0], origin[1], origin[2]
    last = placed.shape[0] - 1
    mx, my, mz = placed[last, 0], placed[last, 1], placed[last, 2]
    fx = fy = fz = tx = ty = tz = 0.0
    for h in range(ordinals.shape[0]):
        i, j, k = voxel_at(addresses[h], bits, curve, shift)
        n = ordinals[h]
        px, py, pz = placed[n, 0], placed[n, 1], placed[n, 2]
        nx, ny, nz = placed[n, 3], placed[n, 4], placed[n, 5]
        cx = ox + size * (i + 0.5)
        cy = oy + size * (j + 0.5)
        cz = oz + size * (k + 0.5)
        depth = contact_depth(px, py, pz, nx, ny, nz, cx, cy, cz)
        if depth > 0.0:
            x, y, z = contact_force(nx, ny, nz, depth, stiffness)
            fx += x
            fy += y
            fz += z
            x, y, z = moment(px - mx, py - my, pz - mz, x, y, z)
            tx += x
            ty += y
            tz += z
    wrench = np.empty(6)
    average_into(wrench, ordinals.shape[0], fx, fy, fz, tx, ty, tz)
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
        depths[h] = max(contact_depth(px, py, pz, nx, ny, nz, cx, cy, cz), 0.0)
    return depths

"""One frame in arrays: the shell's points located in the grid, rows refined to hits, the wrench.

Every sum runs in the order of the shell's points and every product is written out, so that each
strategy, layout, curve and engine gives the same wrench bit for bit (numba contracts no
multiplication and addition without fastmath, which this package never sets).
"""

import numpy as np

from hapticdb.kernels._jit import entry, leaf
from hapticdb.kernels.curves import Z_ORDER, key_of, voxel_of, z_encode

AVERAGE_FROM = 10
"""Hits from which force and torque are averaged (McNeely et al. 1999, section 4.3)."""


@leaf
def contact_depth(px, py, pz, nx, ny, nz, cx, cy, cz):
    """Depth of a hit below its tangent plane, metres: (c - p) . n, not yet cut off at 0."""
    return (cx - px) * nx + (cy - py) * ny + (cz - pz) * nz


@leaf
def add_contact(px, py, pz, nx, ny, nz, depth, center, stiffness, out):
    """Add the force and torque of a contact of that depth to out (6,).

    Tangent-plane law, McNeely et al. 1999: F = K d n, tau = (p - x_cm) x F. Points and normals
    come as scalars: a row taken from an array costs a counted reference (4 times the frame).
    """
    fx = stiffness * depth * nx
    fy = stiffness * depth * ny
    fz = stiffness * depth * nz
    rx = px - center[0]
    ry = py - center[1]
    rz = pz - center[2]
    out[0] += fx
    out[1] += fy
    out[2] += fz
    out[3] += ry * fz - rz * fy
    out[4] += rz * fx - rx * fz
    out[5] += rx * fy - ry * fx


@leaf
def average(n_hits, out):
    """Divide the wrench (6,) by a tenth of the hits when there are ten or more."""
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
def turn(pose, axis, x, y, z):
    """One coordinate of (x, y, z) rotated by the upper left of pose (4, 4)."""
    return pose[axis, 0] * x + pose[axis, 1] * y + pose[axis, 2] * z


@leaf
def sort_small_or_large(keys):
    """Order (U,) that sorts keys (U,): insertion for the few dozen bricks of a common frame."""
    count = keys.shape[0]
    if count > 64:
        return np.argsort(keys)
    order = np.empty(count, dtype=np.int64)
    for n in range(count):
        key = keys[n]
        at = n
        while at > 0 and keys[order[at - 1]] > key:
            order[at] = order[at - 1]
            at -= 1
        order[at] = n
    return order


@entry
def locate(points, normals, center, pose, origin, size, bits, curve, shift):
    """Place a shell in the grid and collect the distinct row keys that it asks for.

    points, normals (N, 3) and center (3,) float64, tool frame; pose (4, 4) float64,
    world_from_tool; origin (3,) and size in metres; shift 0 for voxel rows, 9 for brick rows.

    Returns
    -------
    status : int
        0, or 1 when the pose is not rigid (then the rest is empty).
    world : (N, 3), turned : (N, 3) float64
        Points in metres and normals, world frame.
    address : (N,) int64
        Voxel rows: the key. Brick rows: the brick's key << 9 | bit number. -1 outside the grid.
    slot : (N,) int32
        Place of the point's row key in `keys`; -1 outside the grid.
    keys : (U,) int64
        Distinct row keys, ascending.
    first, last : (U,) int64
        Lowest and highest voxel key that the shell asks for under each row key.
    placed : (3,) float64
        The centre, world frame.
    """
    total = points.shape[0]
    world = np.empty((total, 3))
    turned = np.empty((total, 3))
    address = np.empty(total, dtype=np.int64)
    slot = np.empty(total, dtype=np.int32)
    none = np.empty(0, dtype=np.int64)
    placed = np.empty(3)
    if not is_rigid(pose):
        return 1, world, turned, address, slot, none, none, none, placed
    for axis in range(3):
        placed[axis] = turn(pose, axis, center[0], center[1], center[2]) + pose[axis, 3]
    side = 1 << bits
    capacity = 16
    while capacity < 2 * total:
        capacity *= 2
    table = np.full(capacity, -1, dtype=np.int32)
    found = np.empty(total, dtype=np.int64)
    low = np.empty(total, dtype=np.int64)
    high = np.empty(total, dtype=np.int64)
    count = 0
    memo_key = -1
    memo_slot = -1
    for n in range(total):
        for axis in range(3):
            world[n, axis] = (
                turn(pose, axis, points[n, 0], points[n, 1], points[n, 2]) + pose[axis, 3]
            )
            turned[n, axis] = turn(pose, axis, normals[n, 0], normals[n, 1], normals[n, 2])
        x = np.floor((world[n, 0] - origin[0]) / size)
        y = np.floor((world[n, 1] - origin[1]) / size)
        z = np.floor((world[n, 2] - origin[2]) / size)
        if not (0 <= x < side and 0 <= y < side and 0 <= z < side):
            address[n] = -1
            slot[n] = -1
            continue
        i = np.int64(x)
        j = np.int64(y)
        k = np.int64(z)
        key = key_of(i, j, k, bits, curve)
        row_key = key >> shift
        if shift == 0 or curve == Z_ORDER:
            address[n] = key  # a Z-order key ends in the bit number
        else:
            address[n] = (row_key << 9) | z_encode(i & 7, j & 7, k & 7)
        if row_key != memo_key:
            # Fibonacci hashing (Knuth, volume 3, section 6.4) into a table at most half full
            at = ((row_key * 0x9E3779B97F4A7C1) >> 20) & (capacity - 1)
            while table[at] >= 0 and found[table[at]] != row_key:
                at = (at + 1) & (capacity - 1)
            if table[at] < 0:
                table[at] = count
                found[count] = row_key
                low[count] = key
                high[count] = key
                count += 1
            memo_key = row_key
            memo_slot = table[at]
        slot[n] = memo_slot
        low[memo_slot] = min(low[memo_slot], key)
        high[memo_slot] = max(high[memo_slot], key)
    order = sort_small_or_large(found[:count])
    rank = np.empty(count, dtype=np.int32)
    keys = np.empty(count, dtype=np.int64)
    first = np.empty(count, dtype=np.int64)
    last = np.empty(count, dtype=np.int64)
    for u in range(count):
        keys[u] = found[order[u]]
        first[u] = low[order[u]]
        last[u] = high[order[u]]
        rank[order[u]] = u
    for n in range(total):
        if slot[n] >= 0:
            slot[n] = rank[slot[n]]
    return 0, world, turned, address, slot, keys, first, last, placed


@leaf
def holds(occupancy, row, bit):
    """Whether a row covers a point: bit of its brick, or any row of a voxel (no occupancy)."""
    if occupancy.shape[0] == 0:
        return True
    return (occupancy[64 * row + (bit >> 3)] >> (bit & 7)) & 1 == 1


@leaf
def is_excluded(object_id, exclude):
    """Whether the object is left out; exclude (E,) int64, a handful."""
    for n in range(exclude.shape[0]):
        if exclude[n] == object_id:
            return True
    return False


@leaf
def first_rows(keys, row_keys):
    """Where the rows of each asked key begin, (U,) int64: one merge of two ascending lists."""
    starts = np.empty(keys.shape[0], dtype=np.int64)
    row = 0
    for u in range(keys.shape[0]):
        while row < row_keys.shape[0] and row_keys[row] < keys[u]:
            row += 1
        starts[u] = row
    return starts


@entry
def refine(
    world, turned, address, slot, keys, row_keys, row_ids, occupancy, exclude,
    origin, size, center, stiffness,
):  # fmt: skip
    """Drop the false hits of a frame's rows and sum the wrench of the rest.

    world, turned, address, slot, keys as `locate` returns them; row_keys (R,) int64 ascending,
    row_ids (R,) int64, occupancy (64 R,) uint8 or empty for voxel rows; exclude (E,) int64;
    center (3,) the tool's centre of mass, world frame; stiffness in N/m.

    Returns
    -------
    wrench : (6,) float64
        Force in N, torque in N m about the centre, world frame.
    hits : (H,) int64
        Indices of the shell's points inside a voxel, ascending.
    depths : (H,) float64
        Metres below the tangent plane, 0 where the point is above it.
    touched : (R,) bool
        Rows that at least one hit lies in.
    """
    wrench = np.zeros(6)
    total = slot.shape[0]
    hits = np.empty(total, dtype=np.int64)
    depths = np.empty(total)
    touched = np.zeros(row_keys.shape[0], dtype=np.bool_)
    starts = first_rows(keys, row_keys)
    count = 0
    for n in range(total):
        u = slot[n]
        if u < 0:
            continue
        bit = address[n] & 511
        is_hit = False
        row = starts[u]
        while row < row_keys.shape[0] and row_keys[row] == keys[u]:
            if holds(occupancy, row, bit) and not is_excluded(row_ids[row], exclude):
                is_hit = True
                touched[row] = True
            row += 1
        if not is_hit:
            continue
        px = world[n, 0]
        py = world[n, 1]
        pz = world[n, 2]
        nx = turned[n, 0]
        ny = turned[n, 1]
        nz = turned[n, 2]
        cx = origin[0] + size * (np.floor((px - origin[0]) / size) + 0.5)
        cy = origin[1] + size * (np.floor((py - origin[1]) / size) + 0.5)
        cz = origin[2] + size * (np.floor((pz - origin[2]) / size) + 0.5)
        depth = contact_depth(px, py, pz, nx, ny, nz, cx, cy, cz)
        if depth > 0.0:
            add_contact(px, py, pz, nx, ny, nz, depth, center, stiffness, wrench)
        hits[count] = n
        depths[count] = max(depth, 0.0)
        count += 1
    average(count, wrench)
    return wrench, hits[:count], depths[:count], touched


@entry
def pairs_of_hits(slot, address, keys, hits, row_keys, row_ids, occupancy, exclude):
    """Every (shell point, object) pair of a frame's hits, (P, 2) int64, ordered by both."""
    starts = first_rows(keys, row_keys)
    pairs = np.empty((hits.shape[0] * 2 + 8, 2), dtype=np.int64)
    count = 0
    for n in hits:
        row = starts[slot[n]]
        while row < row_keys.shape[0] and row_keys[row] == keys[slot[n]]:
            if holds(occupancy, row, address[n] & 511) and not is_excluded(row_ids[row], exclude):
                if count == pairs.shape[0]:
                    larger = np.empty((2 * count, 2), dtype=np.int64)
                    larger[:count] = pairs
                    pairs = larger
                pairs[count, 0] = n
                pairs[count, 1] = row_ids[row]
                count += 1
            row += 1
    return pairs[:count]


@leaf
def voxel_at(address, bits, curve, shift):
    """Voxel (i, j, k) of an address as `locate` gives it."""
    if shift == 0:
        return voxel_of(address, bits, curve)
    i, j, k = voxel_of(address >> 9, max(bits - 3, 0), curve)
    x, y, z = voxel_of(address & 511, 3, Z_ORDER)
    return (i << 3) | x, (j << 3) | y, (k << 3) | z


@entry
def wrench_of_addresses(
    world, turned, ordinals, addresses, origin, size, bits, curve, shift, center, stiffness
):
    """Wrench (6,) of hits given as ordinals (H,), ascending, and addresses (H,) int64.

    The paper's ``force(point, z_val)``: the voxel's centre comes from the address alone.
    """
    wrench = np.zeros(6)
    for h in range(ordinals.shape[0]):
        i, j, k = voxel_at(addresses[h], bits, curve, shift)
        cx = origin[0] + size * (i + 0.5)
        cy = origin[1] + size * (j + 0.5)
        cz = origin[2] + size * (k + 0.5)
        n = ordinals[h]
        px = world[n, 0]
        py = world[n, 1]
        pz = world[n, 2]
        nx = turned[n, 0]
        ny = turned[n, 1]
        nz = turned[n, 2]
        depth = contact_depth(px, py, pz, nx, ny, nz, cx, cy, cz)
        if depth > 0.0:
            add_contact(px, py, pz, nx, ny, nz, depth, center, stiffness, wrench)
    average(ordinals.shape[0], wrench)
    return wrench


@entry
def depths_of_hits(world, turned, hits, origin, size):
    """Depths (H,) in metres of hits (H,) int64, 0 where the point is above its tangent plane."""
    depths = np.empty(hits.shape[0])
    for h in range(hits.shape[0]):
        n = hits[h]
        depth = 0.0
        for axis in range(3):
            p = world[n, axis]
            c = origin[axis] + size * (np.floor((p - origin[axis]) / size) + 0.5)
            depth += (c - p) * turned[n, axis]
        depths[h] = max(depth, 0.0)
    return depths

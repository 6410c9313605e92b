"""The limit of a real-time frame: the same flat loop over one dense bitmap in memory.

Word ``(i * side + j) * side / 32 + k / 32``, bit ``k & 31``. All of a frame's arithmetic, and the
order of its sums, are those of `hapticdb.kernels.resident.cells.felt`; only the lookup differs.
"""

import numpy as np
from numba import types
from numpy.typing import NDArray

from hapticdb.kernels._jit import FLOAT, FLOATS2, FLOATS3, INT, INTS, INTS32, WORDS32_2, entry, leaf
from hapticdb.kernels.query.contact import (
    average_into,
    center_of,
    contact_depth,
    contact_force,
    is_rigid,
    moment,
    turn,
)
from hapticdb.kernels.resident.cells import (
    CLUSTERS,
    CONTACTS,
    DEEPEST,
    EMPTY_SLOT,
    HITS,
    PLACE,
    Cells,
)


@entry(INTS, INTS32, WORDS32_2, INT, types.uint32[::1])
def spread_out(keys: NDArray[np.int64], slots, words, side, bitmap):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Resident cells of one directory into a bitmap, zero before."""
    row = side // 32
    for entry_at in range(keys.shape[0]):
        if keys[entry_at] < 0 or slots[entry_at] == EMPTY_SLOT:
            continue
        ci = keys[entry_at] >> 32
        cj = (keys[entry_at] >> 16) & 0xFFFF
        ck = keys[entry_at] & 0xFFFF
        for word in range(1024):
            i, j = (ci << 5) | (word >> 5), (cj << 5) | (word & 31)
            bitmap[(i * side + j) * row + ck] = words[slots[entry_at], word]


@leaf
def dense_felt(bitmap, shell, pose, place, stiffness, met, out):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """One frame, as `felt`."""
    points = shell.points
    a, b, c, u = pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]
    d, e, f, v = pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]
    g, h, m, w = pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]
    ox, oy, oz, size, side = place.x, place.y, place.z, place.size, place.side
    row = np.int64(side) >> 5
    width = np.int64(side)
    x, y, z = shell.center[0], shell.center[1], shell.center[2]
    mx = turn(a, b, c, x, y, z) + u
    my = turn(d, e, f, x, y, z) + v
    mz = turn(g, h, m, x, y, z) + w
    fx = fy = fz = tx = ty = tz = deepest = 0.0
    count = n_contacts = 0
    for n in range(points.shape[0]):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        px, py, pz = (
            turn(a, b, c, px, py, pz) + u,
            turn(d, e, f, px, py, pz) + v,
            turn(g, h, m, px, py, pz) + w,
        )
        x = (px - ox) / size
        y = (py - oy) / size
        z = (pz - oz) / size
        if not (0.0 <= x < side and 0.0 <= y < side and 0.0 <= z < side):
            continue
        i, j, k = np.int64(x), np.int64(y), np.int64(z)
        if not (bitmap[(i * width + j) * row + (k >> 5)] >> np.uint32(k & 31)) & 1:
            continue
        nx, ny, nz = points[n, 3], points[n, 4], points[n, 5]
        nx, ny, nz = turn(a, b, c, nx, ny, nz), turn(d, e, f, nx, ny, nz), turn(g, h, m, nx, ny, nz)
        cx = center_of(px, ox, size)
        cy = center_of(py, oy, size)
        cz = center_of(pz, oz, size)
        depth = contact_depth(px, py, pz, nx, ny, nz, cx, cy, cz)
        met[count] = n
        count += 1
        if depth > 0.0:
            n_contacts += 1
            deepest = max(deepest, depth)
            x, y, z = contact_force(nx, ny, nz, depth, stiffness)
            fx += x
            fy += y
            fz += z
            x, y, z = moment(px - mx, py - my, pz - mz, x, y, z)
            tx += x
            ty += y
            tz += z
    average_into(out, count, fx, fy, fz, tx, ty, tz)
    out[HITS] = count
    out[CONTACTS] = n_contacts
    out[DEEPEST] = deepest


@entry(types.uint32[::1], CLUSTERS, FLOATS3, PLACE, FLOAT, INTS, FLOATS2)
def dense_feel(bitmap, shell, poses, place, stiffness, met, out):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """`dense_felt` at poses (M, 4, 4) into out (M, RESULTS), as `feel_kernel`."""
    for n in range(poses.shape[0]):
        if not is_rigid(poses[n]):
            return n
        dense_felt(bitmap, shell, poses[n], place, stiffness, met, out[n])
    return poses.shape[0]


def dense_bitmap(cells: Cells, which: int, side: int) -> NDArray[np.uint32]:
    """Bitmap of all that is resident in one directory; what is not is empty there."""
    bitmap = np.zeros(side**3 // 32, dtype=np.uint32)
    spread_out(cells.keys[which], cells.slots[which], cells.words, side, bitmap)
    return bitmap

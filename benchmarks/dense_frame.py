"""The limit of a real-time frame: the same flat loop over one dense bitmap in memory.

Voxel (i, j, k) is bit ``k & 31`` of word ``(i * side + j) * side / 32 + k / 32``. Arithmetic and
order of sums equal those of `hapticdb.kernels.resident.cell_frames.evaluate_frame`; only the lookup
differs.
"""

import numpy as np
from numba import types
from numpy.typing import NDArray

from hapticdb.kernels._jit import FLOATS3, INTS, entry, leaf, record_of
from hapticdb.kernels.force_law import (
    NO_WRENCH,
    NOTHING_NEAR,
    TANGENT_PLANE,
    accumulate,
    average_into,
    respond,
)
from hapticdb.kernels.query.shell_keys import center_of
from hapticdb.kernels.records.hand import RESULT
from hapticdb.kernels.resident.cells import CELL_GRID, CLUSTERS, EMPTY_SLOT, Cells
from hapticdb.kernels.rigid import is_rigid, moved, transform_of, turned


@leaf
def dense_felt(bitmap, shell, pose, place, law, met, out):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """One frame, as `evaluate_frame`, under a law that reads no payload."""
    points = shell.points
    transform = transform_of(pose)
    ox, oy, oz, size, side = place.x, place.y, place.z, place.size, place.side
    row = np.int64(side) >> 5
    width = np.int64(side)
    center = moved(transform, shell.center[0], shell.center[1], shell.center[2])
    sums, weight, deepest = NO_WRENCH, 0.0, 0.0
    count = n_contacts = 0
    for n in range(points.shape[0]):
        px, py, pz = moved(transform, points[n, 0], points[n, 1], points[n, 2])
        x = (px - ox) / size
        y = (py - oy) / size
        z = (pz - oz) / size
        if not (0.0 <= x < side and 0.0 <= y < side and 0.0 <= z < side):
            continue
        i, j, k = np.int64(x), np.int64(y), np.int64(z)
        is_hit = (bitmap[(i * width + j) * row + (k >> 5)] >> np.uint32(k & 31)) & 1 != 0
        if not is_hit:
            continue
        nx, ny, nz = turned(transform, points[n, 3], points[n, 4], points[n, 5])
        cx, cy, cz = center_of(px, ox, size), center_of(py, oy, size), center_of(pz, oz, size)
        point = px, py, pz, nx, ny, nz, cx, cy, cz
        depth, share = respond(law, is_hit, NOTHING_NEAR, *point, size)
        met[count] = n
        count += 1
        weight += share
        if depth > 0.0:
            n_contacts += 1
            deepest = max(deepest, depth)
            sums = accumulate(sums, point, center, depth, law.stiffness)
    average_into(out.wrench, weight, sums)
    out.hits, out.contacts, out.deepest = count, n_contacts, deepest


@entry(types.uint32[::1], CLUSTERS, FLOATS3, CELL_GRID, TANGENT_PLANE, INTS, record_of(RESULT, 1))
def dense_feel(bitmap, shell, poses, place, law, met, out):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """`dense_felt` at poses (M, 4, 4) into out (M,) of RESULT, as `evaluate_frames` does."""
    for n in range(poses.shape[0]):
        if not is_rigid(poses[n]):
            return n
        dense_felt(bitmap, shell, poses[n], place, law, met, out[n])
    return poses.shape[0]


def dense_bitmap(cells: Cells, which: int, side: int) -> NDArray[np.uint32]:
    """Bitmap of the resident cells of one directory; other cells are empty in the bitmap."""
    keys, slots, n = cells.keys[which], cells.slots[which], side // 32
    held = (keys >= 0) & (slots != EMPTY_SLOT)
    keys, words = keys[held], cells.words[slots[held]]
    bitmap = np.zeros((n, 32, n, 32, n), dtype=np.uint32)
    place = keys >> 32, slice(None), (keys >> 16) & 0xFFFF, slice(None), keys & 0xFFFF
    bitmap[place] = words.reshape(-1, 32, 32)
    return bitmap.ravel()

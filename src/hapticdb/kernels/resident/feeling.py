"""Frames over resident cells: what a placed shell feels, without a database."""

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import FLOAT, FLOATS2, FLOATS3, INT, INTS, entry, inlined, leaf
from hapticdb.kernels.field.law import DISTANCE_FIELD
from hapticdb.kernels.law import (
    TANGENT_PLANE,
    accumulate,
    average_into,
    felt_within,
    reach,
    respond,
    sample_slot,
    share_slot,
)
from hapticdb.kernels.query.contact import center_of
from hapticdb.kernels.resident.cells import (
    CELLS,
    CELLS_WITH_DISTANCES,
    CLUSTERS,
    CONTACTS,
    DEEPEST,
    EMPTY_SLOT,
    GROUP,
    HITS,
    LISTED,
    PLACE,
    UNKNOWN,
    UNKNOWNS,
    begin_frame,
    bit_in,
    brick_bit,
    cell_key,
    column_of,
    end_frame,
    enter_cell,
    key_of_cell,
    slot_of,
)
from hapticdb.kernels.rigid import is_rigid, moved, transform_of, turned

MOST_COLUMNS = 64
"""Most columns (i, j) of a box that are read. In a larger box an occupied brick counts as near."""
MOST_CELLS = 8
"""Most cells of a box that are read. A larger box counts as near, and its points are looked up."""


def _masks_of_runs(stride: int) -> NDArray[np.uint64]:
    """Masks (4, 4): entry [low, high] has the bricks low .. high on the axis of that stride."""
    masks = np.zeros((4, 4), dtype=np.uint64)
    for low in range(4):
        for high in range(low, 4):
            bits = [b for b in range(64) if low <= (b // stride) % 4 <= high]
            masks[low, high] = sum(1 << b for b in bits)
    return masks


_MASKS_I, _MASKS_J, _MASKS_K = _masks_of_runs(16), _masks_of_runs(4), _masks_of_runs(1)
_COLUMNS = np.array(
    [[((2 << high) - 1) & ~((1 << low) - 1) for high in range(32)] for low in range(32)]
).astype(np.uint32)
"""Masks (32, 32) for a word: entry [low, high] has the bits k = low .. high."""


@inlined
def is_something_near(
    keys, slots, words, masks, used, which, low_i, low_j, low_k, high_i, high_j, high_k
):
    """Whether a closed box in the grid holds an occupied voxel, or may: unknown cells count, too.

    The masks of bricks are read first, then, in a small box, the words. The loop over words has no
    early end, since a mispredicted branch costs more than ten words.
    """
    is_near = False
    first_i, first_j, first_k = low_i >> 5, low_j >> 5, low_k >> 5
    last_i, last_j, last_k = high_i >> 5, high_j >> 5, high_k >> 5
    n_cells = (last_i - first_i + 1) * (last_j - first_j + 1) * (last_k - first_k + 1)
    n_columns = (high_i - low_i + 1) * (high_j - low_j + 1)
    if n_cells > MOST_CELLS:
        return True
    for ci in range(first_i, last_i + 1):
        i0, i1 = max(low_i, ci << 5) & 31, min(high_i, (ci << 5) | 31) & 31
        for cj in range(first_j, last_j + 1):
            j0, j1 = max(low_j, cj << 5) & 31, min(high_j, (cj << 5) | 31) & 31
            for ck in range(first_k, last_k + 1):
                slot = slot_of(keys, slots, which, key_of_cell(ci, cj, ck))
                if slot < 0:
                    return True
                if slot == EMPTY_SLOT:
                    continue
                used[slot] = 1
                k0, k1 = max(low_k, ck << 5) & 31, min(high_k, (ck << 5) | 31) & 31
                bricks = _MASKS_I[i0 >> 3, i1 >> 3] & _MASKS_J[j0 >> 3, j1 >> 3]
                if not masks[slot] & bricks & _MASKS_K[k0 >> 3, k1 >> 3]:
                    continue
                if n_columns > MOST_COLUMNS:
                    return True
                met = np.uint32(0)
                for i in range(i0, i1 + 1):
                    for word in range((i << 5) | j0, ((i << 5) | j1) + 1):
                        met |= words[slot, word]
                if met & _COLUMNS[k0, k1]:
                    is_near = True
    return is_near


@inlined
def is_sphere_free(keys, slots, words, masks, used, which, spheres, n, transform, place, reached):
    """Whether no voxel is in the box around sphere n of a placed shell, wider by `reached` voxels.

    Unknown cells count as occupied; space outside the grid is free.
    """
    side = place.side
    x, y, z = moved(transform, spheres[n, 0], spheres[n, 1], spheres[n, 2])
    radius = spheres[n, 3] / place.size + reached
    x = (x - place.x) / place.size
    y = (y - place.y) / place.size
    z = (z - place.z) / place.size
    if x + radius < 0.0 or y + radius < 0.0 or z + radius < 0.0:
        return True
    if x - radius >= side or y - radius >= side or z - radius >= side:
        return True
    return not is_something_near(
        keys, slots, words, masks, used, which,
        np.int64(max(x - radius, 0.0)),
        np.int64(max(y - radius, 0.0)),
        np.int64(max(z - radius, 0.0)),
        np.int64(min(x + radius, side - 1.0)),
        np.int64(min(y + radius, side - 1.0)),
        np.int64(min(z + radius, side - 1.0)),
    )  # fmt: skip


@inlined
def free_runs(
    keys, slots, words, masks, used, which, spheres, groups, cluster, transform, place, reached
):
    """Number of runs, from run `cluster` on, that are far from all voxels: GROUP, 1 or 0.

    Far means farther away than `reached` voxels. It is 0 for a shell without spheres.
    """
    if spheres.shape[0] == 0:
        return 0
    if cluster % GROUP == 0 and is_sphere_free(
        keys, slots, words, masks, used, which, groups, cluster // GROUP, transform, place, reached
    ):
        return GROUP
    if is_sphere_free(
        keys, slots, words, masks, used, which, spheres, cluster, transform, place, reached
    ):
        return 1
    return 0


@inlined
def place_run(columns, start, count, transform, place, scratch):
    """Place points start .. start + count: scratch takes metres (rows 0-2), voxels (rows 3-5).

    One loop for each axis, which the compiler vectorizes: this halves the time of a flat frame of
    100,000 points.
    """
    ox, oy, oz, size = place.x, place.y, place.z, place.size
    for at in range(count):
        x, y, z = columns[0, start + at], columns[1, start + at], columns[2, start + at]
        x, y, z = moved(transform, x, y, z)
        scratch[0, at] = x
        scratch[1, at] = y
        scratch[2, at] = z
    for at in range(count):
        scratch[3, at] = (scratch[0, at] - ox) / size
    for at in range(count):
        scratch[4, at] = (scratch[1, at] - oy) / size
    for at in range(count):
        scratch[5, at] = (scratch[2, at] - oz) / size


@leaf
def respond_at(law, is_hit, sample, transform, px, py, pz, nx, ny, nz, ox, oy, oz, size):
    """Depth, weight and turned normal of a placed point p; n is its normal in the tool's frame."""
    nx, ny, nz = turned(transform, nx, ny, nz)
    cx, cy, cz = center_of(px, ox, size), center_of(py, oy, size), center_of(pz, oz, size)
    depth, weight = respond(law, is_hit, sample, px, py, pz, nx, ny, nz, cx, cy, cz, size)
    return depth, weight, nx, ny, nz


@leaf
def felt(cells, which, shell, pose, place, law, met, missed, out):
    """One frame: hits of a placed shell and the wrench of the points felt, into out (RESULTS,).

    met (N,) takes the indices of the hits; missed (1 + MOST_MISSED,) takes the number and the keys
    of the unknown cells that hold points. A point in an unknown cell is neither a hit nor a miss.
    Arithmetic and order of the sums are those of `contact.locate` and `refining.refine`.
    """
    # arrays get local names: a field that is read in a loop costs a counted reference
    _, _, keys, slots, words, masks, used, payload = cells
    points, _, spheres, groups, run, columns, scratch = shell
    transform = transform_of(pose)
    ox, oy, oz, size, side = place.x, place.y, place.z, place.size, place.side
    mx, my, mz = moved(transform, shell.center[0], shell.center[1], shell.center[2])
    fx = fy = fz = tx = ty = tz = weight = deepest = 0.0
    n_hits = n_contacts = n_unknown = n_missed = cluster = start = 0
    last_key, slot, mask = np.int64(-1), np.int64(UNKNOWN), np.uint64(0)
    while start < points.shape[0]:
        n_free = free_runs(
            keys, slots, words, masks, used, which, spheres, groups, cluster, transform, place,
            felt_within(law),
        )  # fmt: skip
        if n_free > 0:
            cluster += n_free
            start += n_free * run
            continue
        n_run = min(run, points.shape[0] - start)
        place_run(columns, start, n_run, transform, place, scratch)
        for at in range(n_run):
            x, y, z = scratch[3, at], scratch[4, at], scratch[5, at]
            if not (0.0 <= x < side and 0.0 <= y < side and 0.0 <= z < side):
                continue
            i, j, k = np.int64(x), np.int64(y), np.int64(z)
            key = cell_key(i, j, k)
            if key != last_key:
                last_key = key
                slot, mask, n_missed = enter_cell(
                    keys, slots, masks, used, which, key, missed, n_missed
                )
            # bricks first: most of space is free, and the mask is in a register
            if not (mask >> brick_bit(i, j, k)) & np.uint64(1):
                if slot < 0:
                    n_unknown += 1
                continue
            is_hit = bit_in(words[slot, column_of(i, j)], k) != 0
            sample = sample_slot(law, payload, slot, x, y, z)
            if not (is_hit or sample <= reach(law)):
                continue
            n = start + at
            px, py, pz = scratch[0, at], scratch[1, at], scratch[2, at]
            depth, counted, nx, ny, nz = respond_at(
                law, is_hit, sample, transform, px, py, pz, points[n, 3], points[n, 4],
                points[n, 5], ox, oy, oz, size,
            )  # fmt: skip
            share = share_slot(law, payload, slot, x, y, z, nx, ny, nz, sample)
            depth *= share
            weight += counted * share
            if is_hit:
                met[n_hits] = n
                n_hits += 1
            if depth > 0.0:
                n_contacts += 1
                deepest = max(deepest, depth)
                fx, fy, fz, tx, ty, tz = accumulate(
                    fx, fy, fz, tx, ty, tz, px, py, pz, nx, ny, nz, mx, my, mz, depth, law.stiffness
                )
        cluster += 1
        start += n_run
    average_into(out, weight, fx, fy, fz, tx, ty, tz)
    out[HITS], out[CONTACTS] = n_hits, n_contacts
    out[UNKNOWNS], out[DEEPEST] = n_unknown, deepest
    missed[LISTED] = n_missed


@entry(
    CELLS, INT, CLUSTERS, FLOATS3, PLACE, TANGENT_PLANE, INTS, INTS, FLOATS2,
    also={CELLS: CELLS_WITH_DISTANCES, TANGENT_PLANE: DISTANCE_FIELD},
)  # fmt: skip
def feel_kernel(cells, reader, shell, poses, place, law, met, missed, out):
    """`felt` at poses (M, 4, 4) into out (M, RESULTS); met and missed are those of the last frame.

    Returns the number of poses done: fewer than M when one is not rigid.
    """
    for n in range(poses.shape[0]):
        if not is_rigid(poses[n]):
            return n
        which = begin_frame(cells, reader)
        felt(cells, which, shell, poses[n], place, law, met, missed, out[n])
        end_frame(cells, reader)
    return poses.shape[0]


@entry(FLOATS2, INT, FLOAT, FLOATS2)
def bounding_spheres(points, run, slack, out):
    """Sphere (C, 4) at the centre of the box of each run of points (N, 6), radius plus `slack`.

    The radius also has room for the stretch of a pose that `is_rigid` just accepts.
    """
    total = points.shape[0]
    for cluster in range(out.shape[0]):
        start = cluster * run
        end = min(start + run, total)
        for axis in range(3):
            low = high = points[start, axis]
            for n in range(start + 1, end):
                low = min(low, points[n, axis])
                high = max(high, points[n, axis])
            out[cluster, axis] = 0.5 * (low + high)
        furthest = 0.0
        for n in range(start, end):
            x = points[n, 0] - out[cluster, 0]
            y = points[n, 1] - out[cluster, 1]
            z = points[n, 2] - out[cluster, 2]
            furthest = max(furthest, x * x + y * y + z * z)
        out[cluster, 3] = np.sqrt(furthest) * (1.0 + 1e-5) + slack

"""From rows to a wrench: drop the false hits of a frame, and sum what its points feel.

Every sum runs in the order of the shell's points and every product is written out, so that each
strategy, layout, curve and engine gives the same wrench bit for bit (numba contracts no
multiplication and addition without fastmath, which this package never sets).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import (
    BYTES2,
    FLOAT,
    FLOATS,
    FLOATS2,
    INT,
    INTS,
    INTS2,
    NONE,
    READ_BYTES,
    entry,
    inlined,
    maker,
)
from hapticdb.kernels.field.lattice import ROW_VALUES
from hapticdb.kernels.field.law import DISTANCE_FIELD
from hapticdb.kernels.field.packing import unpack_rows
from hapticdb.kernels.law import (
    NOTHING_NEAR,
    TANGENT_PLANE,
    accumulate,
    average_into,
    depth_below_plane,
    reach,
    respond,
    sample_rows,
    share_rows,
)
from hapticdb.kernels.query.contact import center_of, voxel_at
from hapticdb.kernels.query.sorting import insert_distinct

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

Refined = tuple[Floats, Ints, Floats, Ints, Ints, Floats]
"""What `refine` returns.

wrench (6,): N and N m about the centre, world frame; hits (H,): indices of the shell's points
inside a voxel, ascending; depths (H,): depth of each hit in metres, 0 where the law feels nothing;
ids (I,): objects that the hits are in, and those that felt points touch, ascending; apart (A,):
points that the law feels although they are no hits, ascending; apart_depths (A,): their depths in
metres, above 0.
"""
NO_POINTS = np.empty(0, dtype=np.int64)
NO_DEPTHS = np.empty(0)


@maker
def _rows_of_keys(keys, row_keys):
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


@maker
def _counting_rows(row_ids, exclude):
    """Mask (R,) bool of the rows whose objects are not in exclude (E,), ascending and distinct.

    An excluded id has id - exclude[0] smaller ids before it, less the ids in between that are not
    excluded: the search begins between these bounds, which are close where almost all are excluded.
    """
    counts = np.empty(row_ids.shape[0], dtype=np.bool_)
    for row in range(row_ids.shape[0]):
        counts[row] = True
    total = exclude.shape[0]
    if total > 0:
        first, last = exclude[0], exclude[total - 1]
        n_between = last - first + 1 - total
        for row in range(row_ids.shape[0]):
            before = row_ids[row] - first
            if before < 0 or row_ids[row] > last:
                continue
            low, high = max(before - n_between, np.int64(0)), min(before, np.int64(total - 1))
            while low < high:
                middle = (low + high) >> 1
                if exclude[middle] < row_ids[row]:
                    low = middle + 1
                else:
                    high = middle
            counts[row] = exclude[low] != row_ids[row]
    return counts


@inlined
def _has_voxel(occupancy, row, address):
    """Whether a row has the voxel of an address; always true for a voxel row (no occupancy)."""
    if occupancy.shape[0] == 0:
        return True
    return (occupancy[64 * row + ((address & 511) >> 3)] >> (address & 7)) & 1 != 0


@inlined
def _distinct_ids(touched, row_ids, met, start):
    """Write the distinct ids of touched rows into met[start:], ascending -> number of ids."""
    count = np.int64(0)
    for row in range(row_ids.shape[0]):
        if touched[row]:
            count = insert_distinct(met, start, count, row_ids[row])
    return count


@inlined
def _touch_near_rows(
    law, payload, counts, touched, first, end, x, y, z, sample, is_hit,
    px, py, pz, nx, ny, nz, cx, cy, cz, size,
):  # fmt: skip
    """Mark the rows of the objects that a felt point touches, by each object's own sample.

    These are the objects that the point would feel alone. Between two objects the least distances,
    interpolated, may be below the onset although each object's own distance is not: then it is the
    nearest object. Nothing is marked under a law without samples, which feels hits alone.
    """
    if sample <= reach(law):
        n_touched = np.int64(0)
        nearest = np.int64(-1)
        least = NOTHING_NEAR
        for row in range(first, end):
            if counts[row]:
                own = sample_rows(law, payload, counts, row, row + 1, x, y, z)
                if own < least:
                    least = own
                    nearest = np.int64(row)
                if own <= reach(law):
                    depth, _ = respond(
                        law, is_hit, own, px, py, pz, nx, ny, nz, cx, cy, cz, size
                    )  # fmt: skip
                    if depth > 0.0:
                        depth *= share_rows(
                            law, payload, counts, row, row + 1, x, y, z, nx, ny, nz, own
                        )
                    if depth > 0.0:
                        touched[row] = True
                        n_touched += 1
        if n_touched == 0:
            touched[nearest] = True


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
    also={NONE: BYTES2, TANGENT_PLANE: DISTANCE_FIELD},
)
def refine_kernel(
    placed, asked, keys, row_keys, row_ids, occupancy, payload, exclude, origin, size, law,
    felt, met,
):  # fmt: skip
    """`refine` into felt (6 + 2 N,) and met (2 N + R,) -> H, A and I.

    felt takes the wrench, from 6 on the depths of the H hits, and from 6 + N on those of the A
    points that are felt only. met takes the H indices, from N on the A indices, and from 2 N on
    the I ids.
    """
    total = asked.shape[1]
    touched = np.zeros(row_ids.shape[0], dtype=np.bool_)
    starts, ends = _rows_of_keys(keys, row_keys)
    counts = _counting_rows(row_ids, exclude)
    ox, oy, oz = origin[0], origin[1], origin[2]
    mx, my, mz = placed[total, 0], placed[total, 1], placed[total, 2]
    fx = fy = fz = tx = ty = tz = weight = 0.0
    n_hits = n_apart = np.int64(0)
    for n in range(total):
        at = asked[1, n]
        if at < 0:
            continue
        px, py, pz = placed[n, 0], placed[n, 1], placed[n, 2]
        first, end = starts[at], ends[at]
        if first == end:
            continue
        x, y, z = (px - ox) / size, (py - oy) / size, (pz - oz) / size
        sample = sample_rows(law, payload, counts, first, end, x, y, z)
        is_hit = False
        for row in range(first, end):
            if counts[row] and _has_voxel(occupancy, row, asked[0, n]):
                is_hit = True
                touched[row] = True
        if not is_hit and not sample <= reach(law):
            continue
        nx, ny, nz = placed[n, 3], placed[n, 4], placed[n, 5]
        cx, cy, cz = center_of(px, ox, size), center_of(py, oy, size), center_of(pz, oz, size)
        depth, counted = respond(law, is_hit, sample, px, py, pz, nx, ny, nz, cx, cy, cz, size)
        share = share_rows(law, payload, counts, first, end, x, y, z, nx, ny, nz, sample)
        depth *= share
        weight += counted * share
        if is_hit:
            met[n_hits] = n
            felt[6 + n_hits] = max(depth, 0.0)
            n_hits += 1
        elif depth > 0.0:
            met[total + n_apart] = n
            felt[6 + total + n_apart] = depth
            n_apart += 1
        if depth > 0.0:
            _touch_near_rows(
                law, payload, counts, touched, first, end, x, y, z, sample, is_hit,
                px, py, pz, nx, ny, nz, cx, cy, cz, size,
            )  # fmt: skip
            fx, fy, fz, tx, ty, tz = accumulate(
                fx, fy, fz, tx, ty, tz, px, py, pz, nx, ny, nz, mx, my, mz, depth, law.stiffness
            )
    average_into(felt, weight, fx, fy, fz, tx, ty, tz)
    return n_hits, n_apart, _distinct_ids(touched, row_ids, met, 2 * total)


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
    occupancy (64 R,) uint8, or empty for voxel rows; payload (R, 1000) uint8, the rows' distances,
    or None for a law that reads none; exclude (E,) int64; origin (3,) and size of a voxel, metres.
    """
    total = asked.shape[1]
    felt = np.empty(6 + 2 * total)
    met = np.empty(2 * total + row_ids.shape[0], dtype=np.int64)
    n_hits, n_apart, n_ids = refine_kernel(
        placed, asked, keys, row_keys, row_ids, occupancy, payload, exclude, origin, size, law,
        felt, met,
    )  # fmt: skip
    wrench, hits, depths = felt[:6], met[:n_hits], felt[6 : 6 + n_hits]
    ids = met[2 * total : 2 * total + n_ids]
    if n_apart == 0:
        return wrench, hits, depths, ids, NO_POINTS, NO_DEPTHS
    apart, apart_depths = met[total : total + n_apart], felt[6 + total : 6 + total + n_apart]
    return wrench, hits, depths, ids, apart, apart_depths


@entry(
    FLOATS2, INTS2, INTS, INTS, INTS, READ_BYTES, NONE, INTS, FLOATS, FLOAT, TANGENT_PLANE, INTS,
    also={NONE: BYTES2, TANGENT_PLANE: DISTANCE_FIELD},
)  # fmt: skip
def pairs_of_points(
    placed, asked, keys, row_keys, row_ids, occupancy, payload, exclude, origin, size, law, chosen
):
    """Every (point, object) pair of chosen points (C,) of a frame, (P, 2) int64, ordered by both.

    A point touches the objects in whose voxel it is, and those of `_touch_near_rows`. The other
    arguments are those of `refine`.
    """
    starts, ends = _rows_of_keys(keys, row_keys)
    counts = _counting_rows(row_ids, exclude)
    touched = np.zeros(row_ids.shape[0], dtype=np.bool_)
    ox, oy, oz = origin[0], origin[1], origin[2]
    most = 0
    for c in range(chosen.shape[0]):
        at = asked[1, chosen[c]]
        most += ends[at] - starts[at]
    pairs = np.empty((most, 2), dtype=np.int64)
    count = 0
    for c in range(chosen.shape[0]):
        n = chosen[c]
        at = asked[1, n]
        first, end = starts[at], ends[at]
        is_hit = False
        for row in range(first, end):
            touched[row] = counts[row] and _has_voxel(occupancy, row, asked[0, n])
            is_hit |= touched[row]
        px, py, pz = placed[n, 0], placed[n, 1], placed[n, 2]
        x, y, z = (px - ox) / size, (py - oy) / size, (pz - oz) / size
        sample = sample_rows(law, payload, counts, first, end, x, y, z)
        nx, ny, nz = placed[n, 3], placed[n, 4], placed[n, 5]
        cx, cy, cz = center_of(px, ox, size), center_of(py, oy, size), center_of(pz, oz, size)
        _touch_near_rows(
            law, payload, counts, touched, first, end, x, y, z, sample, is_hit,
            px, py, pz, nx, ny, nz, cx, cy, cz, size,
        )  # fmt: skip
        for row in range(first, end):
            if touched[row]:
                pairs[count, 0] = n
                pairs[count, 1] = row_ids[row]
                count += 1
    return pairs[:count]


@maker
def is_asked(keys, row_keys):
    """Mask (R,) bool of the rows whose key is among those that a shell asks for: no false hits.

    keys (U,) and row_keys (R,) int64, both ascending.
    """
    found = np.empty(row_keys.shape[0], dtype=np.bool_)
    at = 0
    for row in range(row_keys.shape[0]):
        while at < keys.shape[0] and keys[at] < row_keys[row]:
            at += 1
        found[row] = at < keys.shape[0] and keys[at] == row_keys[row]
    return found


@entry(INTS, INTS, READ_BYTES, INTS, BYTES2)
def unpack_asked_kernel(keys, row_keys, data, ends, out):
    """`unpack_asked` into out (R, 1000); return the first row that is damaged, or -1."""
    return unpack_rows(data, ends, is_asked(keys, row_keys), out)


def unpack_asked(
    keys: Ints, row_keys: Ints, data: NDArray[np.uint8], ends: Ints
) -> NDArray[np.uint8]:
    """Unpack the distances of those rows whose keys a shell asks for: (R, 1000) uint8.

    keys (U,) and row_keys (R,) int64, both ascending; data (n,) and ends (R,) as `packing.pack`
    gives them. Rows of other keys, the false hits, are left unset.

    Raises
    ------
    ValueError
        If the bytes of a row that is asked for are no packed row.
    """
    if data.flags.writeable:
        data = data.view()
        data.flags.writeable = False
    out = np.empty((row_keys.shape[0], ROW_VALUES), dtype=np.uint8)
    damaged = unpack_asked_kernel(keys, row_keys, data, ends, out)
    if damaged >= 0:
        raise ValueError(f"row {damaged} of {len(ends)} packed rows of distances is damaged")
    return out


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

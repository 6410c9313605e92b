"""From rows to a wrench: drop the false hits of a frame, and sum the forces on its points.

Every sum runs in the order of the shell's points and every product is written out, so that each
strategy, layout, curve and engine gives the same wrench bit for bit (numba contracts no
multiplication and addition without fastmath, which this package never sets).
"""

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import (
    BYTES2,
    FLOATS,
    FLOATS2,
    INTS,
    INTS2,
    NONE,
    READ_BYTES,
    entry,
    inlined,
    maker,
    record_of,
)
from hapticdb.kernels.field.distance_law import DISTANCE_FIELD
from hapticdb.kernels.force_law import (
    NO_WRENCH,
    NOTHING_NEAR,
    TANGENT_PLANE,
    accumulate,
    average_into,
    reach,
    respond,
    sample_rows,
    share_rows,
)
from hapticdb.kernels.query.key_ranges import first_bound
from hapticdb.kernels.query.shell_keys import center_of, voxel_at
from hapticdb.kernels.query.sorting import insert_distinct
from hapticdb.kernels.records.rows import GRID

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@maker
def _rows_of_keys(keys, row_keys):
    """Start and end of the rows of each requested key, (U,) int64 each.

    One merge of two ascending lists; rows of other keys are the false hits.
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
    """Mask (R,) bool of the rows whose objects are not in exclude (E,), ascending and distinct."""
    counts = np.empty(row_ids.shape[0], dtype=np.bool_)
    for row in range(row_ids.shape[0]):
        counts[row] = is_included(row_ids[row], exclude)
    return counts


@inlined
def is_included(object_id, exclude):
    """Whether an object is not in exclude (E,), ascending and distinct.

    The search starts at a lower bound of the id's index: id - exclude[0], less the number of gaps
    in `exclude`. The bound is tight if almost all objects are excluded.
    """
    total = exclude.shape[0]
    # most ids are outside the excluded range: no search
    if total == 0 or object_id < exclude[0] or object_id > exclude[total - 1]:
        return True
    before, n_between = object_id - exclude[0], exclude[total - 1] - exclude[0] + 1 - total
    at = first_bound(object_id, exclude, max(before - n_between, np.int64(0)))
    return exclude[at] != object_id


@inlined
def _has_voxel(occupancy, row, address):
    """Whether a row occupies the voxel of an address; always true for a voxel row."""
    if occupancy.shape[0] == 0:
        return True
    # the lowest 9 bits of an address: byte of 2^3 voxels, then bit
    return (occupancy[64 * row + ((address & 511) >> 3)] >> (address & 7)) & 1 != 0


@inlined
def _distinct_ids(touched, row_ids, indices, start):
    """Write the distinct ids of touched rows into `indices[start:]`, ascending -> number of ids."""
    count = np.int64(0)
    for row in range(row_ids.shape[0]):
        if touched[row]:
            count = insert_distinct(indices, start, count, row_ids[row])
    return count


BY_DISTANCE = {NONE: BYTES2, TANGENT_PLANE: DISTANCE_FIELD}


@inlined
def _point_at(placed, n, place):
    """Point n of a placed shell, its normal, and the centre of its voxel: nine numbers, metres."""
    x, y, z = placed[n, 0], placed[n, 1], placed[n, 2]
    return (
        x, y, z, placed[n, 3], placed[n, 4], placed[n, 5], center_of(x, place.x, place.voxel),
        center_of(y, place.y, place.voxel), center_of(z, place.z, place.voxel),
    )  # fmt: skip


@inlined
def _in_grid(placed, n, place):
    """Point n of a placed shell in voxels from the grid's origin."""
    x, y, z = placed[n, 0] - place.x, placed[n, 1] - place.y, placed[n, 2] - place.z
    return x / place.voxel, y / place.voxel, z / place.voxel


@inlined
def _share_of(law, payload, counts, first, end, at, point, sample):
    """Share of a point at `at`, in voxels from the grid's origin, by rows first .. end - 1."""
    return share_rows(law, payload, counts, first, end, *at, point[3], point[4], point[5], sample)


@inlined
def _touch_near_rows(law, payload, counts, touched, first, end, at, point, size, sample, is_hit):
    """Mark the rows of the objects in contact with a point, by each object's own sample.

    An object is in contact if the law gives a depth for it alone. Between two objects the
    interpolated least distances may be below the onset although each object's own distance is
    above; then the nearest object is marked. A law without samples marks nothing: its contacts are
    hits.
    """
    if not sample <= reach(law):
        return
    n_unknown = 0
    # touched before by another point: no new object to find
    for row in range(first, end):
        if counts[row] and not touched[row]:
            n_unknown += 1
    if n_unknown == 0:
        return
    if end - first == 1:  # the least distance is its own
        touched[first] = True
        return
    n_touched, nearest, least = np.int64(0), np.int64(-1), NOTHING_NEAR
    for row in range(first, end):
        if not counts[row]:
            continue
        own = sample_rows(law, payload, counts, row, row + 1, *at)  # this object's distance alone
        if own < least:
            nearest, least = np.int64(row), own
        if own <= reach(law):
            depth, _ = respond(law, is_hit, own, *point, size)
            if depth > 0.0:
                depth *= _share_of(law, payload, counts, row, row + 1, at, point, own)
            if depth > 0.0:
                touched[row] = True
                n_touched += 1
    if n_touched == 0:
        touched[nearest] = True


NO_TALLY = (NO_WRENCH, 0.0, 0, 0)
"""Initial sums: force and torque, weights, hits, and contacts without a hit."""


@inlined
def accumulate_point(
    law, payload, counts, touched, occupancy, rows, least, n, address, placed, place, result,
    indices, tally,
):  # fmt: skip
    """Evaluate the law at point n of a placed shell; return the tally with the point added.

    rows : first row of the point's brick and the row behind its last; least : the same of the rows
    with the brick's least distances; `result`, `indices` as for `refine`; `tally` as `NO_TALLY`.
    """
    total = placed.shape[0] - 1
    first, end = rows
    low, high = least
    sums, weight, n_hits, n_apart = tally
    at = _in_grid(placed, n, place)
    # the force follows the least distance of all objects, as in the resident cells
    sample = sample_rows(law, payload, counts, low, high, *at)
    is_hit = False
    for row in range(first, end):
        if counts[row] and _has_voxel(occupancy, row, address):
            is_hit = True
            touched[row] = True
    # negated comparison: NaN, too, is out of reach
    if not is_hit and not sample <= reach(law):
        return tally
    point = _point_at(placed, n, place)
    depth, counted = respond(law, is_hit, sample, *point, place.voxel)
    share = _share_of(law, payload, counts, low, high, at, point, sample)
    depth *= share
    weight += counted * share
    if is_hit:
        indices[n_hits] = n
        result[6 + n_hits] = max(depth, 0.0)
        n_hits += 1
    elif depth > 0.0:
        # second half of the array: hits and other contacts grow without a count in advance
        indices[total + n_apart] = n
        result[6 + total + n_apart] = depth
        n_apart += 1
    if depth > 0.0:
        _touch_near_rows(
            law, payload, counts, touched, first, end, at, point, place.voxel, sample, is_hit
        )
        center = placed[total, 0], placed[total, 1], placed[total, 2]
        sums = accumulate(sums, point, center, depth, law.stiffness)
    return sums, weight, n_hits, n_apart


@entry(
    FLOATS2, INTS2, INTS, INTS, INTS, READ_BYTES, NONE, INTS, record_of(GRID), TANGENT_PLANE,
    FLOATS, INTS, also=BY_DISTANCE,
)  # fmt: skip
def refine(
    placed,
    addresses,
    keys,
    row_keys,
    row_ids,
    occupancy,
    payload,
    exclude,
    grid,
    law,
    result,
    indices,
):
    """Drop the false hits of a frame's rows and sum the wrench of its contacts -> H, A and I.

    `placed`, `addresses`, `keys` of `Located`; row_keys (R,), ascending, and row_ids (R,);
    occupancy (64 R,), or empty for voxel rows; payload (R, 1000), the rows' distances, or None for
    a law without payload; exclude (E,), ascending.

    Output `result` (6 + 2 N,): wrench about the centre, world frame, N and N m; from 6 on the
    depths of the H hits, metres, 0 without contact; from 6 + N on those of the A contacts without a
    hit. Output `indices` (2 N + R,): the H indices, ascending; from N on the A indices; from 2 N on
    the I ids of the objects around the hits or in contact.
    """
    place, total = grid[()], addresses.shape[1]
    touched = np.zeros(row_ids.shape[0], dtype=np.bool_)
    starts, ends = _rows_of_keys(keys, row_keys)
    counts = _counting_rows(row_ids, exclude)
    tally = NO_TALLY
    for n in range(total):
        if addresses[1, n] < 0:
            continue
        rows = starts[addresses[1, n]], ends[addresses[1, n]]
        if rows[0] != rows[1]:
            tally = accumulate_point(
                law, payload, counts, touched, occupancy, rows, rows, n, addresses[0, n], placed,
                place, result, indices, tally,
            )  # fmt: skip
    sums, weight, n_hits, n_apart = tally
    average_into(result, weight, sums)
    return n_hits, n_apart, _distinct_ids(touched, row_ids, indices, 2 * total)


@entry(
    FLOATS2, INTS2, INTS, INTS, INTS, READ_BYTES, NONE, INTS, record_of(GRID), TANGENT_PLANE, INTS,
    also=BY_DISTANCE,
)  # fmt: skip
def pairs_of_points(
    placed, addresses, keys, row_keys, row_ids, occupancy, payload, exclude, grid, law, chosen
):
    """Touching (point, object) pairs (P, 2) of chosen points (C,) of a frame, ordered by both.

    A point touches the objects occupying its voxel, and those of `_touch_near_rows`. The other
    arguments are those of `refine`.
    """
    place = grid[()]
    starts, ends = _rows_of_keys(keys, row_keys)
    counts = _counting_rows(row_ids, exclude)
    touched = np.zeros(row_ids.shape[0], dtype=np.bool_)
    # counted first: one allocation, at its upper bound
    most = 0
    for c in range(chosen.shape[0]):
        slot = addresses[1, chosen[c]]
        most += ends[slot] - starts[slot]
    pairs = np.empty((most, 2), dtype=np.int64)
    count = 0
    for c in range(chosen.shape[0]):
        n = chosen[c]
        first, end = starts[addresses[1, n]], ends[addresses[1, n]]
        is_hit = False
        for row in range(first, end):
            # reset by assignment: marks of the point before do not stay
            touched[row] = counts[row] and _has_voxel(occupancy, row, addresses[0, n])
            is_hit |= touched[row]
        at = _in_grid(placed, n, place)
        sample = sample_rows(law, payload, counts, first, end, *at)
        point = _point_at(placed, n, place)
        _touch_near_rows(
            law, payload, counts, touched, first, end, at, point, place.voxel, sample, is_hit
        )
        for row in range(first, end):
            if touched[row]:
                pairs[count, 0] = n
                pairs[count, 1] = row_ids[row]
                count += 1
    return pairs[:count]


@entry(INTS, INTS)
def requested_rows(keys, row_keys):
    """Mask (R,) of the rows with requested keys; the others are the false hits.

    keys (U,) and row_keys (R,) int64, both ascending.
    """
    starts, ends = _rows_of_keys(keys, row_keys)
    is_requested = np.zeros(row_keys.shape[0], dtype=np.bool_)
    for n in range(keys.shape[0]):
        for row in range(starts[n], ends[n]):
            is_requested[row] = True
    return is_requested


@entry(FLOATS2, INTS, INTS, record_of(GRID), TANGENT_PLANE, FLOATS)
def wrench_of_addresses(placed, ordinals, addresses, grid, law, depths):
    """Wrench (6,) of hits given as ordinals (H,), ascending, and addresses (H,) int64.

    The paper's ``force(point, z_val)``: the voxel's centre comes from the address alone. For laws
    without payload. Output depths (H,): of each hit, metres, 0 above its tangent plane.
    """
    place, last = grid[()], placed.shape[0] - 1
    size = place.voxel
    center = placed[last, 0], placed[last, 1], placed[last, 2]
    sums, weight = NO_WRENCH, 0.0
    for h in range(ordinals.shape[0]):
        i, j, k = voxel_at(addresses[h], place.bits, place.curve, place.shift)
        n = ordinals[h]
        point = (
            placed[n, 0], placed[n, 1], placed[n, 2], placed[n, 3], placed[n, 4], placed[n, 5],
            place.x + size * (i + 0.5), place.y + size * (j + 0.5), place.z + size * (k + 0.5),
        )  # fmt: skip
        depth, share = respond(law, True, NOTHING_NEAR, *point, size)
        weight += share
        depths[h] = max(depth, 0.0)
        if depth > 0.0:
            sums = accumulate(sums, point, center, depth, law.stiffness)
    wrench = np.empty(6)
    average_into(wrench, weight, sums)
    return wrench

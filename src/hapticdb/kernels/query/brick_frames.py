"""Frame over a cache of decoded bricks: one call if all of its bricks are cached.

A brick is a range of slots, one row for each object near it. A point is sampled from the least
distances over the rows not excluded: the only such row, or an extra slot behind the brick's rows.
The sums are those of `refining`, over the same numbers in the same order.
"""

import numpy as np

from hapticdb.kernels._jit import (
    BOOL,
    FLOATS,
    FLOATS2,
    INT,
    INTS,
    INTS2,
    READ_BYTES,
    READ_FLOATS,
    READ_FLOATS2,
    entry,
    inlined,
    maker,
    record_of,
)
from hapticdb.kernels.field.distance_law import DISTANCE_FIELD
from hapticdb.kernels.field.lattice import ROW_VALUES
from hapticdb.kernels.field.packing import unpack_one, unpacking_memory
from hapticdb.kernels.force_law import TANGENT_PLANE, average_into
from hapticdb.kernels.query.refining import NO_TALLY, accumulate_point, is_included
from hapticdb.kernels.query.shell_keys import (
    address_of,
    new_table,
    number_of_key,
    place_shell,
)
from hapticdb.kernels.query.sorting import insert_distinct, sorting_order
from hapticdb.kernels.records.rows import BRICK, GRID, MEASURED, OCCUPIED
from hapticdb.kernels.resident.cells import spread_key
from hapticdb.kernels.rigid import is_rigid, transform_of

NOT_RIGID, INCOMPLETE = -1, -2
"""Results in place of the number of hits: pose not rigid; some bricks not cached."""


BY_DISTANCE = {record_of(OCCUPIED): record_of(MEASURED), TANGENT_PLANE: DISTANCE_FIELD}


@inlined
def _entry_of(directory, key):
    """Index of a key's entry in the directory, or of the free entry at the end of its probe."""
    # locality: the 8 bricks of a cube are neighbours, so a frame touches few pages
    at = (spread_key(key >> 3, directory.shape[0] >> 3) << 3) | (key & 7)
    while directory[at].end != 0 and directory[at].key != key:
        at = (at + 1) & (directory.shape[0] - 1)
    return at


@inlined
def _set_least(rows, first, end):
    """Write the minimum distances over the rows not excluded to the slot behind them."""
    # the slot behind the rows is a row of its own: the frame reads it without a special case
    rows.counts[end] = True
    for value in range(rows.distances.shape[1]):
        rows.distances[end, value] = 255
    for row in range(first, end):
        if rows.counts[row]:
            for value in range(rows.distances.shape[1]):
                here = rows.distances[row, value]
                rows.distances[end, value] = min(rows.distances[end, value], here)


@inlined
def _choose(brick, rows, exclude, number):
    """Apply a filter of that number to a brick: mark the rows that count and set its least slot."""
    first, end = np.int64(brick.first), np.int64(brick.end)
    least, n_contacts = np.int64(-1), 0
    for row in range(first, end):
        rows.counts[row] = is_included(rows.id[row], exclude)
        if rows.counts[row]:
            least = np.int64(row)
            n_contacts += 1
    # one row counts: it is its own minimum, without a copy
    if n_contacts > 1:
        least = end
        _set_least(rows, first, end)
    # cached under the filter's number: recomputed only after the filter has changed
    brick.least, brick.filter = np.int32(least), np.int32(number)


@maker
def _missing_keys(directory, addresses, keys):
    """Write the distinct keys of uncached bricks, ascending; return their number."""
    found, count = np.empty(addresses.shape[1], dtype=np.int64), np.int64(0)
    table = new_table(addresses.shape[1])
    for n in range(addresses.shape[1]):
        if addresses[1, n] >= 0 and directory[addresses[1, n]].end == 0:
            number = number_of_key(table, found, count, addresses[0, n] >> 9)
            count = max(count, number + 1)
    # ascending, as `enter_bricks` merges them with the fetched rows
    order = sorting_order(found[:count])
    for n in range(count):
        keys[n] = found[order[n]]
    return count


@inlined
def _find_touched(directory, rows, addresses):
    """Write the distinct ids of touched rows to `rows.found`, ascending, and clear the marks."""
    count = np.int64(0)
    for n in range(addresses.shape[1]):
        at = addresses[1, n]
        # points in the same brick are neighbours: most repeated bricks are skipped here
        if at < 0 or (n > 0 and at == addresses[1, n - 1]):
            continue
        for row in range(directory[at].first, directory[at].end):
            if rows.touched[row]:
                # cleared here, touched rows alone: no reset of the whole cache at each frame
                rows.touched[row] = False
                count = insert_distinct(rows.found, 0, count, rows.id[row])
    return count


@inlined
def _find_bricks(directory, addresses):
    """Set the directory indices of the addresses' bricks; return whether all are cached."""
    is_complete, last_key, last_at = True, np.int64(-1), np.int64(-1)
    for n in range(addresses.shape[1]):
        if addresses[0, n] < 0:
            addresses[1, n] = -1
            continue
        row_key = addresses[0, n] >> 9
        if row_key != last_key:
            last_key, last_at = row_key, _entry_of(directory, row_key)
            # goes on after a missing brick: one fetch is to bring all of them
            is_complete &= directory[last_at].end != 0
        addresses[1, n] = last_at
    return is_complete


@entry(
    READ_FLOATS2, READ_FLOATS2, READ_FLOATS, FLOATS2, record_of(GRID), record_of(BRICK, 1),
    record_of(OCCUPIED), INTS, INT, TANGENT_PLANE, BOOL, FLOATS2, INTS2, FLOATS, INTS,
    also=BY_DISTANCE,
)  # fmt: skip
def touch_bricks(
    points, normals, center, pose, grid, directory, decoded, exclude, number, law, is_new, placed,
    addresses, result, indices,
):  # fmt: skip
    """Evaluate a shell at a pose -> hits H, other contacts A, and ids I, these in `rows.found`.

    points, normals (N, 3) and center (3,), tool frame; pose (4, 4), world_from_tool; directory (C,)
    and cached rows; exclude (E,) object ids, ascending, of the filter of that number; is_new :
    false if an earlier call placed the shell. Outputs: placed as from `locate`; `result` and
    `indices` (2 N,) as from `refine`, without ids; `addresses` (2, N), addresses and indices in the
    directory, -1 outside the grid.

    Returns `INCOMPLETE` and the number of uncached bricks, their keys in `indices`, ascending, if
    there are any; `NOT_RIGID` for a pose that is not rigid.
    """
    if not is_rigid(pose):
        return np.int64(NOT_RIGID), np.int64(0), np.int64(0)
    place, rows = grid[()], decoded[()]
    if is_new:
        place_shell(points, normals, center, transform_of(pose), placed)
        for n in range(addresses.shape[1]):
            _, addresses[0, n] = address_of(placed, n, place)
    if not _find_bricks(directory, addresses):
        return np.int64(INCOMPLETE), _missing_keys(directory, addresses, indices), np.int64(0)
    occupancy = rows.occupancy.reshape(-1)
    tally = NO_TALLY
    for n in range(addresses.shape[1]):
        if addresses[1, n] < 0:
            continue
        brick = directory[addresses[1, n]]
        if brick.filter != number:
            _choose(brick, rows, exclude, number)
        least = np.int64(brick.least)
        if least >= 0:
            tally = accumulate_point(
                law, rows.distances, rows.counts, rows.touched, occupancy,
                (np.int64(brick.first), np.int64(brick.end)), (least, least + 1), n,
                addresses[0, n], placed, place, result, indices, tally,
            )  # fmt: skip
    sums, weight, n_hits, n_apart = tally
    average_into(result, weight, sums)
    return n_hits, n_apart, _find_touched(directory, rows, addresses)


@entry(record_of(BRICK, 1), record_of(BRICK, 1))
def copy_entries(directory, larger):
    """Rehash the bricks of a directory into a larger one."""
    for at in range(directory.shape[0]):
        if directory[at].end != 0:
            larger[_entry_of(larger, directory[at].key)] = directory[at]


@entry(record_of(BRICK, 1), INTS, INTS)
def absent_bricks(directory, keys, found):
    """Write the keys (U,) absent from the directory to `found` (U,); return their number."""
    count = 0
    for n in range(keys.shape[0]):
        if directory[_entry_of(directory, keys[n])].end == 0:
            found[count] = keys[n]
            count += 1
    return count


@maker
def _decode(rows, slots, bits, data, ends):
    """Decode fetched rows into their slots, except slots < 0 -> -1, or the first damaged row.

    A loop of its own: interleaved with the directory's probes, unpacking takes a third longer.
    """
    memory, has_distances = unpacking_memory(), rows.distances.shape[1] == ROW_VALUES
    for row in range(slots.shape[0]):
        if slots[row] < 0:
            continue
        to, first = np.uint64(slots[row]), np.uint64(64 * row)  # unsigned: LLVM copies vectors
        for byte in range(np.uint64(64)):
            rows.occupancy[to, byte] = bits[first + byte]
        if has_distances and not unpack_one(data, ends, row, memory, rows.distances, slots[row]):
            return row
    return -1


@entry(
    record_of(BRICK, 1), record_of(OCCUPIED), INTS, INTS, INTS, READ_BYTES, READ_BYTES, INTS, INT,
    also=BY_DISTANCE,
)  # fmt: skip
def enter_bricks(directory, decoded, keys, row_keys, row_ids, bits, data, ends, used):
    """Enter bricks into the cache and decode their rows into slots from `used` on.

    keys (U,) of uncached bricks, ascending; row_keys (R,), ascending, row_ids (R,) and occupancy
    bits (64 R,) of fetched rows, other bricks' rows allowed; data (n,), ends (R,): packed
    distances. Needs R + R / 2 free slots. Returns the next free slot, or -1 - r if row r is
    damaged.
    """
    slots, rows = np.full(row_keys.shape[0], -1, dtype=np.int64), decoded[()]
    row = 0
    for n in range(keys.shape[0]):
        key, first = keys[n], used
        while row < row_keys.shape[0] and row_keys[row] < key:
            row += 1
        while row < row_keys.shape[0] and row_keys[row] == key:
            slots[row], rows.id[used] = used, row_ids[row]
            used += 1
            row += 1
        brick = directory[_entry_of(directory, key)]
        brick.key, brick.first, brick.end = key, np.int32(first), np.int32(used)
        # no filter has this number: the first frame chooses
        brick.least, brick.filter = np.int32(-1), np.int32(-1)
        if used - first > 1:
            used += 1  # for the least
    damaged = _decode(rows, slots, bits, data, ends)
    return used if damaged < 0 else -1 - damaged

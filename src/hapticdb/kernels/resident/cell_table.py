"""The writer's side of a cell table: edit directories, fill cells from rows, free slots."""

import numpy as np

from hapticdb.kernels._jit import (
    BYTES,
    BYTES2,
    FLOAT,
    FLOATS,
    FLOATS2,
    FLOATS3,
    INT,
    INTS,
    INTS2,
    INTS32_2,
    READ_BYTES,
    WORDS,
    WORDS32_2,
    entry,
    leaf,
)
from hapticdb.kernels.curves import compact, decode, encode, voxel_of
from hapticdb.kernels.field.lattice import (
    BEYOND,
    CELL_VALUES,
    cell_place,
    row_place,
)
from hapticdb.kernels.query.grouping import first_bound
from hapticdb.kernels.resident.cells import (
    BUFFERS,
    PLACE,
    READER_STRIDE,
    REVISION,
    VERSION,
    Ints,
    brick_bit,
    cell_key,
    cell_of_key,
    column_of,
    key_of_cell,
    place_in_set,
    slot_of,
    spread_key,
)
from hapticdb.kernels.resident.fence import fence
from hapticdb.kernels.rigid import moved, transform_of

NEVER_AGAIN = 0x7FFFFFFFFFFFFFFF
"""`wanted_at` of a slot that is already chosen for freeing: later than every `since`."""


@entry(INTS2, INTS32_2, INT, INTS, INTS)
def insert_cells(keys, slots, which, new_keys, new_slots):
    """Enter cells (n,) in directory `which`; cells that are there already get the new slots."""
    for n in range(new_keys.shape[0]):
        at = place_in_set(keys[which], new_keys[n])
        slots[which, at] = new_slots[n]
        keys[which, at] = new_keys[n]


@entry(INTS2, INTS32_2, INT, INTS)
def remove_cells(keys, slots, which, old_keys):
    """Remove cells (n,) from directory `which`; later entries of the same run move up."""
    capacity = keys.shape[1]
    for n in range(old_keys.shape[0]):
        at = hole = place_in_set(keys[which], old_keys[n])
        if keys[which, at] < 0:
            continue
        while True:
            at = (at + 1) & (capacity - 1)
            if keys[which, at] < 0:
                break
            home = spread_key(keys[which, at], capacity)
            # move an entry only if its search, from its home, passes the hole (going round)
            if ((at - home) & (capacity - 1)) >= ((at - hole) & (capacity - 1)):
                keys[which, hole] = keys[which, at]
                slots[which, hole] = slots[which, at]
                hole = at
        keys[which, hole] = -1


@entry(INTS2, INTS32_2, INT, INTS, INTS)
def slots_of_cells(keys, slots, which, asked, out):
    """Write slots (n,) of cells (n,) in directory `which`, UNKNOWN for a cell without an entry."""
    for n in range(asked.shape[0]):
        out[n] = slot_of(keys, slots, which, asked[n])


@leaf
def _is_in(number, numbers):
    """Whether a number is among numbers (n,), ascending."""
    at = first_bound(number, numbers, np.int64(0))
    return at < numbers.shape[0] and numbers[at] == number


@leaf
def _mark_brick(masks, slot, i, j, k):
    """Mark the brick that holds voxel (i, j, k) in the mask of its cell's slot."""
    masks[slot] |= np.uint64(1) << brick_bit(i, j, k)


@leaf
def _fill_brick(words, slot, i, j, k, occupancy, start):
    """Set the voxels of the brick at (i, j, k), bytes from `start` -> whether it has a voxel."""
    has_any = False
    for byte in range(64):
        value = occupancy[start + byte]
        if value == 0:
            continue
        has_any = True
        x = (i & 31) | (compact(byte >> 2) << 1)
        y = (j & 31) | (compact(byte >> 1) << 1)
        z = (k & 31) | (compact(byte) << 1)
        for column in range(4):  # a byte is 2 x 2 x 2 voxels, k the lowest bit
            two = np.uint32((value >> (2 * column)) & 3)
            word = ((x | (column >> 1)) << 5) | y | (column & 1)
            words[slot, word] |= two << np.uint32(z)
    return has_any


@entry(INTS, INTS, READ_BYTES, INTS, INTS, INTS, INT, INT, INT, WORDS32_2, WORDS)
def fill_cells(
    row_keys, row_ids, occupancy, exclude, cell_keys, places, bits, curve, shift, words, masks
):
    """Fill empty cells from rows of the index table.

    row_keys (R,) ascending, row_ids (R,), occupancy (64 R,) or empty for voxel rows; exclude (E,)
    ids to leave out, ascending; cell_keys (n,) of the cells on the curve (voxel keys >> 15),
    ascending; places (n,) their slots in words (S, 1024) uint32 and masks (S,) uint64. Rows of
    other cells are skipped.
    """
    n_cells = cell_keys.shape[0]
    has_bits = occupancy.shape[0] > 0
    at = 0
    for row in range(row_keys.shape[0]):
        row_key = row_keys[row]
        cell = row_key >> (15 - shift)
        while at < n_cells and cell_keys[at] < cell:
            at += 1
        if at == n_cells:
            break
        if cell_keys[at] != cell:
            continue
        if _is_in(row_ids[row], exclude):
            continue
        slot = places[at]
        if has_bits:
            i, j, k = voxel_of(row_key, max(bits - 3, 0), curve)
            i, j, k = i << 3, j << 3, k << 3
            if _fill_brick(words, slot, i, j, k, occupancy, 64 * row):
                _mark_brick(masks, slot, i, j, k)
        else:
            i, j, k = voxel_of(row_key, bits, curve)
            words[slot, column_of(i, j)] |= np.uint32(1) << np.uint32(k & 31)
            _mark_brick(masks, slot, i, j, k)


@leaf
def _merge_row(payload, slot, i, j, k, last, values, row):
    """Lower a slot's distances to those of the brick at (i, j, k), in `row` of values (R, 1000).

    Of the row's outer layer only what lies outside the cell is written. A centre in the cell
    belongs to a brick of the cell, whose own row has it; without such a row it is BEYOND. last:
    where the cell's last brick begins on each axis: 24, or less in a grid smaller than a cell.
    """
    i, j, k = i & 31, j & 31, k & 31
    low_i, low_j = -1 if i == 0 else 0, -1 if j == 0 else 0
    high_i, high_j = 9 if i == last else 8, 9 if j == last else 8
    for x in range(low_i, high_i):
        for y in range(low_j, high_j):
            at = cell_place(i + x, j + y, k)
            start = row_place(x, y, 0)
            for z in range(8):
                payload[slot, at + z] = min(payload[slot, at + z], values[row, start + z])
            if k == 0:
                payload[slot, at - 1] = min(payload[slot, at - 1], values[row, start - 1])
            if k == last:
                payload[slot, at + 8] = min(payload[slot, at + 8], values[row, start + 8])


@entry(INTS, INTS, BYTES2, INTS, INTS, INTS, INT, INT, INT, BYTES2, WORDS)
def fill_distances(
    row_keys, row_ids, values, exclude, cell_keys, places, bits, curve, before, payload, masks
):
    """Fill the distances of cells from rows of the band; `fill_cells` has filled their voxels.

    row_keys (R,) of bricks, ascending; values (R, 1000) uint8, unpacked; payload (S, 34^3) uint8;
    before: the slot that the rows of an earlier call have filled last, or -1; the other arguments
    are those of `fill_cells`. What a slot held is forgotten when its first row comes; a slot
    without a row stays as it was, and its mask has no bit. Returns the slot that was filled last.
    """
    n_cells = cell_keys.shape[0]
    at = 0
    last_brick = min(1 << bits, 32) - 8
    for row in range(row_keys.shape[0]):
        cell = row_keys[row] >> 6
        while at < n_cells and cell_keys[at] < cell:
            at += 1
        if at == n_cells:
            break
        if cell_keys[at] != cell:
            continue
        if _is_in(row_ids[row], exclude):
            continue
        slot = places[at]
        if slot != before:
            before = slot
            for n in range(CELL_VALUES):
                payload[slot, n] = BEYOND
        i, j, k = voxel_of(row_keys[row], max(bits - 3, 0), curve)
        i, j, k = i << 3, j << 3, k << 3
        _merge_row(payload, slot, i, j, k, last_brick, values, row)
        _mark_brick(masks, slot, i, j, k)
    return before


def curve_keys_of_cells(cells: Ints, bits: int, curve: int) -> Ints:
    """Keys on the curve (voxel keys >> 15) of cells (n,), given by directory keys."""
    ijk = np.stack([cells >> 32, (cells >> 16) & 0xFFFF, cells & 0xFFFF], axis=1)
    return encode(ijk, max(bits - 5, 0), curve)


def cells_of_curve_keys(curve_keys: Ints, bits: int, curve: int) -> Ints:
    """Directory keys of cells (n,) on the curve; undoes `curve_keys_of_cells`."""
    i, j, k = decode(curve_keys, max(bits - 5, 0), curve).T
    cells: Ints = (i << 32) | (j << 16) | k
    return cells


@entry(INTS, INTS, BYTES, INT, INT, INT, INTS)
def slots_to_free(cell_of_slot, wanted_at, used, since, hand, wanted, out):
    """Clock eviction: choose slots of cells that no frame has used since the hand last passed.

    cell_of_slot (S,) int64, -1 where free; wanted_at (S,) int64: slots wanted at `since` or later
    stay; used (S,) uint8 is cleared as the hand passes. hand is the slot at which the clock's hand
    is. Up to `wanted` slots go into out. Returns their number and the new hand.
    """
    total = cell_of_slot.shape[0]
    count = 0
    for _ in range(2 * total):
        if count == wanted:
            break
        hand += 1
        if hand >= total:
            hand = 1
        if cell_of_slot[hand] < 0 or wanted_at[hand] >= since:
            continue
        if used[hand]:
            used[hand] = 0
            continue
        wanted_at[hand] = NEVER_AGAIN
        out[count] = hand
        count += 1
    return count, hand


@entry(INTS, INT, INT)
def publish(control, version, revision):
    """Publish a directory that is complete in its buffer: new frames read it from now on."""
    control[REVISION + version % BUFFERS] = revision
    fence()
    control[VERSION] = version
    fence()


@entry(INTS)
def oldest_version_read(readers):
    """Lowest version that a frame is reading; the largest int64 when no frame is reading."""
    fence()
    oldest = np.int64(0x7FFFFFFFFFFFFFFF)
    for n in range(0, readers.shape[0], READER_STRIDE):
        if readers[n] > 0:
            oldest = min(oldest, readers[n])
    return oldest


@entry(INTS, INTS, FLOATS, FLOATS, FLOAT, FLOAT, INTS, FLOATS)
def cells_ahead(first, last, start, move, radius, margin, keys, urgency):
    """Cells of a box that a sphere comes near on a straight way, and the urgency of each.

    first, last (3,) int64: the box, in cells, both included; start, move (3,), radius: the sphere's
    way; margin: the largest distance that counts as near; all in voxels. keys (n,) and urgency (n,)
    take the cells. The urgency is the way to the sphere's nearest position plus the distance there,
    in voxels, 0 for a cell that the sphere meets already. Returns the number of cells.
    """
    length = move[0] * move[0] + move[1] * move[1] + move[2] * move[2]
    way = np.sqrt(length)
    count = 0
    for i in range(first[0], last[0] + 1):
        x = 32.0 * i + 16.0
        for j in range(first[1], last[1] + 1):
            y = 32.0 * j + 16.0
            for k in range(first[2], last[2] + 1):
                z = 32.0 * k + 16.0
                along = 0.0
                if length > 0.0:
                    along = (
                        (x - start[0]) * move[0]
                        + (y - start[1]) * move[1]
                        + (z - start[2]) * move[2]
                    ) / length
                    along = min(max(along, 0.0), 1.0)
                dx = max(abs(start[0] + along * move[0] - x) - 16.0, 0.0)
                dy = max(abs(start[1] + along * move[1] - y) - 16.0, 0.0)
                dz = max(abs(start[2] + along * move[2] - z) - 16.0, 0.0)
                gap = np.sqrt(dx * dx + dy * dy + dz * dz) - radius
                if gap <= margin:
                    dx = max(abs(start[0] - x) - 16.0, 0.0)
                    dy = max(abs(start[1] - y) - 16.0, 0.0)
                    dz = max(abs(start[2] - z) - 16.0, 0.0)
                    keys[count] = key_of_cell(i, j, k)
                    urgency[count] = 0.0
                    if dx * dx + dy * dy + dz * dz > radius * radius:
                        urgency[count] = max(gap, 0.0) + along * way
                    count += 1
    return count


@entry(FLOATS2, FLOAT, FLOATS3, PLACE, INTS, INT)
def cells_met(points, reach, poses, place, found, most):
    """Distinct cells within `reach` of points (N, 3+) at the first of the poses.

    reach in voxels, at most 16; poses (M, 4, 4). The cells go into found (capacity,) int64, an
    open-addressing set, all -1 before. Its capacity is a power of two, at least 2 (most + 8 N), or
    2 (most + N) if reach is 0. Returns the number of poses taken and the number of cells: at least
    one pose is taken, and more as long as there are at most `most` cells.
    """
    ox, oy, oz, size, side = place.x, place.y, place.z, place.size, place.side
    r, top = reach, side - 1.0
    count = 0
    low_memo = high_memo = np.int64(-1)
    before = np.empty((8 if r > 0.0 else 1) * points.shape[0], dtype=np.int64)
    for n in range(poses.shape[0]):
        transform = transform_of(poses[n])
        added = 0
        for p in range(points.shape[0]):
            x, y, z = moved(transform, points[p, 0], points[p, 1], points[p, 2])
            x, y, z = (x - ox) / size, (y - oy) / size, (z - oz) / size
            if not (-r <= x < side + r and -r <= y < side + r and -r <= z < side + r):
                continue
            low = cell_key(
                np.int64(max(x - r, 0.0)), np.int64(max(y - r, 0.0)), np.int64(max(z - r, 0.0))
            )
            high = cell_key(
                np.int64(min(x + r, top)), np.int64(min(y + r, top)), np.int64(min(z + r, top))
            )
            if low == low_memo and high == high_memo:
                continue
            low_memo, high_memo = low, high
            low_i, low_j, low_k = cell_of_key(low)
            high_i, high_j, high_k = cell_of_key(high)
            for ci in range(low_i, high_i + 1):
                for cj in range(low_j, high_j + 1):
                    for ck in range(low_k, high_k + 1):
                        key = key_of_cell(ci, cj, ck)
                        at = place_in_set(found, key)
                        if found[at] < 0:
                            found[at] = key
                            before[added] = at
                            added += 1
        if n > 0 and count + added > most:
            for p in range(added):  # newest first: no run of entries gets a hole
                found[before[added - 1 - p]] = -1
            return n, count
        count += added
    return poses.shape[0], count

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
    record_of,
)
from hapticdb.kernels.curves import compact, decode, encode, voxel_of
from hapticdb.kernels.field.lattice import (
    BEYOND,
    CELL_VALUES,
    cell_place,
    row_place,
)
from hapticdb.kernels.records.cells import BUFFERS, CONTROL, READER
from hapticdb.kernels.resident.cells import (
    CELL_GRID,
    Ints,
    brick_bit,
    cells_of_box,
    column_of,
    in_voxels,
    key_of_cell,
    place_in_set,
    slot_of,
    spread_key,
)
from hapticdb.kernels.resident.fence import fence
from hapticdb.kernels.rigid import transform_of

NEVER_AGAIN = 0x7FFFFFFFFFFFFFFF
"""`wanted_at` of a slot already chosen for eviction: later than every `since`."""


@entry(INTS2, INTS32_2, INT, INTS, INTS)
def insert_cells(keys, slots, which, new_keys, new_slots):
    """Insert cells (n,) into directory `which`, or replace their slots."""
    for n in range(new_keys.shape[0]):
        at = place_in_set(keys[which], new_keys[n])
        # plain stores: no frame reads this buffer before `publish`
        slots[which, at] = new_slots[n]
        keys[which, at] = new_keys[n]


@entry(INTS2, INTS32_2, INT, INTS)
def remove_cells(keys, slots, which, old_keys):
    """Remove cells (n,) from directory `which`, by backward-shift deletion."""
    # no tombstones: a frame's probe sequences stay as short as after an insertion alone
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
            # move an entry only if its probes, from its home, pass the hole (modulo capacity)
            if ((at - home) & (capacity - 1)) >= ((at - hole) & (capacity - 1)):
                keys[which, hole] = keys[which, at]
                slots[which, hole] = slots[which, at]
                hole = at
        keys[which, hole] = -1


@entry(INTS2, INTS32_2, INT, INTS, INTS)
def slots_of_cells(keys, slots, which, requested, out):
    """Slots (n,) of cells (n,) in directory `which`; UNKNOWN for a cell without an entry."""
    for n in range(requested.shape[0]):
        out[n] = slot_of(keys, slots, which, requested[n])


@leaf
def _mark_brick(masks, slot, i, j, k):
    """Set the bit of the brick with voxel (i, j, k) in the mask of its cell's slot."""
    masks[slot] |= np.uint64(1) << brick_bit(i, j, k)


@leaf
def _fill_brick(words, slot, i, j, k, occupancy, start):
    """Set the voxels of the brick at (i, j, k), bytes from `start`; return whether it has any."""
    has_any = False
    for byte in range(64):
        value = occupancy[start + byte]
        if value == 0:
            continue
        has_any = True
        x = (i & 31) | (compact(byte >> 2) << 1)
        y = (j & 31) | (compact(byte >> 1) << 1)
        z = (k & 31) | (compact(byte) << 1)
        # two bits along k fit one word, since bricks begin at even k
        for column in range(4):  # a byte is 2 x 2 x 2 voxels, k the lowest bit
            two = np.uint32((value >> (2 * column)) & 3)
            word = ((x | (column >> 1)) << 5) | y | (column & 1)
            words[slot, word] |= two << np.uint32(z)
    return has_any


@entry(INTS, INTS, READ_BYTES, INT, INT, WORDS32_2, WORDS)
def fill_cells(row_keys, row_slots, occupancy, bits, curve, words, masks):
    """Fill empty cells from rows of the index table.

    row_keys (R,); row_slots (R,) : slot of each row's cell in words (S, 1024) uint32 and masks (S,)
    uint64, below 0 to skip the row; occupancy (64 R,), or empty for voxel rows.
    """
    has_bits = occupancy.shape[0] > 0
    for row in range(row_keys.shape[0]):
        row_key, slot = row_keys[row], row_slots[row]
        if slot < 0:
            continue
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

    Of the row's outer layer only the part outside the cell is written. A centre in the cell belongs
    to a brick of the cell, with a row of its own; without such a row it is BEYOND. last : first
    voxel of the cell's last brick on each axis: 24, or less in a grid smaller than a cell.
    """
    # min is commutative: neighbouring rows store their common centres in any order
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


@entry(INTS, INTS, BYTES2, INT, INT, INT, BYTES2, WORDS)
def fill_distances(row_keys, row_slots, values, bits, curve, before, payload, masks):
    """Fill the distances of cells from rows of the band, after `fill_cells` -> last slot filled.

    row_keys (R,) of bricks, ascending; values (R, 1000) uint8, unpacked; payload (S, 34^3) uint8;
    before : slot filled last by the rows of an earlier call, or -1; the other arguments are those
    of `fill_cells`. A slot's first row resets all its distances to BEYOND; a slot without a row is
    unchanged, and its mask has no bit.
    """
    last_brick = min(1 << bits, 32) - 8
    for row in range(row_keys.shape[0]):
        slot = row_slots[row]
        if slot < 0:
            continue
        # ascending keys: all rows of a cell are neighbours, also across calls by `before`
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
    """Curve keys (voxel keys >> 15) of cells (n,) given by directory keys."""
    ijk = np.stack([cells >> 32, (cells >> 16) & 0xFFFF, cells & 0xFFFF], axis=1)
    return encode(ijk, max(bits - 5, 0), curve)


def cells_of_curve_keys(curve_keys: Ints, bits: int, curve: int) -> Ints:
    """Directory keys of cells (n,) given by curve keys; inverse of `curve_keys_of_cells`."""
    i, j, k = decode(curve_keys, max(bits - 5, 0), curve).T
    cells: Ints = (i << 32) | (j << 16) | k
    return cells


@entry(INTS, INTS, BYTES, INT, INT, INT, INTS)
def slots_to_free(cell_of_slot, wanted_at, used, since, hand, wanted, out):
    """Clock eviction: choose slots unused by frames since the last pass of the clock's hand.

    cell_of_slot (S,) int64, -1 if free; wanted_at (S,) int64 : slots requested at `since` or later
    stay; used (S,) uint8 : cleared by the pass of the hand; hand : slot of the clock's hand; out :
    up to `wanted` slots. Returns their number and the new hand.
    """
    total = cell_of_slot.shape[0]
    count = 0
    # two turns at most: the first clears every `used`, the second finds them clear
    for _ in range(2 * total):
        if count == wanted:
            break
        hand += 1
        if hand >= total:
            hand = 1  # slot 0 is that of all empty cells
        if cell_of_slot[hand] < 0 or wanted_at[hand] >= since:
            continue
        # second chance; frames set the byte without a lock: a lost mark costs a reload at most
        if used[hand]:
            used[hand] = 0
            continue
        wanted_at[hand] = NEVER_AGAIN
        out[count] = hand
        count += 1
    return count, hand


@entry(record_of(CONTROL), INT, INT)
def publish(control_record, version, revision):
    """Publish a version's directory, complete in its buffer: new frames read it from now on."""
    control = control_record[()]
    # revision before version: a frame that sees the version reads its own revision
    control.revisions[version % BUFFERS] = revision
    fence()
    control.version = version
    # store, fence, load on both sides (Dekker): `begin_frame` announces, then reads `version`;
    # here `version` is stored before the leases are read, so one of the two sees the other
    fence()


@entry(record_of(READER, 1))
def oldest_version_read(readers):
    """Lowest version among frames in progress; the largest int64 without any."""
    fence()
    oldest = np.int64(0x7FFFFFFFFFFFFFFF)
    for n in range(readers.shape[0]):
        if readers[n].version > 0:  # 0: no frame in progress
            oldest = min(oldest, readers[n].version)
    return oldest


@entry(INTS, INTS, FLOATS, FLOATS, FLOAT, FLOAT, INTS, FLOATS)
def cells_ahead(first, last, start, move, radius, margin, keys, urgency):
    """Cells of a box near a sphere's straight path, and the urgency of each.

    first, last (3,) int64 : the box, in cells, both included; start, move (3,), radius : the
    sphere's path; margin : greatest distance that counts as near; all in voxels; keys (n,), urgency
    (n,) : output. The urgency is the path length to the sphere's nearest position plus the distance
    there, in voxels, 0 for a cell in the sphere at the start. Returns the number of cells.
    """
    length = move[0] * move[0] + move[1] * move[1] + move[2] * move[2]
    distance = np.sqrt(length)
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
                    # path parameter of the closest approach to the cell's centre
                    along = min(max(along, 0.0), 1.0)
                # to the cell's box, not its centre: half an edge off on each axis
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
                        urgency[count] = max(gap, 0.0) + along * distance
                    count += 1
    return count


@entry(FLOATS2, INT, INT, FLOAT, FLOATS3, CELL_GRID, INTS, INT)
def cells_in_reach(points, first, least, reach, poses, grid, found, most):
    """Distinct cells within `reach` voxels of points (N, 3+) at the first of poses (M, 4, 4).

    At poses[0] only points from `first` on count. The cells go into found (capacity,) int64, an
    open-addressing set, all -1 before; its capacity is a power of two. The search ends before more
    than `most` cells, but not before point `least` of the first pose. Returns the number of
    complete poses, and of cells.
    """
    end, count = grid.side + reach, np.int64(0)
    memo = cells_of_box(-1.0, -1.0, -1.0, 0.0, grid.side)
    for n in range(poses.shape[0]):
        transform = transform_of(poses[n])
        for p in range(first if n == 0 else 0, points.shape[0]):
            x, y, z = in_voxels(transform, grid, points[p, 0], points[p, 1], points[p, 2])
            if not (-reach <= x < end and -reach <= y < end and -reach <= z < end):
                continue
            box = cells_of_box(x, y, z, reach, grid.side)
            # neighbouring points often have the same box: no look-up in the set
            if box == memo:
                continue
            memo = box
            low_i, high_i, low_j, high_j, low_k, high_k = box
            n_cells = (high_i - low_i + 1) * (high_j - low_j + 1) * (high_k - low_k + 1)
            # cells already in the set count again: an upper bound without a look-up
            if count + n_cells > most and (n > 0 or p >= least):
                return n, count
            for ci in range(low_i, high_i + 1):
                for cj in range(low_j, high_j + 1):
                    for ck in range(low_k, high_k + 1):
                        key = key_of_cell(ci, cj, ck)
                        at = place_in_set(found, key)
                        if found[at] < 0:
                            found[at] = key
                            count += 1
    return poses.shape[0], count

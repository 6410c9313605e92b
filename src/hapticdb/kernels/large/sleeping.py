"""Clusters of a large shell that sleep: they are not looked at until they may touch something.

A shell has clusters of two levels: runs of points, and blocks of `BLOCK` runs. A run that is far
from all voxels gets a *rest*: where its sphere's centre was, and how far the centre may go from
there, on each axis, before anything can be near. While the centre stays within the rest, the run
sleeps: a sphere looks the same however the tool turns, so three subtractions prove that none of its
points meets a voxel. A block whose runs all sleep rests as long as the first of them: the largest
way of a corner of the box around their centres bounds the way of each centre, turns included,
because the difference of two poses is affine. This is the idea of dead reckoning (McNeely,
Puterbaugh and Troy 2006), with the way measured instead of foretold, so that no largest speed is
assumed. The nesting follows Barbic and James 2008.

Cells never change within a version of their directory. Between versions, changed cells end the
rests that they concern (`waking`).

Whether a run is *near* depends only on the pose and the cells, not on what slept before. So the
number of points near something, which the budget bounds, is the same in every replay.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import (
    FLOATS2,
    INTS,
    fields_of,
    inlined,
    leaf,
)
from hapticdb.kernels.large.waking import AWAKE, wake_changed
from hapticdb.kernels.resident.cells import (
    EMPTY_SLOT,
    key_of_cell,
    slot_of,
)
from hapticdb.kernels.resident.clearance import gap
from hapticdb.kernels.resident.runs import is_sphere_free
from hapticdb.kernels.rigid import moved, turn

BLOCK = 64
"""Runs of a block. A larger value tests fewer blocks and wakes more runs at once."""
SHORTEST, LONGEST = 8.0, 16.0
"""Largest rests of runs, voxels, from block to block. Longer rests read more cells when they end;
equal ones would end in one frame when a tool moves without turning."""
GOLDEN = 0.6180339887498949
"""Golden ratio: its multiples, without their whole parts, spread evenly (Knuth, volume 3, 6.4)."""
HASH_FACTOR, LOW_32 = 0x45D9F3B, 0xFFFFFFFF
"""Factor of the hash of a group of points, and the bits that are kept of a product."""
REST_BETWEEN_BRICKS = 2.0
"""Rest of a run, voxels, that is tested voxel by voxel because an occupied brick is near."""
ROUNDING = 1e-6
"""Voxels taken off each rest: far more than the rounding errors of a placed centre."""
LARGEST_BLOCK = 128.0
"""Half the side of the largest cube around a block's runs that is tested as a whole, voxels.
Larger: more cells to read at once."""
MOST_IN_TWO_CELLS = 16.0
"""Half the side of a box that spans at most two cells on an axis, voxels."""


class Sleepers(NamedTuple):
    """What frames keep of a shell with sleeping clusters.

    boxes (B, 7): centre and half the sides, metres, tool frame, of the box around the centres of
    each block's runs, and the radius of a sphere at its centre around the runs. block_rests (B,
    13): the pose at which a block's rest began (`transform_of`), and how far a centre may go,
    voxels; below zero for a block that is awake. run_rests (C, 4): the place of a sphere's centre
    and how far it may go from there on each axis, voxels; below zero for a run that is near
    something. state (STATE,) int64: which changes of cells are followed, and how
    many runs they have woken (`waking`). changed (CHANGES_KEPT, 3): lowest corners of the cells
    changed since the last frame, voxels. listed (C,) int64: the runs near something. skips (C, 1):
    the number of runs that a frame skips from each run on. nothing (0, 4): the spheres of a shell
    that has none. chosen (K, 6), columns (3, K), indices (K,) int64: points of a frame beyond its
    budget.
    """

    boxes: NDArray[np.float64]
    block_rests: NDArray[np.float64]
    run_rests: NDArray[np.float64]
    state: NDArray[np.int64]
    changed: NDArray[np.float64]
    listed: NDArray[np.int64]
    skips: NDArray[np.float64]
    nothing: NDArray[np.float64]
    chosen: NDArray[np.float64]
    columns: NDArray[np.float64]
    indices: NDArray[np.int64]


SLEEPERS = fields_of(
    Sleepers, FLOATS2, FLOATS2, FLOATS2, INTS, FLOATS2, INTS, FLOATS2, FLOATS2, FLOATS2, FLOATS2,
    INTS,
)  # fmt: skip
RADIUS = 6
"""Column of `Sleepers.boxes` after the box."""
REST = 12
"""Column of `Sleepers.block_rests` after the pose."""
LOOKED_AT, LEFT_OUT, COUNTS = 0, 1, 2
"""Columns of the counts of frames: points near something that a frame looked at, and that its
budget left out."""


@leaf
def room_around(keys, slots, masks, used, which, x, y, z, half, most, side):
    """How far a cube may grow on each side before it meets an occupied brick or an unknown cell.

    (x, y, z), half: the cube's centre and half its side, voxels. The result is at most `most`, and
    not above zero if the cube meets one already.
    """
    reach, top = half + most, side - 1.0
    least = reach
    for ci in range(np.int64(max(x - reach, 0.0)) >> 5, (np.int64(min(x + reach, top)) >> 5) + 1):
        di = gap(x, 32.0 * ci, 32.0 * ci + 32.0)
        for cj in range(
            np.int64(max(y - reach, 0.0)) >> 5, (np.int64(min(y + reach, top)) >> 5) + 1
        ):
            dj = max(di, gap(y, 32.0 * cj, 32.0 * cj + 32.0))
            if dj >= least:
                continue
            for ck in range(
                np.int64(max(z - reach, 0.0)) >> 5, (np.int64(min(z + reach, top)) >> 5) + 1
            ):
                dk = max(dj, gap(z, 32.0 * ck, 32.0 * ck + 32.0))
                if dk >= least:
                    continue
                slot = slot_of(keys, slots, which, key_of_cell(ci, cj, ck))
                if slot == EMPTY_SLOT:
                    continue
                if slot < 0:
                    least = dk
                else:
                    used[slot] = 1
                    least = _nearest_brick(
                        masks[slot], 32.0 * ci, 32.0 * cj, 32.0 * ck, x, y, z, least
                    )
                if least <= half:
                    return least - half
    return least - half


@leaf
def _nearest_brick(mask, i, j, k, x, y, z, least):
    """Distance on the axis where it is largest, from (x, y, z) to the nearest brick of a cell.

    mask: of the cell, whose lowest corner is (i, j, k); all in voxels. `least` if none is nearer.
    """
    for bi in range(4):
        if not (mask >> np.uint64(bi << 4)) & np.uint64(0xFFFF):
            continue
        di = gap(x, i + 8.0 * bi, i + 8.0 * bi + 8.0)
        if di >= least:
            continue
        for bj in range(4):
            four = (mask >> np.uint64((bi << 4) | (bj << 2))) & np.uint64(0xF)
            dj = max(di, gap(y, j + 8.0 * bj, j + 8.0 * bj + 8.0))
            if not four or dj >= least:
                continue
            for bk in range(4):
                if (four >> np.uint64(bk)) & np.uint64(1):
                    least = min(least, max(dj, gap(z, k + 8.0 * bk, k + 8.0 * bk + 8.0)))
    return least


@inlined
def placed_center(spheres, n, transform, place):
    """Centre of sphere n of a placed shell, voxels."""
    x, y, z = moved(transform, spheres[n, 0], spheres[n, 1], spheres[n, 2])
    return (x - place.x) / place.size, (y - place.y) / place.size, (z - place.z) / place.size


@leaf
def _way_on_axis(a, b, c, u, x, y, z, half_x, half_y, half_z):
    """Largest way on one axis of a point of a box, when that row of the pose changes by a, b, c, u.

    (x, y, z), half_x, half_y, half_z: the box's centre and half its sides.
    """
    turning = abs(a) * half_x + abs(b) * half_y + abs(c) * half_z
    return abs(turn(a, b, c, x, y, z) + u) + turning


@leaf
def way_of_box(boxes, rests, block, transform):
    """Largest way on an axis, metres, of a point of a block's box since the block's rest began."""
    a, b, c, u, d, e, f, v, g, h, m, w = transform
    x, y, z = boxes[block, 0], boxes[block, 1], boxes[block, 2]
    half_x, half_y, half_z = boxes[block, 3], boxes[block, 4], boxes[block, 5]
    along_x = _way_on_axis(
        a - rests[block, 0], b - rests[block, 1], c - rests[block, 2], u - rests[block, 3],
        x, y, z, half_x, half_y, half_z,
    )  # fmt: skip
    along_y = _way_on_axis(
        d - rests[block, 4], e - rests[block, 5], f - rests[block, 6], v - rests[block, 7],
        x, y, z, half_x, half_y, half_z,
    )  # fmt: skip
    along_z = _way_on_axis(
        g - rests[block, 8], h - rests[block, 9], m - rests[block, 10], w - rests[block, 11],
        x, y, z, half_x, half_y, half_z,
    )  # fmt: skip
    return max(along_x, along_y, along_z)


@leaf
def _begin_block_rest(rests, block, transform, rest):
    """Enter the rest of a block from this pose on."""
    a, b, c, u, d, e, f, v, g, h, m, w = transform
    rests[block, 0] = a
    rests[block, 1] = b
    rests[block, 2] = c
    rests[block, 3] = u
    rests[block, 4] = d
    rests[block, 5] = e
    rests[block, 6] = f
    rests[block, 7] = v
    rests[block, 8] = g
    rests[block, 9] = h
    rests[block, 10] = m
    rests[block, 11] = w
    rests[block, REST] = rest


@inlined
def _left_of_rest(rests, n, x, y, z):
    """How far the centre of run n, now at (x, y, z), may still go on each axis; all in voxels."""
    way = max(abs(x - rests[n, 0]), abs(y - rests[n, 1]), abs(z - rests[n, 2]))
    return rests[n, 3] - way


@inlined
def _begin_rest(rests, n, x, y, z, rest):
    """Enter the rest of run n, whose centre is at (x, y, z)."""
    rests[n, 0] = x
    rests[n, 1] = y
    rests[n, 2] = z
    rests[n, 3] = rest


@leaf
def _rest_of_run(
    keys, slots, words, masks, used, which, spheres, n, x, y, z, transform, place, margin, longest
):  # fmt: skip
    """Rest of run n, whose centre is at (x, y, z): zero if it is free only here, -1 if it is near.

    A run is near unless its box is free of voxels, or of occupied bricks. What is free in a larger
    box is free in each smaller one, so rests change nothing.
    """
    half = spheres[n, 3] / place.size + margin
    is_free = is_sphere_free(
        keys, slots, words, masks, used, which, spheres, n, transform, place, margin
    )
    if not is_free and half <= MOST_IN_TWO_CELLS:
        return -1.0
    rest = room_around(keys, slots, masks, used, which, x, y, z, half, longest, place.side)
    if rest > REST_BETWEEN_BRICKS:
        return rest - ROUNDING
    if is_free and is_sphere_free(
        keys, slots, words, masks, used, which, spheres, n, transform, place,
        margin + REST_BETWEEN_BRICKS,
    ):  # fmt: skip
        return REST_BETWEEN_BRICKS - ROUNDING
    if rest > ROUNDING:
        return rest - ROUNDING
    return 0.0 if is_free else -1.0


@leaf
def _rest_of_block(
    keys, slots, masks, used, which, boxes, block, transform, place, margin, longest
):  # fmt: skip
    """Rest of all runs of a block that are far from all bricks; zero if they must be tested."""
    half = boxes[block, RADIUS] / place.size + margin
    if half > LARGEST_BLOCK:
        return 0.0
    x, y, z = placed_center(boxes, block, transform, place)
    rest = room_around(keys, slots, masks, used, which, x, y, z, half, longest, place.side)
    return rest - ROUNDING if rest > REST_BETWEEN_BRICKS else 0.0


@leaf
def list_near_runs(
    control, keys, slots, felt, masks, used, which, spheres, sleepers, transform, place, margin
):  # fmt: skip
    """List the runs of a placed shell that are near something; returns their number.

    felt, margin: `feeling.felt_words`, `feeling.felt_margin`. No argument has a law's own type, so
    this is compiled once.
    """
    boxes, block_rests, run_rests, state, changed, listed, _, _, _, _, _ = sleepers
    wake_changed(
        control, which, spheres, run_rests, block_rests, REST, BLOCK, state, changed, margin,
        place.size,
    )  # fmt: skip
    count = 0
    for block in range(boxes.shape[0]):
        if block_rests[block, REST] > 0.0:
            way = way_of_box(boxes, block_rests, block, transform) / place.size
            if way < block_rests[block, REST]:
                continue
        longest = SHORTEST + (LONGEST - SHORTEST) * (block * GOLDEN % 1.0)
        least = LONGEST
        rest = 0.0
        if block_rests[block, REST] >= AWAKE:  # it slept, or is to be tested anew
            rest = _rest_of_block(
                keys, slots, masks, used, which, boxes, block, transform, place, margin, longest
            )
        for n in range(block * BLOCK, min((block + 1) * BLOCK, spheres.shape[0])):
            x, y, z = placed_center(spheres, n, transform, place)
            left = _left_of_rest(run_rests, n, x, y, z)
            if rest > 0.0:
                left = rest
                _begin_rest(run_rests, n, x, y, z, left)
            elif left < 0.0:
                left = _rest_of_run(
                    keys, slots, felt, masks, used, which, spheres, n, x, y, z, transform, place,
                    margin, longest,
                )  # fmt: skip
                _begin_rest(run_rests, n, x, y, z, left)
                if left < 0.0:
                    listed[count] = n
                    count += 1
            least = min(least, left)
        _begin_block_rest(block_rests, block, transform, least - ROUNDING)
    return count


@leaf
def points_listed(listed, count, run, n_points):
    """Number of points of the listed runs; only the last run of a shell may be shorter."""
    last = (n_points - 1) // run
    short = (last + 1) * run - n_points
    return count * run - (short if count > 0 and listed[count - 1] == last else 0)


@leaf
def skip_between(listed, count, skips):
    """Write the number of runs that a frame skips, from each run on that it comes to."""
    at = 0
    for n in range(count):
        if listed[n] > at:
            skips[at, 0] = listed[n] - at
        at = listed[n] + 1
        skips[at - 1, 0] = 0.0
    if at < skips.shape[0]:
        skips[at, 0] = skips.shape[0] - at


@leaf
def _chosen_of_group(group, stride):
    """Number of the one point that a frame looks at of a group of `stride` points of a shell.

    stride: a power of two, at most 2^31. The place in the group is a hash of the group's number:
    one place for all groups would make a grid, because the points are in Z-order, and would miss
    an edge between its rows. The hash is T. Mueller's for 32 bits: shifts and products, twice.
    """
    mixed = ((group ^ (group >> 16)) * HASH_FACTOR) & LOW_32
    mixed = ((mixed ^ (mixed >> 16)) * HASH_FACTOR) & LOW_32
    return group * stride + ((mixed ^ (mixed >> 16)) & (stride - 1))


@leaf
def choose_points(listed, count, points, columns, run, budget, chosen, chosen_columns, indices):
    """Copy one point of each 2, 4, 8 ... of a shell if it is in a listed run; returns the number.

    These are the most that are not more than `budget`, in the order of the shell. Which point
    stands for a group depends on its number alone: it stays while other runs come near.
    """
    stride, n_chosen = 2, 0
    while points_listed(listed, count, run, points.shape[0]) > stride * budget:
        stride *= 2
    n = 0
    while n < count:
        start = listed[n] * run
        end = min(start + run, points.shape[0])
        for group in range(start // stride, (end - 1) // stride + 1):
            at = _chosen_of_group(group, stride)
            if at < start or at >= end:
                continue
            if n_chosen == budget:
                n_chosen = budget + 1
                break
            for axis in range(3):
                chosen[n_chosen, 3 + axis] = points[at, 3 + axis]
                chosen_columns[axis, n_chosen] = columns[axis, at]
            indices[n_chosen] = at
            n_chosen += 1
        n += 1
        if n_chosen > budget:  # groups that lie in several runs are chosen by chance
            stride, n_chosen, n = 2 * stride, 0, 0
    return n_chosen

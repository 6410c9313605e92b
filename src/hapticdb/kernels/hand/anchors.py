"""Anchors: what a point that hits may do, so that no surface is ever passed.

Every point that hits has an *anchor*: a free voxel beside its own. When it comes to hit, the anchor
is the voxel from which it came, or a nearer one beside both; as it goes on, the anchor follows, by
one step at most and through free voxels only. A point may leave its voxel only for one beside which
its anchor can follow, or for a free one beside the anchor.

Two free voxels that touch, if only by a corner, are together one closed body that meets no surface,
for a voxel is occupied when a surface so much as touches it. So a walk through free voxels never
changes sides, and a point stays beside its anchor's walk. Neither normals nor forces take part in
this: it holds for the points of a needle as for those of a ball. The surface need not be closed;
where it has a hole of a voxel or more a point goes through, as it should.

Where something is put upon the tool, or the tool is first placed in something, points on either
side of it would hold the tool for ever. So such points have no anchor, nor has any that comes to
hit as near to where they were as the tool reaches: it may leave by any side. When the last of them
is free, all hits have anchors again. One that goes on hitting till it is farther away gets one on
the side of the tool's centre, if that is clear, and what is met there holds the tool as ever.
"""

import math

import numpy as np

from hapticdb.kernels._jit import leaf
from hapticdb.kernels.resident.cells import UNKNOWN, cell_key, slot_of
from hapticdb.kernels.rigid import turn

BEFORE, AFTER, ANCHOR = 0, 1, 2
"""Rows of `met` (MET_ROWS, N): indices of the points that hit, of those that hit at the end of a
step that is tried, and each point's anchor."""
MET_ROWS = 3
NO_ANCHOR, LOOSE = -1, -2
"""Instead of an anchor, of points that do not hit, and of those that may leave by any side."""
CLEARLY = 0.8
"""Of the cosine to the best of two sides: below it lies the other."""


@leaf
def state_of(keys, slots, words, which, side, i, j, k):
    """1 where voxel (i, j, k) is occupied, 0 where it is free or outside the grid, or UNKNOWN."""
    if not (0 <= i < side and 0 <= j < side and 0 <= k < side):
        return np.int64(0)
    slot = slot_of(keys, slots, which, cell_key(i, j, k))
    if slot < 0:
        return np.int64(UNKNOWN)
    return np.int64((words[slot, ((i & 31) << 5) | (j & 31)] >> np.uint32(k & 31)) & 1)


@leaf
def voxel_under(points, n, pose, place):
    """Voxel of point n under a pose, as `felt` finds it; outside the grid, too."""
    x, y, z = points[n, 0], points[n, 1], points[n, 2]
    px = turn(pose[0, 0], pose[0, 1], pose[0, 2], x, y, z) + pose[0, 3]
    py = turn(pose[1, 0], pose[1, 1], pose[1, 2], x, y, z) + pose[1, 3]
    pz = turn(pose[2, 0], pose[2, 1], pose[2, 2], x, y, z) + pose[2, 3]
    return (
        np.int64(np.floor((px - place.x) / place.size)),
        np.int64(np.floor((py - place.y) / place.size)),
        np.int64(np.floor((pz - place.z) / place.size)),
    )


@leaf
def lever_of(points, n, pose, center):
    """Lever of point n about the centre, world frame."""
    x, y, z = points[n, 0] - center[0], points[n, 1] - center[1], points[n, 2] - center[2]
    return (
        turn(pose[0, 0], pose[0, 1], pose[0, 2], x, y, z),
        turn(pose[1, 0], pose[1, 1], pose[1, 2], x, y, z),
        turn(pose[2, 0], pose[2, 1], pose[2, 2], x, y, z),
    )


@leaf
def are_beside(ai, aj, ak, i, j, k):
    """Whether two voxels are the same, or touch by a face, an edge or a corner."""
    return abs(ai - i) <= 1 and abs(aj - j) <= 1 and abs(ak - k) <= 1


@leaf
def anchor_code(di, dj, dk):
    """An anchor as it is kept: where it is, seen from its point's voxel."""
    return (di + 1) * 9 + (dj + 1) * 3 + (dk + 1)


@leaf
def anchor_of(code, i, j, k):
    """Undo `anchor_code` for a point in voxel (i, j, k)."""
    return i + code // 9 - 1, j + (code // 3) % 3 - 1, k + code % 3 - 1


@leaf
def follow(keys, slots, words, which, side, ai, aj, ak, i, j, k):
    """Code of the free voxel nearest to (i, j, k), beside it and an anchor, or NO_ANCHOR."""
    best = np.int64(NO_ANCHOR)
    least = 4
    for di in range(max(-1, ai - 1 - i), min(1, ai + 1 - i) + 1):
        for dj in range(max(-1, aj - 1 - j), min(1, aj + 1 - j) + 1):
            for dk in range(max(-1, ak - 1 - k), min(1, ak + 1 - k) + 1):
                distance = di * di + dj * dj + dk * dk
                if (
                    distance < least
                    and state_of(keys, slots, words, which, side, i + di, j + dj, k + dk) == 0
                ):
                    least = distance
                    best = np.int64(anchor_code(di, dj, dk))
    return best


@leaf
def may_enter(keys, slots, words, which, side, ai, aj, ak, i, j, k):
    """Whether a point with that anchor may go to the next voxel (i, j, k): 1, 0 or UNKNOWN."""
    state = state_of(keys, slots, words, which, side, i, j, k)
    if state == UNKNOWN:
        return np.int64(UNKNOWN)
    if state == 0:
        return np.int64(are_beside(ai, aj, ak, i, j, k))
    return np.int64(follow(keys, slots, words, which, side, ai, aj, ak, i, j, k) != NO_ANCHOR)


@leaf
def outward(keys, slots, words, which, side, ai, aj, ak, i, j, k):
    """Unit direction out of voxel (i, j, k): the mean to free voxels beside it and its anchor."""
    x = y = z = 0.0
    for di in range(max(-1, ai - 1 - i), min(1, ai + 1 - i) + 1):
        for dj in range(max(-1, aj - 1 - j), min(1, aj + 1 - j) + 1):
            for dk in range(max(-1, ak - 1 - k), min(1, ak + 1 - k) + 1):
                if state_of(keys, slots, words, which, side, i + di, j + dj, k + dk) == 0:
                    x += di
                    y += dj
                    z += dk
    length = math.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        x, y, z = float(ai - i), float(aj - j), float(ak - k)
        length = max(math.sqrt(x * x + y * y + z * z), 1.0)
    return x / length, y / length, z / length


@leaf
def cosine_to(code, x, y, z):
    """Cosine, times the length of (x, y, z), between it and the way to that anchor; 0 for none."""
    di, dj, dk = anchor_of(code, 0, 0, 0)
    return (di * x + dj * y + dk * z) / math.sqrt(max(di * di + dj * dj + dk * dk, 1))


@leaf
def towards(keys, slots, words, which, side, x, y, z, i, j, k):
    """Code of the free voxel beside (i, j, k) that lies nearest to direction (x, y, z).

    NO_ANCHOR when none does, or when one that it does not touch lies almost as near: then it is
    not clear which side of a surface is meant.
    """
    best = np.int64(NO_ANCHOR)
    most = 0.0
    for code in range(27):
        ai, aj, ak = anchor_of(code, i, j, k)
        along = cosine_to(code, x, y, z)
        if along > most and state_of(keys, slots, words, which, side, ai, aj, ak) == 0:
            most = along
            best = np.int64(code)
    if best == NO_ANCHOR:
        return best
    bi, bj, bk = anchor_of(best, i, j, k)
    for code in range(27):
        ai, aj, ak = anchor_of(code, i, j, k)
        if cosine_to(code, x, y, z) < CLEARLY * most or are_beside(bi, bj, bk, ai, aj, ak):
            continue
        if state_of(keys, slots, words, which, side, ai, aj, ak) == 0:
            return np.int64(NO_ANCHOR)
    return best


@leaf
def is_within(box, i, j, k):
    """Whether voxel (i, j, k) is in a half-open box (6,), lower corner first."""
    return box[0] <= i < box[3] and box[1] <= j < box[4] and box[2] <= k < box[5]


@leaf
def extend(box, i, j, k, reach):
    """Take all voxels that are no farther than `reach` on any axis into a box, empty if zero."""
    is_empty = not box[0] < box[3]
    for axis in range(3):
        at = i if axis == 0 else (j if axis == 1 else k)
        box[axis] = at - reach if is_empty else min(box[axis], at - reach)
        box[3 + axis] = at + reach + 1.0 if is_empty else max(box[3 + axis], at + reach + 1.0)


@leaf
def anchor_or_loose(code, box, i, j, k, reach):
    """That code, or, where it is no anchor, LOOSE, and the box extended around the voxel."""
    if code != NO_ANCHOR:
        return np.int64(code)
    extend(box, i, j, k, reach)
    return np.int64(LOOSE)


@leaf
def settle_anchors(
    keys, slots, words, which, points, center, place, met, n_before, n_after, before, after, is_new,
    box, reach,
):  # fmt: skip
    """Give the hits of a frame at `after` their anchors, given those at `before`, a step away.

    met (MET_ROWS, N) as above. is_new: the cells are of another
    version, in which what was free may be occupied. box (6,): voxels in which no new hit gets an
    anchor, as near to what the tool was found in as `reach`, voxels; zero while all have one.
    """
    side = np.int64(place.side)
    for m in range(n_before):
        n = met[BEFORE, m]
        i, j, k = voxel_under(points, n, after, place)
        oi, oj, ok = voxel_under(points, n, before, place)
        is_same = i == oi and j == oj and k == ok
        if is_same and not is_new:
            continue
        if state_of(keys, slots, words, which, side, i, j, k) == 0:
            met[ANCHOR, n] = NO_ANCHOR
            continue
        if met[ANCHOR, n] < 0:
            if not is_within(box, i, j, k):
                rx, ry, rz = lever_of(points, n, after, center)
                code = towards(keys, slots, words, which, side, -rx, -ry, -rz, i, j, k)
                met[ANCHOR, n] = LOOSE if code == NO_ANCHOR else code
            continue
        ai, aj, ak = anchor_of(met[ANCHOR, n], oi, oj, ok)
        # one whose cell has gone was free, and is still on the side from which the point came
        if is_same and state_of(keys, slots, words, which, side, ai, aj, ak) != 1:
            continue
        code = follow(keys, slots, words, which, side, ai, aj, ak, i, j, k)
        met[ANCHOR, n] = anchor_or_loose(code, box, i, j, k, reach)
    any_loose = False
    for m in range(n_after):
        n = met[AFTER, m]
        met[BEFORE, m] = n
        if met[ANCHOR, n] == NO_ANCHOR:
            i, j, k = voxel_under(points, n, after, place)
            ai, aj, ak = voxel_under(points, n, before, place)
            code = np.int64(NO_ANCHOR)
            if is_within(box, i, j, k):
                code = np.int64(LOOSE)
            elif are_beside(ai, aj, ak, i, j, k) and not (ai == i and aj == j and ak == k):
                code = follow(keys, slots, words, which, side, ai, aj, ak, i, j, k)
            met[ANCHOR, n] = anchor_or_loose(code, box, i, j, k, reach)
        any_loose = any_loose or met[ANCHOR, n] == LOOSE
    if not any_loose:
        for n in range(6):
            box[n] = 0.0

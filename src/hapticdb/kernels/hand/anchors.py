"""Anchors: they decide where a hit may move, so that no point passes through a surface.

Every hit has an *anchor*: a free voxel beside the point's own voxel. When a point becomes a hit,
its anchor is the voxel that the point came from, or a nearer free voxel beside both. While the
point moves on, its anchor follows, by at most one voxel on each axis and through free voxels only.
A hit may leave its voxel for an occupied voxel only if the anchor can follow to a free voxel beside
it, and for a free voxel only if that voxel is beside the anchor.

Two free voxels that touch, even only at a corner, form one closed body that meets no surface,
because a voxel is occupied as soon as a surface touches it. So a walk through free voxels never
changes to the other side of a surface, and each hit stays beside the walk of its anchor. The rule
uses neither normals nor forces: it holds for the points of a needle as well as for those of a ball.
The surface need not be closed: a point passes through a hole of one voxel or more, as it should.

If an object is placed on the tool, or the tool is first placed inside an object, points on both
sides of the object would hold the tool for ever. So these hits are *loose*: they have no anchor and
may leave by any side. A point that becomes a hit within the tool's radius of such a place is loose,
too. When no hit is loose any more, all new hits get anchors again. A loose hit that is still a hit
farther away gets an anchor on the side of the tool's centre, if that side is clear. The surfaces
that the tool meets there hold it as usual.
"""

import math

import numpy as np

from hapticdb.kernels._jit import leaf
from hapticdb.kernels.resident.cells import UNKNOWN, cell_key, slot_of
from hapticdb.kernels.rigid import turn

BEFORE, AFTER, ANCHOR = 0, 1, 2
"""Rows of `met` (MET_ROWS, N): indices of the hits, indices of the hits at the end of the step that
is tried, and the code of each point's anchor."""
MET_ROWS = 3
NO_ANCHOR, LOOSE = -1, -2
"""Codes in place of an anchor: the point is no hit; the point is a loose hit."""
CLEARLY = 0.8
"""Part of the best cosine. A free voxel on another side with a cosine of at least this part of the
best makes the side unclear. Larger: fewer sides are unclear."""


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
    """Voxel that holds point n at a pose, as `felt` computes it; it may lie outside the grid."""
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
    """Lever from the centre to point n, metres, world frame."""
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
    """Code of an anchor: its offset (di, dj, dk) from its point's voxel, each -1, 0 or 1."""
    return (di + 1) * 9 + (dj + 1) * 3 + (dk + 1)


@leaf
def anchor_of(code, i, j, k):
    """Anchor's voxel for a code and a point in voxel (i, j, k); undoes `anchor_code`."""
    return i + code // 9 - 1, j + (code // 3) % 3 - 1, k + code % 3 - 1


@leaf
def follow(keys, slots, words, which, side, ai, aj, ak, i, j, k):
    """Code of the free voxel nearest to (i, j, k) beside both it and the anchor, or NO_ANCHOR."""
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
    """Whether a point with anchor (ai, aj, ak) may enter voxel (i, j, k): 1, 0 or UNKNOWN."""
    state = state_of(keys, slots, words, which, side, i, j, k)
    if state == UNKNOWN:
        return np.int64(UNKNOWN)
    if state == 0:
        return np.int64(are_beside(ai, aj, ak, i, j, k))
    return np.int64(follow(keys, slots, words, which, side, ai, aj, ak, i, j, k) != NO_ANCHOR)


@leaf
def outward(keys, slots, words, which, side, ai, aj, ak, i, j, k):
    """Unit direction out of voxel (i, j, k): mean way to free voxels beside it and its anchor."""
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
    """Length of (x, y, z) along the way from a voxel to the anchor of that code; 0 for no way."""
    di, dj, dk = anchor_of(code, 0, 0, 0)
    return (di * x + dj * y + dk * z) / math.sqrt(max(di * di + dj * dj + dk * dk, 1))


@leaf
def towards(keys, slots, words, which, side, x, y, z, i, j, k):
    """Code of the free voxel beside (i, j, k) that lies nearest to direction (x, y, z).

    NO_ANCHOR when no free voxel lies on that side. NO_ANCHOR, too, when another free voxel lies
    almost as near and does not touch the first: then the side of the surface is not clear.
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
    """Whether voxel (i, j, k) is in a half-open box (6,): lower corner, then upper corner."""
    return box[0] <= i < box[3] and box[1] <= j < box[4] and box[2] <= k < box[5]


@leaf
def extend(box, i, j, k, reach):
    """Enlarge a box (6,), empty if zero, by all voxels within `reach` of (i, j, k) on each axis."""
    is_empty = not box[0] < box[3]
    for axis in range(3):
        at = i if axis == 0 else (j if axis == 1 else k)
        box[axis] = at - reach if is_empty else min(box[axis], at - reach)
        box[3 + axis] = at + reach + 1.0 if is_empty else max(box[3 + axis], at + reach + 1.0)


@leaf
def anchor_or_loose(code, box, i, j, k, reach):
    """Return the code if it is an anchor; else extend the box around the voxel, return LOOSE."""
    if code != NO_ANCHOR:
        return np.int64(code)
    extend(box, i, j, k, reach)
    return np.int64(LOOSE)


@leaf
def settle_anchors(
    keys, slots, words, which, points, center, place, met, n_before, n_after, before, after, is_new,
    box, reach,
):  # fmt: skip
    """Update the anchors from the hits at pose `before` to the hits at pose `after`, a step later.

    met (MET_ROWS, N) as above. is_new: the cells are of another version, so a voxel that was free
    may be occupied now. box (6,): voxels in which a new hit is loose; they lie within `reach`
    voxels of a hit that found no anchor. The box is zero while every hit has an anchor.
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
        # an anchor in a cell that is unknown now was free: it is still on the side of arrival
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

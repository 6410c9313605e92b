"""Orientation of surfaces and nesting of bodies, by parity votes of lines through a BVH.

A ray from a point inside a closed surface crosses it an odd number of times, from a point outside
an even number (Jordan's theorem). So the parities of a line's crossings ahead of a face and behind
it give the face's inner side, for any winding of the triangles. A line may hit an edge, a hole or a
rounding error, so several lines vote. Lengths are in metres, in one frame of the caller's choice.
docs/decisions/0015 gives the reasons.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import (
    BYTES,
    FLOAT,
    FLOATS2,
    FLOATS3,
    INTS,
    INTS2,
    entry,
    fields_of,
    leaf,
)
from hapticdb.kernels.curves import Z_ORDER, encode

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LEAF_SIZE = 4
"""Triangles of a leaf of the BVH. Larger: a lower tree, and more triangle tests."""
STACK = 64
"""Size of a traversal stack: more than the height of a tree over 2^31 leaves."""
TOUCH = 2
"""Code of a crossing at the line's own start, which invalidates its vote."""
MOST_VOTES = 32
"""Greatest number of lines for one patch or body. Larger: slower, fewer undecided."""
ENOUGH = 5
"""Lead of one side at which the votes end early. Larger: slower, fewer errors."""
LABOUR = 2e8
"""Limit of node visits by all votes together: a few seconds. Beyond it patches get fewer votes, or
none. Larger: more time for dense, tangled surfaces."""


class TriangleBVH(NamedTuple):
    """BVH of AABBs over triangles: complete binary tree, children of node n at 2 n + 1 and 2 n + 2.

    Triangles are sorted by body, then in Z-order of their centroids, so a query of one body visits
    its own nodes only.
    """

    corners: Floats  # (T, 3, 3), sorted
    faces: Ints  # (T,) number of each sorted triangle in the caller's order
    bodies: Ints  # (T,) body of each sorted triangle, ascending
    boxes: Floats  # (nodes, 2, 3) lower and upper corner
    spans: Ints  # (nodes, 2) least and greatest body below
    slack: float  # largest distance that counts as zero, metres


TREE = fields_of(TriangleBVH, FLOATS3, INTS, INTS, FLOATS3, INTS2, FLOAT)


def triangle_bvh(triangles: Floats, bodies: Ints) -> TriangleBVH:
    """BVH over triangles (T, 3, 3), T > 0, of the bodies (T,)."""
    centroids = (triangles[:, 0] + triangles[:, 1] + triangles[:, 2]) / 3.0
    least = centroids.min(axis=0)
    extent = float((centroids.max(axis=0) - least).max()) or 1.0
    cells = ((centroids - least) * ((2**21 - 1) / extent)).astype(np.int64)
    order = np.lexsort((encode(cells, 21, Z_ORDER), bodies))
    corners = np.ascontiguousarray(triangles[order])
    boxes, slack = _boxes_of(corners)
    n_leaves = (len(boxes) + 1) // 2
    first, last = np.full((2, n_leaves * LEAF_SIZE), np.iinfo(np.int64).max)
    last[:] = -1
    first[: len(corners)] = last[: len(corners)] = bodies[order]
    spans = np.empty((len(boxes), 2), dtype=np.int64)
    while len(first) > 1:
        first, last = np.minimum(first[::2], first[1::2]), np.maximum(last[::2], last[1::2])
        if len(first) <= n_leaves:
            nodes = slice(len(first) - 1, 2 * len(first) - 1)
            spans[nodes, 0], spans[nodes, 1] = first, last
    return TriangleBVH(corners, order.astype(np.int64), bodies[order], boxes, spans, slack)


def refitted(tree: TriangleBVH, corners: Floats) -> TriangleBVH:
    """BVH over the same triangles with other corners (T, 3, 3), in the tree's order.

    Its AABBs are as tight as those of a new tree, but in the order of the old corners.
    """
    boxes, slack = _boxes_of(corners)
    return tree._replace(corners=corners, boxes=boxes, slack=slack)


@entry(FLOATS3, FLOATS3)
def boxes_kernel(corners, boxes):
    """Write AABBs (nodes, 2, 3) over sorted triangles (T, 3, 3), and return their slack.

    AABBs are enlarged by the slack: a rounding error could make a line in the plane of a flat one
    miss it.
    """
    slack = 0.0
    for n in range(corners.shape[0]):
        for i in range(3):
            for axis in range(3):
                slack = max(slack, abs(corners[n, i, axis]))
    slack *= 1e-11
    first_leaf = boxes.shape[0] // 2
    # backwards: children have higher numbers than their parent
    for node in range(boxes.shape[0] - 1, -1, -1):
        start = (node - first_leaf) * LEAF_SIZE
        for axis in range(3):
            low, high = np.inf, -np.inf
            if node < first_leaf:
                low = min(boxes[2 * node + 1, 0, axis], boxes[2 * node + 2, 0, axis])
                high = max(boxes[2 * node + 1, 1, axis], boxes[2 * node + 2, 1, axis])
            else:
                for n in range(start, min(start + LEAF_SIZE, corners.shape[0])):
                    a, b, c = corners[n, 0, axis], corners[n, 1, axis], corners[n, 2, axis]
                    low, high = min(low, min(a, b, c) - slack), max(high, max(a, b, c) + slack)
            boxes[node, 0, axis], boxes[node, 1, axis] = low, high
    return slack


def _boxes_of(corners: Floats) -> tuple[Floats, float]:
    """AABBs (nodes, 2, 3) over sorted triangles (T, 3, 3), and the tree's slack."""
    n_leaves = 1
    while n_leaves * LEAF_SIZE < len(corners):
        n_leaves *= 2
    boxes = np.empty((2 * n_leaves - 1, 2, 3))
    return boxes, float(boxes_kernel(corners, boxes))


@leaf
def _line_meets_box(ox, oy, oz, ix, iy, iz, boxes, node):
    """Slab test: whether the line through o, of inverse direction i, meets the node's AABB."""
    a = (boxes[node, 0, 0] - ox) * ix
    b = (boxes[node, 1, 0] - ox) * ix
    # a line, not a ray: `near` may be negative, since both directions are counted
    near = min(a, b)
    far = max(a, b)
    a = (boxes[node, 0, 1] - oy) * iy
    b = (boxes[node, 1, 1] - oy) * iy
    near = max(near, min(a, b))
    far = min(far, max(a, b))
    a = (boxes[node, 0, 2] - oz) * iz
    b = (boxes[node, 1, 2] - oz) * iz
    near = max(near, min(a, b))
    far = min(far, max(a, b))
    return near <= far


@leaf
def _crossing_side(ox, oy, oz, dx, dy, dz, corners, n, slack):
    """Crossing of the line through o along d with triangle n: 1 ahead, -1 behind, TOUCH at o, or 0.

    Moeller and Trumbore, Journal of Graphics Tools 2(1), 1997.
    """
    x, y, z = corners[n, 0, 0], corners[n, 0, 1], corners[n, 0, 2]
    ax, ay, az = corners[n, 1, 0] - x, corners[n, 1, 1] - y, corners[n, 1, 2] - z
    bx, by, bz = corners[n, 2, 0] - x, corners[n, 2, 1] - y, corners[n, 2, 2] - z
    sx, sy, sz = ox - x, oy - y, oz - z
    px, py, pz = dy * bz - dz * by, dz * bx - dx * bz, dx * by - dy * bx
    det = ax * px + ay * py + az * pz
    if det == 0.0:  # parallel to the line, or degenerate
        return 0
    u = (sx * px + sy * py + sz * pz) / det
    if u < 0.0 or u > 1.0:
        return 0
    qx, qy, qz = sy * az - sz * ay, sz * ax - sx * az, sx * ay - sy * ax
    v = (dx * qx + dy * qy + dz * qz) / det
    if v < 0.0 or u + v > 1.0:
        return 0
    distance = (bx * qx + by * qy + bz * qz) / det
    if abs(distance) <= slack:
        return TOUCH
    return 1 if distance > 0.0 else -1


@leaf
def crossings(origin, direction, body, skip, tree, stack):
    """Crossings of a line with one body, ahead of the origin and behind it, and nodes visited.

    Face `skip`, the line's own face, is not tested. So the start needs no offset from it, and walls
    may be arbitrarily thin. Both counts are -1 if the start lies on another triangle.
    """
    ox, oy, oz = origin[0], origin[1], origin[2]
    dx, dy, dz = direction[0], direction[1], direction[2]
    ix, iy, iz = 1.0 / dx, 1.0 / dy, 1.0 / dz
    first_leaf = tree.boxes.shape[0] // 2
    n_triangles = tree.corners.shape[0]
    ahead = 0
    behind = 0
    visits = 0
    stack[0] = 0
    top = 1
    while top > 0:
        visits += 1
        top -= 1
        node = stack[top]
        # sorted by body: a subtree without the body is skipped by its span
        if tree.spans[node, 0] > body or tree.spans[node, 1] < body:
            continue
        if not _line_meets_box(ox, oy, oz, ix, iy, iz, tree.boxes, node):
            continue
        if node < first_leaf:
            stack[top] = 2 * node + 2
            stack[top + 1] = 2 * node + 1
            top += 2
            continue
        start = (node - first_leaf) * LEAF_SIZE
        for n in range(start, min(start + LEAF_SIZE, n_triangles)):
            if tree.bodies[n] != body or tree.faces[n] == skip:
                continue
            side = _crossing_side(ox, oy, oz, dx, dy, dz, tree.corners, n, tree.slack)
            if side == TOUCH:
                return -1, -1, visits
            if side > 0:
                ahead += 1
            elif side < 0:
                behind += 1
    return ahead, behind, visits


@entry(TREE, INTS2, FLOATS2, FLOATS2, FLOATS2, INTS, INTS)
def side_votes_kernel(tree, picks, directions, centroids, normals, body_of, out):
    """For each patch, votes for inward normals minus votes for outward ones.

    picks (P, L) int64 faces, -1 for none; directions (L, 3); centroids, normals (F, 3); body_of
    (F,) int64; out (P,) int64. A line from a face of a closed surface crosses the rest of it an odd
    number of times on the inner side of the face, and an even number on the other side. Other
    parities come from a hole or a rounding error and have no vote. `LABOUR` is shared evenly: if
    each line crosses thousands of triangles, some patches get fewer lines, or none.
    """
    stack = np.empty(STACK, dtype=np.int64)
    spent = 0
    for p in range(picks.shape[0]):
        votes = 0
        for line in range(picks.shape[1]):
            face = picks[p, line]
            if face < 0:
                continue
            # shared evenly up to this patch: unspent labour goes to the next ones
            if spent > LABOUR * (p + 1) / picks.shape[0]:
                break
            ahead, behind, visits = crossings(
                centroids[face], directions[line], body_of[face], face, tree, stack
            )
            spent += visits
            # the own face is skipped, so the parities differ by one on a closed surface
            if ahead < 0 or ahead % 2 == behind % 2:
                continue
            along = 0.0
            for axis in range(3):
                along += directions[line, axis] * normals[face, axis]
            votes += 1 if (along > 0.0) == (ahead % 2 == 1) else -1
            if abs(votes) >= ENOUGH:
                break
        out[p] = votes


@entry(TREE, INTS2, INTS2, FLOATS2, FLOATS2, BYTES)
def nesting_kernel(tree, pairs, picks, directions, centroids, out):
    """For each pair (inner, outer) of bodies, whether the outer one encloses all of the inner one.

    pairs (Q, 2) int64; picks (B, L) int64 faces of each body, -1 for none; out (Q,) uint8. One line
    with its start outside decides against it.
    """
    stack = np.empty(STACK, dtype=np.int64)
    for q in range(pairs.shape[0]):
        n_inside = 0
        n_outside = 0
        for line in range(picks.shape[1]):
            face = picks[pairs[q, 0], line]
            if face < 0:
                continue
            ahead, behind, _ = crossings(
                centroids[face], directions[line], pairs[q, 1], np.int64(-1), tree, stack
            )
            if ahead < 0 or ahead % 2 != behind % 2:
                continue
            if ahead % 2 == 1:
                n_inside += 1
            else:
                n_outside += 1
                break
        out[q] = 1 if n_inside > 0 and n_outside == 0 else 0


def normals_of(triangles: Floats) -> tuple[Floats, Floats]:
    """Unit normals (F, 3) by the winding, and areas (F,); zero for degenerate triangles."""
    along = triangles[:, 1] - triangles[:, 0]
    across = triangles[:, 2] - triangles[:, 0]
    cross = np.cross(along, across)
    double = np.linalg.norm(cross, axis=1)
    longest = np.maximum((along**2).sum(axis=1), (across**2).sum(axis=1))
    is_degenerate = ~(double > 1e-12 * longest)  # below, the normal is rounding
    double[is_degenerate] = 0.0
    normals = cross / np.where(is_degenerate, 1.0, double)[:, None]
    normals[is_degenerate] = 0.0
    return normals, double / 2.0


def body_boxes(triangles: Floats, bodies: Ints) -> Floats:
    """Boxes (B, 2, 3) of bodies 0 .. B - 1 (F,) of triangles (F, 3, 3); inside out without any."""
    order = np.argsort(bodies, kind="stable")
    found, starts = np.unique(bodies[order], return_index=True)
    boxes = np.full((int(found[-1]) + 1, 2, 3), np.inf)
    boxes[:, 1] = -np.inf
    boxes[found, 0] = np.minimum.reduceat(triangles.min(axis=1)[order], starts)
    boxes[found, 1] = np.maximum.reduceat(triangles.max(axis=1)[order], starts)
    return boxes


def _pick_faces(group: Ints, areas: Floats, n_groups: int) -> Ints:
    """`MOST_VOTES` faces of each group in proportion to their area, (n_groups, MOST_VOTES).

    group (F,) : of each face. Small groups repeat their faces; a group without area has none: -1.
    """
    totals = np.bincount(group, areas, n_groups)
    order = np.argsort(group, kind="stable")
    order = order[areas[order] > 0.0]
    filled = np.cumsum(areas[order] / totals[group[order]])  # a filled group takes up 1
    starts = np.cumsum(totals > 0.0) - 1.0
    # Multiples of the golden ratio: the first few picks, however many, cover the whole group.
    wanted = starts[:, None] + (np.arange(MOST_VOTES) * 0.6180339887498949 + 0.5) % 1.0
    picks = order[np.minimum(np.searchsorted(filled, wanted), len(order) - 1)]
    is_own = group[picks] == np.arange(n_groups)[:, None]
    return np.where(is_own, picks, -1).astype(np.int64)


@cache
def directions_of(n: int) -> Floats:
    """`n` fixed unit vectors, uniform over the sphere, none along an axis."""
    directions = np.random.default_rng(2015).normal(size=(n, 3))
    directions[np.abs(directions) < 1e-3] = 1e-3
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions


def side_votes(
    tree: TriangleBVH,
    patch: Ints,
    body: Ints,
    areas: Floats,
    centroids: Floats,
    normals: Floats,
) -> Ints:
    """Votes (P,) on each patch: positive for inward normals.

    patch, body, areas (F,); centroids, normals (F, 3). In a patch all normals are on one side.
    """
    picks = _pick_faces(patch, areas, int(patch.max()) + 1)
    votes = np.zeros(len(picks), dtype=np.int64)
    side_votes_kernel(tree, picks, directions_of(MOST_VOTES), centroids, normals, body, votes)
    return votes


def enclosures(
    tree: TriangleBVH,
    pairs: Ints,
    body: Ints,
    areas: Floats,
    centroids: Floats,
) -> NDArray[np.bool_]:
    """For each pair (inner, outer) of bodies, whether the outer body encloses the inner body."""
    picks = _pick_faces(body, areas, int(body.max()) + 1)
    out = np.zeros(len(pairs), dtype=np.uint8)
    nesting_kernel(tree, pairs, picks, directions_of(MOST_VOTES), centroids, out)
    return out.astype(np.bool_)


def encloses(tree: TriangleBVH, body: int, positions: Floats) -> NDArray[np.bool_]:
    """Whether a closed body of the tree encloses each of the positions (Q, 3): (Q,)."""
    numbers = np.arange(len(positions))
    pairs = np.stack([numbers, np.full(len(positions), body)], axis=1)
    picks = np.repeat(numbers[:, None], MOST_VOTES, axis=1)
    out = np.zeros(len(positions), dtype=np.uint8)
    nesting_kernel(tree, pairs, picks, directions_of(MOST_VOTES), positions, out)
    return out.astype(np.bool_)

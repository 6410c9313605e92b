"""Distance of two surfaces: a traversal of both BVHs of AABBs (`surfaces.triangle_bvh`).

A pair of nodes with boxes farther apart than the nearest triangles so far, along the axes of
either, is pruned. The bound from below is proved for each pair of triangles (`pairs`), and
distances of boxes are rounded down, so it is never too large.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import FLOAT, FLOATS, FLOATS2, FLOATS3, INTS, INTS2, entry, leaf
from hapticdb.kernels.rigid import moved, transform_of
from hapticdb.kernels.surfaces.point_distance import sides_of
from hapticdb.kernels.surfaces.triangle_bvh import LEAF_SIZE, TREE, TriangleBVH
from hapticdb.kernels.triangles.triangle_distance import ROUNDING, measure_pair

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

WAITING = 256
"""Pairs of nodes on the stack: more than the height of two trees over 2^31 leaves."""


FLAT = 1e-3
"""Least area of a triangle with an exact enough normal, as twice a share of its longest edge
squared."""
PLANE = 1e-12
"""Greatest error of a distance from a plane, as a share of the largest coordinate: more than the
effect of a normal's rounding, 2e-16 / `FLAT`."""
TURNED = 0.98
"""Greatest share of an axis of a turned tree along any axis of the other one: 11 degrees. Below
that, its own axes prune too little for their time."""
RIGID = 1e-6
"""Greatest error of a rotation for a test along its own axes; a surface may be stretched, too."""


@leaf
def place_corners(corners, first, last, pose, out):
    """Write triangles first .. last - 1, moved by a pose (4, 4), into out (.., 3, 3)."""
    transform = transform_of(pose)
    for n in range(first, last):
        for i in range(3):
            x, y, z = moved(transform, corners[n, i, 0], corners[n, i, 1], corners[n, i, 2])
            out[n - first, i, 0], out[n - first, i, 1], out[n - first, i, 2] = x, y, z


@leaf
def middle_of(boxes, node):
    """Middle of a box, and half of each edge."""
    x = 0.5 * (boxes[node, 0, 0] + boxes[node, 1, 0])
    y = 0.5 * (boxes[node, 0, 1] + boxes[node, 1, 1])
    z = 0.5 * (boxes[node, 0, 2] + boxes[node, 1, 2])
    return x, y, z, boxes[node, 1, 0] - x, boxes[node, 1, 1] - y, boxes[node, 1, 2] - z


@leaf
def box_gap(boxes, node, others, other, pose, slack):
    """Squared distance, at most, of a node's box and that of another tree, moved by a pose."""
    if boxes[node, 0, 0] > boxes[node, 1, 0] or others[other, 0, 0] > others[other, 1, 0]:
        return math.inf
    square = 0.0
    cx, cy, cz, hx, hy, hz = middle_of(others, other)
    for axis in range(3):
        middle = pose[axis, 0] * cx + pose[axis, 1] * cy + pose[axis, 2] * cz + pose[axis, 3]
        # AABB of the moved box (Arvo): |R| h, without its eight corners
        half = abs(pose[axis, 0]) * hx + abs(pose[axis, 1]) * hy + abs(pose[axis, 2]) * hz + slack
        gap = max(boxes[node, 0, axis] - middle - half, middle - half - boxes[node, 1, axis], 0.0)
        square += gap * gap
    return square


@leaf
def own_slack(pose, size):
    """Margin of `own_gap` for rounding and an inexact rotation; infinite without that test.

    Of vectors up to 6 sizes long, an error e of the products of the axes changes the length by
    9 e sizes, and the origin of the other box by 3 e sizes.
    """
    error, is_turned = 0.0, False
    for i in range(3):
        is_turned = is_turned or max(abs(pose[0, i]), abs(pose[1, i]), abs(pose[2, i])) < TURNED
        for j in range(3):
            dot = pose[0, i] * pose[0, j] + pose[1, i] * pose[1, j] + pose[2, i] * pose[2, j]
            error = max(error, abs(dot - (1.0 if i == j else 0.0)))
    return 16.0 * (error + ROUNDING) * size if is_turned and error <= RIGID else math.inf


@leaf
def own_gap(boxes, node, others, other, pose, slack):
    """Squared distance, at most, as `box_gap`, along the axes of the other tree's box."""
    square = 0.0
    cx, cy, cz, hx, hy, hz = middle_of(boxes, node)
    cx, cy, cz = cx - pose[0, 3], cy - pose[1, 3], cz - pose[2, 3]
    for axis in range(3):
        # transposed rotation: it is the inverse only up to the error in `slack`
        middle = pose[0, axis] * cx + pose[1, axis] * cy + pose[2, axis] * cz
        half = abs(pose[0, axis]) * hx + abs(pose[1, axis]) * hy + abs(pose[2, axis]) * hz + slack
        gap = max(others[other, 0, axis] - middle - half, middle - half - others[other, 1, axis])
        square += max(gap, 0.0) ** 2
    return square


@leaf
def _extent(boxes, node):
    """Sum of a box's edges."""
    return (
        (boxes[node, 1, 0] - boxes[node, 0, 0])
        + (boxes[node, 1, 1] - boxes[node, 0, 1])
        + (boxes[node, 1, 2] - boxes[node, 0, 2])
    )


@leaf
def largest(boxes):
    """Largest coordinate of the box of all."""
    found = 0.0
    for axis in range(3):
        found = max(found, abs(boxes[0, 0, axis]), abs(boxes[0, 1, axis]))
    return found


@leaf
def triangle_gap(one, n, other, m):
    """Squared distance of the boxes of two triangles."""
    square = 0.0
    for axis in range(3):
        low = min(one[n, 0, axis], one[n, 1, axis], one[n, 2, axis])
        high = max(one[n, 0, axis], one[n, 1, axis], one[n, 2, axis])
        below = min(other[m, 0, axis], other[m, 1, axis], other[m, 2, axis])
        above = max(other[m, 0, axis], other[m, 1, axis], other[m, 2, axis])
        gap = max(low - above, below - high, 0.0)
        square += gap * gap
    return square


@leaf
def plane_gap(one, n, other, m):
    """Distance of triangle m from the plane of triangle n, all of it on one side; else 0."""
    x, y, z, ux, uy, uz, vx, vy, vz, nx, ny, nz = sides_of(one, n)
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    longest = max(ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz)
    # a degenerate triangle's normal is rounding: it bounds nothing
    if not length > FLAT * longest:
        return 0.0
    low, high = math.inf, -math.inf
    for i in range(3):
        off = (other[m, i, 0] - x) * nx + (other[m, i, 1] - y) * ny + (other[m, i, 2] - z) * nz
        low, high = min(low, off), max(high, off)
    return max(low, -high, 0.0) / length


@leaf
def _end_along(corners, first, last, x, y, z, sign):
    """Begin of triangles first .. last - 1 along a direction, or along its opposite: sign -1."""
    end = math.inf
    for n in range(first, last):
        for i in range(3):
            along = x * corners[n, i, 0] + y * corners[n, i, 1] + z * corners[n, i, 2]
            end = min(end, sign * along)
    return end


@leaf
def _measure_leaves(a, node, b, other, pose, size, placed, found, pair, out):
    """Measure the triangles of two leaves; notes pairs nearer than out[0] from below.

    The nearest pair from above has its triangles in pair (2,) and its places in out[2:8]. Most
    triangles are apart along the direction of these places, and are not measured.
    """
    begin = (other - b.boxes.shape[0] // 2) * LEAF_SIZE
    end = min(begin + LEAF_SIZE, b.corners.shape[0])
    place_corners(b.corners, begin, end, pose, placed)
    first = (node - a.boxes.shape[0] // 2) * LEAF_SIZE
    last = min(first + LEAF_SIZE, a.corners.shape[0])
    # no direction yet: the null vector separates nothing
    x, y, z = 0.0, 0.0, 0.0
    if 0.0 < out[1] < math.inf:
        x, y, z = (out[2] - out[5]) / out[1], (out[3] - out[6]) / out[1], (out[4] - out[7]) / out[1]
    far = out[0] + PLANE * size
    high = _end_along(placed, 0, end - begin, x, y, z, -1.0)
    if _end_along(a.corners, first, last, x, y, z, 1.0) + high >= far:
        return
    for n in range(first, last):
        low = _end_along(a.corners, n, n + 1, x, y, z, 1.0)
        if low + high >= far:
            continue
        for m in range(begin, end):
            far = out[0] + PLANE * size
            # from the cheapest test to the dearest
            if (
                low + _end_along(placed, m - begin, m - begin + 1, x, y, z, -1.0) < far
                and triangle_gap(a.corners, n, placed, m - begin) < out[0] * out[0]
                and plane_gap(a.corners, n, placed, m - begin) < far
                and plane_gap(placed, m - begin, a.corners, n) < far
            ):
                below, above = measure_pair(a.corners, n, placed, m - begin, size, found)
                _keep(below, above, n, m, found, pair, out)


@leaf
def _keep(below, above, n, m, found, pair, out):
    """Note a pair of triangles if it is the nearest so far."""
    is_nearer = below < out[0]
    if is_nearer:
        out[0] = below
    # the first pair must be within the distance of interest; later ones need only be nearer
    if above < out[1] and (is_nearer or pair[0] >= 0):
        out[1] = above
        pair[0], pair[1] = n, m
        for k in range(6):
            out[2 + k] = found[1 + k]


@leaf
def nearest_pair(a, b, pose, enough, nodes, squares, placed, found, pair, out):
    """Find the nearest triangles of tree a and of tree b, moved by a pose (4, 4) into a's frame.

    out (8,): bounds of the distance from below and from above, at first the greatest distance of
    interest and infinity, then the place on each; an upper bound of `enough` or less ends the
    search. pair (2,): triangles for a first try, or -1; afterwards the nearest ones, or -1.
    nodes (.., 2), squares, placed, found are scratch.
    """
    size = largest(a.boxes)
    reach = largest(b.boxes)
    for axis in range(3):
        size = max(size, abs(pose[axis, 3]) + 2.0 * reach)
    slack, turned_slack = ROUNDING * size, own_slack(pose, size)
    first, second = pair[0], pair[1]
    pair[0], pair[1] = -1, -1
    if first >= 0:
        # the nearest pair of the pose before: a tight bound before the first box
        place_corners(b.corners, second, second + 1, pose, placed)
        below, above = measure_pair(a.corners, first, placed, 0, size, found)
        _keep(below, above, first, second, found, pair, out)
    leaves_a, leaves_b = a.boxes.shape[0] // 2, b.boxes.shape[0] // 2
    nodes[0, 0], nodes[0, 1] = 0, 0
    squares[0] = box_gap(a.boxes, np.int64(0), b.boxes, np.int64(0), pose, slack)
    top = 1
    while top > 0 and out[1] > enough:
        top -= 1
        # tested again: the bound may have fallen while the entry waited
        if not squares[top] < out[0] * out[0]:
            continue
        node, other = nodes[top, 0], nodes[top, 1]
        if (
            # the other box's axes, after the cheaper test on the stack
            turned_slack < math.inf
            and own_gap(a.boxes, node, b.boxes, other, pose, turned_slack) >= out[0] * out[0]
        ):
            continue
        if node >= leaves_a and other >= leaves_b:
            _measure_leaves(a, node, b, other, pose, size, placed, found, pair, out)
            continue
        if other >= leaves_b or (
            node < leaves_a and _extent(a.boxes, node) >= _extent(b.boxes, other)
        ):
            near, far, near_other, far_other = 2 * node + 1, 2 * node + 2, other, other
        else:
            near, far, near_other, far_other = node, node, 2 * other + 1, 2 * other + 2
        here = box_gap(a.boxes, near, b.boxes, near_other, pose, slack)
        there = box_gap(a.boxes, far, b.boxes, far_other, pose, slack)
        if there < here:
            near, far, near_other, far_other = far, near, far_other, near_other
            here, there = there, here
        # the nearer pair on top: it tightens the bound before the other is visited
        nodes[top, 0], nodes[top, 1], squares[top] = far, far_other, there
        top += 1
        nodes[top, 0], nodes[top, 1], squares[top] = near, near_other, here
        top += 1


@entry(TREE, TREE, FLOATS3, FLOATS, FLOAT, INTS2, FLOATS2)
def nearest_kernel(a, b, poses, farthest, enough, pairs, out):
    """Find the nearest triangles at poses (N, 4, 4) of b in a's frame.

    farthest (N,): the greatest distance of interest; enough, pairs (N, 2), out (N, 8): as for
    `nearest_pair`. The pair of a pose is tried first at the next one without any.
    """
    nodes = np.empty((WAITING, 2), dtype=np.int64)
    squares = np.empty(WAITING)
    placed = np.empty((LEAF_SIZE, 3, 3))
    found = np.empty(7)
    for n in range(poses.shape[0]):
        if n and pairs[n, 0] < 0:
            pairs[n, 0], pairs[n, 1] = pairs[n - 1, 0], pairs[n - 1, 1]
        out[n, 0], out[n, 1] = farthest[n], math.inf
        nearest_pair(a, b, poses[n], enough, nodes, squares, placed, found, pairs[n], out[n])


@leaf
def are_near(one, n, other, m, far, found):
    """Whether two triangles are within `far` metres; found (7,) is scratch."""
    return (
        triangle_gap(one, n, other, m) < far * far
        and measure_pair(one, n, other, m, 0.0, found)[1] <= far
    )


@entry(TREE, TREE, FLOATS2, FLOATS2, INTS2, FLOAT, INTS)
def free_shift_kernel(a, b, pose, shifts, first, far, out):
    """Find a shift after which tree b, at a pose (4, 4) in a's frame, is `far` metres from a.

    shifts (N, 3); first (M, 2): pairs of triangles that are tested first. out (3,): the number of
    the shift to begin with, then that of the free one, N without any; and, from -1, a pair too near
    after a shift before it.
    """
    nodes = np.empty((WAITING, 2), dtype=np.int64)
    squares, placed, found = np.empty(WAITING), np.empty((LEAF_SIZE, 3, 3)), np.empty(7)
    pair, near, here = np.full(2, -1, dtype=np.int64), np.empty(8), pose.copy()
    while out[0] < shifts.shape[0]:
        for axis in range(3):
            here[axis, 3] = pose[axis, 3] + shifts[out[0], axis]
        is_free = True
        for n in range(first.shape[0]):
            place_corners(b.corners, first[n, 1], first[n, 1] + 1, here, placed)
            is_free = not are_near(a.corners, first[n, 0], placed, 0, far, found)
            if not is_free:
                break
        if is_free:
            near[0], near[1] = far, math.inf
            nearest_pair(a, b, here, far, nodes, squares, placed, found, pair, near)
            if pair[0] < 0:
                return
            if out[1] < 0:
                out[1], out[2] = pair[0], pair[1]
        out[0] += 1


class Nearest(NamedTuple):
    """Distances of two surfaces at N poses, metres, in the frame of the first.

    at_least, at_most (N,): bounds; beyond the greatest distance of interest, that distance and
    infinity; on_a, on_b (N, 3): the nearest places, at the distance `at_most`; pairs (N, 2):
    numbers of the triangles in the trees, -1 beyond that distance.
    """

    at_least: Floats
    at_most: Floats
    on_a: Floats
    on_b: Floats
    pairs: Ints


def nearest(
    a: TriangleBVH, b: TriangleBVH, poses: Floats, farthest: Floats, enough: float = 0.0
) -> Nearest:
    """Measure two surfaces at poses (N, 4, 4) of the second in the frame of the first.

    farthest (N,): the greatest distance of interest. Within `enough` the search ends early:
    `at_most` is a distance, but not the least, and `at_least` has no meaning.
    """
    pairs = np.full((len(poses), 2), -1, dtype=np.int64)
    out = np.zeros((len(poses), 8))
    nearest_kernel(
        a, b, np.ascontiguousarray(poses), np.ascontiguousarray(farthest), enough, pairs, out
    )
    return Nearest(out[:, 0], out[:, 1], out[:, 2:5], out[:, 5:], pairs)

"""Where edges go through a surface."""

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import FLOATS, FLOATS2, FLOATS3, INTS2, entry, leaf
from hapticdb.kernels.surfaces.sides import LEAF_SIZE, STACK, TREE, TriangleTree
from hapticdb.kernels.triangles.nearest import largest
from hapticdb.kernels.triangles.pairs import edge_goes_through

BESIDE = 1e-9
"""Share of a triangle's height by which an edge may pass beside it and still goes through. Without
it, rounding lets an edge slip between two triangles."""
ASIDE = 8.0 * BESIDE
"""Greatest distance of a place on an edge from the triangle that the edge goes through there, as a
share of the surface's largest coordinate: beside a corner it is `BESIDE` of two sides, and no side
is longer than the diagonal of a box of twice that coordinate."""
TOGETHER = 8
"""Edges that walk through the tree together. More: fewer walks, through more boxes."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@leaf
def _are_apart(corners, n, one, e, margin):
    """Whether the box of triangle n is farther than `margin` from that of an edge."""
    for axis in range(3):
        a, b, c = corners[n, 0, axis], corners[n, 1, axis], corners[n, 2, axis]
        low, high = min(one[e, 0, axis], one[e, 1, axis]), max(one[e, 0, axis], one[e, 1, axis])
        if min(a, b, c) > high + margin or max(a, b, c) < low - margin:
            return True
    return False


@leaf
def _place_edges(edges, first, last, pose, one, low, high):
    """Write edges first .. last - 1, moved by a pose, into one (.., 3, 3), and their common box."""
    for axis in range(3):
        low[axis], high[axis] = np.inf, -np.inf
        for e in range(first, last):
            for end in range(2):
                x = pose[axis, 3]
                for k in range(3):
                    x += pose[axis, k] * edges[e, end, k]
                one[e - first, end, axis] = x
                low[axis], high[axis] = min(low[axis], x), max(high[axis], x)
            one[e - first, 2, axis] = one[e - first, 1, axis]


@leaf
def _misses(one, e, boxes, node):
    """Whether the box of an edge is beside a node's."""
    for axis in range(3):
        a, b = one[e, 0, axis], one[e, 1, axis]
        if min(a, b) > boxes[node, 1, axis] or max(a, b) < boxes[node, 0, axis]:
            return True
    return False


@entry(FLOATS3, TREE, FLOATS2, INTS2, FLOATS)
def piercing_kernel(edges, tree, pose, where, shares):
    """Find where edges (E, 2, 3), moved by a pose (4, 4) into the tree's frame, go through it.

    where (P, 2): edge and triangle of the tree; shares (P,): share of the edge. Returns how many
    there are, which may be more than P. An edge in a triangle's plane does not go through it.
    `TOGETHER` edges walk through the tree at once, so neighbours should be near one another.
    """
    waiting = np.empty(STACK, dtype=np.int64)
    one = np.zeros((TOGETHER, 3, 3))
    low, high = np.empty(3), np.empty(3)
    boxes = tree.boxes
    first_leaf = boxes.shape[0] // 2
    margin = ASIDE * largest(boxes)
    count = 0
    for first in range(0, edges.shape[0], TOGETHER):
        last = min(first + TOGETHER, edges.shape[0])
        _place_edges(edges, first, last, pose, one, low, high)
        waiting[0] = 0
        top = 1
        while top > 0:
            top -= 1
            node = waiting[top]
            is_apart = False
            for axis in range(3):
                if low[axis] > boxes[node, 1, axis] or high[axis] < boxes[node, 0, axis]:
                    is_apart = True
            if is_apart:
                continue
            if node < first_leaf:
                waiting[top], waiting[top + 1] = 2 * node + 1, 2 * node + 2
                top += 2
                continue
            start = (node - first_leaf) * LEAF_SIZE
            end = min(start + LEAF_SIZE, tree.corners.shape[0])
            for e in range(last - first):
                if _misses(one, e, boxes, node):
                    continue
                for n in range(start, end):
                    if _are_apart(tree.corners, n, one, e, margin):
                        continue
                    share = edge_goes_through(one, e, np.int64(0), tree.corners, n, BESIDE)
                    if share >= 0.0:
                        if count < shares.shape[0]:
                            where[count, 0], where[count, 1], shares[count] = first + e, n, share
                        count += 1
    return count


def piercing(edges: Floats, tree: TriangleTree, pose: Floats) -> tuple[Ints, Ints, Floats]:
    """Edges (P,), triangles (P,) and shares (P,) where edges (E, 2, 3) go through, in any order.

    Triangles are numbers in the tree.
    """
    most = 4 * len(edges) + 1024
    while True:
        where, shares = np.empty((most, 2), dtype=np.int64), np.empty(most)
        count = piercing_kernel(edges, tree, np.ascontiguousarray(pose), where, shares)
        if count <= most:
            return where[:count, 0], where[:count, 1], shares[:count]
        most = count

"""Where edges go through a surface."""

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import FLOATS, FLOATS2, FLOATS3, INTS2, entry
from hapticdb.kernels.surfaces.sides import LEAF_SIZE, STACK, TREE, TriangleTree
from hapticdb.kernels.triangles.pairs import edge_goes_through

BESIDE = 1e-9
"""Share of a triangle's height by which an edge may pass beside it and still goes through. Without
it, rounding lets an edge slip between two triangles."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@entry(FLOATS3, TREE, FLOATS2, INTS2, FLOATS)
def piercing_kernel(edges, tree, pose, where, shares):
    """Find where edges (E, 2, 3), moved by a pose (4, 4) into the tree's frame, go through it.

    where (P, 2): edge and triangle of the tree; shares (P,): share of the edge. Returns how many
    there are, which may be more than P. An edge in a triangle's plane does not go through it.
    """
    waiting = np.empty(STACK, dtype=np.int64)
    one = np.zeros((1, 3, 3))
    low, high = np.empty(3), np.empty(3)
    boxes = tree.boxes
    first_leaf = boxes.shape[0] // 2
    n_triangles = tree.corners.shape[0]
    count = 0
    for e in range(edges.shape[0]):
        for axis in range(3):
            for end in range(2):
                one[0, end, axis] = pose[axis, 3]
                for k in range(3):
                    one[0, end, axis] += pose[axis, k] * edges[e, end, k]
            one[0, 2, axis] = one[0, 1, axis]
            low[axis] = min(one[0, 0, axis], one[0, 1, axis])
            high[axis] = max(one[0, 0, axis], one[0, 1, axis])
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
            for n in range(start, min(start + LEAF_SIZE, n_triangles)):
                share = edge_goes_through(one, np.int64(0), np.int64(0), tree.corners, n, BESIDE)
                if share >= 0.0:
                    if count < shares.shape[0]:
                        where[count, 0], where[count, 1], shares[count] = e, n, share
                    count += 1
    return count


def piercing(edges: Floats, tree: TriangleTree, pose: Floats) -> tuple[Ints, Ints, Floats]:
    """Edges (P,), triangles (P,) and shares (P,) where edges (E, 2, 3) go through; by edge, share.

    Triangles are numbers in the tree.
    """
    most = 1024
    while True:
        where, shares = np.empty((most, 2), dtype=np.int64), np.empty(most)
        count = piercing_kernel(edges, tree, np.ascontiguousarray(pose), where, shares)
        if count <= most:
            break
        most = count
    where, shares = where[:count], shares[:count]
    order = np.lexsort((shares, where[:, 0]))
    return where[order, 0], where[order, 1], shares[order]

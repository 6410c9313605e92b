"""Distance from a point to the nearest triangle, by a BVH of AABBs.

The BVH is `triangle_bvh.TriangleBVH`. Branch and bound: nodes beyond the nearest triangle so far
are pruned, so the distance equals the minimum over all triangles. Lengths are in metres, in one
frame of the caller's choice.
"""

import numpy as np

from hapticdb.kernels._jit import inlined, leaf
from hapticdb.kernels.rigid import gap, moment
from hapticdb.kernels.surfaces.triangle_bvh import LEAF_SIZE

ROUNDED = 1.0 + 1e-9
"""Margin of pruning by a triangle's AABB, on squared distances, for rounding."""


@leaf
def _square_to_box(boxes, node, x, y, z):
    """Squared distance from (x, y, z) to the node's AABB; infinite if the node is empty."""
    dx = gap(x, boxes[node, 0, 0], boxes[node, 1, 0])
    dy = gap(y, boxes[node, 0, 1], boxes[node, 1, 1])
    dz = gap(z, boxes[node, 0, 2], boxes[node, 1, 2])
    return dx * dx + dy * dy + dz * dz


@leaf
def _square_to_own_box(corners, n, x, y, z):
    """Squared distance from (x, y, z) to the AABB of triangle n."""
    a, b, c = corners[n, 0, 0], corners[n, 1, 0], corners[n, 2, 0]
    dx = gap(x, min(a, b, c), max(a, b, c))
    a, b, c = corners[n, 0, 1], corners[n, 1, 1], corners[n, 2, 1]
    dy = gap(y, min(a, b, c), max(a, b, c))
    a, b, c = corners[n, 0, 2], corners[n, 1, 2], corners[n, 2, 2]
    dz = gap(z, min(a, b, c), max(a, b, c))
    return dx * dx + dy * dy + dz * dz


@leaf
def _square_to_edge(px, py, pz, ux, uy, uz):
    """Squared distance from p to the edge from the origin to u."""
    length = ux * ux + uy * uy + uz * uz
    share = 0.0
    if length > 0.0:
        share = min(max((px * ux + py * uy + pz * uz) / length, 0.0), 1.0)
    x, y, z = px - share * ux, py - share * uy, pz - share * uz
    return x * x + y * y + z * z


@inlined
def sides_of(corners, n):
    """Corner a of triangle n, its edge vectors u and v from there, and u x v: twelve numbers."""
    ax, ay, az = corners[n, 0, 0], corners[n, 0, 1], corners[n, 0, 2]
    ux, uy, uz = corners[n, 1, 0] - ax, corners[n, 1, 1] - ay, corners[n, 1, 2] - az
    vx, vy, vz = corners[n, 2, 0] - ax, corners[n, 2, 1] - ay, corners[n, 2, 2] - az
    nx, ny, nz = moment(ux, uy, uz, vx, vy, vz)
    return ax, ay, az, ux, uy, uz, vx, vy, vz, nx, ny, nz


@inlined
def shares_of(sides, x, y, z):
    """Barycentric coordinates of a point's projection on a triangle, without a division.

    sides : as from `sides_of`; (x, y, z) : the point relative to corner a. Returns |u x v|^2, and
    the coordinates along u and v times that; the projection is inside if both are at least 0 and
    add up to at most the first.
    """
    _, _, _, ux, uy, uz, vx, vy, vz, nx, ny, nz = sides
    along = (y * vz - z * vy) * nx + (z * vx - x * vz) * ny + (x * vy - y * vx) * nz
    across = (uy * z - uz * y) * nx + (uz * x - ux * z) * ny + (ux * y - uy * x) * nz
    return nx * nx + ny * ny + nz * nz, along, across


@leaf
def square_to_triangle(corners, n, x, y, z):
    """Squared distance from (x, y, z) to triangle n: to an edge, or to its interior."""
    sides = sides_of(corners, n)
    ax, ay, az, ux, uy, uz, vx, vy, vz, nx, ny, nz = sides
    px, py, pz = x - ax, y - ay, z - az
    # edges first: they are exact for degenerate triangles, too
    square = min(
        _square_to_edge(px, py, pz, ux, uy, uz),
        _square_to_edge(px, py, pz, vx, vy, vz),
        _square_to_edge(px - ux, py - uy, pz - uz, vx - ux, vy - uy, vz - uz),
    )
    area, along, across = shares_of(sides, px, py, pz)
    if area > 0.0 and along >= 0.0 and across >= 0.0 and along + across <= area:
        over = px * nx + py * ny + pz * nz
        square = min(square, over * over / area)
    return square


@leaf
def distance_at(tree, x, y, z, enough, farthest, hint, waiting, squares):
    """Distance of a point to the nearest triangle, up to `farthest`, and its number, or -1.

    A distance of `enough` or less ends the search, with the distance of some triangle. hint :
    number of a triangle probably near, or -1; waiting, squares (STACK,) : scratch.
    """
    boxes = tree.boxes
    first_leaf = boxes.shape[0] // 2
    n_triangles = tree.corners.shape[0]
    best, found = farthest * farthest, np.int64(-1)
    if hint >= 0:
        square = square_to_triangle(tree.corners, hint, x, y, z)
        if square < best:
            best, found = square, hint
    waiting[0], squares[0] = 0, _square_to_box(boxes, np.int64(0), x, y, z)
    top = 1
    while top > 0 and best > enough * enough:
        top -= 1
        node = waiting[top]
        # again: the best may have improved while the node waited
        if not squares[top] < best:
            continue
        if node < first_leaf:
            near, far = 2 * node + 1, 2 * node + 2
            here = _square_to_box(boxes, near, x, y, z)
            there = _square_to_box(boxes, far, x, y, z)
            if there < here:
                near, far, here, there = far, near, there, here
            # the far child below the near one on the stack: depth-first, nearest first
            if there < best:
                waiting[top], squares[top] = far, there
                top += 1
            if here < best:
                waiting[top], squares[top] = near, here
                top += 1
            continue
        start = (node - first_leaf) * LEAF_SIZE
        for n in range(start, min(start + LEAF_SIZE, n_triangles)):
            # cheaper than the exact distance; ROUNDED covers the rounding of the box's distance
            if _square_to_own_box(tree.corners, n, x, y, z) > ROUNDED * best:
                continue
            square = square_to_triangle(tree.corners, n, x, y, z)
            if square < best:
                best, found = square, np.int64(n)
    return np.sqrt(best), found

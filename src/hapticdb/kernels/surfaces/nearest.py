"""Distances from places to the nearest of many triangles, through a tree of boxes.

The tree is that of `sides`. A node whose box is farther than the nearest triangle so far is not
entered, so the distance is that of testing every triangle. Lengths are in metres, in one frame of
the caller's choice.
"""

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import FLOAT, FLOATS, FLOATS2, INTS, entry, leaf
from hapticdb.kernels.surfaces.sides import LEAF_SIZE, STACK, TREE, TriangleTree

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@leaf
def _square_to_box(boxes, node, x, y, z):
    """Squared distance from (x, y, z) to the node's box; infinite if it holds no triangle."""
    dx = max(boxes[node, 0, 0] - x, x - boxes[node, 1, 0], 0.0)
    dy = max(boxes[node, 0, 1] - y, y - boxes[node, 1, 1], 0.0)
    dz = max(boxes[node, 0, 2] - z, z - boxes[node, 1, 2], 0.0)
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


@leaf
def _square_to_triangle(corners, n, x, y, z):
    """Squared distance from (x, y, z) to triangle n: to an edge, or to the plane above it."""
    ax, ay, az = corners[n, 0, 0], corners[n, 0, 1], corners[n, 0, 2]
    ux, uy, uz = corners[n, 1, 0] - ax, corners[n, 1, 1] - ay, corners[n, 1, 2] - az
    vx, vy, vz = corners[n, 2, 0] - ax, corners[n, 2, 1] - ay, corners[n, 2, 2] - az
    px, py, pz = x - ax, y - ay, z - az
    square = min(
        _square_to_edge(px, py, pz, ux, uy, uz),
        _square_to_edge(px, py, pz, vx, vy, vz),
        _square_to_edge(px - ux, py - uy, pz - uz, vx - ux, vy - uy, vz - uz),
    )
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    area = nx * nx + ny * ny + nz * nz
    if area > 0.0:
        # shares of the corners at the place's image in the plane; all positive inside
        along = (
            (py * vz - pz * vy) * nx + (pz * vx - px * vz) * ny + (px * vy - py * vx) * nz
        )  # fmt: skip
        across = (
            (uy * pz - uz * py) * nx + (uz * px - ux * pz) * ny + (ux * py - uy * px) * nz
        )  # fmt: skip
        if along >= 0.0 and across >= 0.0 and along + across <= area:
            over = px * nx + py * ny + pz * nz
            square = min(square, over * over / area)
    return square


@leaf
def is_flat(corners, n, x, y, z, nx, ny, nz, flat):
    """Whether triangle n lies within `flat` of the plane through (x, y, z) with that normal."""
    for corner in range(3):
        off = (corners[n, corner, 0] - x) * nx
        off += (corners[n, corner, 1] - y) * ny
        off += (corners[n, corner, 2] - z) * nz
        if abs(off) > flat:
            return False
    return True


@leaf
def distance_at(tree, place, own, normal, flat, enough, farthest, hint, waiting, squares):
    """Distance of a place (x, y, z), and the number of its triangle, or -1.

    normal (x, y, z), the others as for `distances_kernel`; hint : number of a triangle that may be
    near and counts, or -1.
    """
    x, y, z = place
    boxes, spans = tree.boxes, tree.spans
    first_leaf = boxes.shape[0] // 2
    n_triangles = tree.corners.shape[0]
    best, found = farthest * farthest, np.int64(-1)
    if hint >= 0:
        square = _square_to_triangle(tree.corners, hint, x, y, z)
        if square < best:
            best, found = square, hint
    waiting[0], squares[0] = 0, _square_to_box(boxes, np.int64(0), x, y, z)
    top = 1
    while top > 0 and best > enough * enough:
        top -= 1
        node = waiting[top]
        if not squares[top] < best or spans[node, 0] == spans[node, 1] == own:
            continue
        if node < first_leaf:
            near, far = 2 * node + 1, 2 * node + 2
            here = _square_to_box(boxes, near, x, y, z)
            there = _square_to_box(boxes, far, x, y, z)
            if there < here:
                near, far, here, there = far, near, there, here
            waiting[top], squares[top] = far, there
            waiting[top + 1], squares[top + 1] = near, here
            top += 2
            continue
        start = (node - first_leaf) * LEAF_SIZE
        for n in range(start, min(start + LEAF_SIZE, n_triangles)):
            if tree.bodies[n] == own:
                continue
            if flat >= 0.0 and is_flat(
                tree.corners, n, x, y, z, normal[0], normal[1], normal[2], flat
            ):
                continue
            square = _square_to_triangle(tree.corners, n, x, y, z)
            if square < best:
                best, found = square, np.int64(n)
    return np.sqrt(best), found


@entry(TREE, FLOATS2, INTS, FLOATS2, FLOAT, FLOAT, FLOAT, FLOATS)
def distances_kernel(tree, places, own, normals, flat, enough, farthest, out):
    """Distance out (Q,) of each of places (Q, 3) to the nearest triangle.

    own (Q,) int64: triangles of this body do not count. Nor do those within `flat` of the plane
    through the place with the unit normal of normals (Q, 3); a negative `flat` leaves none out. A
    distance of `enough` or less ends the search of a place: it is then that of some triangle.
    `farthest` is the greatest distance that is looked for, and given if nothing is nearer.
    """
    waiting = np.empty(STACK, dtype=np.int64)
    squares = np.empty(STACK)
    for q in range(places.shape[0]):
        place = (places[q, 0], places[q, 1], places[q, 2])
        normal = (normals[q, 0], normals[q, 1], normals[q, 2])
        out[q], _ = distance_at(
            tree, place, own[q], normal, flat, enough, farthest, np.int64(-1), waiting, squares
        )


def distances_to(
    tree: TriangleTree, places: Floats, enough: float = 0.0, farthest: float = np.inf
) -> Floats:
    """Distances (Q,) of places (Q, 3) to a tree's triangles; arguments as for the kernel."""
    nobody = np.full(len(places), -1, dtype=np.int64)
    normals = np.zeros((len(places), 3))
    return distances_to_others(tree, places, nobody, normals, -1.0, farthest, enough)


def distances_to_others(
    tree: TriangleTree, places: Floats, own: Ints, normals: Floats, flat: float, farthest: float,
    enough: float = 0.0,
) -> Floats:  # fmt: skip
    """Distances (Q,) of places (Q, 3) to triangles of other bodies than their `own`."""
    out = np.empty(len(places))
    distances_kernel(
        tree, np.ascontiguousarray(places), np.ascontiguousarray(own),
        np.ascontiguousarray(normals), float(flat), float(enough), float(farthest), out,
    )  # fmt: skip
    return out

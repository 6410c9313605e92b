"""Depth of one surface in the closed bodies of another: branch and bound over its triangles.

A place inside a closed body, at distance d from all of the other surface, stays inside after every
motion that moves it by less than d. So whatever separates the two moves some place by the greatest
such distance at least: the depth bounds the penetration from below, for any deformation.

Distances change by no more than a place moves. So a triangle of radius R about its middle, which is
at distance d, is nowhere deeper than d + R if the middle is inside, and than R - d if it is
outside. Boxes of triangles are searched likewise. Distance to one triangle is convex: no place is
farther from the triangle next to the middle than a corner is, which ends flush faces at once.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import (
    BOOL,
    FLOAT,
    FLOATS,
    FLOATS2,
    FLOATS3,
    INT,
    INTS,
    entry,
    fields_of,
    leaf,
)
from hapticdb.kernels.rigid import moved, transform_of, turn
from hapticdb.kernels.surfaces.point_distance import distance_at, square_to_triangle
from hapticdb.kernels.surfaces.triangle_bvh import (
    LEAF_SIZE,
    STACK,
    TREE,
    TriangleBVH,
    crossings,
    directions_of,
)
from hapticdb.kernels.triangles.surface_distance import middle_of, place_corners

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

WAITING = 256
"""Pieces of triangles that wait: more than the halvings from 1 km to 1 um."""
LINES = directions_of(5)
"""Directions of the lines that decide whether a place is inside."""
LIKELY, CERTAIN = 1, 2
"""Lines that agree where a place is only passed over, and where it is the deepest."""
HALFWAY = 0.34
"""Greatest distance of the middles of a triangle and its halves, as a share of its radius: a sixth
of its longest side, so a third of the radius at most, and rounding."""
SAMPLES = 256
"""Triangles whose middles are tried first: a depth soon found spares the search of others."""


class Solid(NamedTuple):
    """Surface with closed bodies.

    tree : all of the surface; bodies (B,) : numbers of the closed ones; signs (B,) : 1, or -1 of
    the wall of a void; boxes (B, 2, 3) : of these; box (2, 3) : of all.
    """

    tree: TriangleBVH
    bodies: Ints
    signs: Ints
    boxes: Floats
    box: Floats


SOLID = fields_of(Solid, TREE, INTS, INTS, FLOATS3, FLOATS2)


@leaf
def _below_ball(box, middle, radius):
    """Greatest depth of a ball below the faces of a box; negative if it is outside."""
    found = math.inf
    for axis in range(3):
        beside = min(middle[axis] - box[0, axis], box[1, axis] - middle[axis])
        found = min(found, beside + radius)
    return found


@leaf
def _is_inside(solid, place, lines, majority, stack):
    """Whether a place (3,) off the surface is inside, by the parity of crossings."""
    count = 0
    for k in range(solid.bodies.shape[0]):
        if _below_ball(solid.boxes[k], place, 0.0) < 0.0:
            continue
        inside = outside = 0
        for n in range(lines.shape[0]):
            ahead, behind, _ = crossings(
                place, lines[n], solid.bodies[k], np.int64(-1), solid.tree, stack
            )
            # a closed body is crossed equally on both sides, modulo 2: else the line grazed an edge
            if ahead < 0 or ahead % 2 != behind % 2:
                continue
            if ahead % 2 == 1:
                inside += 1
            else:
                outside += 1
            if max(inside, outside) == majority:
                break
        if inside > outside:
            count += solid.signs[k]  # the wall of a void: -1
    return count > 0


@leaf
def _below_box(box, triangle):
    """Greatest depth of a triangle (3, 3) below the faces of a box; negative if it is outside."""
    found = math.inf
    for axis in range(3):
        a, b, c = triangle[0, axis], triangle[1, axis], triangle[2, axis]
        found = min(found, max(a, b, c) - box[0, axis], box[1, axis] - min(a, b, c))
    return found


@leaf
def _middle_of(triangle, middle):
    """Write the middle (3,) of a triangle (3, 3); returns its radius about the middle."""
    for axis in range(3):
        middle[axis] = (triangle[0, axis] + triangle[1, axis] + triangle[2, axis]) / 3.0
    square = 0.0
    for i in range(3):
        x, y, z = triangle[i, 0] - middle[0], triangle[i, 1] - middle[1], triangle[i, 2] - middle[2]
        square = max(square, x * x + y * y + z * z)
    return math.sqrt(square)


@leaf
def _farthest(tree, near, triangle):
    """Greatest distance of the corners of a triangle (3, 3) from triangle `near` of a tree."""
    square = 0.0
    for i in range(3):
        x, y, z = triangle[i, 0], triangle[i, 1], triangle[i, 2]
        square = max(square, square_to_triangle(tree.corners, near, x, y, z))
    return math.sqrt(square)


@leaf
def _halve(waiting, n):
    """Replace triangle n of some (.., 3, 3) by its halves n and n + 1, across its longest side."""
    first, longest = 0, -1.0
    for i in range(3):
        square = 0.0
        for axis in range(3):
            square += (waiting[n, i, axis] - waiting[n, (i + 1) % 3, axis]) ** 2
        # longest-edge bisection: the halves do not degenerate, and HALFWAY holds
        if square > longest:
            first, longest = i, square
    second, third = (first + 1) % 3, (first + 2) % 3
    for axis in range(3):
        a, b, c = waiting[n, first, axis], waiting[n, second, axis], waiting[n, third, axis]
        middle = 0.5 * (a + b)
        waiting[n, 0, axis], waiting[n, 1, axis], waiting[n, 2, axis] = a, middle, c
        waiting[n + 1, 0, axis], waiting[n + 1, 1, axis], waiting[n + 1, 2, axis] = middle, b, c


@leaf
def _ball_of(boxes, node, pose, middle):
    """Write the middle (3,) of a node's box, moved by a pose (4, 4); returns its radius."""
    x, y, z, hx, hy, hz = middle_of(boxes, node)
    middle[0], middle[1], middle[2] = moved(transform_of(pose), x, y, z)
    return math.sqrt(hx * hx + hy * hy + hz * hz)


@leaf
def _enough(out, tolerance, fine):
    """Depth from which on a place is wanted."""
    return out[0] + max(tolerance, fine * out[0])


@leaf
def _try_middle(solid, lines, waiting, middle, scratch, hint, out):
    """Note the middle of triangle 0 of `waiting` if it is deepest; returns a triangle near it."""
    nodes, squares, stack, _ = scratch
    _middle_of(waiting[0], middle)
    if _below_ball(solid.box, middle, 0.0) <= out[0]:
        return hint
    x, y, z = middle[0], middle[1], middle[2]
    far, near = distance_at(solid.tree, x, y, z, out[0], math.inf, hint, nodes, squares)
    if far > out[0] and _is_inside(solid, middle, lines, CERTAIN, stack):
        out[0], out[1], out[2], out[3] = far, x, y, z
    return near


@leaf
def _search_triangle(solid, lines, tolerance, fine, most, waiting, middle, scratch, hint, out):
    """Search the deepest place of triangle 0 of `waiting`.

    Returns a triangle that is near, and how many distances were measured, about `most` at most. The
    side of a middle (1 inside, -1 outside, 0 not known) is tested only where a bound depends on it;
    halves whose middles are nearer to it than the surface have the same: 2.3 times fewer nodes.
    """
    nodes, squares, stack, sides = scratch
    top, queries = 1, np.int64(0)
    sides[0] = 0
    # depth-first: the stack grows by one entry a halving, so WAITING bounds it
    while top > 0 and queries < most:
        top -= 1
        queries += 1
        enough = _enough(out, tolerance, fine)
        # cheapest bound first: no place in the bodies is deeper than it is below their box's faces
        if _below_box(solid.box, waiting[top]) <= enough:
            continue
        radius = _middle_of(waiting[top], middle)
        x, y, z = middle[0], middle[1], middle[2]
        # a distance this short prunes the piece already: its exact value is not needed
        wanted = max(enough - radius, 0.0)
        far, near = distance_at(solid.tree, x, y, z, wanted, math.inf, hint, nodes, squares)
        hint = near
        if far + radius <= enough or _farthest(solid.tree, near, waiting[top]) <= enough:
            continue
        side = sides[top]
        # ray casting is dear: only if the middle may be deepest or its outside would prune
        if side == 0 and (far > out[0] or radius - far <= enough):
            side = 1 if _is_inside(solid, middle, lines, LIKELY, stack) else -1
        if side < 0 and radius - far <= enough:
            continue
        # a wrong side would falsify the result: CERTAIN lines must agree
        if side > 0 and far > out[0] and _is_inside(solid, middle, lines, CERTAIN, stack):
            out[0], out[1], out[2], out[3] = far, x, y, z
            enough = _enough(out, tolerance, fine)
        if far + radius > enough and radius > tolerance and top + 2 <= WAITING:
            _halve(waiting, top)
            # the surface is farther than the halves' middles: no crossing between, so the same side
            sides[top] = sides[top + 1] = side if far > HALFWAY * radius else 0
            top += 2
    return hint, queries


@entry(SOLID, TREE, FLOATS2, FLOATS2, FLOAT, FLOAT, INT, FLOATS)
def depth_kernel(solid, surface, pose, lines, tolerance, fine, most, out):
    """Find the deepest place of a surface, moved by a pose (4, 4), in a solid.

    out (4,) : depth, metres, which begins as the least one that is looked for, and its place. It is
    within `tolerance`, or a share `fine` of it, of the greatest depth, unless `most` distances were
    measured before.
    """
    nodes, squares = np.empty(STACK, dtype=np.int64), np.empty(STACK)
    stack, middle = np.empty(STACK, dtype=np.int64), np.empty(3)
    waiting, hint = np.empty((WAITING, 3, 3)), np.int64(-1)
    todo, top = np.empty(STACK, dtype=np.int64), 1
    scratch = nodes, squares, stack, np.empty(WAITING, dtype=np.int64)
    count = surface.corners.shape[0]
    # incumbent first: branch and bound prunes by it from the root on
    for n in range(0, count, max(count // SAMPLES, 1)):
        place_corners(surface.corners, n, n + 1, pose, waiting)
        hint = _try_middle(solid, lines, waiting, middle, scratch, hint, out)
    todo[0] = 0
    first_leaf, queries = surface.boxes.shape[0] // 2, np.int64(0)
    while top > 0 and queries < most:
        top -= 1
        queries += 1
        node = todo[top]
        if surface.boxes[node, 0, 0] > surface.boxes[node, 1, 0]:  # empty: padding of the tree
            continue
        enough = _enough(out, tolerance, fine)
        radius = _ball_of(surface.boxes, node, pose, middle)
        if _below_ball(solid.box, middle, radius) <= enough:
            continue
        wanted = max(enough - radius, 0.0)
        far, hint = distance_at(
            solid.tree, middle[0], middle[1], middle[2], wanted, math.inf, hint, nodes, squares
        )
        if far + radius <= enough:
            continue
        # outside at distance d the ball is nowhere deeper than R - d, so the side decides
        if radius - far <= enough and not _is_inside(solid, middle, lines, LIKELY, stack):
            continue
        if node < first_leaf:
            todo[top], todo[top + 1] = 2 * node + 2, 2 * node + 1
            top += 2
            continue
        start = (node - first_leaf) * LEAF_SIZE
        for n in range(start, min(start + LEAF_SIZE, count)):
            place_corners(surface.corners, n, n + 1, pose, waiting)
            hint, more = _search_triangle(
                solid, lines, tolerance, fine, most - queries, waiting, middle, scratch, hint, out
            )
            queries += more


@entry(FLOATS3, INTS, INTS, INTS, FLOATS2, BOOL, FLOATS2, FLOAT, FLOATS2)
def pieces_kernel(corners, points, pieces, starts, pose, is_back, box, reach, out):
    """Write one place of each piece of a surface in a box to out (P, 3); returns how many.

    corners (T, 3, 3), moved by a rigid pose (4, 4) or back; points (V,): numbers of corners; pieces
    (V,) of these, 0 to P - 1; starts (P,): a point of each; box (2, 3): larger by `reach` metres.
    """
    place, left = np.empty(3), starts.shape[0]
    is_in = np.ones(starts.shape[0], dtype=np.bool_)
    for n in range(points.shape[0]):
        if is_in[pieces[n]]:
            _place_corner(corners, points[n], pose, is_back, place)
            if _below_ball(box, place, reach) < 0.0:
                is_in[pieces[n]] = False
                left -= 1
                if left == 0:
                    return 0
    count = 0
    for piece in range(starts.shape[0]):
        if is_in[piece]:
            _place_corner(corners, points[starts[piece]], pose, is_back, out[count])
            count += 1
    return count


@leaf
def _place_corner(corners, n, pose, is_back, place):
    """Write corner n of triangles (T, 3, 3) into place (3,), moved by a rigid pose or back."""
    x, y, z = corners[n // 3, n % 3, 0], corners[n // 3, n % 3, 1], corners[n // 3, n % 3, 2]
    if not is_back:
        place[0], place[1], place[2] = moved(transform_of(pose), x, y, z)
        return
    x, y, z = x - pose[0, 3], y - pose[1, 3], z - pose[2, 3]
    for axis in range(3):
        place[axis] = turn(pose[0, axis], pose[1, axis], pose[2, axis], x, y, z)


def depth_in(
    solid: Solid, surface: TriangleBVH, pose: Floats, least: float, tolerance: float, fine: float,
    most: int,
) -> tuple[float, Floats]:  # fmt: skip
    """Depth of a surface in a solid, and its place (3,), the solid's frame, metres.

    pose (4, 4) : of the surface in that frame; the others as for `depth_kernel`. A depth of `least`
    or less is 0.
    """
    out = np.array([least, 0.0, 0.0, 0.0])
    depth_kernel(solid, surface, np.ascontiguousarray(pose), LINES, tolerance, fine, most, out)
    return (float(out[0]) if out[0] > least else 0.0), out[1:]

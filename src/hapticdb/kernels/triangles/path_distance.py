"""Least distance of two surfaces along a path, and their first collision: branch and bound.

Both BVHs and the time are searched together. An entry of the search is a node of either tree and a
part of the path. Its bound is a least distance of all below both nodes on all of that part: along a
separating axis of the boxes or triangles only the motion along it counts (`motion`), so the bound
of sliding surfaces is good on a long part. An entry with too low a bound is split: at the larger
box, or in time if the motion is more than the boxes' size, or both are leaves. The distance of
triangles in the middle of a part bounds the least distance from above. Bounds have a margin for
rounding, so none is too large.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import FLOAT, FLOATS, FLOATS2, INT, INTS, INTS2, entry, fields_of, leaf
from hapticdb.kernels.rigid import moved as placed_by
from hapticdb.kernels.rigid import transform_of
from hapticdb.kernels.surfaces.point_distance import sides_of
from hapticdb.kernels.surfaces.triangle_bvh import LEAF_SIZE, TREE, TriangleBVH
from hapticdb.kernels.triangles.path_motion import MOTION, Moved, PathMotion, bend, move, velocity
from hapticdb.kernels.triangles.surface_distance import largest, middle_of, place_corners
from hapticdb.kernels.triangles.triangle_distance import ROUNDING, measure_pair

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

WAITING = 512
"""Entries on the stack: more than the heights of two trees over 2^31 leaves and of halvings."""
MARGIN = 8.0 * ROUNDING
"""Greatest error of a bound, as a share of the largest coordinate: of a separation, its pose and
its motion."""
IN_TIME = 1.0
"""Motion, in sizes of the larger box, above which an entry is halved in time. Larger: fewer parts
of the path, and larger swept boxes."""
MEETING = 1e-5
"""Distance of a collision, metres."""
SMALLEST = 0.25 * MEETING
"""Half of the least motion of a part of the path."""


class Waiting(NamedTuple):
    """Stack of entries, the next one last; it stays from call to call."""

    nodes: Ints  # (.., 3) node of either tree, segment
    parts: Floats  # (.., 3) ways where the part begins and ends, bound
    state: Ints  # (3,) entries on the stack; the next segment; pairs of leaves measured


WAIT = fields_of(Waiting, INTS2, FLOATS2, INTS)


class Found(NamedTuple):
    """Result so far.

    distance (2,): the least one measured, and a lower bound of all others; parameter (1,): its path
    parameter; places (2, 3): there on either surface.
    """

    distance: Floats
    parameter: Floats
    places: Floats


FOUND = fields_of(Found, FLOATS, FLOATS, FLOATS2)


@leaf
def wanted(distance, fine):
    """Bound of the entries without effect on the result, for a measured distance.

    fine: tolerance of a least distance, metres, and per mille of it if that is more.
    """
    return max(min(distance - fine, (1.0 - 1e3 * fine) * distance), 0.5 * MEETING)


@leaf
def _box_bound(boxes, node, others, other, moved, slack):
    """Least distance of two boxes on a part of the path, and the motion of the second one."""
    if boxes[node, 0, 0] > boxes[node, 1, 0] or others[other, 0, 0] > others[other, 1, 0]:
        return math.inf, 0.0
    pose = moved.pose
    cx, cy, cz, hx, hy, hz = middle_of(others, other)
    x, y, z = placed_by(transform_of(pose), cx, cy, cz)
    ux, uy, uz, turned = velocity(moved, x, y, z)
    # the box's rotation about its own middle, and the second-order rest of `bend`
    spread = moved.angle[0] * math.sqrt(hx * hx + hy * hy + hz * hz)
    more = spread + bend(moved) * (turned + spread)
    square = 0.0
    for axis in range(3):
        middle = x if axis == 0 else (y if axis == 1 else z)
        speed = ux if axis == 0 else (uy if axis == 1 else uz)
        half = abs(pose[axis, 0]) * hx + abs(pose[axis, 1]) * hy + abs(pose[axis, 2]) * hz
        # swept box: per axis only the motion along that axis counts
        half += abs(speed) + more + slack
        gap = max(boxes[node, 0, axis] - middle - half, middle - half - boxes[node, 1, axis], 0.0)
        square += gap * gap
    return math.sqrt(square), math.sqrt(ux * ux + uy * uy + uz * uz) + more


@leaf
def _largest_edge(boxes, node):
    """Largest edge of a box."""
    return max(
        boxes[node, 1, 0] - boxes[node, 0, 0],
        boxes[node, 1, 1] - boxes[node, 0, 1],
        boxes[node, 1, 2] - boxes[node, 0, 2],
    )


@leaf
def _move_corners(moved, count, placed, speeds):
    """Write the motion of the corners of placed triangles (.., 3, 3): speeds (.., 3, 4).

    They are the shift of each corner to first order, and a bound of its deviation.
    """
    share = bend(moved)
    for m in range(count):
        for i in range(3):
            ux, uy, uz, turned = velocity(moved, placed[m, i, 0], placed[m, i, 1], placed[m, i, 2])
            speeds[m, i, 0], speeds[m, i, 1], speeds[m, i, 2] = ux, uy, uz
            speeds[m, i, 3] = share * turned


@leaf
def _axis_bound(one, n, placed, m, speeds):
    """Least distance of two triangles on a part of the path, by their boxes."""
    square = 0.0
    for axis in range(3):
        low = min(one[n, 0, axis], one[n, 1, axis], one[n, 2, axis])
        high = max(one[n, 0, axis], one[n, 1, axis], one[n, 2, axis])
        below, above = math.inf, -math.inf
        for i in range(3):
            motion = abs(speeds[m, i, axis]) + speeds[m, i, 3]
            below = min(below, placed[m, i, axis] - motion)
            above = max(above, placed[m, i, axis] + motion)
        gap = max(low - above, below - high, 0.0)
        square += gap * gap
    return math.sqrt(square)


@leaf
def _bound_along(nx, ny, nz, one, n, placed, m, speeds):
    """Least distance of two triangles on a part of the path along a direction, of any length."""
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    if not length > 0.0:
        return 0.0
    nx, ny, nz = nx / length, ny / length, nz / length
    # relative to a corner: without cancellation of large coordinates
    x, y, z = one[n, 0, 0], one[n, 0, 1], one[n, 0, 2]
    low, high, below, above = math.inf, -math.inf, math.inf, -math.inf
    for i in range(3):
        off = nx * (one[n, i, 0] - x) + ny * (one[n, i, 1] - y) + nz * (one[n, i, 2] - z)
        low, high = min(low, off), max(high, off)
        off = nx * (placed[m, i, 0] - x) + ny * (placed[m, i, 1] - y) + nz * (placed[m, i, 2] - z)
        motion = abs(nx * speeds[m, i, 0] + ny * speeds[m, i, 1] + nz * speeds[m, i, 2])
        motion += speeds[m, i, 3]
        below, above = min(below, off - motion), max(above, off + motion)
    return max(low - above, below - high)


@leaf
def _bound_by_plane(of, k, one, n, placed, m, speeds):
    """The same along the normal of triangle k of some (.., 3, 3)."""
    _, _, _, _, _, _, _, _, _, nx, ny, nz = sides_of(of, k)
    return _bound_along(nx, ny, nz, one, n, placed, m, speeds)


@leaf
def _measure_path_leaves(a, node, b, other, moved, parameter, size, radius, fine, scratch, found):
    """Measure the triangles of two leaves; returns their least distance on the part, from below.

    Notes nearer places; after a collision, earlier ones.
    """
    placed, speeds, pair = scratch
    begin = (other - b.boxes.shape[0] // 2) * LEAF_SIZE
    end = min(begin + LEAF_SIZE, b.corners.shape[0])
    place_corners(b.corners, begin, end, moved.pose, placed)
    _move_corners(moved, end - begin, placed, speeds)
    first = (node - a.boxes.shape[0] // 2) * LEAF_SIZE
    slack = radius + MARGIN * size
    least = math.inf
    for n in range(first, min(first + LEAF_SIZE, a.corners.shape[0])):
        for m in range(end - begin):
            far = wanted(found.distance[0], fine) + slack
            # bounds in the order of cost: boxes, two normals, then the exact pair
            bound = _axis_bound(a.corners, n, placed, m, speeds)
            if bound < far:
                plane = _bound_by_plane(a.corners, n, a.corners, n, placed, m, speeds)
                bound = max(bound, plane)
            if bound < far:
                plane = _bound_by_plane(placed, m, a.corners, n, placed, m, speeds)
                bound = max(bound, plane)
            if bound < far:
                _, above = measure_pair(a.corners, n, placed, m, size, pair)
                # a measured distance on the path bounds the result from above
                _note(above, radius, parameter, pair, found)
                x, y, z = pair[1] - pair[4], pair[2] - pair[5], pair[3] - pair[6]
                # direction of the nearest places: the best axis of disjoint convex bodies
                bound = max(bound, _bound_along(x, y, z, a.corners, n, placed, m, speeds))
            least = min(least, bound)
    return least - slack


@leaf
def _note(above, radius, parameter, pair, found):
    """Note a measured distance if it is the least, or after a collision, the earliest."""
    distance = max(above - radius, 0.0)
    if found.distance[0] > MEETING:
        if distance >= found.distance[0]:
            return
    elif distance > MEETING or parameter >= found.parameter[0]:
        return
    found.distance[0], found.parameter[0] = distance, parameter
    outwards = min(radius / above, 1.0) if above > 0.0 else 0.0
    for axis in range(3):
        found.places[0, axis] = pair[1 + axis]
        found.places[1, axis] = pair[4 + axis] + outwards * (pair[1 + axis] - pair[4 + axis])


@leaf
def _push(waiting, node, other, segment, low, high, bound):
    """Push an entry."""
    n = waiting.state[0]
    waiting.nodes[n, 0], waiting.nodes[n, 1], waiting.nodes[n, 2] = node, other, segment
    waiting.parts[n, 0], waiting.parts[n, 1], waiting.parts[n, 2] = low, high, bound
    waiting.state[0] = n + 1


@leaf
def _part_in_time(a, b, motion, moved, entry_, slack, waiting):
    """Push both halves of an entry, the next one last: the nearer one, or the first."""
    node, other, segment, low, high = entry_
    middle = 0.5 * (low + high)
    move(motion, segment, middle, high, moved)
    later, _ = _box_bound(a.boxes, node, b.boxes, other, moved, slack)
    move(motion, segment, low, middle, moved)
    earlier, _ = _box_bound(a.boxes, node, b.boxes, other, moved, slack)
    # ties go to the earlier half: a first collision is sought
    if later < earlier:
        _push(waiting, node, other, segment, low, middle, earlier)
        _push(waiting, node, other, segment, middle, high, later)
    else:
        _push(waiting, node, other, segment, middle, high, later)
        _push(waiting, node, other, segment, low, middle, earlier)


@leaf
def _part_boxes(a, b, moved, entry_, slack, waiting):
    """Push both children of the larger box of an entry, the nearer one last."""
    node, other, segment, low, high = entry_
    is_last, is_other_last = node >= a.boxes.shape[0] // 2, other >= b.boxes.shape[0] // 2
    # descend the larger box: boxes of unlike size hardly separate
    if is_other_last or (
        not is_last and _largest_edge(a.boxes, node) >= _largest_edge(b.boxes, other)
    ):
        near, far, near_other, far_other = 2 * node + 1, 2 * node + 2, other, other
    else:
        near, far, near_other, far_other = node, node, 2 * other + 1, 2 * other + 2
    here, _ = _box_bound(a.boxes, near, b.boxes, near_other, moved, slack)
    there, _ = _box_bound(a.boxes, far, b.boxes, far_other, moved, slack)
    if there < here:
        near, far, near_other, far_other = far, near, far_other, near_other
        here, there = there, here
    _push(waiting, far, far_other, segment, low, high, there)
    _push(waiting, near, near_other, segment, low, high, here)


@leaf
def _size_of(a, b, motion):
    """Largest coordinate of both surfaces anywhere on the path."""
    # a turn raises the largest coordinate by the root of 3 at most: hence twice
    size, reach = largest(a.boxes), 2.0 * largest(b.boxes)
    for axis in range(3):
        reach += 2.0 * abs(motion.center[axis])
    for m in range(motion.centers.shape[0]):
        for axis in range(3):
            size = max(size, abs(motion.centers[m, axis]) + reach)
    return size


@entry(TREE, TREE, MOTION, FLOAT, FLOAT, FLOAT, INT, WAIT, FOUND)
def least_kernel(a, b, motion, radius, begin, fine, steps, waiting, found):
    """Search the least distance of tree a and of tree b along its path, from `begin` on.

    radius: of balls about the places of b; fine: as for `wanted`; steps: entries to visit. For a
    least distance of `MEETING` or less, its first place on the path is searched; before that place,
    the surfaces are half of `MEETING` apart. Returns whether the search is over.
    """
    moved = Moved(np.eye(4), np.empty(3), np.empty(3), np.empty(3), np.empty(1))
    scratch = np.empty((LEAF_SIZE, 3, 3)), np.empty((LEAF_SIZE, 3, 4)), np.empty(7)
    leaves_a, leaves_b = a.boxes.shape[0] // 2, b.boxes.shape[0] // 2
    size = _size_of(a, b, motion)
    slack = MARGIN * size
    last = np.array([-1.0, -1.0, -1.0])  # segment and ways that `moved` tells
    for _ in range(steps):
        if waiting.state[0] == 0:
            segment = waiting.state[1]
            if segment >= motion.turns.shape[0]:
                return True
            waiting.state[1] += 1
            if motion.parameters[segment + 1] >= begin:
                low = max(motion.parameters[segment], begin)
                _push(waiting, 0, 0, segment, low, motion.parameters[segment + 1], 0.0)
            continue
        waiting.state[0] -= 1
        n = waiting.state[0]
        node, other, segment = waiting.nodes[n, 0], waiting.nodes[n, 1], waiting.nodes[n, 2]
        low, high, bound = waiting.parts[n, 0], waiting.parts[n, 1], waiting.parts[n, 2]
        if found.distance[0] <= MEETING:
            high = min(high, found.parameter[0])  # only earlier is of interest
        if low > high or (low == high and found.distance[0] <= MEETING):
            continue
        if bound - radius >= wanted(found.distance[0], fine):
            found.distance[1] = min(found.distance[1], bound - radius)
            continue
        if last[0] != segment or last[1] != low or last[2] != high:
            move(motion, segment, low, high, moved)
            last[0], last[1], last[2] = segment, low, high
        if node >= leaves_a and other >= leaves_b:
            waiting.state[2] += 1
            parameter = 0.5 * (low + high)
            bound = _measure_path_leaves(
                a, node, b, other, moved, parameter, size, radius, fine, scratch, found
            )
            if bound >= wanted(found.distance[0], fine) or 0.5 * (high - low) <= SMALLEST:
                found.distance[1] = min(found.distance[1], bound)
                continue
            is_in_time = True
        else:
            _, travel = _box_bound(a.boxes, node, b.boxes, other, moved, slack)
            edge = max(_largest_edge(a.boxes, node), _largest_edge(b.boxes, other))
            is_in_time = travel > IN_TIME * edge
        if is_in_time:
            _part_in_time(a, b, motion, moved, (node, other, segment, low, high), slack, waiting)
            last[0] = -1.0  # `moved` is of a half now
        else:
            _part_boxes(a, b, moved, (node, other, segment, low, high), slack, waiting)
    return False


class Search:
    """Search of the least distance of two surfaces along a path, in steps.

    Attributes
    ----------
    found : Found
        Result so far.
    """

    def __init__(
        self, a: TriangleBVH, b: TriangleBVH, motion: PathMotion, *, radius: float, begin: float,
        best: float, fine: float,
    ) -> None:  # fmt: skip
        """Begin; arguments as for the kernel; best : greatest distance of interest."""
        self._given = a, b, motion, radius, begin, fine
        self._waiting = Waiting(
            np.empty((WAITING, 3), dtype=np.int64), np.empty((WAITING, 3)),
            np.zeros(3, dtype=np.int64),
        )  # fmt: skip
        self.found = Found(np.array([best, best]), np.array([-1.0]), np.zeros((2, 3)))

    def go_on(self, steps: int) -> bool:
        """Visit so many entries; returns whether the search is over."""
        return bool(least_kernel(*self._given, steps, self._waiting, self.found))

    @property
    def queries(self) -> int:
        """Number of pairs of leaves measured."""
        return int(self._waiting.state[2])

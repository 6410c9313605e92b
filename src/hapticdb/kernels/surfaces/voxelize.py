"""Exact voxelization of triangles, at a cost in proportion to the voxels.

A voxel belongs to a triangle if the triangle meets its closed box by the separating axis test
(Akenine-Moeller, "Fast 3D Triangle-Box Overlap Testing", 2001): no separation above 1e-9 voxel
along the 3 box normals, the 9 cross products of an edge and a box normal, and the triangle's
normal, each axis of unit length and both projections complete (all three corners, not one face of
them).

Here the test is not made voxel by voxel. Each axis bounds a linear function of the voxel's corner
from below and from above. A cross product with box normal w has no w in it, so the nine are three
each on the planes (u, v), (u, w) and (v, w), as in the conservative rasterisation of Schwarz and
Seidel ("Fast parallel surface and solid voxelization on GPUs", 2010). Hence, with w the axis with
the fewest columns through the triangle:

- each row u has one interval of columns v, and one of w;
- each v has one interval of w;
- each column (u, v) has one interval of w from the normal,

and their intersection is one run of voxels along w, set by one OR for each half brick on it.

Precision
---------
Each triangle is first moved by whole voxels to the corner of its own AABB, without rounding. Axes
are kept unscaled and the tolerance is scaled instead, so that on coordinates with few bits every
bound is exact. Otherwise a bound errs by a few 2^-53 of the triangle's length: far below the
tolerance up to 2^16 voxels, near it at 2^21. The normal of a thin triangle is computed in twice the
precision, since cancellation would turn the axis.

Null axes are skipped: a cross product shorter than 1e-30 voxel (an edge parallel to the box normal,
or none), and a normal shorter than 2^-50 of the longest edge's square, of a triangle degenerate to
a line to within 1e-9 voxel in the largest grid. The others decide a line exactly.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import FLOATS3, INT, INTS, entry, inlined, leaf
from hapticdb.kernels.surfaces.bricks import (
    FIRST_CAPACITY,
    RUN_AXIS,
    RUN_LAST,
    RUNS_AT_ONCE,
    brick_voxels,
    bricks_of_run,
    count_voxels,
    mark_points,
    mark_runs,
    new_table,
    sorted_bricks,
)

__all__ = ["brick_voxels", "count_voxels", "mark_points", "voxelize", "voxelize_pieces"]

TOUCH = 1e-9
"""Separations up to this, in voxels, count as touching."""
NULL_EDGE = 1e-30
"""Cross products of an edge and a box normal up to this length, in voxels, are skipped as null."""
NULL_NORMAL = 2.0**-50
"""Normals up to this length, in squares of the longest edge, are skipped as null."""
THIN = 2.0**14
"""Greatest edge^3 / |normal| for a normal in double precision; beyond it, its rounding would move
the result by 1e-11 voxel, and the normal is computed in twice the precision. Larger: faster, less
exact."""
FAR = 2.0**60
"""Coordinates are clamped to this, in voxels, against overflow of a product of three."""
AXIS_X, AXIS_Y, AXIS_Z = np.int64(0), np.int64(1), np.int64(2)
"""Numbers of the axes as int64: numba would give a bare 0 a type of its own."""
OUTSIDE, CUT, WHOLE = 0, 1, 2
"""Parts of a triangle's AABB in the grid: none, some, all."""
AT_TRIANGLE, AT_ROW, AT_COLUMN, ROWS_DONE = 0, 1, 2, 3
"""Fields of `resume`, the state between calls: triangle; row in it, from the first row of its AABB,
or -1 for a new triangle; column; thousandths of its rows done."""
MOST_BRICKS = 1 << 17
"""Bricks of a piece: 10 MB, and as much again for sorting. Larger: more memory, fewer progress
reports; smaller: more pieces to sort and merge."""
VISITS_A_BRICK = 128
"""Limit of a piece's brick crossings by runs, for each brick of its limit, so that a piece ends
also if many triangles meet the same bricks. Larger: fewer progress reports."""
VOXELS_AT_ONCE = 1 << 23
"""Limit of the voxels of buffered runs: a fraction of a second. Smaller: fewer runs at once for
very long triangles."""
STEEP = 1e40
"""Replaces 1 / 0 in the slope of an axis perpendicular to the direction solved for."""


@leaf
def _exact_difference(a, b):
    """(d, e) with d + e = a - b exactly (Knuth, TwoDiff)."""
    d = a - b
    t = d - a
    return d, (a - (d - t)) - (b + t)


@leaf
def _exact_product(a, b):
    """(p, e) with p + e = a b exactly (Dekker 1971)."""
    p = a * b
    t = 134217729.0 * a  # 2^27 + 1: Veltkamp's split into halves
    a_high = t - (t - a)
    a_low = a - a_high
    t = 134217729.0 * b
    b_high = t - (t - b)
    b_low = b - b_high
    return p, ((a_high * b_high - p) + a_high * b_low + a_low * b_high) + a_low * b_low


@leaf
def _exact_minor(corners, p, q):
    """Minor (c1 - c0)_p (c2 - c0)_q - (c1 - c0)_q (c2 - c0)_p, exact to the last bits."""
    a, a_low = _exact_difference(corners[1, p], corners[0, p])
    b, b_low = _exact_difference(corners[2, q], corners[0, q])
    c, c_low = _exact_difference(corners[1, q], corners[0, q])
    d, d_low = _exact_difference(corners[2, p], corners[0, p])
    left, left_low = _exact_product(a, b)
    right, right_low = _exact_product(c, d)
    whole, low = _exact_difference(left, right)
    low += left_low - right_low
    return whole + (low + ((a * b_low + a_low * b) - (c * d_low + c_low * d)))


@leaf
def minor(corners, p, q):
    """Minor (c1 - c0)_p (c2 - c0)_q - (c1 - c0)_q (c2 - c0)_p."""
    return (corners[1, p] - corners[0, p]) * (corners[2, q] - corners[0, q]) - (
        corners[1, q] - corners[0, q]
    ) * (corners[2, p] - corners[0, p])


@leaf
def normal_of(corners):
    """Normal (x, y, z) of a triangle (3, 3), not of unit length; zeros if null."""
    x, y, z = (
        minor(corners, AXIS_Y, AXIS_Z),
        minor(corners, AXIS_Z, AXIS_X),
        minor(corners, AXIS_X, AXIS_Y),
    )
    longest = 0.0
    for n in range(3):
        m = (n + 1) % 3
        dx = corners[m, 0] - corners[n, 0]
        dy = corners[m, 1] - corners[n, 1]
        dz = corners[m, 2] - corners[n, 2]
        longest = max(longest, dx * dx + dy * dy + dz * dz)
    # cancellation turns the normal of a sliver: only there is twice the precision worth its time
    if longest * np.sqrt(longest) > THIN * np.sqrt(x * x + y * y + z * z):
        x = _exact_minor(corners, AXIS_Y, AXIS_Z)
        y = _exact_minor(corners, AXIS_Z, AXIS_X)
        z = _exact_minor(corners, AXIS_X, AXIS_Y)
        if np.sqrt(x * x + y * y + z * z) <= NULL_NORMAL * longest:
            return 0.0, 0.0, 0.0
    return x, y, z


@leaf
def slope(along, length):
    """Inverse of an axis' component along the direction solved for, never infinite."""
    # STEEP keeps the interval's product finite: 0 times infinity would be NaN
    return 1.0 / along if along * STEEP > length else STEEP / length


@leaf
def _set_edge_axis(axes, row, corners, n, p, q):
    """Axis perpendicular to edge n in the plane of axes p and q, solved for q.

    Sets the coefficient of p, the least and the greatest value of ``coefficient * p + rest * q``
    over the corners of touching voxels, and 1 / rest.
    """
    m, o = (n + 1) % 3, (n + 2) % 3
    from_p, from_q, to_p, to_q = corners[n, p], corners[n, q], corners[m, p], corners[m, q]
    at_p = to_q - from_q
    at_q = from_p - to_p
    # coefficient of q at least 0: dividing by it keeps low below high
    if at_q < 0.0:
        at_p = -at_p
        at_q = -at_q
    length = np.sqrt(at_p * at_p + at_q * at_q)
    if length <= NULL_EDGE:
        axes[row, 0], axes[row, 1], axes[row, 2], axes[row, 3] = 0.0, -1.0, 1.0, STEEP
        return
    edge = at_p * from_p + at_q * from_q
    other = at_p * corners[o, p] + at_q * corners[o, q]
    # two corners of the edge project alike: two values give the triangle's extent
    low = min(edge, other) - TOUCH * length - (max(at_p, 0.0) + at_q)
    high = max(edge, other) + TOUCH * length - min(at_p, 0.0)
    axes[row, 0], axes[row, 1], axes[row, 2], axes[row, 3] = at_p, low, high, slope(at_q, length)


@leaf
def _set_normal_axis(plane, corners, normal, u, v, w):
    """As `_set_edge_axis`, for the normal: coefficients of u, v, bounds, 1 / coefficient of w."""
    at_u, at_v, at_w = normal[u], normal[v], normal[w]
    if at_w < 0.0:
        at_u, at_v, at_w = -at_u, -at_v, -at_w
    length = np.sqrt(at_u * at_u + at_v * at_v + at_w * at_w)
    plane[0] = at_u
    plane[1] = at_v
    if length == 0.0:  # null axis: no bound
        plane[2] = -1.0
        plane[3] = 1.0
        plane[4] = STEEP
        return
    low = np.inf
    high = -np.inf
    for n in range(3):
        value = at_u * corners[n, u] + at_v * corners[n, v] + at_w * corners[n, w]
        low = min(low, value)
        high = max(high, value)
    # the voxel's corner stands for its box: the box's own extent is moved into the bounds
    plane[2] = low - TOUCH * length - (max(at_u, 0.0) + max(at_v, 0.0) + at_w)
    plane[3] = high + TOUCH * length - (min(at_u, 0.0) + min(at_v, 0.0))
    plane[4] = slope(at_w, length)


@leaf
def _place_in_grid(triangles, t, edge, corners, box):
    """Move a triangle to the corner of its AABB, and compute the voxels of the AABB.

    Writes corners (3, 3), and to box (3, 3) int64 the first and last voxel on each axis, relative
    to the move, and the move. Returns `OUTSIDE`, `CUT` or `WHOLE`.
    """
    placed = WHOLE
    for axis in range(3):
        a = min(max(triangles[t, 0, axis], -FAR), FAR)
        b = min(max(triangles[t, 1, axis], -FAR), FAR)
        c = min(max(triangles[t, 2, axis], -FAR), FAR)
        low = min(a, b, c)
        high = max(a, b, c)
        if low > edge + TOUCH or high < -TOUCH:
            return OUTSIDE
        move = max(np.floor(low), 0.0)  # never negative: a - move is exact only below a
        corners[0, axis] = a - move
        corners[1, axis] = b - move
        corners[2, axis] = c - move
        # closed boxes: a corner on a border belongs to both voxels
        first = np.ceil(low - move - TOUCH) - 1.0
        last = np.floor(high - move + TOUCH)
        if first < -move or last > edge - 1.0 - move:
            placed = CUT
            first = max(first, -move)
            last = min(last, edge - 1.0 - move)
            if first > last:
                return OUTSIDE
        box[0, axis] = int(first)
        box[1, axis] = int(last)
        box[2, axis] = int(move)
    return placed


@leaf
def _order_axes(box, normal):
    """Axes (u, v, w): w with the fewest columns, u with fewer rows than v."""
    x = box[1, 0] - box[0, 0]
    y = box[1, 1] - box[0, 1]
    z = box[1, 2] - box[0, 2]
    # area of the projection, plus half the AABB's outline: estimate of the columns along each axis
    columns_x = 0.5 * abs(normal[0]) + y + z
    columns_y = 0.5 * abs(normal[1]) + x + z
    columns_z = 0.5 * abs(normal[2]) + x + y
    if columns_z <= columns_x and columns_z <= columns_y:
        return (0, 1, 2) if x <= y else (1, 0, 2)
    if columns_y <= columns_x:
        return (0, 2, 1) if x <= z else (2, 0, 1)
    return (1, 2, 0) if y <= z else (2, 1, 0)


@leaf
def _longest_box(triangles, edge):
    """Upper bound of the voxels of any triangle's AABB along an axis, in the grid."""
    longest = 0.0
    for t in range(triangles.shape[0]):
        for axis in range(3):
            a, b, c = triangles[t, 0, axis], triangles[t, 1, axis], triangles[t, 2, axis]
            longest = max(longest, min(max(a, b, c), edge) - max(min(a, b, c), 0.0))
    return int(longest) + 3


@leaf
def _set_axes(axes, plane, corners, normal, u, v, w):
    """Set the ten axes of a triangle: rows 0-2 of (u, v), 3-5 of (u, w), 6-8 of (v, w); plane."""
    for n in range(3):
        _set_edge_axis(axes, n, corners, n, u, v)
        _set_edge_axis(axes, n + 3, corners, n, u, w)
        _set_edge_axis(axes, n + 6, corners, n, v, w)
    _set_normal_axis(plane, corners, normal, u, v, w)


@leaf
def _set_spans(axes, spans, box, v, w):
    """Set the interval of w for each v of a triangle's AABB."""
    for at_v in range(box[0, v], box[1, v] + 1):
        y = float(at_v)
        low, high = float(box[0, w]), float(box[1, w])
        for n in range(6, 9):
            value = axes[n, 0] * y
            low = max(low, (axes[n, 1] - value) * axes[n, 3])
            high = min(high, (axes[n, 2] - value) * axes[n, 3])
        spans[at_v - box[0, v], 0] = low
        spans[at_v - box[0, v], 1] = high


@inlined
def _row_intervals(axes, x, box_intervals):
    """Intersect an AABB's intervals of v and of w, both lowest first, with those of the row x."""
    low, high, low_row, high_row = box_intervals
    for n in range(3):
        value = axes[n, 0] * x
        low = max(low, (axes[n, 1] - value) * axes[n, 3])
        high = min(high, (axes[n, 2] - value) * axes[n, 3])
        value = axes[n + 3, 0] * x
        low_row = max(low_row, (axes[n + 3, 1] - value) * axes[n + 3, 3])
        high_row = min(high_row, (axes[n + 3, 2] - value) * axes[n + 3, 3])
    return low, high, low_row, high_row


@inlined
def _write_run(runs, n, axes, voxel, last):
    """Write run n: first voxel on the axes (u, v, w), and last coordinate on w."""
    u, v, w = axes
    runs[n, u], runs[n, v], runs[n, w] = voxel
    runs[n, RUN_AXIS] = 2 - w
    runs[n, RUN_LAST] = last


@leaf
def _fill_runs(triangles, edge, resume, corners, box, axes, plane, spans, runs):
    """Write the runs of triangles from `resume` on until `runs` is full; return their number.

    resume (4,) int64 : state between calls. The other arrays are state of the current triangle.
    """
    n_runs = 0
    for t in range(resume[AT_TRIANGLE], triangles.shape[0]):
        is_new = resume[AT_ROW] < 0
        placed = _place_in_grid(triangles, t, edge, corners, box) if is_new else CUT
        if placed == OUTSIDE:
            continue
        if n_runs == runs.shape[0]:
            resume[AT_TRIANGLE] = t
            return n_runs
        normal = normal_of(corners)
        u, v, w = uvw = _order_axes(box, normal)
        first_u, first_v = box[0, u], box[0, v]
        move_u, move_v, move_w = box[2, u], box[2, v], box[2, w]
        if placed == WHOLE and first_u == box[1, u] and first_v == box[1, v]:
            # a triangle in one column meets every voxel of its AABB
            start = (first_u + move_u, first_v + move_v, box[0, w] + move_w)
            _write_run(runs, n_runs, uvw, start, box[1, w] + move_w)
            n_runs += 1
            continue
        if is_new:
            _set_axes(axes, plane, corners, normal, u, v, w)
            _set_spans(axes, spans, box, v, w)
        else:
            first_u += resume[AT_ROW]
        box_intervals = (float(first_v), float(box[1, v]), float(box[0, w]), float(box[1, w]))
        for at_u in range(first_u, box[1, u] + 1):
            x = float(at_u)
            low, high, low_row, high_row = _row_intervals(axes, x, box_intervals)
            if low_row > high_row or low > high:
                resume[AT_ROW] = -1
                continue
            low_v = int(np.ceil(low))
            if resume[AT_ROW] >= 0:
                low_v = resume[AT_COLUMN]
                resume[AT_ROW] = -1
            for at_v in range(low_v, int(np.floor(high)) + 1):
                value = plane[0] * x + plane[1] * float(at_v)
                low_w = max(low_row, spans[at_v - first_v, 0], (plane[2] - value) * plane[4])
                high_w = min(high_row, spans[at_v - first_v, 1], (plane[3] - value) * plane[4])
                first, last = int(np.ceil(low_w)), int(np.floor(high_w))
                if first > last or low_w > high_w:
                    continue
                if n_runs == runs.shape[0]:
                    resume[AT_TRIANGLE], resume[AT_ROW], resume[AT_COLUMN] = (
                        t,
                        at_u - box[0, u],
                        at_v,
                    )
                    return n_runs
                start = (at_u + move_u, at_v + move_v, first + move_w)
                _write_run(runs, n_runs, uvw, start, last + move_w)
                n_runs += 1
    resume[AT_TRIANGLE] = triangles.shape[0]
    return n_runs


@entry(FLOATS3, INT, INTS, INT)
def voxelize_kernel(triangles, bits, resume, most):
    """Bricks of the voxels of triangles (T, 3, 3): packed keys, words (C, 8), count.

    Stops after about `most` bricks, or when runs have crossed `VISITS_A_BRICK` times as many.
    resume (4,) int64 : state between calls, `AT_TRIANGLE`, `AT_ROW`, `AT_COLUMN`, `ROWS_DONE`; at
    the end the triangle is T.
    """
    edge = float(1 << bits)
    table, n_bricks = new_table(FIRST_CAPACITY), np.int64(0)
    longest = _longest_box(triangles, edge)
    runs = np.empty((max(min(RUNS_AT_ONCE, VOXELS_AT_ONCE // longest), 1), 5), np.int64)
    corners = np.empty((3, 3))
    box = np.empty((3, 3), np.int64)
    axes = np.empty((9, 4))
    plane = np.empty(5)
    spans = np.empty((longest, 2))
    n_visits = np.int64(0)
    if resume[AT_ROW] >= 0:  # within a triangle: recompute its axes
        _place_in_grid(triangles, resume[AT_TRIANGLE], edge, corners, box)
        normal = normal_of(corners)
        u, v, w = _order_axes(box, normal)
        _set_axes(axes, plane, corners, normal, u, v, w)
        _set_spans(axes, spans, box, v, w)
    while (
        resume[AT_TRIANGLE] < triangles.shape[0]
        and n_bricks < most
        and n_visits < VISITS_A_BRICK * most
    ):
        # runs are buffered: the hash table's arrays are passed once a batch, not once a run
        n_runs = _fill_runs(triangles, edge, resume, corners, box, axes, plane, spans, runs)
        table, n_bricks = mark_runs(table, n_bricks, runs, n_runs)
        for n in range(n_runs):
            n_visits += bricks_of_run(runs[n, 2 - runs[n, RUN_AXIS]], runs[n, RUN_LAST])
    resume[ROWS_DONE] = 0
    if resume[AT_ROW] >= 0:
        u, v, w = _order_axes(box, normal_of(corners))
        span = box[1, u] - box[0, u] + 1
        resume[ROWS_DONE] = (1000 * resume[AT_ROW]) // span
    return table.keys, table.words, n_bricks


def voxelize_pieces(
    triangles: NDArray[np.float64], bits: int, most: int = MOST_BRICKS
) -> Iterator[tuple[float, NDArray[np.int64], NDArray[np.uint8]]]:
    """Result of `voxelize` in pieces of a bounded number of bricks, each after the share done.

    The share is 0 to 1, within a triangle by its rows. Pieces may have bricks in common; their bits
    are to be ORed.
    """
    corners = np.ascontiguousarray(triangles, dtype=np.float64).reshape(-1, 3, 3)
    resume = np.array([0, -1, 0, 0], dtype=np.int64)
    while True:
        piece = sorted_bricks(*voxelize_kernel(corners, bits, resume, most))
        if resume[AT_TRIANGLE] >= len(corners):
            yield 1.0, *piece
            return
        yield float(resume[AT_TRIANGLE] + resume[ROWS_DONE] / 1000) / len(corners), *piece


def voxelize(
    triangles: NDArray[np.float64], bits: int
) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Z-order keys (B,) and occupancy (B, 64) of the voxels of triangles (T, 3, 3).

    Corners in voxels from the grid's origin, finite; parts outside the grid of `bits` bits an axis,
    1 to 21, are clipped. Keys are ascending, each once; bit n of an occupancy is the voxel of
    Z-order n modulo 8, least significant first. Boxes are closed: a triangle in the plane between
    two layers of voxels marks both. Threads may voxelize different parts at once.
    """
    _, keys, occupancy = next(voxelize_pieces(triangles, bits, 1 << 40))
    return keys, occupancy

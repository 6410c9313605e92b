"""Band of unsigned distances around triangles or points, as packed rows.

Space is divided into blocks of 8^3 bricks. A block contains the least squared distance of its 66^3
centres: its 64^3 voxels, and one more centre on each side for the rows of its outer bricks. Each
triangle is entered into the blocks near it, one line of centres along k after the other. Then the
block is quantised, and each brick with a distance becomes a row.

Separating directions bound the centres near a triangle: every centre within h of a triangle lies at
most h outside its extent in any direction. The directions are the normal, the normals of the edges
in the plane, those of the edges' projections on the plane (i, j), and the axes. For a triangle
degenerate to a line, its own direction and two perpendicular ones replace the first ones.

A distance depends on the triangle and on the centre's position in the grid alone, not on the block
or on other triangles, and the minimum precedes the quantisation. So neither the order of the
triangles nor a split of them changes a bit, and rows with a common centre have the same value
there.

The exact distance is not computed if the distance to the plane, or to the AABB, already exceeds the
centre's value. For bit-exact results, the exact distance is never below those two.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import (
    BYTES,
    BYTES2,
    FLOATS,
    FLOATS3,
    INT,
    INTS,
    INTS2,
    entry,
    fields_of,
    inlined,
    leaf,
)
from hapticdb.kernels.curves import compact, z_encode
from hapticdb.kernels.field.lattice import BEYOND, HALF_WIDTH, ROW_SIDE, ROW_VALUES, step_of
from hapticdb.kernels.field.packing import pack
from hapticdb.kernels.rigid import gap
from hapticdb.kernels.surfaces.voxelize import normal_of

BRICK = 8
"""Voxels of a brick on each axis."""
BLOCK_BITS = 3
"""Bits of a brick's coordinate in its block."""
BLOCK_BRICKS = 1 << (3 * BLOCK_BITS)
"""Bricks of a block, and upper bound of its rows."""
BLOCK = BRICK << BLOCK_BITS
"""Voxels of a block on each axis. Larger: fewer triangles enter several blocks; a block of 64 takes
2.3 MB in each thread."""
SIDE = BLOCK + 2
"""Centres of a block on each axis."""
REACH = 0.5 * (SIDE - 1)
"""Distance of a block's middle to its outermost centres along an axis, voxels."""
SLACK = 1e-6
"""Margin of the directions' reach h for rounding, voxels."""
NEAR_ZERO = 1e-12
"""Least slope; a smaller one changes a line along k by less than `SLACK`."""
FAR = 2.0**40
"""Coordinates are clamped to this, in voxels, against overflow of products. Triangles with such
corners, far outside any grid, are less exact."""
NOTHING = HALF_WIDTH * HALF_WIDTH * (1.0 + 1e-9)
"""Squared distance of a centre without a triangle near it: just above h^2."""
POINT, LINE, FACE = 0, 1, 2
"""Kinds of triangles: all corners coincide, all lie on a line, or neither."""
N_SIDES = 7
"""Directions of a triangle: 0 to 3 bound k, 4 to 6 bound j. The first is the normal of a face."""
AT_X, AT_Y, AT_Z, INVERSE, LOW, HIGH, NEAR_LOW, NEAR_HIGH = 0, 1, 2, 3, 4, 5, 6, 7
"""Fields of a direction: unit vector, 1 / slope, least and greatest value in the triangle, and the
same bounds of the centres near it."""
EDGE_X, EDGE_Y, EDGE_Z, INVERSE_SQUARE = 3, 4, 5, 6
"""Fields of an edge after its first corner: its vector, and 1 / its squared length, or 0."""
ROWS_OF_PIECE = 8 * BLOCK_BRICKS
"""Greatest number of rows of one call: 4 MB. Larger: more memory, fewer progress reports."""
PAIRS_OF_PIECE = 1 << 12
"""Greatest number of (block, triangle) pairs of one call: a second or two if each triangle covers
its block. Larger: fewer progress reports."""
TRIANGLES_AT_ONCE = 1 << 20
"""Triangles, or points, of one call of `find_blocks`. Larger: fewer progress reports."""


class _Prepared(NamedTuple):
    """One triangle, prepared; directions are relative to its first corner.

    sides (7, 8), edges (3, 7), box (2, 3) float64: its directions, edges and AABB; corners (3, 3)
    float64.
    """

    sides: NDArray[np.float64]
    edges: NDArray[np.float64]
    box: NDArray[np.float64]
    corners: NDArray[np.float64]


class _Block(NamedTuple):
    """A block under construction.

    squares (66^3,) float64: least squared distances; unset outside the spans. spans (66^2, 2)
    int64: first centre set on each line along k, and one past the last. steps (66^3,) uint8:
    quantised.
    """

    squares: NDArray[np.float64]
    spans: NDArray[np.int64]
    steps: NDArray[np.uint8]


BLOCK_FIELDS = fields_of(_Block, FLOATS, INTS2, BYTES)


@leaf
def _set_side(shape, n, x, y, z, slope, reach):
    """Set direction n to the unit vector along (x, y, z), or to no bound for a null vector.

    slope : AT_Y or AT_Z, axis of the solution; reach : half the edge of boxes, 0 for points.
    """
    sides, corners = shape.sides, shape.corners
    length = np.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        for field in range(INVERSE):
            sides[n, field] = 0.0
        sides[n, LOW] = sides[n, NEAR_LOW] = -1.0
        sides[n, HIGH] = sides[n, NEAR_HIGH] = 1.0
        # solved for, the interval -1 .. 1 becomes wider than any grid: no bound
        sides[n, INVERSE] = 1.0 / NEAR_ZERO
        return
    # slope at least 0: dividing by it keeps low bounds low
    sign = -1.0 if (y if slope == AT_Y else z) < 0.0 else 1.0
    x, y, z = sign * x / length, sign * y / length, sign * z / length
    low, high = 0.0, 0.0
    for m in range(1, 3):
        value = x * (corners[m, 0] - corners[0, 0]) + y * (corners[m, 1] - corners[0, 1])
        value += z * (corners[m, 2] - corners[0, 2])
        low, high = min(low, value), max(high, value)
    more = reach * (abs(x) + abs(y) + abs(z)) + HALF_WIDTH + SLACK
    sides[n, AT_X], sides[n, AT_Y], sides[n, AT_Z] = x, y, z
    sides[n, INVERSE] = 1.0 / max(y if slope == AT_Y else z, NEAR_ZERO)
    sides[n, LOW], sides[n, HIGH] = low, high
    sides[n, NEAR_LOW], sides[n, NEAR_HIGH] = low - more, high + more


@leaf
def _set_edges(triangles, t, shape):
    """Set corners, AABB and edges of triangle t; return the number of its longest edge.

    Returns -1 if all corners coincide.
    """
    corners, edges, box = shape.corners, shape.edges, shape.box
    for axis in range(3):
        box[0, axis], box[1, axis] = FAR, -FAR
        for m in range(3):
            value = triangles[t, min(m, triangles.shape[1] - 1), axis]  # a point repeats its corner
            corners[m, axis] = min(max(value, -FAR), FAR)
            box[0, axis] = min(box[0, axis], corners[m, axis])
            box[1, axis] = max(box[1, axis], corners[m, axis])
    longest, longest_square = -1, 0.0
    for m in range(3):
        square = 0.0
        for axis in range(3):
            edges[m, axis] = corners[m, axis]
            along = corners[(m + 1) % 3, axis] - corners[m, axis]
            edges[m, EDGE_X + axis] = along
            square += along * along
        edges[m, INVERSE_SQUARE] = 1.0 / square if square > 0.0 else 0.0
        if square > longest_square:
            longest, longest_square = m, square
    return longest


@leaf
def _set_shape(triangles, t, shape, reach):
    """Prepare triangle t of triangles (T, 3, 3), or point t of (T, 1, 3); return its kind."""
    longest = _set_edges(triangles, t, shape)
    edges = shape.edges
    for m in range(3):  # perpendicular to each edge's projection on (i, j)
        _set_side(shape, 4 + m, -edges[m, EDGE_Y], edges[m, EDGE_X], 0.0, AT_Y, reach)
    if longest < 0:
        for n in range(4):
            _set_side(shape, n, 0.0, 0.0, 0.0, AT_Z, reach)
        return POINT
    x, y, z = normal_of(shape.corners)
    if x != 0.0 or y != 0.0 or z != 0.0:
        length = np.sqrt(x * x + y * y + z * z)
        x, y, z = x / length, y / length, z / length
        _set_side(shape, 0, x, y, z, AT_Z, reach)
        for m in range(3):
            u, v, w = edges[m, EDGE_X], edges[m, EDGE_Y], edges[m, EDGE_Z]
            _set_side(shape, 1 + m, y * w - z * v, z * u - x * w, x * v - y * u, AT_Z, reach)
        return FACE
    u, v, w = edges[longest, EDGE_X], edges[longest, EDGE_Y], edges[longest, EDGE_Z]
    if abs(u) <= min(abs(v), abs(w)):  # perpendicular to the edge and to x, y or z
        x, y, z = 0.0, w, -v
    elif abs(v) <= abs(w):
        x, y, z = -w, 0.0, u
    else:
        x, y, z = v, -u, 0.0
    _set_side(shape, 0, x, y, z, AT_Z, reach)
    _set_side(shape, 1, v * z - w * y, w * x - u * z, u * y - v * x, AT_Z, reach)
    _set_side(shape, 2, u, v, w, AT_Z, reach)
    _set_side(shape, 3, 0.0, 0.0, 0.0, AT_Z, reach)
    return LINE


@inlined
def _y_interval(sides, x, least, greatest):
    """Narrow an interval of y to the part of the line at x near the triangle's projection."""
    for n in range(4, N_SIDES):
        value = sides[n, AT_X] * x
        least = max(least, (sides[n, NEAR_LOW] - value) * sides[n, INVERSE])
        greatest = min(greatest, (sides[n, NEAR_HIGH] - value) * sides[n, INVERSE])
    return least, greatest


@inlined
def _z_interval(sides, x, y, least, greatest):
    """Narrow an interval of z to the part of the line at (x, y) near the triangle."""
    for n in range(4):
        value = sides[n, AT_X] * x + sides[n, AT_Y] * y
        least = max(least, (sides[n, NEAR_LOW] - value) * sides[n, INVERSE])
        greatest = min(greatest, (sides[n, NEAR_HIGH] - value) * sides[n, INVERSE])
    return least, greatest


@leaf
def whole(low, high, first, last):
    """Integers from low to high in first..last: the least, and one past the greatest."""
    low, high = max(np.ceil(low), float(first)), min(np.floor(high), float(last))
    if low > high:
        return first, first
    return int(low), int(high) + 1


@entry(FLOATS3, INT, INTS2)
def find_blocks(triangles, bits, pairs):
    """Blocks near each triangle; returns the number of (block, triangle) pairs.

    triangles (T, 3, 3), or (T, 1, 3) for points. pairs (P, 2) int64: the block's Z-order key and
    the triangle; pairs beyond P are counted only.
    """
    shape = _Prepared(np.empty((N_SIDES, 8)), np.empty((3, 7)), np.empty((2, 3)), np.empty((3, 3)))
    last, half = (np.int64(1) << max(bits - BLOCK_BITS - 3, 0)) - 1, 0.5 * BLOCK
    n_pairs = 0
    for t in range(triangles.shape[0]):
        _set_shape(triangles, t, shape, REACH)
        sides, box = shape.sides, shape.box
        at_x, at_y, at_z = shape.corners[0, 0], shape.corners[0, 1], shape.corners[0, 2]
        more = REACH + HALF_WIDTH + SLACK
        low, high = box[0, 0] - more, box[1, 0] + more
        first_i, end_i = whole((low - half) / BLOCK, (high - half) / BLOCK, 0, last)
        for i in range(first_i, end_i):
            x = i * BLOCK + half - at_x
            low, high = box[0, 1] - more - at_y, box[1, 1] + more - at_y
            low, high = _y_interval(sides, x, low, high)
            low, high = (low + at_y - half) / BLOCK, (high + at_y - half) / BLOCK
            first_j, end_j = whole(low, high, 0, last)
            for j in range(first_j, end_j):
                y = j * BLOCK + half - at_y
                low, high = box[0, 2] - more - at_z, box[1, 2] + more - at_z
                low, high = _z_interval(sides, x, y, low, high)
                low, high = (low + at_z - half) / BLOCK, (high + at_z - half) / BLOCK
                first_k, end_k = whole(low, high, 0, last)
                for k in range(first_k, end_k):
                    if n_pairs < pairs.shape[0]:
                        pairs[n_pairs, 0] = z_encode(i, j, k)
                        pairs[n_pairs, 1] = t
                    n_pairs += 1
    return n_pairs


@leaf
def _segment_square(x, y, z, u, v, w, inverse):
    """Squared distance of (x, y, z) to the segment from 0 to (u, v, w); inverse : of its square."""
    t = min(max((x * u + y * v + z * w) * inverse, 0.0), 1.0)
    x, y, z = x - t * u, y - t * v, z - t * w
    return x * x + y * y + z * z


@inlined
def cover(squares, spans, line, first, end):
    """Extend a line's span by the centres first..end; a new line begins at `NOTHING`."""
    low, high = spans[line, 0], spans[line, 1]
    if low >= high:
        for k in range(np.uint64(line * SIDE), np.uint64((line + 1) * SIDE)):
            squares[k] = NOTHING
        low, high = first, end
    spans[line, 0] = min(low, first)
    spans[line, 1] = max(high, end)


@inlined
def _edge_square(sides, edges, is_line, x, y, z, u, v, w):
    """Least squared distance of a centre to the edges with it on their outer side, or 0.

    (x, y, z) : the centre; (u, v, w) : relative to the first corner. For a line, to all edges.
    """
    near = np.inf
    for m in range(3):
        s = sides[m + 1, AT_X] * u + sides[m + 1, AT_Y] * v + sides[m + 1, AT_Z] * w
        # inside all edges the plane's distance alone counts: 0 leaves it to the caller's maximum
        if is_line or s < sides[m + 1, LOW] or s > sides[m + 1, HIGH]:
            found = _segment_square(
                x - edges[m, 0], y - edges[m, 1], z - edges[m, 2],
                edges[m, EDGE_X], edges[m, EDGE_Y], edges[m, EDGE_Z], edges[m, INVERSE_SQUARE],
            )  # fmt: skip
            near = min(near, found)
    return near if near < np.inf else 0.0


@inlined
def _enter_line(shape, kind, squares, at, x, y, base_z, first, end):
    """Update the centres first..end of a line along k by a triangle.

    at : index of the line's first centre in squares; x, y : the line's position in the grid; base_z
    : position of its first centre.
    """
    sides, edges, box, corners = shape
    u, v = x - corners[0, 0], y - corners[0, 1]
    across_x, across_y = gap(x, box[0, 0], box[1, 0]), gap(y, box[0, 1], box[1, 1])
    across = across_x * across_x + across_y * across_y
    height_here = sides[0, AT_X] * u + sides[0, AT_Y] * v
    low_z, high_z, corner_z, slope_z = box[0, 2], box[1, 2], corners[0, 2], sides[0, AT_Z]
    z = base_z + first - 1.0
    for here in range(np.uint64(at + first), np.uint64(at + end)):
        z += 1.0
        w = z - corner_z
        along = gap(z, low_z, high_z)
        square = across + along * along
        if kind == FACE:
            height = height_here + slope_z * w
            # lower bounds; rounding must not bring the exact distance below them, for equal bits
            square = max(square, height * height)
        if square < squares[here]:
            if kind != POINT:
                near = _edge_square(sides, edges, kind == LINE, x, y, z, u, v, w)
                square = max(square, near)
            squares[here] = min(squares[here], square)


@leaf
def enter(shape, kind, block, i, j, k):
    """Enter a triangle into a block; voxel (i, j, k) has the block's first centre."""
    sides, _, box, corners = shape
    squares, spans, _ = block
    x0, y0, z0 = i + 0.5, j + 0.5, k + 0.5
    corner_x, corner_y, corner_z = corners[0, 0], corners[0, 1], corners[0, 2]
    more = HALF_WIDTH + SLACK
    low_y, high_y = box[0, 1] - more - corner_y, box[1, 1] + more - corner_y
    low_z, high_z = box[0, 2] - more - corner_z, box[1, 2] + more - corner_z
    first, end = whole(box[0, 0] - more - x0, box[1, 0] + more - x0, 0, SIDE - 1)
    for at_x in range(first, end):
        x = x0 + at_x
        low, high = _y_interval(sides, x - corner_x, low_y, high_y)
        first_y, end_y = whole(low + corner_y - y0, high + corner_y - y0, 0, SIDE - 1)
        for at_y in range(first_y, end_y):
            y = y0 + at_y
            low, high = _z_interval(sides, x - corner_x, y - corner_y, low_z, high_z)
            first_z, end_z = whole(low + corner_z - z0, high + corner_z - z0, 0, SIDE - 1)
            if first_z < end_z:
                line = at_x * SIDE + at_y
                cover(squares, spans, line, first_z, end_z)
                _enter_line(shape, kind, squares, line * SIDE, x, y, z0, first_z, end_z)


@inlined
def _brick_at(centre):
    """Coordinate in its block of the last brick with a row begun at a centre, on one axis."""
    return min(max(centre, 0) // BRICK, BLOCK // BRICK - 1)


@leaf
def _quantise(block, reached):
    """Quantise a block's squared distances, and mark the bricks with rows that meet a span.

    reached (8, 8) int64: bit k of item (i, j) for the brick at (i, j, k).
    """
    squares, spans, steps = block
    for n in range(steps.shape[0]):
        steps[n] = BEYOND
    for x in range(reached.shape[0]):
        for y in range(reached.shape[1]):
            reached[x, y] = 0
    for x in range(SIDE):
        for y in range(SIDE):
            line = x * SIDE + y
            low, high = spans[line, 0], spans[line, 1]
            if low >= high:
                continue
            for here in range(np.uint64(line * SIDE + low), np.uint64(line * SIDE + high)):
                if squares[here] < NOTHING:
                    steps[here] = step_of(np.sqrt(squares[here]))
            # rows overlap by two centres
            bits = (2 << _brick_at(high - 1)) - (1 << _brick_at(low - 2))
            for i in range(_brick_at(x - 2), _brick_at(x) + 1):
                for j in range(_brick_at(y - 2), _brick_at(y) + 1):
                    reached[i, j] |= bits


@leaf
def _copy_row(steps, i, j, k, out, n):
    """Copy the row from centre (i, j, k) of a block on to row n of out (R, 1000).

    Returns whether the row has a distance.
    """
    least = np.int64(BEYOND)
    for x in range(ROW_SIDE):
        for y in range(ROW_SIDE):
            here = np.uint64(((i + x) * SIDE + j + y) * SIDE + k)
            to = np.uint64((x * ROW_SIDE + y) * ROW_SIDE)
            for z in range(np.uint64(ROW_SIDE)):
                step = steps[here + z]
                out[n, to + z] = step
                least = min(least, np.int64(step))
    return least < BEYOND


@entry(FLOATS3, INTS2, BLOCK_FIELDS, INTS, INT, INTS, BYTES2)
def rows_of_blocks(triangles, pairs, block, at, bits, keys, out):
    """Rows of the blocks from pair at[0] on; returns their number.

    pairs (P, 2) int64, ascending, as from `find_blocks`; block : under construction, state between
    calls; at (1,) int64, first pair of the next call. Stops before a block with possibly more rows
    than room in keys (R,) and out (R, 1000), and after `PAIRS_OF_PIECE`, also within a block.
    """
    shape = _Prepared(np.empty((N_SIDES, 8)), np.empty((3, 7)), np.empty((2, 3)), np.empty((3, 3)))
    bricks = np.int64(1) << max(bits - 3, 0)
    reached = np.empty((BLOCK // BRICK, BLOCK // BRICK), np.int64)
    n_rows = 0
    end = at[0] + PAIRS_OF_PIECE
    while at[0] < pairs.shape[0] and n_rows + BLOCK_BRICKS <= out.shape[0]:
        key = pairs[at[0], 0]
        i, j, k = compact(key >> 2), compact(key >> 1), compact(key)
        if at[0] == 0 or pairs[at[0] - 1, 0] != key:  # the block is new
            for line in range(SIDE * SIDE):
                block.spans[line, 0] = block.spans[line, 1] = 0
        while at[0] < pairs.shape[0] and pairs[at[0], 0] == key:
            if at[0] == end:
                return n_rows
            kind = _set_shape(triangles, pairs[at[0], 1], shape, 0.0)
            enter(shape, kind, block, i * BLOCK - 1, j * BLOCK - 1, k * BLOCK - 1)
            at[0] += 1
        _quantise(block, reached)
        for brick in range(BLOCK_BRICKS):
            place = np.int64(brick)
            x, y, z = compact(place >> 2), compact(place >> 1), compact(place)
            if max((i << BLOCK_BITS) + x, (j << BLOCK_BITS) + y, (k << BLOCK_BITS) + z) >= bricks:
                continue
            if not (reached[x, y] >> z) & 1:
                continue
            if _copy_row(block.steps, x * BRICK, y * BRICK, z * BRICK, out, n_rows):
                keys[n_rows] = (key << (3 * BLOCK_BITS)) | brick
                n_rows += 1
    return n_rows


def band_pieces(
    triangles: NDArray[np.float64], bits: int, rows: int = ROWS_OF_PIECE
) -> Iterator[tuple[float, NDArray[np.int64], NDArray[np.uint8], NDArray[np.int64]]]:
    """Band of triangles (T, 3, 3), or points (P, 1, 3), in pieces of bounded time and rows.

    Corners in voxels from the grid's origin, finite; a triangle may be a line or a point. Triangles
    outside the grid of `bits` bits an axis, 1 to 21, count if near it. rows : of a piece, at most;
    at least `BLOCK_BRICKS`.

    Yields the share done, 0 to 1; the Z-order keys (R,) of all bricks with a distance of up to h in
    their row, ascending through all pieces, each once; and their packed rows, data and ends, as
    from `packing.pack`. A piece may be empty.
    """
    corners = np.ascontiguousarray(triangles, dtype=np.float64)
    keys = np.empty(rows, dtype=np.int64)
    out = np.empty((rows, ROW_VALUES), dtype=np.uint8)
    found = [np.empty((0, 2), dtype=np.int64)]
    for first in range(0, len(corners), TRIANGLES_AT_ONCE):
        some = corners[first : first + TRIANGLES_AT_ONCE]
        pairs = np.empty((4 * len(some) + 64, 2), dtype=np.int64)
        n_pairs = find_blocks(some, bits, pairs)
        if n_pairs > len(pairs):
            pairs = np.empty((n_pairs, 2), dtype=np.int64)
            find_blocks(some, bits, pairs)
        pairs[:n_pairs, 1] += first
        found.append(pairs[:n_pairs])
        yield 0.0, keys[:0], *pack(out[:0])
    pairs = np.concatenate(found)
    found.clear()
    pairs = np.ascontiguousarray(pairs[np.argsort(pairs[:, 0], kind="stable")])
    block = _Block(np.empty(SIDE**3), np.empty((SIDE**2, 2), np.int64), np.empty(SIDE**3, np.uint8))
    at = np.zeros(1, dtype=np.int64)
    while at[0] < len(pairs):
        n_rows = rows_of_blocks(corners, pairs, block, at, bits, keys, out)
        yield float(at[0]) / len(pairs), keys[:n_rows].copy(), *pack(out[:n_rows])

"""Distance of two triangles in float64, with a bound below that is never too large.

Two triangles are nearest at a corner of one and an edge or the inside of the other, or at two
edges. The least distance of all these pairs of places is a bound from above, since both places are
on the triangles; rounding may miss the nearest ones, as with almost parallel edges. So the bound
from below is proved by itself: along the direction between the two places the corners of the
triangles are apart by so much, and so is all between the corners (separating axis of convex
bodies). Without a separating axis, an edge goes through the other triangle and the distance is 0,
or the bound from below is 0.
"""

import math

from hapticdb.kernels._jit import leaf
from hapticdb.kernels.surfaces.point_distance import shares_of, sides_of

ROUNDING = 2.0**-48
"""Greatest error of a separation, as a share of the largest coordinate. It is 16 units in the last
place: each term is a sum of three products of rounded differences."""
CERTAIN = 1e-9
"""Relative difference of both bounds for the test of an edge through a triangle."""


@leaf
def _try_edge(found, px, py, pz, ax, ay, az, bx, by, bz, is_first):
    """Note the place of the edge from a to b nearest to p, if it is nearer than `found`.

    is_first: whether p is on the first triangle.
    """
    ux, uy, uz = bx - ax, by - ay, bz - az
    length = ux * ux + uy * uy + uz * uz
    share = 0.0
    if length > 0.0:
        share = ((px - ax) * ux + (py - ay) * uy + (pz - az) * uz) / length
        share = min(max(share, 0.0), 1.0)
    _note(found, px, py, pz, ax + share * ux, ay + share * uy, az + share * uz, is_first)


@leaf
def _note(found, px, py, pz, qx, qy, qz, is_first):
    """Note places p and q, if they are nearer than `found`: that of the first triangle first."""
    square = (px - qx) ** 2 + (py - qy) ** 2 + (pz - qz) ** 2
    if square < found[0]:
        found[0] = square
        first, second = (1, 4) if is_first else (4, 1)
        found[first], found[first + 1], found[first + 2] = px, py, pz
        found[second], found[second + 1], found[second + 2] = qx, qy, qz


@leaf
def _try_inside(found, px, py, pz, other, m, is_first):
    """Note the foot of p on the plane of triangle m, if it is inside the triangle and nearer."""
    sides = sides_of(other, m)
    ax, ay, az, ux, uy, uz, vx, vy, vz, _, _, _ = sides
    area, along, across = shares_of(sides, px - ax, py - ay, pz - az)
    # division-free: the coordinates are scaled by `area`; NaN and degenerate triangles end here
    if not area > 0.0 or along < 0.0 or across < 0.0 or along + across > area:
        return
    s, t = along / area, across / area
    qx, qy, qz = ax + s * ux + t * vx, ay + s * uy + t * vy, az + s * uz + t * vz
    _note(found, px, py, pz, qx, qy, qz, is_first)


@leaf
def _try_edges(found, one, n, i, other, m, j):
    """Note the nearest places of the lines through two edges, if they are on the edges and nearer.

    Edge i leads from corner i to the next. Places at the ends are those of `_try_edge`.
    """
    k, h = (i + 1) % 3, (j + 1) % 3
    px, py, pz = one[n, i, 0], one[n, i, 1], one[n, i, 2]
    qx, qy, qz = other[m, j, 0], other[m, j, 1], other[m, j, 2]
    ux, uy, uz = one[n, k, 0] - px, one[n, k, 1] - py, one[n, k, 2] - pz
    vx, vy, vz = other[m, h, 0] - qx, other[m, h, 1] - qy, other[m, h, 2] - qz
    rx, ry, rz = px - qx, py - qy, pz - qz
    a = ux * ux + uy * uy + uz * uz
    e = vx * vx + vy * vy + vz * vz
    b = ux * vx + uy * vy + uz * vz
    c = ux * rx + uy * ry + uz * rz
    f = vx * rx + vy * ry + vz * rz
    determinant = a * e - b * b
    # parallel edges: their nearest places include a corner, tried by `_try_edge`
    if not determinant > 0.0:
        return
    s = (b * f - c * e) / determinant
    if not 0.0 < s < 1.0:
        return
    t = (b * s + f) / e
    if not 0.0 < t < 1.0:
        return
    px, py, pz = px + s * ux, py + s * uy, pz + s * uz
    qx, qy, qz = qx + t * vx, qy + t * vy, qz + t * vz
    _note(found, px, py, pz, qx, qy, qz, True)


@leaf
def _separation(found, one, n, other, m, distance):
    """Separation of the triangles along the direction between the nearest places."""
    nx = (found[1] - found[4]) / distance
    ny = (found[2] - found[5]) / distance
    nz = (found[3] - found[6]) / distance
    low, high = math.inf, -math.inf
    # relative to the places found: offsets are small, so their rounding is, too
    for i in range(3):
        x, y, z = one[n, i, 0] - found[1], one[n, i, 1] - found[2], one[n, i, 2] - found[3]
        low = min(low, nx * x + ny * y + nz * z)
        x, y, z = other[m, i, 0] - found[4], other[m, i, 1] - found[5], other[m, i, 2] - found[6]
        high = max(high, nx * x + ny * y + nz * z)
    return distance + low - high


@leaf
def edge_goes_through(one, n, i, other, m, beside):
    """Share of edge i of triangle n at its crossing of triangle m, or -1.

    The edge's ends lie on different sides of the plane, or one in it, and the place between is
    inside the triangle, on its edge, or outside by the share `beside` of its height at most. An
    edge in the plane does not cross.
    """
    k = (i + 1) % 3
    sides = sides_of(other, m)
    ax, ay, az, _, _, _, _, _, _, nx, ny, nz = sides
    px, py, pz = one[n, i, 0] - ax, one[n, i, 1] - ay, one[n, i, 2] - az
    qx, qy, qz = one[n, k, 0] - ax, one[n, k, 1] - ay, one[n, k, 2] - az
    here = px * nx + py * ny + pz * nz
    there = qx * nx + qy * ny + qz * nz
    if (here > 0.0 and there > 0.0) or (here < 0.0 and there < 0.0) or here == there:
        return -1.0
    share = here / (here - there)
    x, y, z = px + share * (qx - px), py + share * (qy - py), pz + share * (qz - pz)
    area, along, across = shares_of(sides, x, y, z)
    least = -beside * area
    if along < least or across < least or along + across > area - least:
        return -1.0
    return share


@leaf
def _goes_through(found, one, n, other, m, is_first):
    """Whether an edge of triangle n goes through triangle m; notes the place."""
    for i in range(3):
        share = edge_goes_through(one, n, i, other, m, 0.0)
        if share >= 0.0:
            k = (i + 1) % 3
            x = one[n, i, 0] + share * (one[n, k, 0] - one[n, i, 0])
            y = one[n, i, 1] + share * (one[n, k, 1] - one[n, i, 1])
            z = one[n, i, 2] + share * (one[n, k, 2] - one[n, i, 2])
            _note(found, x, y, z, x, y, z, is_first)
            return True
    return False


@leaf
def measure_pair(one, n, other, m, size, found):
    """Distance of triangle n of one (.., 3, 3) and m of other (.., 3, 3): bounds below and above.

    size: the largest coordinate of both. found (7,) is scratch; afterwards found[1:4] and
    found[4:7] are the nearest places, whose distance is the bound above.
    """
    found[0] = math.inf
    for i in range(3):
        px, py, pz = one[n, i, 0], one[n, i, 1], one[n, i, 2]
        qx, qy, qz = other[m, i, 0], other[m, i, 1], other[m, i, 2]
        _try_inside(found, px, py, pz, other, m, True)
        _try_inside(found, qx, qy, qz, one, n, False)
        for j in range(3):
            k = (j + 1) % 3
            _try_edge(
                found, px, py, pz, other[m, j, 0], other[m, j, 1], other[m, j, 2],
                other[m, k, 0], other[m, k, 1], other[m, k, 2], True,
            )  # fmt: skip
            _try_edge(
                found, qx, qy, qz, one[n, j, 0], one[n, j, 1], one[n, j, 2],
                one[n, k, 0], one[n, k, 1], one[n, k, 2], False,
            )  # fmt: skip
            _try_edges(found, one, n, i, other, m, j)
    above = math.sqrt(found[0])
    below = 0.0
    if above > 0.0:
        below = _separation(found, one, n, other, m, above)
    # only without a separating axis: the crossing test is rare and dear
    if below < above * (1.0 - CERTAIN) and (
        _goes_through(found, one, n, other, m, True)
        or _goes_through(found, other, m, one, n, False)
    ):
        return 0.0, 0.0
    # the separation less its rounding: the bound below is never too large
    return max(min(below, above) - ROUNDING * size, 0.0), above

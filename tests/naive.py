"""The oracle: plain Python versions of the kernels, slow and meant to be obviously right."""

from collections.abc import Iterable, Sequence
from fractions import Fraction
from itertools import product
from math import floor

Voxel = tuple[int, int, int]
Vector = tuple[int, int, int]
Triangle = Sequence[Sequence[float]]


def z_order(i: int, j: int, k: int) -> int:
    """Key of a voxel on the Z-order curve, bit by bit, i the most significant axis."""
    key = 0
    for bit in range(21):
        key |= (i >> bit & 1) << (3 * bit + 2)
        key |= (j >> bit & 1) << (3 * bit + 1)
        key |= (k >> bit & 1) << (3 * bit)
    return key


def bricks_of_voxels(voxels: Iterable[Voxel]) -> dict[int, bytes]:
    """Occupancy of 64 bytes for each brick's Z-order key, ascending."""
    occupancy: dict[int, int] = {}
    for i, j, k in voxels:
        key = z_order(i // 8, j // 8, k // 8)
        occupancy[key] = occupancy.get(key, 0) | 1 << z_order(i % 8, j % 8, k % 8)
    return {key: occupancy[key].to_bytes(64, "little") for key in sorted(occupancy)}


TOUCH = Fraction(1, 10**9)


def cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def dot(a: Vector, b: Vector) -> int:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def difference(a: Vector, b: Vector) -> Vector:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def separating_axes(corners: Sequence[Vector], one: int) -> list[Vector]:
    """The 13 axes of triangle against box, without null axes. `one` is the length of a voxel.

    An axis is null if it is a cross product of an edge and a box normal up to 1e-30 voxel long, or
    the triangle's normal with a length of up to 2^-50 of the longest edge's square.
    """
    box_normals = [(1, 0, 0), (0, 1, 0), (0, 0, 1)]
    a, b, c = corners
    edges = [difference(b, a), difference(c, b), difference(a, c)]
    axes = list(box_normals)
    for edge, box_normal in product(edges, box_normals):
        axis = cross(edge, box_normal)
        if dot(axis, axis) * 10**60 > one**2:
            axes.append(axis)
    normal = cross(edges[0], edges[1])
    longest = max(dot(edge, edge) for edge in edges)
    if dot(normal, normal) * 2**100 > longest**2:
        axes.append(normal)
    return axes


def voxels_of_triangle(triangle: Triangle, bits: int, touch: Fraction = TOUCH) -> set[Voxel]:
    """Voxels of the grid whose closed box the triangle meets, by the separating axis test.

    Corners are in voxels. A separation of up to `touch` voxels counts as touching.
    """
    exact = [[Fraction(x) for x in corner] for corner in triangle]
    one = max(x.denominator for corner in exact for x in corner)
    corners = [(int(x * one), int(y * one), int(z * one)) for x, y, z in exact]

    # for each axis: the triangle's shadow, the shadow of the voxel at 0, the squared slack
    shadows = []
    for axis in separating_axes(corners, one):
        values = [dot(axis, corner) for corner in corners]
        low = sum(min(x, 0) for x in axis) * one
        high = sum(max(x, 0) for x in axis) * one
        slack = floor(touch**2 * dot(axis, axis) * one**2)
        shadows.append((axis, min(values), max(values), low, high, slack))
    # the axis that separates most voxels comes first, for speed only
    shadows.reverse()

    def meets(voxel: Voxel) -> bool:
        for axis, least, greatest, low, high, slack in shadows:
            at = dot(axis, voxel) * one
            gap = max(at + low - greatest, least - (at + high))
            if gap > 0 and gap * gap > slack:
                return False
        return True

    def reach(n: int) -> range:
        first = floor(min(corner[n] for corner in exact)) - 1
        last = floor(max(corner[n] for corner in exact)) + 1
        return range(max(first, 0), min(last, 2**bits - 1) + 1)

    return {(i, j, k) for i, j, k in product(reach(0), reach(1), reach(2)) if meets((i, j, k))}


def voxels_of_triangles(
    triangles: Iterable[Triangle], bits: int, touch: Fraction = TOUCH
) -> set[Voxel]:
    return set().union(*(voxels_of_triangle(triangle, bits, touch) for triangle in triangles))


def voxels_of_points(points: Iterable[Sequence[float]], bits: int) -> set[Voxel]:
    """Voxels of the grid that hold a point, each box closed below and open above."""
    voxels = {(floor(x), floor(y), floor(z)) for x, y, z in points}
    return {voxel for voxel in voxels if all(0 <= n < 2**bits for n in voxel)}

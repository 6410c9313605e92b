"""Geometry as it is shown: triangles with smooth and sharp edges, voxels as blocks, boxes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

SHARP = np.cos(np.radians(30.0))
"""Cosine of the angle between two faces above which their common edge is drawn sharp."""
_MIX = np.array(
    [0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0xD6E8FEB86659FD93],
    dtype=np.uint64,
)
"""Odd numbers that mix three coordinates and a shape into one number, to find equal positions."""
_CUBE = np.array(
    [[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
)  # fmt: skip
_SIDES = np.array([
    [0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3],
])  # fmt: skip
"""Corners of a cube's sides, seen from outside in anticlockwise order: -x, +x, -y, +y, -z, +z."""


class Facets(NamedTuple):
    """Vertices (V, 3), metres, and faces (F, 3): float64 and int64; as sent, float32 and uint32."""

    vertices: NDArray[np.floating]
    faces: NDArray[np.integer]


def sharpened(several: Sequence[Facets]) -> list[Facets]:
    """The same triangles in the same order, with vertices split where edges are sharp.

    A browser shades a vertex with the mean normal of its faces. So faces share a vertex here only
    if a path of smooth edges around that point joins them. Equal positions of one shape count as
    one point, because many files repeat them for every triangle. Many small shapes together are ten
    times faster than one after another.
    """
    n_vertices = [len(facets.vertices) for facets in several]
    first = np.cumsum([0, *n_vertices])
    vertices = np.concatenate([facets.vertices for facets in several])
    pairs = zip(several, first.tolist(), strict=False)
    faces = np.concatenate([facets.faces + start for facets, start in pairs])
    points = _welded(vertices, np.repeat(np.arange(len(several)), n_vertices))[faces]
    corners = _smooth_pairs(vertices[faces], points)
    graph = coo_array((np.ones(len(corners), dtype=np.int8), corners.T), shape=(faces.size,) * 2)
    n_found, found = connected_components(graph, directed=False)
    # numbers in the order of the corners, so that those of each shape are neighbours
    seen_first = np.empty(n_found, dtype=np.int64)
    seen_first[found[::-1]] = np.arange(len(found))[::-1]  # the last one that is written stays
    order = np.empty(n_found, dtype=np.int64)
    order[np.argsort(seen_first)] = np.arange(n_found)
    label = order[found].reshape(-1, 3)
    split = vertices[faces.reshape(-1)[np.sort(seen_first)]]
    made, start, begin = [], 0, 0
    for facets in several:
        own = label[start : start + len(facets.faces)]
        end = int(own.max()) + 1 if len(own) else begin
        made.append(Facets(split[begin:end], own - begin))
        start, begin = start + len(own), end
    return made


def _welded(vertices: NDArray[np.floating], shape: NDArray[np.int64]) -> NDArray[np.int64]:
    """A number (V,) for each vertex, equal for equal positions in the same shape (V,)."""
    keys = np.empty((len(vertices), 4))
    keys[:, :3], keys[:, 3] = vertices + 0.0, shape  # -0.0 equals 0.0, but its bits differ
    mixed = (keys.view(np.uint64) * _MIX).sum(axis=1, dtype=np.uint64)
    mixed ^= mixed >> np.uint64(29)
    _, first, number = np.unique(mixed, return_index=True, return_inverse=True)
    if np.array_equal(keys[first][number], keys):
        return number.astype(np.int64)
    return np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64)


def _smooth_pairs(triangles: NDArray[np.float64], points: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pairs (P, 2) of corners that share a vertex: corner 3 f + k is corner k of face f."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    starts, ends = points.reshape(-1), np.roll(points, -1, axis=1).reshape(-1)
    low, high = np.minimum(starts, ends), np.maximum(starts, ends)
    key = low * (int(points.max()) + 1) + high
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(np.diff(key[order]) == 0)
    one, other = order[same], order[same + 1]
    smooth = (normals[one // 3] * normals[other // 3]).sum(axis=1) > SHARP
    one, other = one[smooth], other[smooth]
    one_end, other_end = _next_corner(one), _next_corner(other)
    along = starts[one] == starts[other]
    first = np.stack([one, np.where(along, other, other_end)], axis=1)
    second = np.stack([one_end, np.where(along, other_end, other)], axis=1)
    return np.concatenate([first, second])


def _next_corner(corner: NDArray[np.int64]) -> NDArray[np.int64]:
    """The corner that follows in the same face."""
    return np.where(corner % 3 == 2, corner - 2, corner + 1)


def cube() -> Facets:
    """A cube of edge 1 about the origin."""
    return _quads(_CUBE[_SIDES])


def _quads(corners: NDArray[np.float64]) -> Facets:
    """Two triangles for each of the quadrilaterals (Q, 4, 3)."""
    first = 4 * np.arange(len(corners), dtype=np.int64)
    faces = first[:, None] + np.array([0, 1, 2, 0, 2, 3])
    return Facets(corners.reshape(-1, 3), faces.reshape(-1, 3))


class Blocks(NamedTuple):
    """Cubes of equal size: whole numbers (n, 3) of their places, in cubes; edge in voxels."""

    places: NDArray[np.int64]
    edge: int


def coarsened(voxels: NDArray[np.int64], most: int) -> Blocks:
    """Voxels (n, 3) as at most `most` cubes that hold them, whose edge is a power of two.

    The places of the cubes are counted from the grid's origin, and differ by less than 2^20 on each
    axis, so that three of them fit into one integer.
    """
    places, edge = voxels, 1
    while len(places) > most or np.ptp(places, axis=0).max(initial=0) >= 1 << 20:
        places, edge = np.unique(places >> 1, axis=0), 2 * edge
    return Blocks(places, edge)


def block_facets(blocks: Blocks) -> Facets:
    """The sides of cubes that no neighbour covers, in voxels from the grid's origin."""
    places = blocks.places
    low = places.min(axis=0) - 1
    shape = places.max(axis=0) - low + 2
    keys = np.ravel_multi_index((places - low).T, shape)
    keys.sort()
    sides = []
    for axis in range(3):
        for side, step in ((0, -1), (1, 1)):
            beside = places - low
            beside[:, axis] += step
            wanted = np.ravel_multi_index(beside.T, shape)
            at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
            bare = places[keys[at] != wanted]
            sides.append((bare[:, None, :] + 0.5 + _CUBE[_SIDES[2 * axis + side]]) * blocks.edge)
    return _quads(np.concatenate(sides))

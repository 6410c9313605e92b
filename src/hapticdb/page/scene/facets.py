"""Triangles for display: sharp edges, blocks of voxels, boxes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

SHARP = np.cos(np.radians(30.0))
"""Cosine of the least angle between the faces of a sharp edge."""
_MIX = np.array(
    [0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0xD6E8FEB86659FD93],
    dtype=np.uint64,
)
"""Odd factors of a hash of a position and its shape's number, to weld equal positions."""
_CUBE = np.array(
    [[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
)  # fmt: skip
_SIDES = np.array([
    [0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3],
])  # fmt: skip
"""Corners of a cube's sides, anticlockwise from outside: -x, +x, -y, +y, -z, +z."""


class Facets(NamedTuple):
    """Vertices (V, 3), metres, float64 or float32; faces (F, 3), int64 or uint32."""

    vertices: NDArray[np.floating]
    faces: NDArray[np.integer]


def sharpened(several: Sequence[Facets]) -> list[Facets]:
    """The same triangles in the same order, with vertices split at sharp edges.

    A browser shades a vertex with the mean normal of its faces. So faces share a vertex only if
    smooth edges at that point connect them. Equal positions of one shape count as one point, since
    many files repeat them for every triangle. One call for many small shapes is ten times faster
    than a call for each.
    """
    n_vertices = [len(facets.vertices) for facets in several]
    first = np.cumsum([0, *n_vertices])
    vertices = np.concatenate([facets.vertices for facets in several])
    pairs = zip(several, first.tolist(), strict=False)
    faces = np.concatenate([facets.faces + start for facets, start in pairs])
    points = _welded(vertices, np.repeat(np.arange(len(several)), n_vertices))[faces]
    corners = _smooth_pairs(vertices[faces], points)
    graph = coo_array((np.ones(len(corners), dtype=np.int8), corners.T), shape=(faces.size,) * 2)
    # scipy numbers components by their first corners: the vertices of each shape are contiguous
    found = connected_components(graph, directed=False)[1].astype(np.int64)
    label, first_corners = found.reshape(-1, 3), np.unique(found, return_index=True)[1]
    split = vertices[faces.reshape(-1)[first_corners]]
    made, start, begin = [], 0, 0
    for facets in several:
        own = label[start : start + len(facets.faces)]
        end = int(own.max()) + 1 if len(own) else begin
        made.append(Facets(split[begin:end], own - begin))
        start, begin = start + len(own), end
    return made


def _welded(vertices: NDArray[np.floating], shape: NDArray[np.int64]) -> NDArray[np.int64]:
    """Indices (V,) of vertices, equal for equal positions in the same shape (V,)."""
    keys = np.empty((len(vertices), 4))
    keys[:, :3], keys[:, 3] = vertices + 0.0, shape  # -0.0 equals 0.0, but its bits differ
    # one hashed integer for each position; a collision shows below, then rows are compared
    mixed = (keys.view(np.uint64) * _MIX).sum(axis=1, dtype=np.uint64)
    mixed ^= mixed >> np.uint64(29)
    _, first, number = np.unique(mixed, return_index=True, return_inverse=True)
    if np.array_equal(keys[first][number], keys):
        return number.astype(np.int64)
    return np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64)


def _smooth_pairs(triangles: NDArray[np.float64], points: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pairs (P, 2) of corners with a common vertex: corner 3 f + k is corner k of face f."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    starts, ends = points.reshape(-1), np.roll(points, -1, axis=1).reshape(-1)
    low, high = np.minimum(starts, ends), np.maximum(starts, ends)
    # an edge without direction as one integer: equal neighbours in order are its two faces
    key = low * (int(points.max()) + 1) + high
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(np.diff(key[order]) == 0)
    one, other = order[same], order[same + 1]
    smooth = (normals[one // 3] * normals[other // 3]).sum(axis=1) > SHARP
    one, other = one[smooth], other[smooth]
    one_end, other_end = _next_corner(one), _next_corner(other)
    # faces of one winding run an edge in opposite directions; along: in the same one
    along = starts[one] == starts[other]
    first = np.stack([one, np.where(along, other, other_end)], axis=1)
    second = np.stack([one_end, np.where(along, other_end, other)], axis=1)
    return np.concatenate([first, second])


def _next_corner(corner: NDArray[np.int64]) -> NDArray[np.int64]:
    """Next corner of the same face."""
    return np.where(corner % 3 == 2, corner - 2, corner + 1)


def cube() -> Facets:
    """Cube of edge 1 about the origin, float32 and uint32."""
    vertices, faces = _quads(_CUBE[_SIDES])
    return Facets(vertices.astype(np.float32), faces.astype(np.uint32))


def _quads(corners: NDArray[np.float64]) -> Facets:
    """Two triangles for each of the quadrilaterals (Q, 4, 3)."""
    first = 4 * np.arange(len(corners), dtype=np.int64)
    faces = first[:, None] + np.array([0, 1, 2, 0, 2, 3])
    return Facets(corners.reshape(-1, 3), faces.reshape(-1, 3))


def coarsened(voxels: NDArray[np.int64], most: int) -> tuple[NDArray[np.int64], int]:
    """At most `most` cubes that cover voxels (n, 3): places (n, 3), in cubes, and edge, in voxels.

    The edge is a power of two. Positions are relative to the grid's origin and span less than 2^20
    on each axis, so that three fit in one integer.
    """
    places, edge = voxels, 1
    while len(places) > most or np.ptp(places, axis=0).max(initial=0) >= 1 << 20:
        places, edge = np.unique(places >> 1, axis=0), 2 * edge
    return places, edge


def block_facets(places: NDArray[np.int64], edge: int) -> Facets:
    """Exposed sides of cubes, in voxels from the grid's origin; parameters as of `coarsened`."""
    # a margin of one cube: neighbours beyond the border have keys, too
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
            sides.append((bare[:, None, :] + 0.5 + _CUBE[_SIDES[2 * axis + side]]) * edge)
    return _quads(np.concatenate(sides))

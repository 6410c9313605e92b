"""Triangulation of polygons, strips and fans.

A polygon becomes a fan if its fan stays inside; ear clipping by mapbox_earcut (decision 0003)
otherwise.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Faces = NDArray[np.int64]

_FOLD = 1e-6
"""Tolerance of the fan test: a fan is wrong if a triangle turns against the polygon by more than
this share of the polygon's area. Rounding of float32 positions turns collinear corners by 1e-7."""


def triangulated(
    vertices: NDArray[np.generic],
    polygons: Sequence[Sequence[int]],
    holes: Mapping[int, Sequence[int]] | None = None,
) -> tuple[Faces, int]:
    """Triangles (F, 3) of polygons, and the number of polygons of fewer than three corners.

    polygons : vertex indices, possibly out of range; holes : by the number of a polygon with holes,
    offsets of the holes' first corners in it.
    """
    by_size: dict[int, list[Sequence[int]]] = {}
    pieces = [np.empty((0, 3), dtype=np.int64)]
    for number, polygon in enumerate(polygons):
        if holes and number in holes:
            pieces.append(_cut(vertices, np.array(polygon, dtype=np.int64), holes[number]))
        else:
            by_size.setdefault(len(polygon), []).append(polygon)
    for size, alike in by_size.items():
        if size >= 3:
            pieces.append(triangulated_equal(vertices, np.array(alike, dtype=np.int64)))
    return np.concatenate(pieces), sum(len(p) for size, p in by_size.items() if size < 3)


def triangulated_equal(vertices: NDArray[np.generic], polygons: Faces) -> Faces:
    """Triangles (F, 3) of polygons (P, k) of equal size, k >= 3."""
    if polygons.shape[1] == 3 or not len(vertices):
        return fan(polygons)
    folded = np.flatnonzero(_are_folded(vertices, polygons))
    if not len(folded):
        return fan(polygons)
    return np.concatenate(
        [fan(np.delete(polygons, folded, axis=0))]
        + [_cut(vertices, polygon, ()) for polygon in polygons[folded]]
    )


def strip(corners: Faces) -> Faces:
    """Triangles (k - 2, 3) of a triangle strip (k,)."""
    found = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
    found[1::2] = found[1::2, ::-1]  # every other triangle of a strip is wound the other way
    return found


def fan(polygons: Faces) -> Faces:
    """Triangles (P (k - 2), 3) around the first corners of polygons (P, k), or of one (k,)."""
    polygons = np.atleast_2d(polygons)
    corners = np.arange(1, polygons.shape[1] - 1)
    first = np.broadcast_to(polygons[:, :1], (len(polygons), len(corners)))
    return np.stack([first, polygons[:, corners], polygons[:, corners + 1]], axis=2).reshape(-1, 3)


def _are_folded(vertices: NDArray[np.generic], polygons: Faces) -> NDArray[np.bool_]:
    """Whether the fan of each polygon (P, k) leaves it; False for indices out of range."""
    inside = ((polygons >= 0) & (polygons < len(vertices))).all(axis=1, keepdims=True)
    known = np.where(inside, polygons, 0)
    first = np.asarray(vertices[known[:, 0]], dtype=np.float64)
    edges = [vertices[column] - first for column in known[:, 1:].T]
    turns = [np.cross(a, b) for a, b in pairwise(edges)]
    area = np.sum(turns, axis=0)
    limit = -_FOLD * np.einsum("ij,ij->i", area, area)
    against = [np.einsum("ij,ij->i", turn, area) < limit for turn in turns]
    return np.asarray(np.any(against, axis=0))


def _cut(vertices: NDArray[np.generic], polygon: Faces, starts: Sequence[int]) -> Faces:
    """Ear clipping of one polygon (k,), holes from `starts` on, in its mean plane; else its fan."""
    import mapbox_earcut  # noqa: PLC0415 - few files need it

    as_fan = fan(polygon)
    if not ((polygon >= 0) & (polygon < len(vertices))).all():
        return as_fan
    corners = np.asarray(vertices[polygon], dtype=np.float64)
    ends = [*starts, len(polygon)]
    outer = corners[: ends[0]] - corners[0]
    normal = np.cross(outer, np.roll(outer, -1, axis=0)).sum(axis=0)
    flat = np.delete(corners - corners[0], np.abs(normal).argmax(), axis=1)
    if not np.isfinite(flat).all():
        return as_fan
    found = mapbox_earcut.triangulate_float64(flat, np.array(ends, dtype=np.uint32))
    if not len(found):
        return as_fan
    triangles = found.astype(np.int64).reshape(-1, 3)
    a, b, c = (corners[triangles[:, n]] for n in range(3))
    if np.cross(b - a, c - a).sum(axis=0) @ normal < 0:
        triangles = triangles[:, ::-1]
    return polygon[triangles]

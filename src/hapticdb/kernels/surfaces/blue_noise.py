"""Blue-noise sampling of a surface.

Weighted sample elimination (Yuksel, "Sample Elimination for Generating Poisson Disk Sample Sets",
Computer Graphics Forum 34(2), 2015): from several times as many candidates as points, the most
crowded one is eliminated repeatedly. All lengths are in metres, in one frame of the caller's
choice.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import FLOAT, FLOATS2, INT, INTS32, INTS32_3, entry, leaf

Floats = NDArray[np.float64]

CHUNK = 1 << 18
"""Candidates of one draw. Another value changes the order of the random numbers, and so every
shell. Larger: more memory."""
CROWD = 500
"""Greatest mean number of neighbours of a candidate; above it the reach is shortened. Several
coincident sheets have half as many. Larger: slower for folded surfaces."""
OPPOSITE = 0.35
"""Reach across a sheet, as a share of the spacing. Larger: fewer points per area of thin walls."""


@leaf
def _pair_weight(points, face_of, normals, a, b, reach, nearest):
    """Mutual weight of a and b: (1 - d / reach)^8, d the distance, at least `nearest`.

    Yuksel 2015, equations 2 and 5. Points on opposite sides of a sheet have a weight only within
    `OPPOSITE` times the reach.
    """
    x = points[a, 0] - points[b, 0]
    y = points[a, 1] - points[b, 1]
    z = points[a, 2] - points[b, 2]
    squared = x * x + y * y + z * z
    if squared >= reach * reach:
        return 0.0
    f = face_of[a]
    g = face_of[b]
    facing = 0.0
    for axis in range(3):
        facing += normals[f, axis] * normals[g, axis]
    scale = OPPOSITE if facing < -0.5 else 1.0
    distance = max(np.sqrt(squared), nearest * scale)
    w = 1.0 - distance / (reach * scale)
    if w <= 0.0:
        return 0.0
    w *= w
    w *= w
    return w * w


@leaf
def _sift_down(heap, rank, weights, at, size):
    """Restore the max-heap below `at` after a decrease of its weight.

    rank (M,) int32 : position of each candidate in the heap, -1 after its elimination.
    """
    item = heap[at]
    weight = weights[item]
    while True:
        child = 2 * at + 1
        if child >= size:
            break
        if child + 1 < size and weights[heap[child + 1]] > weights[heap[child]]:
            child += 1
        if weights[heap[child]] <= weight:
            break
        heap[at] = heap[child]
        rank[heap[at]] = at
        at = child
    # the item moves once, at its final place: half of the writes of a swap
    heap[at] = item
    rank[item] = at


@entry(FLOATS2, INTS32, FLOATS2, INTS32, INTS32_3, INT, FLOAT, FLOAT)
def eliminate_kernel(points, face_of, normals, cell_of, ranges, n_keep, reach, nearest):
    """Eliminate the most crowded candidate repeatedly, down to `n_keep`.

    points (M, 3), sorted by cell; face_of (M,) int32; normals (F, 3); cell_of (M,) int32; ranges
    (C, 9, 2) int32, candidates in the cells around each. Returns (M,) int32, -1 for eliminated
    candidates.
    """
    n_points = points.shape[0]
    weights = np.empty(n_points, dtype=np.float64)
    heap = np.empty(n_points, dtype=np.int32)
    rank = np.empty(n_points, dtype=np.int32)
    for a in range(n_points):
        weight = 0.0
        cell = cell_of[a]
        for row in range(9):
            for b in range(ranges[cell, row, 0], ranges[cell, row, 1]):
                if b != a:
                    weight += _pair_weight(points, face_of, normals, a, b, reach, nearest)
        weights[a] = weight
        heap[a] = a
        rank[a] = a
    # Floyd's heap construction, bottom up: linear time
    for at in range(n_points // 2 - 1, -1, -1):
        _sift_down(heap, rank, weights, at, n_points)
    size = n_points
    while size > n_keep:
        item = np.int64(heap[0])
        rank[item] = -1
        size -= 1
        if size > 0:
            heap[0] = heap[size]
            rank[heap[0]] = 0
            _sift_down(heap, rank, weights, np.int64(0), size)
        cell = cell_of[item]
        for row in range(9):
            for b in range(ranges[cell, row, 0], ranges[cell, row, 1]):
                if rank[b] < 0:  # already eliminated
                    continue
                weight = _pair_weight(points, face_of, normals, item, b, reach, nearest)
                if weight > 0.0:
                    # weights only fall, so a max-heap with positions needs no sift up
                    weights[b] -= weight
                    _sift_down(heap, rank, weights, np.int64(rank[b]), size)
    return rank


class _Cells(NamedTuple):
    order: NDArray[np.intp]  # (M,) candidates by cell
    cell_of: NDArray[np.int32]  # (M,) cell of each sorted candidate
    ranges: NDArray[np.int32]  # (C, 9, 2) sorted candidates in the cells around each
    crowd: float  # candidates around a candidate, on average


def _sort_into_cells(points: Floats, edge: float) -> _Cells:
    """Grid of cubes of an edge over candidates (M, 3), with the 27 cubes around each as 9 runs."""
    low = points.min(axis=0)
    extent = points.max(axis=0) - low
    edge = max(edge, float(extent.max()) / 2**20)  # three axes of a key fit 63 bits
    _, ny, nz = (extent / edge).astype(np.int64) + 3
    keys = np.zeros(len(points), dtype=np.int64)
    for axis, n in enumerate((1, ny, nz)):  # a border of one empty cell: neighbours do not wrap
        keys *= n
        keys += ((points[:, axis] - low[axis]) / edge).astype(np.int64) + 1
    order = np.argsort(keys, kind="stable")
    cells, starts, counts = np.unique(keys[order], return_index=True, return_counts=True)
    bounds = np.append(starts, len(points))
    ranges = np.empty((len(cells), 9, 2), dtype=np.int32)
    for row in range(9):
        middle = cells + ((row // 3 - 1) * ny + row % 3 - 1) * nz
        ranges[:, row, 0] = bounds[np.searchsorted(cells, middle - 1)]
        ranges[:, row, 1] = bounds[np.searchsorted(cells, middle + 1, side="right")]
    around = (ranges[:, :, 1] - ranges[:, :, 0]).sum(axis=1, dtype=np.int64)
    cell_of = np.repeat(np.arange(len(cells), dtype=np.int32), counts)
    return _Cells(order, cell_of, ranges, float(counts @ around) / len(points))


def spread_points(
    points: Floats,
    face_of: NDArray[np.int32],
    normals: Floats,
    n_keep: int,
    spacing: float,
) -> NDArray[np.intp]:
    """Indices of `n_keep` of M candidates, by weighted sample elimination, ascending.

    points (M, 3), uniform over the surface; face_of (M,); normals (F, 3) of the faces, unit, all to
    the same side; spacing : of a hexagonal lattice with the same density.
    """
    cells = _sort_into_cells(points, spacing)
    # smaller cells: the pairs are quadratic in the crowd of a cell
    while cells.crowd > CROWD:  # sheets folded upon one another
        spacing *= 0.75
        cells = _sort_into_cells(points, spacing)
    # Yuksel 2015, equation 4: beta = 0.65, gamma = 1.5
    nearest = spacing * (1.0 - (n_keep / len(points)) ** 1.5) * 0.65
    rank = eliminate_kernel(
        points[cells.order],
        face_of[cells.order],
        normals,
        cells.cell_of,
        cells.ranges,
        n_keep,
        spacing,
        nearest,
    )
    return np.sort(cells.order[rank >= 0])


def sample_surface(
    triangles: Floats,
    areas: Floats,
    normals: Floats,
    n_points: int,
    rng: np.random.Generator,
) -> tuple[Floats, NDArray[np.int32]]:
    """Points (N, 3) evenly spaced on triangles, and the face (N,) of each.

    triangles (F, 3, 3); areas (F,), all positive; normals (F, 3). Candidates are drawn in strata of
    equal area, then the most crowded are eliminated. Measured on a sphere, the nearest neighbours
    are 0.74 of the hexagonal lattice's spacing apart with 10 candidates a point, 0.69 with 5, 0.66
    with 4.
    """
    n_candidates = n_points * (10 if n_points <= 20_000 else 5 if n_points <= 200_000 else 4)
    filled = np.cumsum(areas)
    corner = triangles[:, 0]
    along, across = triangles[:, 1] - corner, triangles[:, 2] - corner
    points = np.empty((n_candidates, 3))
    face_of = np.empty(n_candidates, dtype=np.int32)
    for start in range(0, n_candidates, CHUNK):
        part = slice(start, min(start + CHUNK, n_candidates))
        stratum, u, v = rng.random((3, part.stop - start))
        height = (np.arange(start, part.stop) + stratum) * (filled[-1] / n_candidates)
        face = np.minimum(np.searchsorted(filled, height, side="right"), len(filled) - 1)
        u = np.sqrt(u)
        points[part] = corner[face] + (u - u * v)[:, None] * along[face]
        points[part] += (u * v)[:, None] * across[face]
        face_of[part] = face
    spacing = float(np.sqrt(2.0 * filled[-1] / (np.sqrt(3.0) * n_points)))
    chosen = spread_points(points, face_of, normals, n_points, spacing)
    return points[chosen], face_of[chosen]

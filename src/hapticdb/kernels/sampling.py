"""Points spread over a surface, and which side of the surface is inside.

Spreading is weighted sample elimination (Yuksel, "Sample Elimination for Generating Poisson Disk
Sample Sets", Computer Graphics Forum 34(2), 2015). Sides are told by the parity of crossings along
lines (Jordan's theorem), which asks nothing of the winding of the triangles. All lengths are in
metres, in one frame of the caller's choice.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import entry, leaf
from hapticdb.kernels.curves import Z_ORDER, encode

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LEAF_SIZE = 4  # triangles in a leaf of the tree
STACK = 64  # more than the height of a tree over 2^31 leaves
TOUCH = 2  # a crossing at the line's own start
PATIENCE = 32  # lines asked for one group of faces, at most
ENOUGH = 5  # a side that leads by this many lines is not asked further
LABOUR = 2e8  # nodes visited for all votes, a few seconds: past it, patches fall silent
CHUNK = 1 << 18  # candidates drawn at a time
CROWD = 500  # candidates looked at for one, on average: several sheets at one place have half


class TriangleTree(NamedTuple):
    """Boxes over triangles: a complete binary tree, node n above nodes 2 n + 1 and 2 n + 2.

    Triangles are sorted by body, then by Z-order of their centroids, so that a line that asks about
    one body enters only the nodes that hold some of it.
    """

    corners: Floats  # (T, 3, 3), sorted
    faces: Ints  # (T,) number of each sorted triangle in the caller's order
    bodies: Ints  # (T,) body of each sorted triangle, ascending
    boxes: Floats  # (nodes, 2, 3) lower and upper corner
    spans: Ints  # (nodes, 2) least and greatest body below
    slack: float  # what counts as no distance, metres


def triangle_tree(triangles: Floats, bodies: Ints) -> TriangleTree:
    """Build the tree over triangles (T, 3, 3), T > 0, of the bodies (T,)."""
    centroids = triangles.mean(axis=1)
    low = centroids.min(axis=0)
    extent = float((centroids.max(axis=0) - low).max()) or 1.0
    cells = ((centroids - low) * ((2**21 - 1) / extent)).astype(np.int64)
    order = np.lexsort((encode(cells, 21, Z_ORDER), bodies))
    corners = np.ascontiguousarray(triangles[order])
    n_leaves = 1
    while n_leaves * LEAF_SIZE < len(triangles):
        n_leaves *= 2
    # A line in the plane of a flat box would miss it by a rounding: the boxes are grown by more.
    slack = 1e-11 * float(np.abs(triangles).max())
    boxes = np.empty((2 * n_leaves - 1, 2, 3))
    spans = np.empty((2 * n_leaves - 1, 2), dtype=np.int64)
    level = np.full((n_leaves * LEAF_SIZE, 2, 3), np.inf)
    level[:, 1] = -np.inf
    level[: len(corners), 0] = corners.min(axis=1) - slack
    level[: len(corners), 1] = corners.max(axis=1) + slack
    span = np.full((n_leaves * LEAF_SIZE, 2), np.iinfo(np.int64).max)
    span[:, 1] = -1
    span[: len(corners)] = bodies[order, None]
    arity = LEAF_SIZE
    width = n_leaves
    while width > 0:
        below = level.reshape(width, arity, 2, 3)
        level = np.stack((below[:, :, 0].min(axis=1), below[:, :, 1].max(axis=1)), axis=1)
        parts = span.reshape(width, arity, 2)
        span = np.stack((parts[:, :, 0].min(axis=1), parts[:, :, 1].max(axis=1)), axis=1)
        boxes[width - 1 : 2 * width - 1] = level
        spans[width - 1 : 2 * width - 1] = span
        width //= 2
        arity = 2
    return TriangleTree(corners, order.astype(np.int64), bodies[order], boxes, spans, slack)


@leaf
def line_meets_box(ox, oy, oz, ix, iy, iz, boxes, node):
    """Whether the line through o, of inverse direction i, meets the node's box."""
    a = (boxes[node, 0, 0] - ox) * ix
    b = (boxes[node, 1, 0] - ox) * ix
    near = min(a, b)
    far = max(a, b)
    a = (boxes[node, 0, 1] - oy) * iy
    b = (boxes[node, 1, 1] - oy) * iy
    near = max(near, min(a, b))
    far = min(far, max(a, b))
    a = (boxes[node, 0, 2] - oz) * iz
    b = (boxes[node, 1, 2] - oz) * iz
    near = max(near, min(a, b))
    far = min(far, max(a, b))
    return near <= far


@leaf
def crossing_side(ox, oy, oz, dx, dy, dz, corners, n, slack):
    """Where the line through o along d crosses triangle n: 1 ahead, -1 behind, TOUCH at o, or 0.

    Moeller and Trumbore, Journal of Graphics Tools 2(1), 1997.
    """
    x, y, z = corners[n, 0, 0], corners[n, 0, 1], corners[n, 0, 2]
    ax, ay, az = corners[n, 1, 0] - x, corners[n, 1, 1] - y, corners[n, 1, 2] - z
    bx, by, bz = corners[n, 2, 0] - x, corners[n, 2, 1] - y, corners[n, 2, 2] - z
    sx, sy, sz = ox - x, oy - y, oz - z
    px, py, pz = dy * bz - dz * by, dz * bx - dx * bz, dx * by - dy * bx
    det = ax * px + ay * py + az * pz
    if det == 0.0:
        return 0
    u = (sx * px + sy * py + sz * pz) / det
    if u < 0.0 or u > 1.0:
        return 0
    qx, qy, qz = sy * az - sz * ay, sz * ax - sx * az, sx * ay - sy * ax
    v = (dx * qx + dy * qy + dz * qz) / det
    if v < 0.0 or u + v > 1.0:
        return 0
    distance = (bx * qx + by * qy + bz * qz) / det
    if abs(distance) <= slack:
        return TOUCH
    return 1 if distance > 0.0 else -1


@leaf
def crossings(origin, direction, body, skip, tree, stack):
    """Crossings of a line with one body, ahead of the origin and behind it, and nodes visited.

    A line that starts on face `skip` leaves it out, and so needs no offset: walls may be as thin as
    they like. Both counts are -1 where the start lies on yet another triangle.
    """
    ox, oy, oz = origin[0], origin[1], origin[2]
    dx, dy, dz = direction[0], direction[1], direction[2]
    ix, iy, iz = 1.0 / dx, 1.0 / dy, 1.0 / dz
    first_leaf = tree.boxes.shape[0] // 2
    n_triangles = tree.corners.shape[0]
    ahead = 0
    behind = 0
    visits = 0
    stack[0] = 0
    top = 1
    while top > 0:
        visits += 1
        top -= 1
        node = stack[top]
        if tree.spans[node, 0] > body or tree.spans[node, 1] < body:
            continue
        if not line_meets_box(ox, oy, oz, ix, iy, iz, tree.boxes, node):
            continue
        if node < first_leaf:
            stack[top] = 2 * node + 2
            stack[top + 1] = 2 * node + 1
            top += 2
            continue
        start = (node - first_leaf) * LEAF_SIZE
        for n in range(start, min(start + LEAF_SIZE, n_triangles)):
            if tree.bodies[n] != body or tree.faces[n] == skip:
                continue
            side = crossing_side(ox, oy, oz, dx, dy, dz, tree.corners, n, tree.slack)
            if side == TOUCH:
                return -1, -1, visits
            if side > 0:
                ahead += 1
            elif side < 0:
                behind += 1
    return ahead, behind, visits


@entry
def side_votes_kernel(tree, picks, directions, centroids, normals, body_of, out):
    """For each patch, lines that see the inside where the normals point, less those that do not.

    picks (P, L) int64 faces, -1 for none; directions (L, 3); centroids, normals (F, 3); body_of
    (F,) int64; out (P,) int64. A line across a closed surface crosses it, the start not counted, an
    odd number of times on one side of its start, and that side is inside, and an even number on the
    other; anything else is a hole or a rounding and has no vote. A dense soup, where each line
    crosses thousands, runs out of `LABOUR` evenly: some of its patches get fewer lines, or none.
    """
    stack = np.empty(STACK, dtype=np.int64)
    spent = 0
    for p in range(picks.shape[0]):
        votes = 0
        for line in range(picks.shape[1]):
            face = picks[p, line]
            if face < 0:
                continue
            if spent > LABOUR * (p + 1) / picks.shape[0]:
                break
            ahead, behind, visits = crossings(
                centroids[face], directions[line], body_of[face], face, tree, stack
            )
            spent += visits
            if ahead < 0 or ahead % 2 == behind % 2:
                continue
            along = 0.0
            for axis in range(3):
                along += directions[line, axis] * normals[face, axis]
            votes += 1 if (along > 0.0) == (ahead % 2 == 1) else -1
            if abs(votes) >= ENOUGH:
                break
        out[p] = votes


@entry
def nesting_kernel(tree, pairs, picks, directions, centroids, out):
    """For each pair (inner, outer) of bodies, whether the outer one encloses the inner one whole.

    pairs (Q, 2) int64; picks (B, L) int64 faces of each body, -1 for none; out (Q,) uint8.
    """
    stack = np.empty(STACK, dtype=np.int64)
    for q in range(pairs.shape[0]):
        n_inside = 0
        n_outside = 0
        for line in range(picks.shape[1]):
            face = picks[pairs[q, 0], line]
            if face < 0:
                continue
            ahead, behind, _ = crossings(
                centroids[face], directions[line], pairs[q, 1], -1, tree, stack
            )
            if ahead < 0 or ahead % 2 != behind % 2:
                continue
            if ahead % 2 == 1:
                n_inside += 1
            else:
                n_outside += 1
                break
        out[q] = 1 if n_inside > 0 and n_outside == 0 else 0


def normals_of(triangles: Floats) -> tuple[Floats, Floats]:
    """Find unit normals (F, 3) by the winding, and areas (F,); zero for needles and points."""
    along = triangles[:, 1] - triangles[:, 0]
    across = triangles[:, 2] - triangles[:, 0]
    cross = np.cross(along, across)
    double = np.linalg.norm(cross, axis=1)
    longest = np.maximum((along**2).sum(axis=1), (across**2).sum(axis=1))
    is_degenerate = ~(double > 1e-12 * longest)  # below, the normal is rounding
    double[is_degenerate] = 0.0
    normals = cross / np.where(is_degenerate, 1.0, double)[:, None]
    normals[is_degenerate] = 0.0
    return normals, double / 2.0


def _pick_faces(group: Ints, areas: Floats, n_groups: int) -> Ints:
    """For each group (F,) of faces some of them, in proportion to area; (n_groups, PATIENCE).

    Small groups repeat their faces; a group without area has none: -1.
    """
    totals = np.bincount(group, areas, n_groups)
    order = np.argsort(group, kind="stable")
    order = order[areas[order] > 0.0]
    filled = np.cumsum(areas[order] / totals[group[order]])  # a filled group takes up 1
    starts = np.cumsum(totals > 0.0) - 1.0
    # The golden ratio's multiples spread any number of first picks over the whole group.
    wanted = starts[:, None] + (np.arange(PATIENCE) * 0.6180339887498949 + 0.5) % 1.0
    picks = order[np.minimum(np.searchsorted(filled, wanted), len(order) - 1)]
    is_own = group[picks] == np.arange(n_groups)[:, None]
    return np.where(is_own, picks, -1).astype(np.int64)


def _directions(n: int) -> Floats:
    """`n` fixed directions, all over the sphere, none along an axis."""
    directions = np.random.default_rng(2015).normal(size=(n, 3))
    directions[np.abs(directions) < 1e-3] = 1e-3
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions


def side_votes(
    tree: TriangleTree,
    patch: Ints,
    body: Ints,
    areas: Floats,
    centroids: Floats,
    normals: Floats,
) -> Ints:
    """Let lines vote on each patch: positive (P,) where its normals point inside.

    patch, body, areas (F,); centroids, normals (F, 3), the normals alike in each patch.
    """
    picks = _pick_faces(patch, areas, int(patch.max()) + 1)
    votes = np.zeros(len(picks), dtype=np.int64)
    side_votes_kernel(tree, picks, _directions(PATIENCE), centroids, normals, body, votes)
    return votes


def enclosures(
    tree: TriangleTree,
    pairs: Ints,
    body: Ints,
    areas: Floats,
    centroids: Floats,
) -> NDArray[np.bool_]:
    """Tell for each pair (inner, outer) of bodies whether the outer one encloses the inner one."""
    picks = _pick_faces(body, areas, int(body.max()) + 1)
    out = np.zeros(len(pairs), dtype=np.uint8)
    nesting_kernel(tree, pairs, picks, _directions(PATIENCE), centroids, out)
    return out.astype(np.bool_)


@leaf
def pair_weight(points, face_of, normals, a, b, reach, nearest, opposite):
    """Weigh a and b on each other: (1 - d / reach)^8, d the distance, at least `nearest`.

    Yuksel 2015, equations 2 and 5. Points on opposite sides of a sheet see each other only within
    `opposite` times the reach: else thin walls would get fewer points an area than thick ones.
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
    scale = opposite if facing < -0.5 else 1.0
    distance = max(np.sqrt(squared), nearest * scale)
    w = 1.0 - distance / (reach * scale)
    if w <= 0.0:
        return 0.0
    w *= w
    w *= w
    return w * w


@leaf
def sift_down(heap, place, weights, at, size):
    """Restore the heap, heaviest first, below `at`, whose weight may have fallen."""
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
        place[heap[at]] = at
        at = child
    heap[at] = item
    place[item] = at


@entry
def eliminate_kernel(points, face_of, normals, cell_of, ranges, n_keep, reach, nearest, opposite):
    """Drop the most crowded candidate, again and again, until `n_keep` are left.

    points (M, 3), sorted by cell; face_of (M,) int32; normals (F, 3); cell_of (M,) int32; ranges
    (C, 9, 2) int32, the candidates in the cells around each -> (M,) int32, -1 for those dropped.
    """
    n_points = points.shape[0]
    weights = np.empty(n_points, dtype=np.float64)
    heap = np.empty(n_points, dtype=np.int32)
    place = np.empty(n_points, dtype=np.int32)
    for a in range(n_points):
        weight = 0.0
        cell = cell_of[a]
        for row in range(9):
            for b in range(ranges[cell, row, 0], ranges[cell, row, 1]):
                if b != a:
                    weight += pair_weight(points, face_of, normals, a, b, reach, nearest, opposite)
        weights[a] = weight
        heap[a] = a
        place[a] = a
    for at in range(n_points // 2 - 1, -1, -1):
        sift_down(heap, place, weights, at, n_points)
    size = n_points
    while size > n_keep:
        a = heap[0]
        place[a] = -1
        size -= 1
        if size > 0:
            heap[0] = heap[size]
            place[heap[0]] = 0
            sift_down(heap, place, weights, 0, size)
        cell = cell_of[a]
        for row in range(9):
            for b in range(ranges[cell, row, 0], ranges[cell, row, 1]):
                if place[b] < 0:
                    continue
                weight = pair_weight(points, face_of, normals, a, b, reach, nearest, opposite)
                if weight > 0.0:
                    weights[b] -= weight
                    sift_down(heap, place, weights, place[b], size)
    return place


class _Cells(NamedTuple):
    order: NDArray[np.intp]  # (M,) candidates by cell
    cell_of: NDArray[np.int32]  # (M,) cell of each sorted candidate
    ranges: NDArray[np.int32]  # (C, 9, 2) sorted candidates in the cells around each
    crowd: float  # candidates around a candidate, on average


def _sort_into_cells(points: Floats, edge: float) -> _Cells:
    """Candidates (M, 3) in cubes of that edge, and for each cube the 27 around it as 9 runs."""
    low = points.min(axis=0)
    extent = points.max(axis=0) - low
    edge = max(edge, float(extent.max()) / 2**20)  # three axes of a key fit 63 bits
    _, ny, nz = (extent / edge).astype(np.int64) + 3
    keys = np.zeros(len(points), dtype=np.int64)
    for axis, n in enumerate((1, ny, nz)):  # a border of one empty cell: neighbours never wrap
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
    opposite: float = 0.35,
) -> NDArray[np.intp]:
    """Choose `n_keep` of M candidates, as far from one another as they come.

    Parameters
    ----------
    points : (M, 3) candidates, uniform over the surface; M >= n_keep.
    face_of : (M,) face of each.
    normals : (F, 3) unit normals of the faces, all to the same side of the surface.
    n_keep : candidates to keep.
    spacing : distance of neighbours if the points kept were a hexagonal lattice.
    opposite : reach across a sheet, as a part of the spacing.

    Returns
    -------
    (n_keep,) indices, ascending.
    """
    cells = _sort_into_cells(points, spacing)
    while cells.crowd > CROWD:  # a soup folded upon itself: a shorter reach, or it takes for ever
        spacing *= 0.75
        cells = _sort_into_cells(points, spacing)
    # Yuksel 2015, equation 4: beta = 0.65, gamma = 1.5
    nearest = spacing * (1.0 - (n_keep / len(points)) ** 1.5) * 0.65
    place = eliminate_kernel(
        points[cells.order],
        face_of[cells.order],
        normals,
        cells.cell_of,
        cells.ranges,
        n_keep,
        spacing,
        nearest,
        opposite,
    )
    return np.sort(cells.order[place >= 0])


def sample_surface(
    triangles: Floats,
    areas: Floats,
    normals: Floats,
    n_points: int,
    rng: np.random.Generator,
) -> tuple[Floats, NDArray[np.int32]]:
    """Choose points (N, 3) spread evenly over triangles, and tell the face (N,) of each.

    triangles (F, 3, 3); areas (F,), all positive; normals (F, 3). Of several times as many
    candidates, drawn in strata of equal area, those stay that are farthest apart. Measured on a
    sphere, the nearest neighbours are 0.74 of the hexagonal lattice's spacing apart with 10
    candidates a point, 0.69 with 5, 0.66 with 4.
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

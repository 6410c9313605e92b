"""Finds the inner side of a surface from the places of its triangles, not from their winding.

In files, faces may have any winding, may be repeated, and may not share their edges. So corners
that coincide are joined, faces that share edges form patches of one winding and closed bodies, and
lines through the patches vote on the side (`kernels.surfaces.triangle_bvh`). For a patch without
votes the side is guessed from its shape. docs/decisions/0015 gives the reasons.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import UsageError
from hapticdb.kernels.surfaces import triangle_bvh as kernels

JOIN = 1e-6
"""Distance up to which corners of open edges are joined, as a share of the bounding box's diagonal.
A larger value closes wider gaps, and also joins the corners of small details."""
CRACK = 1e-5
"""Distance up to which a corner lies on an open edge, likewise: of a part of a metre, 0.01 mm, the
tolerance of sweeps. A larger value encloses more, and overlooks wider cracks."""
MOST_NEAR = 10_000_000
"""Corners tried on open edges, at most: half a gigabyte. Beyond, edges stay open."""
SIDES = 1024
"""Open edges whose corners are counted at once."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Surface(NamedTuple):
    """Triangles whose inner side is known; the points of a shell are spread over them."""

    triangles: Floats  # (F, 3, 3), none twice
    areas: Floats  # (F,), zero where degenerate
    normals: Floats  # (F, 3), into the tool
    center: Floats  # (3,)
    is_closed: bool
    bodies: Ints  # (F,) 0 for all open ones, then the closed ones
    faces: Ints  # (F,) number of each among the given triangles


class _Edges(NamedTuple):
    """Numbered edges of the faces (F, 3) of a mesh; sides that coincide have one edge number."""

    number: Ints  # (3 F,) edge of each face's side: corners 0 1, 1 2, 2 0
    is_forward: NDArray[np.bool_]  # (3 F,) whether the side starts at the lower corner
    uses: Ints  # (E,) faces at each edge


class _Sides(NamedTuple):
    """Intermediate results of `orient` for each face, relative to a common origin."""

    triangles: Floats  # (F, 3, 3)
    centroids: Floats  # (F, 3)
    normals: Floats  # (F, 3) unit, one winding in each patch; zero where degenerate
    areas: Floats  # (F,)
    patch: Ints  # (F,)
    body: Ints  # (F,) 0 for all open bodies together, then the closed ones
    is_flipped: NDArray[np.bool_]  # (F,) whether the file winds the face the other way


def orient(triangles: Floats, faces: Ints | None = None) -> Surface:
    """Find the inner side of each triangle (F, 3, 3), for any winding.

    faces (F, 3) : as of `faces_of`, if they are known.

    Faces that share edges get one winding, and lines through them vote on the side: if a line
    crosses a body an odd number of times ahead, it starts inside the body. Each closed body votes
    alone, so bodies may overlap. A body completely inside another is a void in it; a body inside a
    void is solid again. All open bodies vote together; `_guess` decides faces without votes.
    """
    if not np.isfinite(triangles).all():
        n_bad = int((~np.isfinite(triangles)).any(axis=(1, 2)).sum())
        raise UsageError(f"{n_bad} triangles have a corner that is not finite: repair the mesh")
    if len(triangles) == 0:
        raise UsageError("no triangles: a tool needs a surface")
    origin = _middle_of(triangles)
    local = triangles - origin
    faces = faces_of(triangles) if faces is None else faces
    kept, walls = _drop_repeated(faces)
    sides, is_even = _sides_of(faces[kept], local[kept])
    outer = walls[~_are_within(sides, faces[kept], faces[walls], local[walls])]
    if len(outer):
        kept = np.sort(np.append(kept, outer))
        sides, is_even = _sides_of(faces[kept], local[kept])
    areas = sides.areas
    inward = sides.normals * _vote(sides)[:, None]
    center, has_volume = _center(sides, inward)
    is_closed = has_volume and is_even
    if not is_closed:
        center = np.einsum("f,fk->k", areas, sides.centroids) / areas.sum()
    sampled = areas > 0.0
    return Surface(
        triangles[kept][sampled], areas[sampled], inward[sampled], center + origin, is_closed,
        sides.body[sampled], kept[sampled],
    )  # fmt: skip


def _sides_of(faces: Ints, triangles: Floats) -> tuple[_Sides, bool]:
    """Sides of the triangles (F, 3, 3), and whether all bodies are closed."""
    normals, areas = kernels.normals_of(triangles)
    if not 0.0 < float(areas.sum()) < np.inf:
        raise UsageError("its triangles have no area, or more than can be counted")
    edges = _edges_of(faces)
    patch, is_flipped = _wind(faces, edges)
    normals[is_flipped] *= -1.0
    body = _bodies(faces, edges, triangles)
    sides = _Sides(triangles, triangles.mean(axis=1), normals, areas, patch, body, is_flipped)
    return sides, bool(body.all())


def _are_within(sides: _Sides, faces: Ints, walls: Ints, triangles: Floats) -> NDArray[np.bool_]:
    """Whether each dropped wall (W, 3) lies inside a closed body of the kept faces that it joins.

    If not, one body is inside another, and without the wall the outer body would be open there.
    """
    is_within = np.zeros(len(walls), dtype=bool)
    if not len(walls):
        return is_within
    joined = np.unique(sides.body[np.isin(faces, walls).any(axis=1)])
    if joined.any():
        tree = kernels.triangle_bvh(sides.triangles, sides.body)
        for body in joined[joined > 0].tolist():
            is_within |= kernels.encloses(tree, body, triangles.mean(axis=1))
    return is_within


def _dense(numbers: Ints) -> Ints:
    """Numbers 0, 1, ... in the order of others, which are small."""
    is_there = np.zeros(int(numbers.max(initial=0)) + 1, dtype=bool)
    is_there[numbers] = True
    return np.asarray((np.cumsum(is_there) - 1)[numbers], np.int64)


def _edges_of(faces: Ints) -> _Edges:
    tail, head = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    keys = np.minimum(tail, head) * (faces.max(initial=0) + 1) + np.maximum(tail, head)
    _, number, uses = np.unique(keys, return_inverse=True, return_counts=True)
    return _Edges(number.astype(np.int64), tail < head, uses.astype(np.int64))


def _middle_of(triangles: Floats) -> Floats:
    corners = triangles.reshape(-1, 3)
    return np.asarray(corners.min(axis=0) / 2.0 + corners.max(axis=0) / 2.0)


def faces_of(triangles: Floats, index: Ints | None = None) -> Ints:
    """Number the corners (F, 3) of triangles (F, 3, 3): corners that coincide have one number.

    index (F, 3) : numbers of corners that are equal for equal bits, not all of these: a sixth of
    the corners is left to sort.

    Corners with equal bits are one. If edges stay open, their corners are also joined within
    `JOIN`, because two faces may store one edge with different rounding errors.
    """
    if index is None:
        index = np.arange(3 * len(triangles)).reshape(-1, 3)
    index = _dense(index)
    corners = np.empty((int(index.max()) + 1, 3))
    corners[index] = triangles - _middle_of(triangles) + 0.0  # -0.0 is 0.0
    order = np.lexsort(corners.T)
    is_new = np.ones(len(corners), dtype=bool)
    is_new[1:] = (corners[order[1:]] != corners[order[:-1]]).any(axis=1)
    number = np.empty(len(corners), dtype=np.int64)
    number[order] = np.cumsum(is_new) - 1
    faces = number[index]
    edges = _edges_of(faces)
    is_open = (edges.uses == 1)[edges.number]
    if not is_open.any():
        return faces
    from scipy.spatial import cKDTree  # noqa: PLC0415 - half a second, for torn files alone

    loose = np.unique(
        np.concatenate((faces.ravel()[is_open], np.roll(faces, -1, axis=1).ravel()[is_open]))
    )
    distinct = corners[order[is_new]]
    tolerance = JOIN * float(np.linalg.norm(np.ptp(distinct, axis=0)))
    pairs = loose[cKDTree(distinct[loose]).query_pairs(tolerance, output_type="ndarray")]
    return components(pairs, len(distinct))[faces]


def components(pairs: Ints, n: int) -> Ints:
    """Component (n,) of each node of a graph of edges (E, 2), numbered by lowest node.

    In each pass, whole components are joined to lower ones, until no edge leads to another. As fast
    as scipy's function, whose import takes a third of a second.
    """
    lowest = np.arange(n)
    tail, head = pairs.T
    while len(tail):
        tail, head = lowest[tail], lowest[head]
        is_open = tail != head
        tail, head = tail[is_open], head[is_open]
        lowest[np.maximum(tail, head)] = np.minimum(tail, head)
        while (lowest != (lower := lowest[lowest])).any():
            lowest = lower
    return np.asarray((np.cumsum(lowest == np.arange(n)) - 1)[lowest], np.int64)


def _neighbours(number: Ints, sides: Ints) -> Ints:
    """Pairs (P, 2) of the given sides on the same edge, each side with the next one."""
    order = sides[np.argsort(number[sides], kind="stable")]
    is_pair = number[order[1:]] == number[order[:-1]]
    return np.stack((order[:-1][is_pair], order[1:][is_pair]), axis=1)


def _drop_repeated(faces: Ints) -> tuple[Ints, Ints]:
    """Numbers of the faces to keep, one of those with the same corners, and of walls not kept.

    Two bodies that are glued together may have the wall between them twice. Kept once, its border
    edges would have an odd number of faces, so be open: a patch of repeated faces is dropped
    completely if more of its border edges would be open than closed.
    """
    is_face = (faces != np.roll(faces, -1, axis=1)).all(axis=1)
    whole = np.flatnonzero(is_face)
    low, middle, high = np.sort(faces[whole], axis=1).T
    n = faces.max(initial=0) + 1
    sides = np.unique(low * n + middle, return_inverse=True)[1]
    _, first, counts = np.unique(sides * n + high, return_index=True, return_counts=True)
    kept = whole[np.sort(first)]
    is_even = (counts % 2 == 0)[np.argsort(first)]
    if not is_even.any():
        return kept, kept[:0]
    edges = _edges_of(faces[kept])
    sides = np.flatnonzero(np.repeat(is_even, 3))
    pairs = _neighbours(edges.number, sides)
    patch = components(pairs // 3, len(kept))
    within = np.bincount(edges.number[sides], minlength=len(edges.uses))
    is_border = (within == 1) & (edges.uses > 1)
    border = sides[is_border[edges.number[sides]]]
    is_odd = edges.uses[edges.number[border]] % 2 == 1
    lean = np.bincount(patch[border // 3], np.where(is_odd, 1.0, -1.0), len(kept))
    is_wall: NDArray[np.bool_] = is_even & (lean[patch] > 0.0)
    return kept[~is_wall], kept[is_wall]


def _wind(faces: Ints, edges: _Edges) -> tuple[Ints, NDArray[np.bool_]]:
    """Patch (F,) of each face, across edges with two faces, and whether to flip the face (F,).

    A patch with only one side (a Moebius strip) is split into single faces.
    """
    n = len(faces)
    pairs = _neighbours(edges.number, np.flatnonzero((edges.uses == 2)[edges.number]))
    f, g = pairs[:, 0] // 3, pairs[:, 1] // 3
    # The double cover: node f is the face with its own winding, node n + f the flipped face.
    agrees = edges.is_forward[pairs[:, 0]] != edges.is_forward[pairs[:, 1]]
    links = np.concatenate(
        (
            np.stack((f, np.where(agrees, g, g + n)), axis=1),
            np.stack((f + n, np.where(agrees, g + n, g)), axis=1),
        )
    )
    sheet = components(links, 2 * n)
    is_one_sided = sheet[:n] == sheet[n:]
    patch = np.minimum(sheet[:n], sheet[n:])
    is_flipped = (sheet[:n] > sheet[n:]) & ~is_one_sided
    patch[is_one_sided] = 2 * n + np.flatnonzero(is_one_sided)
    return _dense(patch), is_flipped


def _bodies(faces: Ints, edges: _Edges, triangles: Floats) -> Ints:
    """Body (F,) of each face: 1, 2, ... for closed bodies of faces that share edges, 0 for open.

    Open edges are cut at the corners on them: a T-junction is closed.
    """
    number, owner, uses = edges.number, np.arange(faces.size) // 3, edges.uses
    is_open = (uses % 2 == 1)[number]
    if is_open.any():
        pieces, of = _cut(faces, np.flatnonzero(is_open), triangles)
        number = np.append(number[~is_open], pieces + len(uses))
        owner = np.append(owner[~is_open], of)
        uses = np.bincount(number)
    body = components(owner[_neighbours(number, np.arange(len(number)))], len(faces))
    is_torn = np.zeros(len(faces), dtype=bool)
    is_torn[body[owner[(uses % 2 == 1)[number]]]] = True
    body += 1
    body[is_torn[body - 1]] = 0
    return _dense(np.append(body, 0))[:-1]


def _cut(faces: Ints, sides: Ints, triangles: Floats) -> tuple[Ints, Ints]:
    """Pieces (P,) of open sides, a number for each two corners, and the face (P,) of each."""
    from scipy.spatial import cKDTree  # noqa: PLC0415 - half a second, for torn files alone

    begins, ends = (
        one.reshape(-1, 3)[sides] for one in (triangles, np.roll(triangles, -1, axis=1))
    )
    tails, heads = (one.ravel()[sides] for one in (faces, np.roll(faces, -1, axis=1)))
    # tails and heads: a corner may be no side's tail under another winding
    loose, first = np.unique(np.append(tails, heads), return_index=True)
    places = np.append(begins, ends, axis=0)[first]
    along = ends - begins
    squares = np.maximum((along**2).sum(axis=1), np.finfo(np.float64).tiny)
    tree, middles, radii = cKDTree(places), 0.5 * (begins + ends), 0.5 * np.sqrt(squares)
    tried = 0
    for at in range(0, len(sides), SIDES):  # many long edges: a count of all takes minutes
        some = slice(at, at + SIDES)
        counts = tree.query_ball_point(middles[some], radii[some], return_length=True)
        tried += int(np.sum(counts))
        if tried > MOST_NEAR:
            return np.arange(len(sides)), sides // 3
    near = tree.query_ball_point(middles, radii)
    side = np.repeat(np.arange(len(sides)), [len(some) for some in near])
    corner = np.concatenate(near).astype(np.int64)
    arms = places[corner] - begins[side]
    shares = (arms * along[side]).sum(axis=1) / squares[side]
    off = np.linalg.norm(arms - shares[:, None] * along[side], axis=1)
    is_on = off <= CRACK * float(np.linalg.norm(np.ptp(triangles.reshape(-1, 3), axis=0)))
    is_on &= (loose[corner] != tails[side]) & (loose[corner] != heads[side])
    # corners of each side from its tail to its head
    everywhere = np.arange(len(sides))
    side = np.concatenate([everywhere, everywhere, side[is_on]])
    place = np.concatenate([np.full(len(sides), -1.0), np.full(len(sides), 2.0), shares[is_on]])
    corner = np.concatenate([tails, heads, loose[corner[is_on]]])
    order = np.lexsort((place, side))
    side, corner = side[order], corner[order]
    two = np.sort(np.stack([corner[:-1], corner[1:]], axis=1), axis=1)[side[:-1] == side[1:]]
    of = side[:-1][side[:-1] == side[1:]]
    keys = two[:, 0] * (faces.max() + 1) + two[:, 1]
    return np.unique(keys, return_inverse=True)[1], sides[of] // 3


def _vote(sides: _Sides) -> Floats:
    """Signs (F,): 1 if the face's normal points inside, -1 if it points outside."""
    tree = kernels.triangle_bvh(sides.triangles, sides.body)
    votes = kernels.side_votes(
        tree, sides.patch, sides.body, sides.areas, sides.centroids, sides.normals
    )
    signs = np.sign(votes).astype(np.float64)[sides.patch]
    _guess(sides, signs)
    signs[_voids(sides, tree)[sides.body]] *= -1.0
    return signs


def _guess(sides: _Sides, signs: Floats) -> None:
    """Guess the signs (F,) that are still zero because no line has decided them.

    The inner side of a curved patch is the side of its middle. All flat patches face one way:
    outwards by the file's winding, or, if that contradicts itself, towards the positive end of the
    axis that they face most.
    """
    silent = np.flatnonzero(signs == 0.0)
    if len(silent) == 0:
        return
    patch = np.unique(sides.patch[silent], return_inverse=True)[1]
    areas, normals, centroids = sides.areas[silent], sides.normals[silent], sides.centroids[silent]
    total = np.maximum(np.bincount(patch, areas), np.finfo(np.float64).tiny)
    middle = np.stack([np.bincount(patch, areas * x) for x in centroids.T], axis=1) / total[:, None]
    arm = middle[patch] - centroids
    bulge = np.bincount(patch, areas * (normals * arm).sum(axis=1))
    size = np.bincount(patch, areas * np.linalg.norm(arm, axis=1))
    guess = np.where(np.abs(bulge) > 1e-6 * size, np.sign(bulge), 0.0)[patch]
    flat = guess == 0.0
    wound = np.where(sides.is_flipped[silent], -areas, areas)
    outer = wound[flat] @ normals[flat]
    if np.linalg.norm(outer) < 0.5 * areas[flat].sum():
        outer = np.linalg.eigh((normals[flat].T * areas[flat]) @ normals[flat])[1][:, -1]
        outer = outer * np.sign(outer[np.argmax(np.abs(outer))])
    facing = normals @ outer
    is_outward = (facing > 0.0) | ((facing == 0.0) & (wound >= 0.0))
    signs[silent] = np.where(flat, np.where(is_outward, -1.0, 1.0), guess)


def _voids(sides: _Sides, tree: "kernels.TriangleBVH") -> NDArray[np.bool_]:
    """Whether each body (B,) is a void's wall: completely inside an odd number of closed bodies."""
    low, high = kernels.body_boxes(sides.triangles, sides.body).swapaxes(0, 1)
    low[0], high[0], n_bodies = np.inf, -np.inf, len(low)  # open bodies enclose nothing
    pairs = [
        (inner, outer)
        for inner in range(1, n_bodies)
        for outer in np.flatnonzero(((low <= low[inner]) & (high >= high[inner])).all(axis=1))
        if outer != inner
    ]
    is_void = np.zeros(n_bodies, dtype=bool)
    if pairs:
        nests = np.array(pairs, dtype=np.int64)
        encloses = kernels.enclosures(tree, nests, sides.body, sides.areas, sides.centroids)
        is_void = np.bincount(nests[:, 0], encloses, n_bodies) % 2 == 1
    return is_void


def _center(sides: _Sides, inward: Floats) -> tuple[Floats, bool]:
    """Centre of mass of the solid, and whether its volume is more than rounding errors."""
    a, b, c = sides.triangles[:, 0], sides.triangles[:, 1], sides.triangles[:, 2]
    # A face with outward normal n and the origin span the volume (centroid . n) area / 3.
    volumes = -(inward * sides.centroids).sum(axis=1) * sides.areas / 3.0
    volume = float(volumes.sum())
    if not volume > 1e-9 * float(np.abs(volumes).sum()):
        return np.zeros(3), False
    return np.einsum("f,fk->k", volumes, a + b + c) / (4.0 * volume), True  # no BLAS: no threads

"""Largest balls inside a tool, tangent to its surface at given positions (medial balls).

A position on the surface can be drawn inward by r, along its inward normal, if its tangent ball of
radius r contains no surface: the drawn point then has the distance r from all of the surface. Balls
start with the requested radius and shrink until they are empty (Ma, Bae and Choi, "3D medial axis
point approximation using nearest neighbors and the normal field", The Visual Computer 28, 2012;
here with the exact distances to triangles in place of those to sample points).
"""

from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.surfaces import triangle_bvh
from hapticdb.pointshell.coverage import halves

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

    from hapticdb.pointshell.orientation import Surface

SLACK = 0.01
"""Share of its radius by which surface may reach into an empty ball: at 0.01, points are drawn in
over convex edges of more than 172 degrees."""
NEARLY = 0.05
"""Share of its radius by which surface may be off a ball and still count as touching it."""
ALIGNED = 0.96
"""Cosine between a plane's normal and the direction to its nearest point above which the ball
touches the plane and not its border: 16 degrees. Larger: fewer opposite walls of round tools."""
MOST_PIECES = 20_000
"""Pieces of long triangles, about. Larger: slower bisection, faster searches."""
MOST_PAIRS = 2_000_000
"""Ball-triangle pairs of a batch, about: up to 0.5 kB each."""
SMALL = 0.1
"""Size of a piece, in radii of a ball, up to which a query of the nearest middles of pieces
replaces the search in the ball; it errs by the size of a piece at most."""
NEIGHBOURS = 4
"""Nearest middles of a query, with exact distances to their pieces."""
FEW = 100
"""Pieces of a fine mesh around a ball for its facing, about. Larger: slower."""
ROUNDS = 60
"""Most steps of shrinking. A step shrinks a ball by `SLACK` at least; most balls take 2 to 4."""
SCALES = 4
"""Sizes of smaller balls, each `2 SLACK` of the one before, for walls too thin for larger ones: the
last is 1.6e-7 of the requested radius, and finds walls of a hundredth of that."""
LINES = 12
"""Lines of the vote on matter behind an open surface."""
MATTER = 0.5
"""Share of lines that must cross an open surface on both sides of a position for matter there,
equal to 2 w - 1 for a winding number w. Larger: fewer open surfaces count as solids with a hole."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class _Octave(NamedTuple):
    """Pieces of the surface of about one size, within a factor of two."""

    tree: "cKDTree"  # middles and numbers of solids, 4 axes
    triangles: Floats  # (P, 3, 3)
    reach: float  # metres; no piece reaches farther from its middle


class InscribedBalls:
    """Inscribed balls of a surface's solids, of radii up to `greatest` metres; see the module.

    A solid is a closed body with its voids; all open surfaces together count as one. A solid's
    balls stop at its own surface alone: anything outside a solid is behind its surface.
    """

    def __init__(self, surface: "Surface", greatest: float) -> None:
        self._center = surface.center
        self._normals = surface.normals
        self._solids = _solids_of(surface)
        self._bodies = surface.bodies
        self._triangles = surface.triangles - surface.center
        self._greatest = greatest
        # Solids are farther apart on the fourth axis than any ball reaches.
        self._apart = 8.0 * (greatest + float(np.abs(self._triangles).max()))
        self._octaves = self._cut(float(surface.areas.sum()))

    def _cut(self, area: float) -> list[_Octave]:
        """Octaves of pieces no longer than a ball, if these are not too many."""
        from scipy.spatial import cKDTree  # noqa: PLC0415 - a third of a second, for insets alone

        longest = max(self._greatest, 3.0 * float(np.sqrt(area / MOST_PIECES)))
        pieces, solids = self._cut_to(longest)
        # Corner by corner: numpy is slow over axes of three.
        a, b, c = pieces[:, 0], pieces[:, 1], pieces[:, 2]
        low = np.minimum(np.minimum(a, b), c)
        high = np.maximum(np.maximum(a, b), c)
        middles = 0.5 * (low + high)
        reach = _longest_of(pieces - middles[:, None])
        octave = np.floor(np.log2(np.maximum(reach, 1e-3 * self._greatest))).astype(np.int64)
        places = np.column_stack([middles, self._apart * solids])
        self._pieces, self._tree = pieces, cKDTree(places)
        return [
            _Octave(cKDTree(places[some]), pieces[some], float(reach[some].max()))
            for number in np.unique(octave)
            for some in [np.flatnonzero(octave == number)]
        ]

    def _cut_to(self, longest: float) -> tuple[Floats, Ints]:
        """Pieces (P, 3, 3) of the triangles, sides up to `longest` metres; their solids (P,)."""
        pieces, solids = self._triangles, self._solids
        done: list[tuple[Floats, Ints]] = []
        n_done = 0
        while True:
            is_long = _longest_of(pieces - pieces[:, [1, 2, 0]]) > longest
            n_pieces = n_done + len(pieces)
            if not is_long.any() or n_pieces > 2 * MOST_PIECES + len(self._triangles):
                break
            done.append((pieces[~is_long], solids[~is_long]))
            n_done += len(done[-1][1])
            pieces, solids = halves(pieces[is_long]), np.tile(solids[is_long], 2)
        done.append((pieces, solids))
        whole, numbers = zip(*done, strict=True)
        return np.concatenate(whole), np.concatenate(numbers)

    def touching(
        self, positions: Floats, face_of: NDArray[np.int32], radius: float
    ) -> tuple[Floats, Floats]:
        """Radii and facings (Q,) of the largest balls, tangent to the surface at positions (Q, 3).

        face_of (Q,) : face of each position; radius : the greatest, metres. It is 0 on an open
        surface without matter behind it. A facing is the cosine between the position's inward
        normal and that of the most opposed touching surface: -1 between parallel walls, -cos(a) in
        a wedge of angle a, 1 without another contact.
        """
        local = positions - self._center
        radii, facing = self._shrunk(local, face_of, radius)
        self._see_thin_walls(local, face_of, radii, facing, radius)
        is_open = np.flatnonzero(self._bodies[face_of] == 0)
        if len(is_open):
            middles = local[is_open] + 0.5 * radii[is_open, None] * self._normals[face_of[is_open]]
            radii[is_open[~self._has_matter(middles)]] = 0.0
        return radii, facing

    def _see_thin_walls(
        self, local: Floats, face_of: NDArray[np.int32], radii: Floats, facing: Floats, most: float
    ) -> None:
        """Shrink balls through walls thinner than their slack, visible to smaller ones only.

        A ball with a contact beside its own plane, and its middle outside its solid, is retried
        smaller and smaller. If none meets a wall, the body crosses itself: the ball stays.
        """
        some = np.arange(len(local))
        for _ in range(SCALES):
            most *= 2.0 * SLACK
            near, near_facing = self._shrunk(local[some], face_of[some], most)
            is_thin = (near < (1.0 - SLACK) * most) & (near < radii[some])
            radii[some[is_thin]], facing[some[is_thin]] = near[is_thin], near_facing[is_thin]
            some = some[near_facing < 1.0]
            if len(some):
                images = local[some] + radii[some, None] * self._normals[face_of[some]]
                some = some[~self._are_inside(images, face_of[some])]
            if not len(some):
                break

    @cached_property
    def _sides(self) -> triangle_bvh.TriangleBVH:
        return triangle_bvh.triangle_bvh(self._triangles, self._bodies)

    def _are_inside(self, images: Floats, face_of: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Whether images (Q, 3) of positions are in their solids; yes for those of open bodies."""
        solids, is_inside = self._solids[face_of], self._bodies[face_of] == 0
        bodies, firsts = np.unique(self._bodies, return_index=True)
        for body, solid in zip(bodies.tolist(), self._solids[firsts].tolist(), strict=True):
            held = np.flatnonzero(solids == solid)
            if body > 0 and len(held):  # what a void encloses is out again
                is_inside[held] ^= triangle_bvh.encloses(self._sides, body, images[held])
        return np.asarray(is_inside)

    def _shrunk(
        self, local: Floats, face_of: NDArray[np.int32], radius: float
    ) -> tuple[Floats, Floats]:
        """Radii and facings (Q,) of the largest balls, within the slack of a ball of `radius`."""
        radii = self._preshrunk(local, face_of, radius)
        facing = np.ones(len(local))
        order, at, step = np.argsort(radii, kind="stable"), 0, len(local)
        while at < len(local):
            # Balls of about one size: their search has one radius.
            least = max(float(radii[order[at]]), 1e-3 * radius)
            end = np.searchsorted(radii[order], 2.0 * least, side="right")
            part = order[at : min(at + step, int(end))]
            is_whole = least >= (1.0 - SLACK) * radius
            balls, pieces = self._pairs(local[part], face_of[part], radii[part], is_whole=is_whole)
            if len(balls) > MOST_PAIRS and len(part) > 64:
                step = max(64, int(len(part) * 0.8 * MOST_PAIRS / len(balls)))
                continue
            normals = self._normals[face_of[part]]
            radii[part], facing[part] = _shrink(local[part], normals, radii[part], balls, pieces)
            at += len(part)
        return radii, facing

    def _preshrunk(self, local: Floats, face_of: NDArray[np.int32], radius: float) -> Floats:
        """Radii (Q,) of balls free of the pieces nearest to their centres.

        An upper bound, mostly near the result: it saves the search among all pieces in a ball.
        """
        radii = np.full(len(local), radius)
        active = np.arange(len(local))
        for _ in range(ROUNDS):
            if not len(active):
                break
            normals = self._normals[face_of[active]]
            centers = local[active] + radii[active, None] * normals
            places = np.column_stack([centers, self._apart * self._solids[face_of[active]]])
            n_near = min(NEIGHBOURS, len(self._pieces))
            _, nearest = self._tree.query(places, k=np.arange(n_near) + 1, workers=-1)
            smaller = radii[active]
            for pieces in np.asarray(nearest).T:
                touched = _nearest_on(self._pieces[pieces], centers)
                some = _smaller(local[active], normals, radii[active], touched, centers)
                smaller = np.minimum(smaller, some)
            is_held = smaller < radii[active]
            radii[active] = smaller
            active = active[is_held]
        return radii

    def _pairs(
        self, local: Floats, face_of: NDArray[np.int32], radii: Floats, *, is_whole: bool
    ) -> tuple[Ints, Floats]:
        """Pairs of a ball and a piece that may meet it: ball (P,), (P, 3, 3).

        radii (Q,), ascending, are results of `_preshrunk`, exact for pieces much smaller than a
        ball. So unshrunk balls need none of these, and the others a few, for their facings. A ball
        lies on the inner side of the tangent plane at its position.
        """
        from scipy.spatial import cKDTree  # noqa: PLC0415 - as above

        normals = self._normals[face_of]
        centers = local + radii[:, None] * normals
        balls = cKDTree(np.column_stack([centers, self._apart * self._solids[face_of]]))
        levels = np.einsum("qk,qk->q", normals, local)
        numbers, pieces = [np.empty(0, dtype=np.int64)], [np.empty((0, 3, 3))]
        for octave in self._octaves:
            is_small = octave.reach <= SMALL * radii[0]
            if is_small and is_whole:
                continue
            tree, triangles = octave.tree, octave.triangles
            reach = (1.0 + NEARLY) * float(radii[-1]) + octave.reach
            if is_small:
                stride = 1 + int(balls.count_neighbors(tree, reach)) // (FEW * len(local))
                tree, triangles = cKDTree(tree.data[::stride]), triangles[::stride]
            near = balls.sparse_distance_matrix(tree, reach, output_type="ndarray")
            near = near[near["v"] <= (1.0 + NEARLY) * radii[near["i"]] + octave.reach]
            ball, piece = near["i"].astype(np.int64), triangles[near["j"]]
            heights = np.einsum("pck,pk->pc", piece, normals[ball]).max(axis=1) - levels[ball]
            is_inner = heights > SLACK * radii[ball]
            numbers.append(ball[is_inner])
            pieces.append(piece[is_inner])
        return np.concatenate(numbers), np.concatenate(pieces)

    def _has_matter(self, local: Floats) -> NDArray[np.bool_]:
        """Whether open surfaces nearly enclose positions (Q, 3): (Q,)."""
        is_open = self._bodies == 0
        tree = triangle_bvh.triangle_bvh(
            np.ascontiguousarray(self._triangles[is_open]), self._bodies[is_open]
        )
        directions = np.random.default_rng(60).normal(size=(LINES, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        # Every line is a body of its own, so the kernel counts its crossings separately.
        numbers = np.arange(len(local) * LINES)
        picks = np.full((len(numbers), LINES), -1, dtype=np.int64)
        picks[numbers, numbers % LINES] = numbers // LINES
        pairs = np.stack([numbers, np.zeros_like(numbers)], axis=1)
        is_crossed = np.zeros(len(numbers), dtype=np.uint8)
        positions = np.ascontiguousarray(local)
        triangle_bvh.nesting_kernel(tree, pairs, picks, directions, positions, is_crossed)
        return np.asarray(is_crossed.reshape(-1, LINES).mean(axis=1) >= MATTER)


def _solids_of(surface: "Surface") -> Ints:
    """Solid (F,) of each face: a closed body with its voids, or 0 for all open surfaces.

    A void belongs to the body with the smallest AABB around it.
    """
    local = surface.triangles - surface.center
    n_bodies = int(surface.bodies.max()) + 1
    volumes = np.bincount(
        surface.bodies,
        -(surface.normals * local.mean(axis=1)).sum(axis=1) * surface.areas,
        n_bodies,
    )
    low, high = triangle_bvh.body_boxes(local, surface.bodies).swapaxes(0, 1)
    solids = np.arange(n_bodies)
    walls = np.flatnonzero(volumes > 0.0)
    walls = walls[walls > 0]
    walls = walls[np.argsort((high[walls] - low[walls]).prod(axis=1), kind="stable")]
    for void in np.flatnonzero(volumes < 0.0):
        around = ((low[walls] <= low[void]) & (high[walls] >= high[void])).all(axis=1)
        if void > 0 and around.any():
            solids[void] = walls[np.argmax(around)]
    return np.asarray(solids[surface.bodies])


def _smaller(
    positions: Floats, normals: Floats, radii: Floats, touched: Floats, centers: Floats
) -> Floats:
    """Radii (Q,) of balls free of the touched points (Q, 3) of the surface.

    The ball through x and y with its centre on the normal n at x has the radius
    |y - x|^2 / (2 n . (y - x)).
    """
    is_inside = ((centers - touched) ** 2).sum(axis=1) < ((1.0 - SLACK) * radii) ** 2
    chord = touched - positions
    height = np.where(is_inside, np.einsum("qk,qk->q", chord, normals), 1.0)
    through = np.einsum("qk,qk->q", chord, chord) / (2.0 * np.maximum(height, 1e-300))
    return np.where(is_inside, np.minimum(through, (1.0 - SLACK) * radii), radii)


def _shrink(
    positions: Floats, normals: Floats, radii: Floats, ball: Ints, pieces: Floats
) -> tuple[Floats, Floats]:
    """Radii and facings (Q,) of the largest empty balls; ball (P,), pieces (P, 3, 3) pair them.

    A smaller ball at a position lies within a larger one, so it meets no other piece.
    """
    radii, facing = radii.copy(), np.ones(len(positions))
    for _ in range(ROUNDS):
        centers = positions[ball] + radii[ball, None] * normals[ball]
        touched = _nearest_on(pieces, centers)
        distance = np.linalg.norm(centers - touched, axis=1)
        is_near = distance <= (1.0 + NEARLY) * radii[ball]
        ball, pieces, touched = ball[is_near], pieces[is_near], touched[is_near]
        centers, distance = centers[is_near], distance[is_near]
        smaller = _smaller(positions[ball], normals[ball], radii[ball], touched, centers)
        if not (smaller < radii[ball]).any():
            break
        np.minimum.at(radii, ball, smaller)
    np.minimum.at(facing, ball, _facings(normals[ball], radii[ball], pieces, touched, centers))
    return radii, facing


def _facings(
    normals: Floats, radii: Floats, pieces: Floats, touched: Floats, centers: Floats
) -> Floats:
    """Cosines (P,) between the normals (P, 3) and those of the pieces that touch the balls.

    A plane's own normal counts within 16 degrees (`ALIGNED`) of the direction to its nearest point.
    Otherwise, at an edge, this direction counts, and only in contact.
    """
    away = centers - touched
    distance = np.linalg.norm(away, axis=1)
    inward = away / np.maximum(distance, 1e-300)[:, None]
    planes, _ = triangle_bvh.normals_of(pieces)
    along = np.einsum("pk,pk->p", planes, inward)
    planes *= np.sign(along)[:, None]
    is_aligned = np.abs(along) > ALIGNED
    cosines = np.einsum("pk,pk->p", np.where(is_aligned[:, None], planes, inward), normals)
    return np.where(is_aligned | (distance < (1.0 + 0.1 * SLACK) * radii), cosines, 1.0)


def _longest_of(vectors: Floats) -> Floats:
    """Greatest length (P,) of three vectors each, (P, 3, 3)."""
    squares = np.einsum("pck,pck->pc", vectors, vectors)
    a, b, c = squares[:, 0], squares[:, 1], squares[:, 2]
    return np.asarray(np.sqrt(np.maximum(np.maximum(a, b), c)))


def _nearest_on(triangles: Floats, positions: Floats) -> Floats:
    """Nearest point (P, 3) of each triangle (P, 3, 3) to its position (P, 3), degenerate or not."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    best, nearest = np.full(len(positions), np.inf), np.empty_like(positions)
    for tail, head in ((a, b), (b, c), (c, a)):
        along, from_tail = head - tail, positions - tail
        squared = np.einsum("pk,pk->p", along, along)
        share = np.einsum("pk,pk->p", from_tail, along) / np.where(squared > 0.0, squared, 1.0)
        foot = tail + np.clip(share, 0.0, 1.0)[:, None] * along
        distance = ((positions - foot) ** 2).sum(axis=1)
        is_better = distance < best
        best[is_better], nearest[is_better] = distance[is_better], foot[is_better]
    u, v, w = b - a, c - a, positions - a
    uu, uv, vv = (np.einsum("pk,pk->p", p, q) for p, q in ((u, u), (u, v), (v, v)))
    wu, wv = np.einsum("pk,pk->p", w, u), np.einsum("pk,pk->p", w, v)
    area = uu * vv - uv * uv
    divisor = np.where(area > 0.0, area, 1.0)
    s, t = (vv * wu - uv * wv) / divisor, (uu * wv - uv * wu) / divisor
    is_over = (area > 1e-24 * uu * vv) & (s >= 0.0) & (t >= 0.0) & (s + t <= 1.0)
    nearest[is_over] = (a + s[:, None] * u + t[:, None] * v)[is_over]
    return nearest

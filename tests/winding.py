"""What two surfaces do to one another at poses of a path, by formulas of our own: an oracle."""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

AT_ONCE = 1 << 19
"""Pairs of a place and a triangle that are computed together."""
FLAT = 1e-9
"""Greatest sine of the angle between triangles of one plane."""


def winding_numbers(places: Floats, triangles: Floats) -> Floats:
    """Winding number (Q,) of triangles (F, 3, 3) about places (Q, 3)."""
    found = np.zeros(len(places))
    step = max(AT_ONCE // max(len(triangles), 1), 1)
    for at in range(0, len(places), step):
        a, b, c = np.moveaxis(triangles[None] - places[at : at + step, None, None], 2, 0)
        la, lb, lc = (np.sqrt((v * v).sum(-1)) for v in (a, b, c))
        top = (a * np.cross(b, c)).sum(-1)
        bottom = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
        found[at : at + step] = np.arctan2(top, bottom).sum(axis=1) / (2.0 * np.pi)
    return found


def distances(places: Floats, triangles: Floats) -> Floats:
    """Distance (Q,) of places (Q, 3) from the nearest of triangles (F, 3, 3)."""
    found = np.full(len(places), np.inf)
    step = max(AT_ONCE // max(len(triangles), 1), 1)
    for at in range(0, len(places), step):
        p = places[at : at + step, None]
        near = _to_planes(p, triangles)
        for i in range(3):
            near = np.minimum(near, _to_segments(p, triangles[:, i], triangles[:, (i + 1) % 3]))
        found[at : at + step] = near.min(axis=1, initial=np.inf)
    return found


def _to_segments(p: Floats, a: Floats, b: Floats) -> Floats:
    way = b - a
    share = ((p - a) * way).sum(-1) / np.maximum((way * way).sum(-1), 1e-300)
    return np.asarray(np.linalg.norm(p - a - share.clip(0.0, 1.0)[..., None] * way, axis=-1))


def _to_planes(p: Floats, triangles: Floats) -> Floats:
    """Distances (Q, F) from the planes of triangles, infinite where a place is not above one."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    normal = np.cross(b - a, c - a)
    square = np.maximum((normal * normal).sum(-1), 1e-300)
    to = p - a
    v = (np.cross(to, c - a) * normal).sum(-1) / square
    w = (np.cross(b - a, to) * normal).sum(-1) / square
    is_above = (v >= 0.0) & (w >= 0.0) & (v + w <= 1.0)
    return np.where(is_above, np.abs((to * normal).sum(-1)) / np.sqrt(square), np.inf)


class Surface:
    """Triangles (F, 3, 3), wound alike where they are closed.

    solid : the closed part of them, each body once, of which places are inside or not; all of it
    unless given. samples (Q, 3) : places on the surface, its corners among them.
    """

    def __init__(
        self, triangles: Floats, n_samples: int = 300, seed: int = 0, solid: Floats | None = None
    ) -> None:
        self.triangles = triangles
        self.solid = triangles if solid is None else solid
        rng = np.random.default_rng(seed)
        sides = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        areas = np.linalg.norm(sides, axis=1)
        which = rng.choice(len(triangles), n_samples, p=areas / areas.sum())
        shares = rng.dirichlet(np.ones(3), n_samples)
        inner = np.einsum("qi,qik->qk", shares, triangles[which])
        self.corners = np.unique(triangles.reshape(-1, 3), axis=0)
        self.samples = np.concatenate([self.corners, inner])

    def depth_of(self, places: Floats) -> float:
        """Greatest distance from the surface of those of places (Q, 3) that are inside."""
        low, high = self.triangles.min(axis=(0, 1)), self.triangles.max(axis=(0, 1))
        near = places[((places > low) & (places < high)).all(axis=1)]
        if not len(near) or not len(self.solid):
            return 0.0
        inside = near[np.abs(winding_numbers(near, self.solid)) > 0.5]
        return float(distances(inside, self.triangles).max(initial=0.0))

    @cached_property
    def edges(self) -> Floats:
        """Edges (E, 2, 3), each once."""
        return np.asarray(self.corners[np.unique(self._sides[0], axis=0)])

    @cached_property
    def creases(self) -> Floats:
        """Edges (E, 2, 3) that are not between exactly two triangles of one plane."""
        pairs, of = self._sides
        kinds, which, counts = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
        order = np.argsort(which.reshape(-1), kind="stable")
        first = np.concatenate([[0], np.cumsum(counts)[:-1]])
        normals = np.cross(*np.moveaxis(np.diff(self.triangles, axis=1), 1, 0))
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        one, other = (of[order[np.minimum(first + n, len(of) - 1)]] for n in (0, 1))
        bent = np.linalg.norm(np.cross(normals[one], normals[other]), axis=1) > FLAT
        return np.asarray(self.corners[kinds[(counts != 2) | bent]])

    @cached_property
    def _sides(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Corners (S, 2) of the sides of triangles, each once, and their triangles (S,)."""
        _, number = np.unique(self.triangles.reshape(-1, 3), axis=0, return_inverse=True)
        faces, once = np.unique(np.sort(number.reshape(-1, 3), axis=1), axis=0, return_index=True)
        pairs = np.concatenate([faces[:, [i, (i + 1) % 3]] for i in range(3)])
        return np.sort(pairs, axis=1), np.tile(once, 3)


def crossed(
    lines: Floats, surface: Surface, before: Floats | float, after: Floats | float, reach: float
) -> Bools:
    """Whether each of lines (L, 2, 3) goes through a surface, whatever is moved by `reach`.

    A line crosses a triangle from farther than `before` (L,) on one side of its plane to farther
    than `after` on the other. If no crease or border of the surface is near the crossing, then no
    motion of any place of line or surface by `reach` parts them: the line stays linked with the
    border of the plane piece around.
    """
    a, b = lines[:, 0], lines[:, 1]
    t = surface.triangles
    normal = np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])
    size = np.linalg.norm(normal, axis=1)
    t, normal = t[size > 0.0], normal[size > 0.0] / size[size > 0.0, None]
    offset = (normal * t[:, 0]).sum(-1)
    da, db = a @ normal.T - offset, b @ normal.T - offset
    least_a = np.broadcast_to(np.asarray(before), len(a))[:, None]
    least_b = np.broadcast_to(np.asarray(after), len(a))[:, None]
    is_across = (da * db < 0.0) & (np.abs(da) > least_a) & (np.abs(db) > least_b)
    line, triangle = np.nonzero(is_across)
    share = np.abs(da[line, triangle]) / (np.abs(da[line, triangle]) + np.abs(db[line, triangle]))
    way = b[line] - a[line]
    place = a[line] + share[:, None] * way
    is_in = _is_in(place, t[triangle])
    line, triangle, place, way = line[is_in], triangle[is_in], place[is_in], way[is_in]
    sine = np.abs((way * normal[triangle]).sum(-1)) / np.linalg.norm(way, axis=-1)
    room = reach * (1.0 + 1.0 / np.maximum(sine, 1e-9))
    e = surface.creases
    far = np.full(len(place), np.inf)
    for at in range(0, len(place), 1 << 10):
        some = place[at : at + (1 << 10), None]
        far[at : at + (1 << 10)] = _to_segments(some, e[:, 0], e[:, 1]).min(axis=1, initial=np.inf)
    out = np.zeros(len(lines), dtype=np.bool_)
    out[line[far > room]] = True
    return out


def _is_in(places: Floats, triangles: Floats) -> Bools:
    """Whether places (N, 3) in the planes of triangles (N, 3, 3) are in these."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    normal = np.cross(b - a, c - a)
    square = (normal * normal).sum(-1)
    v = (np.cross(places - a, c - a) * normal).sum(-1) / square
    w = (np.cross(b - a, places - a) * normal).sum(-1) / square
    return np.asarray((v >= 0.0) & (w >= 0.0) & (v + w <= 1.0))

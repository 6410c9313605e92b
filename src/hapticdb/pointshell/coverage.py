"""Covering radius of points on a surface, and which positions the surface encloses.

The covering radius of points on a surface is the least r such that each position on the surface has
a point within r. It bounds the size of a detail that may pass between the points without a hit.
"""

import contextlib
from copy import copy
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.surfaces import sides
from hapticdb.kernels.triangles.depth import Solid

if TYPE_CHECKING:
    from hapticdb.pointshell.orientation import Surface

CLOSE = 0.1
"""Tolerance of a computed covering radius: it exceeds the least one by at most this share, or comes
from triangles with sides of at most this share of the points' spacing. A smaller value cuts more
triangles."""
AT_ONCE = 1 << 16
"""Triangles that are cut and measured at a time. A larger value takes more memory."""

Floats = NDArray[np.float64]


def spacing_of(area: float, n_points: int) -> float:
    """Distance of neighbours, metres, for a hexagonal lattice of `n_points` on an area (m^2)."""
    return float(np.sqrt(2.0 * area / (np.sqrt(3.0) * n_points)))


def points_for(area: float, spacing: float) -> int:
    """Number of points of a hexagonal lattice on an area; the inverse of `spacing_of`."""
    return int(np.ceil(2.0 * area / (np.sqrt(3.0) * spacing**2)))


def covering_radius(triangles: Floats, points: Floats) -> float:
    """Bound the covering radius of points (N, 3) on triangles (F, 3, 3) from above, metres.

    The distance to a point is convex, so no position in a triangle is farther from a point than the
    triangle's farthest corner. Triangles are halved across their longest side until that bound is
    within `CLOSE` of a distance that occurs. The result is raised by more than its rounding errors.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415 - a third of a second, for sweeps alone

    tree = cKDTree(points)
    edges = triangles - np.roll(triangles, 1, axis=1)
    area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum()
    fine = CLOSE * spacing_of(float(area), len(points))
    found = bound = 0.0
    waiting = [triangles[at : at + AT_ONCE] for at in range(0, len(triangles), AT_ONCE)]
    while waiting:
        cut = waiting.pop()
        if len(cut) > AT_ONCE:
            waiting += [cut[AT_ONCE:], cut[:AT_ONCE]]
            continue
        distances, nearest = tree.query(cut.mean(axis=1), workers=-1)
        found = max(found, float(np.max(distances)))
        corners = np.linalg.norm(cut - points[nearest][:, None], axis=2).max(axis=1)
        longest = np.linalg.norm(cut - np.roll(cut, -1, axis=1), axis=2).max(axis=1)
        is_done = (corners <= (1.0 + CLOSE) * found) | (longest <= fine)
        bound = max(bound, float(corners[is_done].max(initial=0.0)))
        if not is_done.all():
            waiting.append(halves(cut[~is_done]))
    return (1.0 + 1e-6) * bound


def halves(triangles: Floats) -> Floats:
    """Cut triangles (F, 3, 3) across their longest sides, (2 F, 3, 3)."""
    lengths = np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=2)
    turned = (np.argmax(lengths, axis=1)[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(triangles, turned[:, :, None], axis=1).swapaxes(0, 1)
    middle = 0.5 * (a + b)
    return np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])


class Ball(NamedTuple):
    """A sphere about the origin; radius in metres."""

    radius: float

    def covering_radius(self, points: Floats) -> float:
        """Bound the covering radius of points (N, 3) on the sphere from above, metres.

        The farthest positions are the middles of the caps that the faces of the points' convex hull
        cut off. If the points have no hull, or all lie on one side, it is the sphere's diameter.
        """
        from scipy.spatial import ConvexHull, QhullError  # noqa: PLC0415 - as above

        heights = np.zeros(0)
        if len(points) > 3:
            with contextlib.suppress(QhullError):
                heights = -ConvexHull(points / self.radius).equations[:, 3]
        if not len(heights) or heights.min() <= 0.0:
            return 2.0 * self.radius
        return (1.0 + 1e-6) * self.radius * float(np.sqrt(2.0 - 2.0 * heights.min()))


class Interior:
    """The inside of the closed bodies of a result of `orient`, or of a ball.

    Open bodies enclose nothing, and a void is outside. tree : of all triangles, about `origin`
    (3,); boxes : of the closed bodies, likewise.
    """

    def __init__(self, surface: "Surface | Ball") -> None:
        self._ball = surface if isinstance(surface, Ball) else None
        self._bodies: list[tuple[int, int]] = []
        self.boxes: dict[int, tuple[Floats, Floats]] = {}
        if isinstance(surface, Ball):
            return
        self.origin = surface.center
        local = surface.triangles - surface.center
        closed = np.unique(surface.bodies[surface.bodies > 0])
        self.tree = sides.triangle_tree(local, surface.bodies)
        volumes = -(surface.normals * local.mean(axis=1)).sum(axis=1) * surface.areas
        for body in closed.tolist():
            own = surface.bodies == body
            corners = local[own].reshape(-1, 3)
            self._bodies.append((body, 1 if volumes[own].sum() > 0.0 else -1))
            self.boxes[body] = corners.min(axis=0), corners.max(axis=0)

    def __bool__(self) -> bool:
        return self._ball is not None or bool(self._bodies)

    def moved(self, by: Floats) -> "Interior":
        """The inside after the corners of the surface's triangles have moved by (F, 3, 3) metres.

        A ball's has none; the bodies stay closed, whatever moves.
        """
        found, reach = copy(self), float(np.abs(by).max(initial=0.0))
        found.tree = sides.refitted(self.tree, self.tree.corners + by[self.tree.faces])
        found.boxes = {k: (low - reach, high + reach) for k, (low, high) in self.boxes.items()}
        return found

    def solid(self) -> Solid:
        """The closed bodies for `kernels.triangles.depth`, about `origin`."""
        numbers = np.array(self._bodies, dtype=np.int64).reshape(-1, 2)
        low, high = (
            np.array([box[n] for box in self.boxes.values()]).reshape(-1, 3) for n in (0, 1)
        )
        box = np.stack([low.min(axis=0), high.max(axis=0)])
        return Solid(self.tree, numbers[:, 0].copy(), numbers[:, 1].copy(), box)

    def holds(self, positions: Floats) -> NDArray[np.bool_]:
        """Whether each of the positions (Q, 3), metres, surface's frame, is inside: (Q,).

        Decided by the parity of crossings of lines; on the surface itself either answer may come.
        """
        if self._ball is not None:
            return np.asarray(np.linalg.norm(positions, axis=1) < self._ball.radius)
        count = np.zeros(len(positions), dtype=np.int64)
        for body, sign in self._bodies:
            count += sign * self._holds_in(body, positions)
        return count > 0

    def _holds_in(self, body: int, positions: Floats) -> NDArray[np.bool_]:
        """Whether a closed body encloses each of the positions (Q, 3): (Q,)."""
        local = np.ascontiguousarray(positions - self.origin)
        low, high = self.boxes[body]
        held = np.asarray(((local >= low) & (local <= high)).all(axis=1))
        which = np.flatnonzero(held)
        if len(which):
            held[which] = sides.encloses(self.tree, body, local[which])
        return held

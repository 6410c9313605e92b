"""Spacing of points on a surface, pieces of it, and which positions it encloses."""

from copy import copy
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.surfaces import sides
from hapticdb.kernels.triangles.depth import Solid

if TYPE_CHECKING:
    from hapticdb.pointshell.orientation import Surface

Floats = NDArray[np.float64]


def spacing_of(area: float, n_points: int) -> float:
    """Distance of neighbours, metres, for a hexagonal lattice of `n_points` on an area (m^2)."""
    return float(np.sqrt(2.0 * area / (np.sqrt(3.0) * n_points)))


def points_for(area: float, spacing: float) -> int:
    """Number of points of a hexagonal lattice on an area; the inverse of `spacing_of`."""
    return int(np.ceil(2.0 * area / (np.sqrt(3.0) * spacing**2)))


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
        boxes = np.array([self.boxes[body] for body, _ in self._bodies]).reshape(-1, 2, 3)
        box = np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
        return Solid(self.tree, numbers[:, 0].copy(), numbers[:, 1].copy(), boxes, box)

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

"""Point spacing on a surface, bisection of triangles, membership in closed bodies."""

from copy import copy
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.surfaces import triangle_bvh
from hapticdb.kernels.triangles.depth import Solid
from hapticdb.pointshell.orientation import Surface

Floats = NDArray[np.float64]


def spacing_of(area: float, n_points: int) -> float:
    """Spacing, metres, of a hexagonal lattice of `n_points` on an area (m^2)."""
    return float(np.sqrt(2.0 * area / (np.sqrt(3.0) * n_points)))


def points_for(area: float, spacing: float) -> int:
    """Number of points of a hexagonal lattice on an area (m^2); the inverse of `spacing_of`."""
    return int(np.ceil(2.0 * area / (np.sqrt(3.0) * spacing**2)))


def halves(triangles: Floats) -> Floats:
    """Bisect triangles (F, 3, 3) at their longest sides, (2 F, 3, 3)."""
    lengths = np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=2)
    turned = (np.argmax(lengths, axis=1)[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(triangles, turned[:, :, None], axis=1).swapaxes(0, 1)
    middle = 0.5 * (a + b)
    return np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])


def winding_numbers(triangles: Floats, parts: NDArray[np.int64], positions: Floats) -> Floats:
    """Winding numbers (Q, P) of each part of triangles (F, 3, 3), at positions (Q, 3).

    By their corners' order; parts (F,) : of each triangle, 0, 1, ... Solid angles by Van Oosterom
    and Strackee, 1983.
    """
    found = np.zeros((len(positions), int(parts.max(initial=-1)) + 1))
    for n, place in enumerate(positions):
        corners = (triangles - place).swapaxes(0, 1)
        lengths = np.linalg.norm(corners, axis=2)
        dots = np.einsum("kfi,kfi->kf", corners, np.roll(corners, -1, axis=0))
        volumes = np.einsum("fi,fi->f", corners[0], np.cross(corners[1], corners[2]))
        shares = lengths.prod(axis=0) + (dots * np.roll(lengths, 1, axis=0)).sum(axis=0)
        turns = np.arctan2(volumes, shares) / (2.0 * np.pi)
        found[n] = np.bincount(parts, turns, found.shape[1])
    return found


class Ball(NamedTuple):
    """A sphere about the origin; radius in metres."""

    radius: float


class Interior:
    """Inside of the closed bodies of a result of `orient`.

    Open bodies enclose nothing, and a void is outside. solid : the bodies, about `origin` (3,),
    metres.
    """

    def __init__(self, surface: Surface) -> None:
        self.origin = surface.center
        local = surface.triangles - surface.center
        tree = triangle_bvh.triangle_bvh(local, surface.bodies)
        volumes = -(surface.normals * local.mean(axis=1)).sum(axis=1) * surface.areas
        closed = np.unique(surface.bodies[surface.bodies > 0])
        signs = np.where(np.bincount(surface.bodies, volumes)[closed] > 0.0, 1, -1)
        boxes = triangle_bvh.body_boxes(local, surface.bodies)[closed]
        low = boxes[:, 0].min(axis=0, initial=np.inf)
        high = boxes[:, 1].max(axis=0, initial=-np.inf)
        self.solid = Solid(tree, closed, signs, boxes, np.stack([low, high]))

    def __bool__(self) -> bool:
        return len(self.solid.bodies) > 0

    def moved(self, by: Floats) -> "Interior":
        """The inside after a motion of the triangles' corners by (F, 3, 3) metres.

        Bodies stay closed under any motion, but for cracks at T-junctions, up to the motion.
        """
        found, reach = copy(self), float(np.abs(by).max(initial=0.0))
        solid, larger = self.solid, np.array([[-reach], [reach]])
        tree = triangle_bvh.refitted(solid.tree, solid.tree.corners + by[solid.tree.faces])
        boxes, box = solid.boxes + larger, solid.box + larger
        found.solid = solid._replace(tree=tree, boxes=boxes, box=box)
        return found

    def holds(self, positions: Floats) -> NDArray[np.bool_]:
        """Whether positions (Q, 3), metres, surface's frame, are inside: (Q,).

        By the parity of crossings of lines; undefined on the surface itself.
        """
        count = np.zeros(len(positions), dtype=np.int64)
        local = np.ascontiguousarray(positions - self.origin)
        solid = self.solid
        for body, sign, (low, high) in zip(*solid[1:4], strict=True):
            which = np.flatnonzero(((local >= low) & (local <= high)).all(axis=1))
            if len(which):
                count[which] += sign * triangle_bvh.encloses(solid.tree, body, local[which])
        return count > 0

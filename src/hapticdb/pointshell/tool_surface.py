"""The tool's surface, for proximity queries against other surfaces."""

from copy import copy

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.errors import UsageError
from hapticdb.grid import corners_of
from hapticdb.kernels.surfaces.triangle_bvh import TriangleBVH
from hapticdb.kernels.triangles.surface_distance import Nearest, nearest
from hapticdb.pointshell.coverage import Ball
from hapticdb.pointshell.shape import CollisionShape
from hapticdb.pointshell.shell import PointShell

Floats = NDArray[np.float64]

AT_ONCE = 32
"""Boxes of a batch. Larger: more memory."""


class ToolSurface(CollisionShape):
    """A shell's surface, tool frame: triangles, or a ball about the origin.

    corners (V, 3) : positions that span its AABB, metres.

    Raises `UsageError` if the shell has no surface.
    """

    def __init__(self, shell: PointShell) -> None:
        if shell.surface is None:
            raise UsageError("the tool has points but no surface: give its mesh, not a saved shell")
        if isinstance(shell.surface, Ball):
            super().__init__(np.zeros((1, 3, 3)), radius=shell.surface.radius)
            self.corners = self.box
        else:
            super().__init__(shell.surface.triangles, shell.surface, chord=shell.chord)
            self.corners = np.unique(shell.surface.triangles.reshape(-1, 3), axis=0)

    def grown(self, radius: float) -> "ToolSurface":
        """With balls about all its places, as far from points as it is from balls about them."""
        if not radius:
            return self
        made = copy(self)
        made.radius += radius
        low, high = made.corners.min(axis=0), made.corners.max(axis=0)
        made.corners = corners_of(np.stack([low - radius, high + radius]))
        return made

    def nearest(
        self, other: TriangleBVH, poses: Floats, farthest: Floats, enough: float = 0.0
    ) -> Nearest:
        """Distances from another surface at poses (N, 4, 4); see `kernels.triangles`."""
        radius = self.radius
        near = nearest(other, self.tree, poses, farthest + radius, enough + radius)
        if radius == 0.0:
            return near
        away = near.on_a - near.on_b
        away *= np.minimum(radius / np.maximum(near.at_most, 1e-300), 1.0)[:, None]
        return near._replace(
            at_least=np.maximum(near.at_least - radius, 0.0),
            at_most=np.maximum(near.at_most - radius, 0.0),
            on_b=near.on_b + away,
        )

    def box_gaps(self, bounds: Floats, poses: Floats, more: ArrayLike = 0.0) -> Floats:
        """Distances (O, N) of boxes (O, 2, 3) from this one's at poses (N, 4, 4), or lower bounds.

        more (N,) : enlargement of the surface's box on each side, metres.
        """
        low, high = self.corners.min(axis=0), self.corners.max(axis=0)
        middles = poses[:, :3, :3] @ (0.5 * (low + high)) + poses[:, :3, 3]
        reach = (
            np.abs(poses[:, :3, :3]) @ (0.5 * (high - low)) + np.reshape(more, (-1, 1)) + self.chord
        )
        out = np.empty((len(bounds), len(poses)))
        low, high = middles - reach, middles + reach
        for first in range(0, len(bounds), AT_ONCE):
            some = slice(first, first + AT_ONCE)
            apart = low - bounds[some, 1, None]
            np.maximum(apart, bounds[some, 0, None] - high, out=apart)
            np.maximum(apart, 0.0, out=apart)
            np.sqrt(np.einsum("onk,onk->on", apart, apart), out=out[some])
        return out

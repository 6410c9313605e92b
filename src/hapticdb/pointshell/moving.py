"""The surface of a tool, to be measured from other surfaces."""

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import UsageError
from hapticdb.kernels.surfaces.sides import TriangleTree, triangle_tree
from hapticdb.kernels.triangles.nearest import Nearest, nearest
from hapticdb.pointshell.coverage import Ball
from hapticdb.pointshell.shell import PointShell

Floats = NDArray[np.float64]


class MovingSurface:
    """A shell's surface, tool frame: triangles, or a ball about the origin.

    tree : its triangles, or the ball's middle as one without area; corners (V, 3) : whose box holds
    it, metres.

    Raises `UsageError` if the shell has no surface.
    """

    def __init__(self, shell: PointShell) -> None:
        if shell.surface is None:
            raise UsageError("the tool has points but no surface: give its mesh, not a saved shell")
        self.surface = shell.surface
        if isinstance(self.surface, Ball):
            self._radius, triangles = self.surface.radius, np.zeros((1, 3, 3))
            self.corners = self._radius * np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
        else:
            self._radius, triangles = 0.0, self.surface.triangles
            self.corners = np.unique(triangles.reshape(-1, 3), axis=0)
        self.tree = tree_of(triangles)

    def nearest(
        self,
        other: TriangleTree,
        poses: Floats,
        farthest: Floats,
        *,
        then: float = np.inf,
        enough: float = 0.0,
    ) -> Nearest:
        """Measure from another surface at poses (N, 4, 4), as `kernels.triangles.nearest` does."""
        radius = self._radius
        near = nearest(
            other, self.tree, poses, farthest + radius, then=then + radius, enough=enough + radius
        )
        if radius == 0.0:
            return near
        away = near.on_a - near.on_b
        away *= np.minimum(radius / np.maximum(near.at_most, 1e-300), 1.0)[:, None]
        return near._replace(
            at_least=np.maximum(near.at_least - radius, 0.0),
            at_most=np.maximum(near.at_most - radius, 0.0),
            on_b=near.on_b + away,
        )


def tree_of(triangles: Floats) -> TriangleTree:
    """Tree over triangles (F, 3, 3) of one surface."""
    return triangle_tree(triangles, np.zeros(len(triangles), dtype=np.int64))

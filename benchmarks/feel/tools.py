"""Tools of the measures: flat ones that lie exactly along a surface, balls."""

import numpy as np
from numpy.typing import NDArray

from hapticdb.pointshell.shell import PointShell

Floats = NDArray[np.float64]

PITCH = 0.7
"""Distance of neighbouring points of a flat tool, voxels. A whole number would put all points into
the same place within their voxels."""


def flat_tool(n_across: int, voxel_size: float, axes: Floats, pitch: float = PITCH) -> PointShell:
    """A square of n_across^2 points in the plane of a scene's x and y; its inside is at +z."""
    across = (np.arange(n_across) - (n_across - 1) / 2.0) * pitch * voxel_size
    x, y = np.meshgrid(across, across, indexing="ij")
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(n_across**2)]) @ axes.T
    normals = np.tile(axes[:, 2], (len(points), 1))
    return PointShell(points, normals, np.zeros(3), is_closed=False)


def ball(radius_voxels: float, voxel_size: float, points: int = 300) -> PointShell:
    """A sphere about the origin."""
    return PointShell.sphere(radius_voxels * voxel_size, points)

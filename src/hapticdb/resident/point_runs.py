"""A tool as frames hold it: its points in runs."""

import numpy as np

from hapticdb.array_types import Floats
from hapticdb.kernels.resident.cells import BLOCK, GROUP, SCRATCH_ROWS, Clusters
from hapticdb.pointshell.shell import PointShell

RUN = 64
"""Points of a cluster. A larger value tests fewer spheres and skips fewer points."""
FLAT_RUN = 512
"""Points per transformation without clusters: as many as fit into a processor's L1 cache."""


def clusters_of(shell: PointShell, voxel_size: float, run: int | None = None) -> Clusters:
    """Prepare a shell for frames: points with normals, and bounding spheres of clusters.

    The points may have any order; clusters skip most points if neighbours by index are neighbours
    in space, as in shells made from files. A sphere is larger by a thousandth of a voxel (m), more
    than rounding errors. run : points of a cluster, 0 for no clusters; 64 unless given, 0 for small
    shells.
    """
    if run is None:
        run = RUN if len(shell) > RUN else 0
    points = np.hstack([shell.points, shell.normals])
    spheres, groups = spheres_of(points, voxel_size, run)
    run = run or min(len(points), FLAT_RUN)
    columns = np.array(shell.points.T, order="C")  # a view of one point would be read-only
    scratch = np.empty((SCRATCH_ROWS, run))
    return Clusters(points, np.array(shell.center), spheres, groups, run, columns, scratch)


def spheres_of(points: Floats, voxel_size: float, run: int) -> tuple[Floats, Floats]:
    """Bounding spheres of runs of points (N, 6), and of groups and blocks, as `Clusters` has."""
    if not run:
        return np.zeros((0, 4)), np.zeros((0, 4))
    spheres = _around(points, run, 1e-3 * voxel_size)
    groups = _around(points, GROUP * run, 1e-3 * voxel_size)
    return spheres, np.vstack([groups, _blocks_of(spheres)])


def _around(points: Floats, run: int, slack: float) -> Floats:
    """Sphere (C, 4) at the centre of the box of each run of points (N, 3+), radius plus `slack`.

    The radius also has room for the greatest stretch of a pose under `is_rigid`.
    """
    starts = np.arange(0, len(points), run)
    low = np.minimum.reduceat(points[:, :3], starts)
    centers = 0.5 * (low + np.maximum.reduceat(points[:, :3], starts))
    x, y, z = (points[:, :3] - np.repeat(centers, run, axis=0)[: len(points)]).T
    radii = np.sqrt(np.maximum.reduceat(x * x + y * y + z * z, starts)) * (1.0 + 1e-5) + slack
    return np.column_stack([centers, radii])


def _blocks_of(spheres: Floats) -> Floats:
    """Spheres (B, 4) around those (C, 4) of each `BLOCK` runs, or (0, 4) for fewer runs.

    The radius has room for the greatest stretch of a pose under `is_rigid`.
    """
    if len(spheres) < BLOCK:
        return np.zeros((0, 4))
    starts = np.arange(0, len(spheres), BLOCK)
    low = np.minimum.reduceat(spheres[:, :3], starts, axis=0)
    high = np.maximum.reduceat(spheres[:, :3], starts, axis=0)
    centers = np.repeat(0.5 * (low + high), BLOCK, axis=0)[: len(spheres)]
    distances = np.linalg.norm(spheres[:, :3] - centers, axis=1)
    radii = np.maximum.reduceat(distances * (1.0 + 1e-5) + spheres[:, 3], starts)
    return np.hstack([centers[starts], radii[:, None]])

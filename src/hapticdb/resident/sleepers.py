"""What frames of a large shell keep from pose to pose: clusters that sleep, and the budget."""

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import UsageError
from hapticdb.kernels.resident.cells import Clusters
from hapticdb.kernels.resident.sleeping import BLOCK, COUNTS, Sleepers

SLACK = 1e-3
"""Voxels by which a block's sphere is larger: more than rounding errors."""
STRETCH = 1e-5
"""Part by which a block's sphere is larger: a pose that is just accepted may stretch the tool."""


def block_spheres(spheres: NDArray[np.float64], voxel_size: float) -> NDArray[np.float64]:
    """Spheres (B, 4), metres, that contain those of each `BLOCK` runs (C, 4), in the tool frame."""
    starts = np.arange(0, len(spheres), BLOCK)
    low = np.minimum.reduceat(spheres[:, :3], starts, axis=0)
    high = np.maximum.reduceat(spheres[:, :3], starts, axis=0)
    middles = 0.5 * (low + high)
    away = spheres[:, :3] - np.repeat(middles, BLOCK, axis=0)[: len(spheres)]
    radii = np.maximum.reduceat(np.linalg.norm(away, axis=1) + spheres[:, 3], starts)
    return np.column_stack([middles, radii * (1.0 + STRETCH) + SLACK * voxel_size])


def sleepers_of(clusters: Clusters, voxel_size: float, budget: int | None) -> Sleepers:
    """All clusters of a shell, awake.

    budget : most points near something that a frame looks at; None for all.

    Raises
    ------
    UsageError
        If the budget is below one point.
    """
    if budget is not None and budget < 1:
        raise UsageError(f"a budget of {budget} points leaves nothing to feel: give 1 or more")
    n_runs = len(clusters.spheres)
    n_chosen = min(budget or 0, len(clusters.points))
    blocks = block_spheres(clusters.spheres, voxel_size)
    return Sleepers(
        blocks,
        np.zeros((len(blocks), 4)),
        np.zeros((n_runs, 4)),
        np.zeros((2, len(blocks)), dtype=np.int64),
        np.zeros(n_runs, dtype=np.int64),
        np.zeros((n_runs, 1)),
        np.zeros((0, 4)),
        np.zeros((n_chosen, 6)),
        np.zeros((3, n_chosen)),
        np.zeros(n_chosen, dtype=np.int64),
    )


def counts_of(n_poses: int) -> NDArray[np.int64]:
    """Room for the counts of frames: see `sleeping.LOOKED_AT`."""
    return np.zeros((n_poses, COUNTS), dtype=np.int64)

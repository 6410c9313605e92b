"""What frames of a large shell keep from pose to pose: clusters that sleep, and the budget."""

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import UsageError
from hapticdb.kernels.large.sleeping import BLOCK, COUNTS, REST, Sleepers
from hapticdb.kernels.large.waking import AWAKE, FOLLOWED, STATE
from hapticdb.kernels.resident.cells import CHANGES_KEPT, Clusters


def boxes_of_blocks(spheres: NDArray[np.float64]) -> NDArray[np.float64]:
    """Boxes (B, 7) around the centres of the spheres (C, 4) of each `BLOCK` runs, tool frame.

    A box is its centre, half its sides, and the radius of a sphere at its centre around the
    spheres, metres; the radius has room for the stretch of a pose that `is_rigid` just accepts.
    """
    starts = np.arange(0, len(spheres), BLOCK)
    low = np.minimum.reduceat(spheres[:, :3], starts, axis=0)
    high = np.maximum.reduceat(spheres[:, :3], starts, axis=0)
    centers = 0.5 * (low + high)
    ways = np.linalg.norm(
        spheres[:, :3] - np.repeat(centers, BLOCK, axis=0)[: len(spheres)], axis=1
    )
    radii = np.maximum.reduceat(ways * (1.0 + 1e-5) + spheres[:, 3], starts)
    return np.hstack([centers, 0.5 * (high - low), radii[:, None]])


def sleepers_of(clusters: Clusters, budget: int | None) -> Sleepers:
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
    boxes = boxes_of_blocks(clusters.spheres)
    rests = np.zeros((n_runs, 4))
    rests[:, 3] = AWAKE
    state = np.zeros(STATE, dtype=np.int64)
    state[FOLLOWED] = -1
    return Sleepers(
        boxes,
        np.zeros((len(boxes), REST + 1)),
        rests,
        state,
        np.zeros((CHANGES_KEPT, 3)),
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

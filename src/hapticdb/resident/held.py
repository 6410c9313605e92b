"""A tool as frames hold it: its points in runs, and what of it may sleep."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.large.budget import Asleep
from hapticdb.kernels.large.sleeping import BLOCK, COUNTS, REST, Sleepers
from hapticdb.kernels.large.waking import AWAKE, FOLLOWED, STATE
from hapticdb.kernels.resident.cells import CHANGES_KEPT, GROUP, SCRATCH_ROWS, Clusters
from hapticdb.kernels.resident.feeling import bounding_spheres
from hapticdb.pointshell.shell import PointShell

RUN = 64
"""Points of a cluster. A larger value tests fewer spheres and skips fewer points."""
FLAT_RUN = 512
"""Points that are transformed at once without clusters: as many as a processor's L1 cache holds."""
LARGE_FROM = 4096
"""Points from which clusters of a session's tool sleep: one block of 64 runs of 64 points. A
smaller tool has no block to skip at once. Results are the same: a larger value only costs time."""

Floats = NDArray[np.float64]


class PreparedTool(NamedTuple):
    """clusters : the points and bounding spheres; asleep : what sleeps, and the budget."""

    clusters: Clusters
    asleep: Asleep


def held_tool(
    shell: PointShell,
    voxel_size: float,
    budget: int | None = None,
    *,
    sleeps: bool | None = None,
    run: int | None = None,
) -> PreparedTool:
    """Prepare a shell for frames; all of it is awake.

    Parameters
    ----------
    shell, voxel_size, run
        As for `clusters_of`.
    budget : int or None
        Most points near something that a frame looks at, `checked_budget`; None for all.
    sleeps : bool or None
        Whether clusters sleep. A budget needs that they do. None: those of a large tool.
    """
    sleeps = sleeps or budget is not None or (sleeps is None and len(shell) >= LARGE_FROM)
    n_points = len(shell)
    clusters = clusters_of(shell, voxel_size, run or RUN if sleeps else run)
    spheres = clusters.spheres if sleeps else clusters.spheres[:0]
    return PreparedTool(clusters, asleep_of(spheres, budget, n_points))


def asleep_of(spheres: Floats, budget: int | None, n_points: int) -> Asleep:
    """What sleeps of a tool with those spheres (C, 4) of runs: nothing without any."""
    sleepers = _sleepers_of(spheres, budget, n_points)
    return Asleep(sleepers, min(budget or n_points, n_points), counts_of(1))


def clusters_of(shell: PointShell, voxel_size: float, run: int | None = None) -> Clusters:
    """Prepare a shell for frames: points with normals, and bounding spheres of clusters.

    Parameters
    ----------
    shell : PointShell
        Its points may have any order. Clusters skip most points if neighbours by index are
        neighbours in space, as in shells made from files.
    voxel_size : float
        Metres. A sphere is larger by a thousandth of a voxel, which is more than rounding errors.
    run : int or None
        Points of a cluster, 0 for no clusters; 64 unless given, 0 for small shells.
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
    """Bounding spheres of runs of points (N, 6), and of groups of runs, as `Clusters` has them."""
    spheres = np.empty((-(-len(points) // run) if run else 0, 4))
    groups = np.empty((-(-len(spheres) // GROUP), 4))
    if run:
        bounding_spheres(points, run, 1e-3 * voxel_size, spheres)
        bounding_spheres(points, GROUP * run, 1e-3 * voxel_size, groups)
    return spheres, groups


def _boxes_of_blocks(spheres: NDArray[np.float64]) -> NDArray[np.float64]:
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


def _sleepers_of(spheres: Floats, budget: int | None, n_points: int) -> Sleepers:
    n_runs = len(spheres)
    n_chosen = min(budget or 0, n_points)
    boxes = _boxes_of_blocks(spheres)
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

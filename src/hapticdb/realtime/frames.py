"""Frames against resident cells in this process: exact, for paths, replays and benchmarks."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.errors import UsageError
from hapticdb.force import TangentPlane
from hapticdb.kernels import cell_table as kernels
from hapticdb.kernels.cells import (
    CONTACTS,
    DEEPEST,
    GROUP,
    HITS,
    MOST_MISSED,
    RESULTS,
    UNKNOWN,
    UNKNOWNS,
    WRENCH,
    Clusters,
    bounding_spheres,
    feel_kernel,
)
from hapticdb.pointshell import PointShell
from hapticdb.poses import as_floats
from hapticdb.realtime.residency import Residency

RUN = 64
"""Points of a cluster."""
FLAT_RUN = 512
"""Points that are placed at once without clusters: as many as a processor's first cache holds."""
LEAST_FOUND = 1 << 16

Floats = NDArray[np.float64]


class Felt(NamedTuple):
    """What a shell felt at M poses.

    wrenches (M, 6): N and N m about the centre of mass, world frame; hits, contacts, unknown (M,)
    int64: points in a voxel, below their tangent plane, in a cell that is not resident; deepest
    (M,): metres, of the deepest contact.
    """

    wrenches: Floats
    hits: NDArray[np.int64]
    contacts: NDArray[np.int64]
    unknown: NDArray[np.int64]
    deepest: Floats


def clusters_of(shell: PointShell, voxel_size: float, run: int | None = None) -> Clusters:
    """Shell as frames take it: points with normals, and spheres around runs of neighbours.

    Parameters
    ----------
    shell : PointShell
        In any order; clusters skip most where neighbours by index are neighbours in space, as in
        shells made from files.
    voxel_size : float
        Metres; spheres are a thousandth of it larger, above all rounding.
    run : int or None
        Points of a cluster, 0 for no clusters; 64 unless given.
    """
    if run is None:
        run = RUN if len(shell) > RUN else 0
    points = np.hstack([shell.points, shell.normals])
    spheres = np.empty((-(-len(points) // run) if run else 0, 4))
    groups = np.empty((-(-len(spheres) // GROUP), 4))
    if run:
        bounding_spheres(points, run, 1e-3 * voxel_size, spheres)
        bounding_spheres(points, GROUP * run, 1e-3 * voxel_size, groups)
    run = run or min(len(points), FLAT_RUN)
    columns = np.ascontiguousarray(shell.points.T)
    scratch = np.empty((6, run))
    return Clusters(points, np.array(shell.center), spheres, groups, run, columns, scratch)


class Frames:
    """Frames of one shell that wait for their cells: exact, whatever the database takes.

    Parameters
    ----------
    residency : Residency
        Of the environment; this is its table's only reader or one of several.
    shell : PointShell
        The tool.
    law : TangentPlane or None
        1000 N/m unless given.
    run : int or None
        As `clusters_of` takes it.
    """

    def __init__(
        self,
        residency: Residency,
        shell: PointShell,
        law: TangentPlane | None = None,
        *,
        run: int | None = None,
    ) -> None:
        self.residency = residency
        self.shell = shell
        self.stiffness = (law or TangentPlane()).stiffness
        self.clusters = clusters_of(shell, residency.grid.voxel_size, run)
        self.met = np.empty(len(shell), dtype=np.int64)
        self.missed = np.zeros(1 + MOST_MISSED, dtype=np.int64)
        self._row = residency.table.join()

    def close(self) -> None:
        """Be the table's reader no more."""
        self.residency.table.leave(self._row)

    def feel(self, poses: ArrayLike) -> Felt:
        """Wrenches at poses (M, 4, 4) `world_from_tool`, every cell that they need fetched before.

        Raises
        ------
        UsageError
            When a pose is not rigid.
        """
        matrices = as_floats(poses, "poses").reshape(-1, 4, 4)
        out = np.zeros((len(matrices), RESULTS))
        done = 0
        while done < len(matrices):
            n_poses = self._fetch(matrices[done:])
            self._run(matrices, out, done, n_poses)
            done += n_poses
        return Felt(
            out[:, WRENCH : WRENCH + 6],
            out[:, HITS].astype(np.int64),
            out[:, CONTACTS].astype(np.int64),
            out[:, UNKNOWNS].astype(np.int64),
            out[:, DEEPEST],
        )

    def wrenches(self, poses: Floats) -> tuple[Floats, NDArray[np.int64]]:
        """Wrenches (M, 6) and numbers of hits (M,) at poses, as a replay asks for them."""
        felt = self.feel(poses)
        return felt.wrenches, felt.hits

    def _fetch(self, poses: Floats) -> int:
        """Make all cells of the first poses resident; returns how many poses that are."""
        residency = self.residency
        most = (residency.table.n_slots - 1) // 2
        room = max(LEAST_FOUND, 4 * most, 4 * len(self.shell))
        found = np.full(1 << (room - 1).bit_length(), UNKNOWN, dtype=np.int64)
        n_poses, _ = kernels.cells_met(self.clusters.points, poses, residency.place, found, most)
        cells = found[found >= 0]
        residency.bring(cells)
        return int(n_poses)

    def _run(self, poses: Floats, out: Floats, start: int, n_poses: int) -> None:
        """Frames at poses start .. start + n_poses, whose cells are resident."""
        part = slice(start, start + n_poses)
        done = feel_kernel(
            self.residency.table.cells, self._row, self.clusters, poses[part],
            self.residency.place, self.stiffness, self.met, self.missed, out[part],
        )  # fmt: skip
        if done < n_poses:
            raise UsageError(f"pose {start + done} is no rigid transform: give a rotation")

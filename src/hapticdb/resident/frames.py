"""Frames against resident cells in this process: exact, for paths, replays and benchmarks."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.array_types import Floats
from hapticdb.errors import UsageError
from hapticdb.kernels.force_law import force_range, reads_distances
from hapticdb.kernels.records.cells import MISSED
from hapticdb.kernels.records.hand import RESULT
from hapticdb.kernels.resident import cell_table as kernels
from hapticdb.kernels.resident.cell_frames import evaluate_frames
from hapticdb.kernels.resident.cells import UNKNOWN, Clusters
from hapticdb.kernels.resident.collisions import UNDECIDED, find_first_hits
from hapticdb.pointshell.shell import PointShell
from hapticdb.poses import as_floats
from hapticdb.query.law import ForceLaw, TangentPlane
from hapticdb.resident.point_runs import clusters_of
from hapticdb.resident.residency import Residency

LEAST_FOUND = 1 << 16
"""Least number of entries of the hash table of the poses' cells. Larger: fewer collisions and more
time to clear."""
SMALL = 16.0
"""Greatest radius (voxels) of a run for which the search for cells uses the run's middle instead of
its points. Larger: fewer lookups and more unused cells."""


class FrameResults(NamedTuple):
    """Wrenches and counts of a shell at M poses.

    wrenches (M, 6): N and N m about the centre of mass, world frame; hits, contacts, unknown (M,)
    int64: numbers of points with a hit (in a voxel or, with distances, near a surface), with a
    contact (below their tangent plane or the onset), in an unknown cell; deepest (M,): depth of
    the deepest contact, metres.
    """

    wrenches: Floats
    hits: NDArray[np.int64]
    contacts: NDArray[np.int64]
    unknown: NDArray[np.int64]
    deepest: Floats


class Surroundings(NamedTuple):
    """Places used instead of a shell's points in the search for cells.

    places (P, 3+): the middles of small runs, and the points of all other runs; reach : greatest
    distance of a point from its place, voxels; run : points of a run; first (C,) int64: index of
    the first place of each run.
    """

    places: Floats
    reach: float
    run: int
    first: NDArray[np.int64]

    def place_of(self, point: int) -> int:
        """Index of a point's place."""
        run, within = divmod(point, self.run)
        first = int(self.first[run])
        end = int(self.first[run + 1]) if run + 1 < len(self.first) else len(self.places)
        return min(first + within, end - 1)


def _surroundings_of(clusters: Clusters, voxel_size: float, beyond: float) -> Surroundings:
    """Places of the runs: one place for a run with a radius of `SMALL` voxels or less.

    The reach has room for `beyond` voxels around the runs: frames search them before they skip a
    run. It is `SMALL` at most: a missing cell there costs time, not exactness.
    """
    n_points = len(clusters.points)
    starts = np.arange(0, n_points, clusters.run)
    radii = clusters.spheres[:, 3] / voxel_size
    # a large run would request all cells around its sphere: its points have fewer
    is_small = radii <= SMALL
    if not is_small.any():
        return Surroundings(clusters.points, 0.0, clusters.run, starts)
    counts = np.where(is_small, 1, np.minimum(starts + clusters.run, n_points) - starts)
    first = np.cumsum(counts) - counts
    places = np.empty((int(counts.sum()), 3))
    places[first[is_small]] = clusters.spheres[is_small, :3]
    is_point = np.ones(len(places), dtype=bool)
    is_point[first[is_small]] = False
    places[is_point] = clusters.points[np.repeat(~is_small, clusters.run)[:n_points], :3]
    reach = min(float(radii[is_small].max()) + beyond, SMALL)
    return Surroundings(places, reach, clusters.run, first)


class ResidentFrames:
    """Frames of one shell. Each frame waits until its cells are resident, so all are exact.

    law : the tangent plane with 1000 N/m unless given; run : as for `clusters_of`. Raises
    UsageError if the law reads distances, and the cells have none.
    """

    def __init__(
        self,
        residency: Residency,
        shell: PointShell,
        law: ForceLaw | None = None,
        *,
        run: int | None = None,
    ) -> None:
        self.residency = residency
        self.shell = shell
        self.law = (law or TangentPlane()).for_kernels
        table = residency.table
        if reads_distances(self.law) and not table.has_distances:
            raise UsageError(
                "this force law reads distances, which the resident cells do not have: make their "
                "table by CellTable.create(distances=True)"
            )
        self.cells = table.cells
        if not reads_distances(self.law):  # kernels are compiled for the plane without a payload
            self.cells = table.cells.without_distances()
        size = residency.grid.voxel_size
        self.clusters = clusters_of(shell, size, run)
        self.hits = np.empty(len(shell), dtype=np.int64)
        self.surroundings = _surroundings_of(self.clusters, size, force_range(self.law))
        self.missed = np.zeros((), MISSED)
        self._row = table.join()

    def close(self) -> None:
        """Free the table's reader row."""
        self.residency.table.leave(self._row)

    def evaluate(self, poses: ArrayLike) -> FrameResults:
        """Fetch the cells for rigid poses (M, 4, 4) `world_from_tool`; compute wrenches there."""
        matrices = as_floats(poses, "poses").reshape(-1, 4, 4)
        out = np.zeros(len(matrices), RESULT)
        done = 0
        while done < len(matrices):
            # as many poses as the table has room for: their cells must be resident together
            n_poses = self.fetch(matrices[done:])
            self._run(matrices, out, done, n_poses)
            done += n_poses
        return FrameResults(
            out["wrench"],
            out["hits"].astype(np.int64),
            out["contacts"].astype(np.int64),
            out["unknown"].astype(np.int64),
            out["deepest"],
        )

    def collides(
        self, poses: Floats, search: Callable[[Floats], NDArray[np.int64]] | None = None
    ) -> NDArray[np.bool_]:
        """Whether a point is in an occupied voxel at each of poses (M, 4, 4), rigid transforms.

        The poses with hits in `evaluate` under the plane law. The search of a pose ends at its
        first hit, and only unknown cells are fetched.

        search : finds a point with a hit at each pose, such as `first_hits` in several threads.
        """
        search = search or self.first_hits
        found = search(poses)
        # a hit in a known cell decides alone; the rest needs its cells
        pending = np.flatnonzero(found == UNDECIDED)
        while len(pending):
            n_poses = self.fetch(poses[pending])
            now, pending = pending[:n_poses], pending[n_poses:]
            found[now] = search(poses[now])
        return np.asarray(found >= 0)

    def first_hits(self, poses: Floats) -> NDArray[np.int64]:
        """A point (M,) with a hit at each of poses (M, 4, 4), `NOTHING` or `UNDECIDED`."""
        found = np.empty(len(poses), dtype=np.int64)
        cells = self.residency.table.cells.without_distances()
        find_first_hits(cells, self._row, self.clusters, poses, self.residency.cell_grid, found)
        return found

    def fetch(self, poses: Floats) -> int:
        """Make the cells of the first poses resident; returns the number of these poses."""
        residency = self.residency
        most = (residency.table.n_slots - 1) // 2
        around = self.surroundings
        # if the surroundings of the first pose do not fit into the table, its points alone may fit
        for places, reach in ((around.places, around.reach), (self.clusters.points, 0.0)):
            room = max(LEAST_FOUND, 4 * most, (32 if reach > 0.0 else 4) * len(places))
            # hash table: a power of two, several times the cells, so collisions are few
            found = np.full(1 << (room - 1).bit_length(), UNKNOWN, dtype=np.int64)
            n_poses, count = kernels.cells_in_reach(
                places, 0, len(places), reach, poses, residency.cell_grid, found, most
            )
            if count <= most:
                break
        cells = found[found >= 0]
        residency.make_resident(cells)
        return int(n_poses)

    def _run(self, poses: Floats, out: NDArray[np.void], start: int, n_poses: int) -> None:
        """Compute the frames at poses start .. start + n_poses - 1, with resident cells."""
        part = slice(start, start + n_poses)
        done = evaluate_frames(
            self.cells, self._row, self.clusters, poses[part], self.residency.cell_grid, self.law,
            self.hits, self.missed, out[part],
        )  # fmt: skip
        if done < n_poses:
            raise UsageError(f"pose {start + done} is no rigid transform: give a rotation")

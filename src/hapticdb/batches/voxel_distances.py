"""Distances at many poses: kernels search resident cells, and report missing ones."""

import numpy as np

from hapticdb.array_types import Floats, Ints
from hapticdb.batches.batch_threads import BatchThreads, ThreadMemory
from hapticdb.errors import UsageError
from hapticdb.kernels.resident import cell_table, collisions
from hapticdb.kernels.resident import nearest_voxels as kernels
from hapticdb.kernels.resident.cells import UNKNOWN
from hapticdb.resident.frames import SMALL, ResidentFrames
from hapticdb.resident.point_runs import spheres_of

DEFAULT_REACH = 32
"""Default reach of the search, voxels. Larger: more cells are fetched."""
CLOSE = 1.5, 4.0
"""Radii of runs, voxels, up to which points are in cubes of 1 and of 2 voxels, otherwise of 4."""
CELL = 32
"""Voxels of a cell on each axis."""
RUN = 16
"""Points of a run, the unit of bounding spheres; with 64 a search takes a third longer."""


def first_hits_at(frames: ResidentFrames, threads: BatchThreads, poses: Floats) -> Ints:
    """Point (B,) with a hit in a resident cell at each pose, `NOTHING` or `UNDECIDED`."""
    found = np.empty(len(poses), dtype=np.int64)
    cells, place = frames.residency.table.cells.without_distances(), frames.residency.cell_grid

    def work(memory: ThreadMemory, one: slice) -> None:
        collisions.find_first_hits(
            cells, memory.row, memory.clusters, poses[one], place, found[one]
        )

    threads.run(work, len(poses))
    return found


class NearestSearch:
    """Search for the voxels nearest to a shell, within a reach in voxels.

    frames : of the shell, with the table for the cells around its points; threads : of `frames`.

    Raises `UsageError` if the cells within reach of one point exceed the table.
    """

    def __init__(self, frames: ResidentFrames, threads: BatchThreads, reach: float) -> None:
        self._frames = frames
        self._threads = threads
        self._reach = reach
        self._cells = frames.residency.table.cells.without_distances()
        size = frames.residency.grid.voxel_size
        self._spheres, self._groups = spheres_of(frames.clusters.points, size, RUN)
        radii = frames.clusters.spheres[:, 3] / size
        self._fine = int(np.searchsorted(CLOSE, np.median(radii))) if len(radii) else len(CLOSE)
        of_runs = self._spheres[:, 3]
        self._largest = float(of_runs[of_runs <= SMALL * size].max(initial=0.0))
        self._around = reach + 1.0 + max(frames.surroundings.reach, self._largest / size)
        self._most = (frames.residency.table.n_slots - 1) // 2
        across = 2.0 * self._around / CELL
        if across > self._most or (int(across) + 2) ** 3 > self._most:
            raise UsageError(
                f"clearance up to {reach * frames.residency.grid.voxel_size:.4g} m needs more "
                "cells around a point than fit into "
                f"{frames.residency.table.size_bytes} bytes: give less, or a larger budget"
            )

    def search(self, poses: Floats) -> tuple[Floats, Ints]:
        """Distances (B,) in voxels and nearest points (B,), -1 for none, at rigid poses (B, 4, 4).

        A pose without one of its cells resumes after the cells around its points have been fetched.
        """
        n_poses, n_points = len(poses), len(self._frames.shell)
        squares = np.full(n_poses, self._reach**2)
        nearest = np.full(n_poses, -1, dtype=np.int64)
        done = np.zeros(n_poses, dtype=np.int64)
        hits = first_hits_at(self._frames, self._threads, poses)
        is_hit = hits >= 0
        squares[is_hit], nearest[is_hit], done[is_hit] = 0.0, hits[is_hit], n_points
        pending = np.flatnonzero(~is_hit)
        while len(pending):
            part = poses[pending]
            found = squares[pending], nearest[pending], done[pending]
            self._run(part, *found)
            squares[pending], nearest[pending], done[pending] = found
            is_left = found[2] < n_points
            pending = pending[is_left]
            if len(pending):
                self._fetch(part[is_left], int(done[pending[0]]))
        return np.sqrt(squares), nearest

    def _run(self, poses: Floats, squares: Floats, nearest: Ints, done: Ints) -> None:
        place = self._frames.residency.cell_grid

        def work(memory: ThreadMemory, one: slice) -> None:
            clusters = memory.clusters._replace(spheres=self._spheres, groups=self._groups, run=RUN)
            kernels.find_nearest(
                self._cells, memory.row, clusters, poses[one], place, self._largest, self._fine,
                memory.cubes, squares[one], nearest[one], done[one],
            )  # fmt: skip

        self._threads.run(work, len(poses))

    def _fetch(self, poses: Floats, point: int) -> None:
        """Fetch the cells within reach of the shell, from a point at the first of poses on."""
        residency, around = self._frames.residency, self._frames.surroundings
        found = np.full(1 << (2 * self._most).bit_length(), UNKNOWN, dtype=np.int64)
        cell_table.cells_in_reach(
            around.places, around.place_of(point), 0, self._around, poses, residency.cell_grid,
            found, self._most,
        )  # fmt: skip
        residency.make_resident(np.sort(found[found >= 0]))

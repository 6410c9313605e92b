"""Clearance along a path: from the shell's points to the nearest occupied voxel's box.

Between two samples no point moves more than half a voxel, so a known distance bounds the later
ones. A point is measured again only when it may be nearer than the nearest one so far.
"""

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import UsageError
from hapticdb.kernels.resident import clearance as kernels
from hapticdb.kernels.resident.cells import UNKNOWN
from hapticdb.resident.frames import ResidentFrames

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

STRIDE = 16
"""Samples, each half a voxel or less apart, from one fetch ahead to the next. Larger: fewer
fetches, each of more cells."""
CELL = 32


class ClearanceSearch:
    """Least distances along a path, sample after sample.

    Parameters
    ----------
    frames : ResidentFrames
        Frames of the shell; their table is used, and more cells are fetched around the points.
    limit : float
        Voxels; greater distances are not searched.
    n_windows : int or None
        Number of windows; each is a separate pose, far from the others. None: one window with all
        samples of the path.

    Raises
    ------
    UsageError
        If the cells within the limit of one point are more than the table can hold.

    Attributes
    ----------
    least : (W,) float64
        Least distance in each window, voxels; the limit if nothing is nearer.
    """

    def __init__(self, frames: ResidentFrames, limit: float, n_windows: int | None = None) -> None:
        self._frames = frames
        self._stride = STRIDE if n_windows is None else 1
        residency = frames.residency
        clusters, surroundings = frames.clusters, frames.surroundings
        self._reach = limit + kernels.MARGIN + 0.5 * self._stride + surroundings.reach
        self._most = (residency.table.n_slots - 1) // 2
        across = 2.0 * self._reach / CELL
        if across > self._most or (int(across) + 2) ** 3 > self._most:
            size = limit * residency.grid.voxel_size
            raise UsageError(
                f"clearance up to {size:.4g} m needs more cells around a point than fit into "
                f"{residency.table.size_bytes} bytes: give less, or a larger budget"
            )
        self.least = np.full(n_windows or 1, limit)
        self._bounds = kernels.Bounds(
            np.full(len(frames.shell), -np.inf),
            np.full(-(-len(frames.shell) // clusters.run), -np.inf),
            np.full(len(frames.shell), -1, dtype=np.int64),
            self.least,
            np.array([-np.inf, limit]),
            np.array([-1, 0, -1, 0, 0, 0], dtype=np.int64),
        )

    def look(self, first: int, poses: Floats, travels: Floats, windows: Ints) -> None:
        """Search around the points at the samples from `first` on.

        poses (B, 4, 4); travels (B,), as `SweepPath.travels` gives them; windows (B,) int64.
        """
        frames = self._frames
        residency, table = frames.residency, frames.residency.table
        done = 0
        while True:
            with table.reading() as row:
                done = kernels.find_clearance(
                    table.cells, row, frames.clusters, poses, done, first, travels, windows,
                    residency.place, frames.surroundings.reach, self._bounds,
                )  # fmt: skip
            if done == len(poses):
                return
            self._fetch(poses[done:], int(self._bounds.where[kernels.STOPPED]))

    @property
    def distance(self) -> float:
        """Least distance so far, voxels; the limit if nothing was nearer."""
        return float(self._bounds.state[kernels.LEAST])

    @property
    def looked(self) -> int:
        """Number of poses at which any point was looked at."""
        return int(self._bounds.where[kernels.LOOKED])

    @property
    def nearest(self) -> tuple[int, int, int]:
        """Sample, point and packed voxel of the least distance; valid if it is below the limit."""
        sample, point, voxel = self._bounds.where[:3].tolist()
        return sample, point, voxel

    def _fetch(self, poses: Floats, point: int) -> None:
        """Fetch the cells around a point, or its run, at the first pose and at later ones."""
        residency = self._frames.residency
        places = self._frames.surroundings.places
        found = np.full(1 << (2 * self._most).bit_length(), UNKNOWN, dtype=np.int64)
        kernels.cells_near(
            places, poses, residency.place, self._frames.surroundings.place_of(point), self._stride,
            self._reach * residency.grid.voxel_size, found, self._most,
        )  # fmt: skip
        residency.make_resident(np.sort(found[found >= 0]))

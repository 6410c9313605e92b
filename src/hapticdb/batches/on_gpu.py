"""Batches of poses on a GPU, with copies overlapping kernels."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from numba import config, cuda
from numpy.typing import NDArray

from hapticdb.array_types import Floats
from hapticdb.batches.batch_results import TouchBatch
from hapticdb.batches.batch_threads import BatchThreads
from hapticdb.batches.order import not_rigid, order_of
from hapticdb.batches.voxel_distances import NearestSearch
from hapticdb.errors import MissingExtraError, pip_line
from hapticdb.kernels import rigid
from hapticdb.kernels.gpu import gpu_frames as kernels
from hapticdb.kernels.gpu import gpu_nearest as searches
from hapticdb.kernels.gpu.gpu_frames import RESULTS
from hapticdb.resident.frames import ResidentFrames
from hapticdb.resident.mirror import CellMirror

PIECE_POINTS = 1 << 25
"""Points of one launch. Larger: fewer launches, more memory."""
PIECE_POSES = 1 << 16
"""Poses of one launch, at most, 14 MB with their results. Larger: likewise."""
LANES = 2
"""Concurrent launches: one computes while poses and results of the other are copied."""
MOST_BLOCKS = 1 << 13
"""Blocks of a launch, at most; a block computes several poses of a larger launch."""
COPIERS = 4
"""Threads for copies between the caller's memory and the GPU's."""
LEAST_COPIED = 1 << 12
"""Poses of one thread's copy, at least; smaller batches are copied without threads."""
config.CUDA_LOW_OCCUPANCY_WARNINGS = 0  # a frame of a small tool needs few blocks, and no warning


def check_gpu() -> None:
    """Raise `MissingExtraError` where numba finds no GPU."""
    if not cuda.is_available():
        raise MissingExtraError(
            "device 'cuda': numba finds no GPU that it can use; it takes one of NVIDIA with its "
            f"driver, and {pip_line('gpu')}"
        )


class RawFrames(NamedTuple):
    """Results of n poses: forces, torques (n, 3), and (n,) of each of the others."""

    forces: Floats
    torques: Floats
    hits: Floats
    contacts: Floats
    unknown: Floats
    deepest: Floats


class GpuNearest(NearestSearch):
    """Nearest-voxel search on the GPU, over a mirror of the processors' table.

    frames, threads, reach : as for `NearestSearch`; gpu : frames of the same shell.
    """

    def __init__(
        self, frames: ResidentFrames, threads: BatchThreads, reach: float, gpu: "GpuFrames"
    ) -> None:
        super().__init__(frames, threads, reach)
        self._gpu = gpu

    def search(self, poses: Floats) -> tuple[Floats, NDArray[np.int64]]:
        """As `NearestSearch.search`, also for a pose with too many cells for the table.

        The processors search at such a pose.
        """
        squares, points = self._gpu.nearest(poses, self._reach)
        left = np.flatnonzero(points == searches.UNDECIDED)
        while len(left):
            self._fetch(poses[left], 0)
            squares[left], points[left] = self._gpu.nearest(poses[left], self._reach)
            is_left = points[left] == searches.UNDECIDED
            if is_left[0]:
                one = left[:1]
                distance, points[one] = super().search(poses[one])
                squares[one] = distance**2
                is_left[0] = False
            left = left[is_left]
        return np.sqrt(squares), points


class _Lane:
    """Buffers of one launch, here and on the GPU, and its stream."""

    def __init__(self, n_poses: int, shares: int) -> None:
        self.stream = cuda.stream()
        self.part = slice(0, 0)
        self.poses = cuda.pinned_array((n_poses, 4, 4), np.float64)
        self.out = cuda.pinned_array(n_poses * RESULTS, np.float64)
        self.on_gpu = (
            cuda.device_array((n_poses, 4, 4), np.float64),
            cuda.device_array((n_poses, shares, kernels.SUMS), np.float64),
            cuda.to_device(np.zeros(n_poses, np.int32)),
            cuda.device_array(n_poses * RESULTS, np.float64),
        )

    def begin(self, n: int, launch: Callable[..., None]) -> None:
        """Enqueue the copy of the first n of `poses`, the kernel, and the copy of its results."""
        poses, sums, ended, out = self.on_gpu
        if n < len(poses):
            poses, out = poses[:n], out[: n * RESULTS]
        poses.copy_to_device(self.poses[:n], stream=self.stream)
        launch(self.stream, poses, sums, ended, out)
        out.copy_to_host(self.out[: n * RESULTS], stream=self.stream)

    def results(self) -> RawFrames:
        """Wait for the results; the next `begin` overwrites them."""
        self.stream.synchronize()
        n = self.part.stop - self.part.start
        rows = self.out[: n * RESULTS].reshape(RESULTS, n)
        vectors = self.out[: 6 * n].reshape(2, n, 3)
        return RawFrames(vectors[0], vectors[1], *rows[6:])


class GpuFrames:
    """Frames of one shell on the GPU; `frames`, of the processor, fetch the cells."""

    def __init__(self, frames: ResidentFrames) -> None:
        check_gpu()
        self._frames = frames
        residency = frames.residency
        self.mirror = CellMirror(residency.table, frames.law, residency.grid.side)
        points = np.hstack([frames.clusters.points.T, np.zeros((6, 1))])
        points[:3, -1] = frames.clusters.center
        self._shell = cuda.to_device(np.ascontiguousarray(points))
        self._shares, self._threads = kernels.shares_of(len(frames.shell))
        law_type: Any = type(frames.law)  # mypy takes no class for hashable
        self._kernel = kernels.frames_under(law_type, self._threads, single=False)
        self._piece = max(1, min(PIECE_POSES, PIECE_POINTS // len(frames.shell)))
        self._lanes: list[_Lane] = []
        self._copiers = ThreadPoolExecutor(COPIERS, thread_name_prefix="copy")
        self._stream = cuda.stream()
        one = kernels.frames_under(law_type, self._threads, single=True)
        self._one = one[self._shares, self._threads, self._stream]
        self._out = cuda.mapped_array(RESULTS, np.float64)
        self._sums = cuda.device_array((1, self._shares, kernels.SUMS), np.float64)
        self._end = cuda.to_device(np.zeros(1, np.int32))

    def close(self) -> None:
        """End the threads."""
        self._copiers.shutdown()

    def evaluate(self, pose: Floats) -> Floats:
        """Results (RESULTS,) of a frame at a rigid pose (4, 4), else UsageError, in resident cells.

        The pose is an argument of the launch, and the results are in mapped memory: a tenth of the
        time of `run` for one pose.
        """
        if rigid.first_not_rigid(pose[None]) == 0:
            raise not_rigid(0)
        self.mirror.update()
        self._one(
            self._frames.law, self._frames.residency.cell_grid, self._shell,
            tuple(pose[:3].ravel().tolist()), *self.mirror.arrays, self._sums, self._end, self._out,
        )  # fmt: skip
        self._stream.synchronize()
        return np.array(self._out)

    def touch(
        self, poses: Floats, results: TouchBatch, progress: Callable[[int, int], None] | None
    ) -> None:
        """Results at poses (B, 4, 4), into `results`; poses with all cells resident come first."""
        pending: list[NDArray[np.int64]] = []
        for part, found in self.run(poses):
            self._put(results, part, found)
            pending.append(part.start + np.flatnonzero(found.unknown > 0.0))
            if progress is not None:
                progress(part.stop, len(poses))
        left = np.concatenate(pending) if pending else np.empty(0, np.int64)
        if len(left):
            residency, center = self._frames.residency, self._frames.shell.center
            left = left[order_of(poses[left], center, residency.grid)]
        while len(left):
            ready = left[: self._frames.fetch(poses[left])]
            left = left[len(ready) :]
            for part, found in self.run(poses[ready]):
                self._put(results, ready[part], found)

    def run(self, poses: Floats) -> Iterator[tuple[slice, RawFrames]]:
        """Results of rigid poses (B, 4, 4), else UsageError, piece by piece, in resident cells."""
        self.mirror.update()
        piece = min(self._piece, len(poses))
        if self._lanes and len(self._lanes[0].poses) < piece:
            self._lanes = []
        if not self._lanes:
            self._lanes = [_Lane(piece, self._shares) for _ in range(LANES)]
        under_way: list[_Lane] = []
        try:
            for n, start in enumerate(range(0, len(poses), piece or 1)):
                if len(under_way) == LANES:
                    yield self._ended(under_way.pop(0))
                lane = self._lanes[n % LANES]
                lane.part = slice(start, min(start + piece, len(poses)))
                self._copy(lane.poses, poses[lane.part])
                lane.begin(lane.part.stop - start, self._launch)
                under_way.append(lane)
            while under_way:
                yield self._ended(under_way.pop(0))
        finally:
            for lane in under_way:  # after an error, or Ctrl-C
                lane.stream.synchronize()

    def nearest(self, poses: Floats, reach: float) -> tuple[Floats, NDArray[np.int64]]:
        """Squared distances (B,), voxels, and nearest points (B,), or `NO_POINT`, `UNDECIDED`.

        poses (B, 4, 4), rigid; reach: voxels.
        """
        self.mirror.update()
        squares, points = np.empty(len(poses)), np.empty(len(poses), dtype=np.int64)
        seen, search = self.mirror.seen(), searches.search_kernel(searches.THREADS)
        for start in range(0, len(poses), PIECE_POSES):
            part = slice(start, min(start + PIECE_POSES, len(poses)))
            found = (
                cuda.device_array(part.stop - start, np.float64),
                cuda.device_array(part.stop - start, np.int64),
            )
            search[min(part.stop - start, MOST_BLOCKS), searches.THREADS](
                self._frames.residency.cell_grid, self._shell, cuda.to_device(poses[part]), seen,
                reach, *found,
            )  # fmt: skip
            squares[part], points[part] = (one.copy_to_host() for one in found)
        return squares, points

    def _launch(self, stream: Any, poses: Any, sums: Any, ended: Any, out: Any) -> None:  # noqa: ANN401 - numba's
        blocks = min(len(poses) * self._shares, MOST_BLOCKS)
        self._kernel[blocks, self._threads, stream](
            self._frames.law, self._frames.residency.cell_grid, self._shell, poses,
            *self.mirror.arrays, sums, ended, out,
        )  # fmt: skip

    @staticmethod
    def _ended(lane: _Lane) -> tuple[slice, RawFrames]:
        found = lane.results()
        if len(found.unknown) and found.unknown.min() == kernels.NOT_RIGID:
            raise not_rigid(lane.part.start + int(found.unknown.argmin()))
        return lane.part, found

    def _copy(self, to: Floats, poses: Floats) -> None:
        """Copy poses (n, 4, 4) to the front of `to`."""
        self._divide(len(poses), lambda part: np.copyto(to[part], poses[part]))

    def _put(self, results: TouchBatch, at: slice | NDArray[np.int64], found: RawFrames) -> None:
        """Store results in a batch, at the indices of its poses."""

        def put(part: slice) -> None:
            to = (
                slice(at.start + part.start, at.start + part.stop)
                if isinstance(at, slice)
                else at[part]
            )
            results.forces[to], results.torques[to] = found.forces[part], found.torques[part]
            results.hits[to], results.n_contacts[to] = found.hits[part], found.contacts[part]
            results.deepest[to] = found.deepest[part]

        self._divide(len(found.hits), put)

    def _divide(self, n: int, work: Callable[[slice], None]) -> None:
        """Run work on n rows in several threads."""
        step = max(LEAST_COPIED, -(-n // COPIERS))
        parts = [slice(start, min(start + step, n)) for start in range(0, n, step)]
        for _ in self._copiers.map(work, parts) if len(parts) > 1 else map(work, parts):
            pass

"""Threads for the poses of a batch, over shared cells, each with scratch memory of its own."""

import os
import queue
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import UsageError
from hapticdb.kernels.records.cells import MISSED
from hapticdb.kernels.records.rows import NEAR_CUBE
from hapticdb.kernels.resident.cells import Clusters
from hapticdb.kernels.resident.nearest_voxels import NOT_KNOWN
from hapticdb.resident.frames import ResidentFrames
from hapticdb.resident.table import MOST_READERS

CHUNK_POINTS = 1 << 18
"""Points of one call of a kernel, after which Ctrl-C is handled; but at least one pose."""
CHUNK_POSES = 1024
"""Poses of one call of a kernel, at most. Larger: fewer calls, a less even load."""
CUBES = 1 << 19
"""Cubes of space in a thread's cache of nearest voxels, a power of two; 32 bytes each."""
MOST_JOBS = MOST_READERS - 2
"""Threads, at most: each is a reader of the table, next to the shell's own and one more."""


class ThreadMemory(NamedTuple):
    """Memory written by a kernel in a thread: its row of the table, and scratch."""

    row: int
    clusters: Clusters
    hits: NDArray[np.int64]
    missed: NDArray[np.int64]
    cubes: NDArray[np.void]


ChunkWork = Callable[[ThreadMemory, slice], None]
"""Computes the poses of a slice in a thread, mostly inside a kernel."""


def available_jobs(jobs: int | None) -> int:
    """Number of threads: 1 to `MOST_JOBS`, or one for each processor available to this process."""
    if jobs is None:
        return min(len(os.sched_getaffinity(0)), MOST_JOBS)
    if not 1 <= jobs <= MOST_JOBS:
        raise UsageError(f"{jobs} jobs: give 1 to {MOST_JOBS} threads")
    return jobs


class BatchThreads:
    """Runs kernels on slices of a batch; each of `jobs` threads joins the table of `frames`."""

    def __init__(self, frames: ResidentFrames, jobs: int) -> None:
        self.jobs = jobs
        self._table = frames.residency.table
        self._rows: list[int] = []
        self._free: queue.SimpleQueue[ThreadMemory] = queue.SimpleQueue()
        self._pool = ThreadPoolExecutor(jobs, thread_name_prefix="batch")
        self.chunk = max(1, min(CHUNK_POSES, CHUNK_POINTS // len(frames.shell)))
        try:
            for _ in range(jobs):
                self._rows.append(self._table.join())
                self._free.put(
                    ThreadMemory(
                        self._rows[-1],
                        frames.clusters._replace(scratch=np.empty_like(frames.clusters.scratch)),
                        np.empty(len(frames.shell), dtype=np.int64),
                        np.zeros((), MISSED),
                        np.empty(CUBES, NEAR_CUBE),  # no memory before `forget` writes to it
                    )
                )
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the threads, and free their rows of the table."""
        self._pool.shutdown()
        for row in self._rows:
            self._table.leave(row)
        self._rows = []

    def forget(self) -> None:
        """Clear the caches of nearest voxels; before the first `run`; no thread may run."""
        for memory in [self._free.get_nowait() for _ in range(self.jobs)]:
            memory.cubes[:] = NOT_KNOWN
            self._free.put(memory)

    def run(self, work: ChunkWork, n_poses: int) -> None:
        """Run `work` on slices of all poses, and return after the last one.

        After an error, or Ctrl-C, no further slice begins, and the running ones end first.
        """
        slices = [slice(at, at + self.chunk) for at in range(0, n_poses, self.chunk)]
        if self.jobs == 1 or len(slices) == 1:
            for one in slices:
                self._do(work, one)
            return
        running = [self._pool.submit(self._do, work, one) for one in slices]
        try:
            for done in running:
                done.result()
        except BaseException:
            for one_more in running:
                one_more.cancel()
            wait(running)
            raise

    def _do(self, work: ChunkWork, one: slice) -> None:
        memory = self._free.get()
        try:
            work(memory, one)
        finally:
            self._free.put(memory)

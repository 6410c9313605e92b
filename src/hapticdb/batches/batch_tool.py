"""BatchTool: a tool with resident cells for batches of poses."""

from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from typing import TYPE_CHECKING, Literal, TypeVar, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.array_types import Bools, Floats, Ints
from hapticdb.batches.batch_results import ClearanceBatch, TouchBatch, TouchedIds
from hapticdb.batches.batch_threads import BatchThreads, ThreadMemory, available_jobs
from hapticdb.batches.order import order_of
from hapticdb.batches.voxel_distances import DEFAULT_REACH, NearestSearch, first_hits_at
from hapticdb.closing import Closes
from hapticdb.cluster.environment_address import EnvironmentAddress
from hapticdb.errors import ConnectionLostError, UsageError
from hapticdb.kernels.force_law import reads_distances
from hapticdb.kernels.records.hand import RESULT
from hapticdb.kernels.resident.cell_frames import evaluate_frames
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.haptic_query import HapticQuery, as_poses
from hapticdb.query.law import ForceLaw
from hapticdb.resident.frames import ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import DEFAULT_BUDGET, CellTable
from hapticdb.store.base import NO_KEYS
from hapticdb.store.filtering import Filter

if TYPE_CHECKING:
    from hapticdb.batches.on_gpu import GpuFrames

PIECE_CHUNKS = 32
"""Chunks of poses, for each thread, in a piece; cells are fetched between pieces."""
PIECE, TASK = 1 << 18, 1 << 16
"""Poses of a long batch in one piece here, 60 MB, and in one task of a worker."""

PoseCallback = Callable[[int, int], None]
"""Called after each piece with the poses done and their total."""
BatchDevice = Literal["cpu", "cuda"]
"""The processors, or a GPU."""
_Answer = TypeVar("_Answer")


class BatchTool(Closes):
    """A tool in an environment, with resident cells from one batch of poses to the next.

    `Environment.batch_tool` makes one, on the environment's connection and for its thread. It is
    also a context manager. Each call reads one committed revision, the newest.

    shell : the tool; law : force law of all touches.
    """

    def __init__(
        self,
        query: HapticQuery,
        shell: PointShell,
        selection: Filter,
        law: ForceLaw,
        budget_bytes: int | None = None,
        jobs: int | None = None,
        device: BatchDevice = "cpu",
    ) -> None:
        if device not in get_args(BatchDevice):
            raise UsageError(f"device {device!r}: choose 'cpu' or 'cuda'")
        n_jobs = available_jobs(jobs)
        self.shell = shell
        self.law = law
        self._store = query.store
        self._selection = selection
        self._is_torn = False
        self._is_closed = False
        self._known_revision: int | None = None
        self._query = query
        self._gpu: GpuFrames | None = None
        has_distances = reads_distances(law.for_kernels)
        budget = DEFAULT_BUDGET if budget_bytes is None else budget_bytes
        self._table = CellTable.create(budget, distances=has_distances)
        try:
            self._residency = Residency(
                query.store, self._table, selection.exclude, where=selection.where
            )
            self._frames = ResidentFrames(self._residency, shell, law)
            self._threads = BatchThreads(self._frames, n_jobs)
            if device == "cuda":
                from hapticdb.batches import on_gpu  # noqa: PLC0415 - loads numba.cuda

                self._gpu = on_gpu.GpuFrames(self._frames)
        except BaseException:
            self._table.close()
            raise
        self._piece = PIECE_CHUNKS * n_jobs * self._threads.chunk

    def __repr__(self) -> str:
        return (
            f"BatchTool({self._store.url!r}, {len(self.shell)} points, "
            f"{self._threads.jobs} threads, {self.n_loaded} cells read)"
        )

    def close(self) -> None:
        """End the threads and free the memory; the environment stays open."""
        if self._is_closed:
            return
        self._is_closed = True
        if self._gpu is not None:
            self._gpu.close()
        self._threads.close()
        self._frames.close()
        self._table.close()

    @property
    def n_loaded(self) -> int:
        """Number of cells read from the database so far, repeated ones included."""
        return self._residency.n_loaded

    @property
    def size_bytes(self) -> int:
        """Size of the memory for cells, bytes: at most the budget."""
        return self._table.size_bytes

    def touch(
        self, poses: ArrayLike, *, objects: bool = False, progress: PoseCallback | None = None
    ) -> TouchBatch:
        """Force and torque at many poses; bit for bit those of `Environment.touch` at each pose.

        A GPU sums the points in another order, and may fuse multiplications with additions; its
        results are reproducible.

        poses (B, 4, 4) : world_from_tool, rigid, metres, in any order; a mapped array is read piece
            by piece
        objects : whether to name the objects of each pose in contact, by the database: many times
            the time of the force
        progress : called after each piece with the poses done and their total

        Raises `UsageError` if the poses have another shape, one is not rigid, or its cells do not
        fit into the budget; `ObjectNotFoundError` if a word of `where` or `exclude` chooses no
        object.
        """
        places = as_poses(poses)
        # a GPU computes in the given order
        center, grid = self.shell.center, self._residency.grid
        order = NO_KEYS if self._gpu is not None else order_of(places, center, grid)
        return self._at_one_revision(lambda: self._touch(places, order, objects, progress))

    def clearance(
        self, poses: ArrayLike, reach: float | None = None, *, progress: PoseCallback | None = None
    ) -> ClearanceBatch:
        """Distance from the shell's points to the nearest occupied voxel at many poses.

        reach : greatest distance of the search, metres; 32 voxels unless given.

        Raises errors as for `touch`; also if the reach is not positive, or needs too many cells.
        """
        size = self._residency.grid.voxel_size
        limit = reach_of(reach, size)
        places = as_poses(poses)
        order = order_of(places, self.shell.center, self._residency.grid)
        search = self._search(limit / size)

        def searched() -> ClearanceBatch:
            found = ClearanceBatch(len(places), float(limit))
            found.revision = self._residency.revision
            if self._known_revision != found.revision:
                self._threads.forget()
                self._known_revision = found.revision
            for chosen in self._pieces(order, progress):
                voxels, points = search.search(places[chosen])
                found.distances[chosen] = np.where(points < 0, np.inf, voxels * size)
                found.points[chosen] = points
            return found

        return self._at_one_revision(searched)

    def collides(self, poses: ArrayLike, *, progress: PoseCallback | None = None) -> Bools:
        """Whether any of the shell's points is in a voxel at many poses, (B,): `touch` has hits.

        The search of a pose ends at the first hit, so it takes less time than the force. Arguments
        and errors are those of `touch`.
        """
        if self._gpu is not None:
            return self.touch(poses, progress=progress).hits > 0
        places = as_poses(poses)
        order = order_of(places, self.shell.center, self._residency.grid)
        search = partial(first_hits_at, self._frames, self._threads)

        def searched() -> Bools:
            collides = np.zeros(len(places), dtype=np.bool_)
            for chosen in self._pieces(order, progress):
                collides[chosen] = self._frames.collides(places[chosen], search)
            return collides

        return self._at_one_revision(searched)

    def _at_one_revision(self, work: Callable[[], _Answer]) -> _Answer:
        """Result of `work` in a snapshot of the newest revision; repeated once after a lost one."""
        try:
            return self._in_snapshot(work)
        except ConnectionLostError:
            return self._in_snapshot(work)

    def _in_snapshot(self, work: Callable[[], _Answer]) -> _Answer:
        if self._is_closed:
            raise UsageError("this batch tool is closed: make another by env.batch_tool")
        if self._is_torn:  # an error or Ctrl-C interrupted the reading of cells
            self._residency.reopened(self._store)
            self._known_revision = None
        self._is_torn = True
        with self._store.snapshot():
            self._residency.refresh()
            if not self._selection.is_empty:
                self._query.known.refresh()
                self._query.known.check_words(self._selection)
            answer = work()
        self._is_torn = False
        return answer

    def _pieces(self, order: Ints, progress: PoseCallback | None) -> Iterator[Ints]:
        """Indices of the poses of each piece, in the order of computation."""
        for start in range(0, len(order), self._piece):
            yield order[start : start + self._piece]
            if progress is not None:
                progress(min(start + self._piece, len(order)), len(order))

    def _touch(
        self,
        places: Floats,
        order: Ints,
        objects: bool,  # noqa: FBT001 - private
        progress: PoseCallback | None,
    ) -> TouchBatch:
        results = TouchBatch(len(places), self.law)
        results.revision = self._residency.revision
        ids: list[list[int]] = [[] for _ in places] if objects else []
        if self._gpu is not None:
            self._gpu.touch(places, results, progress)
            if objects:
                self._name(places, np.arange(len(places)), results, ids)
        for chosen in self._pieces(order, progress):
            out = self._results_at(places[chosen])
            results.forces[chosen], results.torques[chosen] = np.hsplit(out["wrench"], 2)
            results.hits[chosen], results.n_contacts[chosen] = out["hits"], out["contacts"]
            results.deepest[chosen] = out["deepest"]
            if objects:
                self._name(places, chosen, results, ids)
        if objects:
            offsets = np.cumsum([0, *map(len, ids)])
            flat = np.array([one for found in ids for one in found], dtype=np.int64)
            self._query.known.refresh()
            results.named = TouchedIds(offsets, flat, self._query.known.by_id)
        return results

    def _results_at(self, poses: Floats) -> NDArray[np.void]:
        """Results (B,) of RESULT of frames at poses; poses with all cells resident come first."""
        out = np.zeros(len(poses), RESULT)
        self._run(poses, out)
        pending = np.flatnonzero(out["unknown"] > 0.0)
        while len(pending):
            n_poses = self._frames.fetch(poses[pending])
            now, pending = pending[:n_poses], pending[n_poses:]
            results = np.zeros(n_poses, RESULT)
            self._run(poses[now], results)
            out[now] = results
        return out

    def _run(self, poses: Floats, out: NDArray[np.void]) -> None:
        """Frames at poses into out (B,) of RESULT, in all threads."""
        cells, place, law = self._frames.cells, self._residency.cell_grid, self._frames.law

        def work(memory: ThreadMemory, one: slice) -> None:
            evaluate_frames(
                cells, memory.row, memory.clusters, poses[one], place, law, memory.hits,
                memory.missed, out[one],
            )  # fmt: skip

        self._threads.run(work, len(poses))

    def _name(
        self, places: Floats, chosen: Ints, results: TouchBatch, ids: list[list[int]]
    ) -> None:
        """Store the ids of the objects at the chosen poses, as for a touch."""
        touching = chosen[(results.hits[chosen] > 0) | (results.n_contacts[chosen] > 0)]
        exclude = self._residency.exclude
        answers = self._query.run_many(self.shell, places[touching], exclude, self.law)
        for n, answer in zip(touching.tolist(), answers, strict=True):
            ids[n] = answer.ids

    def _search(self, reach: float) -> NearestSearch:
        """Search for the nearest voxels within a reach, voxels."""
        if self._gpu is None:
            return NearestSearch(self._frames, self._threads, reach)
        from hapticdb.batches.on_gpu import GpuNearest  # noqa: PLC0415 - loads numba.cuda

        return GpuNearest(self._frames, self._threads, reach, self._gpu)


def touch_at(
    there: EnvironmentAddress, shell: PointShell, selection: Filter, law: ForceLaw, poses: Floats
) -> TouchBatch:
    """Touch at a piece: the task of a worker, one for each of its threads."""
    with (
        closing(there.open()) as store,
        BatchTool(HapticQuery(store), shell, selection, law, jobs=1) as batch_tool,
    ):
        return batch_tool.touch(poses)


def reach_of(reach: float | None, voxel_size: float) -> float:
    """Greatest distance of the search, metres; UsageError unless above 0."""
    limit = DEFAULT_REACH * voxel_size if reach is None else reach
    if not (np.isfinite(limit) and limit > 0.0):
        raise UsageError(f"clearance up to {limit} m: give a finite length above 0")
    return float(limit)

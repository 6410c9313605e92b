"""Proximity queries of a session's coupling on a GPU, called by the kernel of its periods."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import config, cuda
from numpy.typing import NDArray

from hapticdb.batches.on_gpu import check_gpu
from hapticdb.errors import HapticDBError, UsageError
from hapticdb.kernels.gpu import proximity_queries as kernels
from hapticdb.kernels.hand.calling import FUNCTION, address_of
from hapticdb.kernels.hand.near_points import (
    FAR,
    FLOOR,
    LEAST_BOUND,
    MOST_MERGED,
    NEVER,
    NOT_KNOWN,
    OPEN,
    POINTS_ANEW,
    SHUT,
)
from hapticdb.kernels.records.cells import MOST_MISSED
from hapticdb.kernels.records.hand import QUERY
from hapticdb.kernels.records.layout import views_of
from hapticdb.kernels.resident.cells import CellGrid
from hapticdb.query.law import DISTANCE
from hapticdb.resident.mirror import CellMirror
from hapticdb.resident.table import CellTable
from hapticdb.session.states import SessionState

ROOM = 1 << 17, 8
"""Room for near points at first: so many, or all of a smaller tool's, or this part of a larger
tool's, at 0.2 kB each. More make new room, in a late frame."""
NOBODY = 1 << 62
"""In the place of a point's number: none."""
NOTHING = np.array([0.0, 0.0, 0.0, NEVER])
"""Result of a query at first."""
MERGES_FROM = 4096
"""Most near points before contacts are merged: the processor solves for them, 34 ms a period with
57,600 of them, 1.3 ms merged. Larger: broad contacts are resolved point by point."""
USED_EVERY = 16
"""Queries between two copies of the read cells to the table. Larger: less copying; a cell may be
evicted sooner after its last use."""


def check_frames(frames_on: str, rendering: str) -> None:
    """Raise unless frames can be computed there."""
    if frames_on != "cuda":
        raise UsageError(f"frames on {frames_on!r}: choose 'cpu' or 'cuda'")
    if rendering != "coupled":
        raise UsageError("frames on 'cuda' are of the rendering coupled, and this one is direct")
    check_gpu()


class _Repeated:
    """Launches and copies of a stream, repeated with their present arguments.

    A launch by numba reads its arguments in Python, a third of a millisecond for twenty arrays; a
    CUDA graph has read them. numba's simulator has no graphs.
    """

    def __init__(self, stream: Any, work: Callable[[], None]) -> None:  # noqa: ANN401 - numba's
        self._stream, self._work = stream, work
        self._graph: Any = None
        if config.ENABLE_CUDASIM:
            return
        from cuda.bindings import driver  # noqa: PLC0415 - of the extra, on a machine with a GPU

        self._driver = driver
        mode = driver.CUstreamCaptureMode.CU_STREAM_CAPTURE_MODE_RELAXED
        self._checked(driver.cuStreamBeginCapture(int(stream), mode))
        work()
        graph = self._checked(driver.cuStreamEndCapture(int(stream)))
        self._graph = self._checked(driver.cuGraphInstantiate(graph, 0))

    def __call__(self) -> None:
        """Begin them once more."""
        if self._graph is None:
            self._work()
        else:
            self._checked(self._driver.cuGraphLaunch(self._graph, int(self._stream)))

    @staticmethod
    def _checked(answer: tuple[Any, ...]) -> Any:  # noqa: ANN401 - the driver's
        if int(answer[0]):
            raise HapticDBError(f"the driver says {answer[0]}")
        return answer[-1]


class GpuQueries:
    """Proximity queries of one coupling on the GPU: same near points, in the same order.

    state : of a tool whose periods this process runs, with cells of `table`; from now on the GPU
    answers its queries. card : name of the GPU.
    """

    def __init__(self, state: SessionState, table: CellTable) -> None:
        check_gpu()
        name = getattr(cuda.current_context().device, "name", "simulated")
        self.card = name.decode() if isinstance(name, bytes) else str(name)
        self._state, self._table = state, table
        self._follower = views_of(state.follower)
        self._tried = state.servo["tool"]["tried_pose"]
        self._place = CellGrid(*state.slot["place"].tolist())
        self._mirror = CellMirror(table, DISTANCE.for_kernels, side=None)
        self._n_queries, self._epoch = 0, 0
        self._error: BaseException | None = None
        self._stream = cuda.stream()
        self._nothing = cuda.to_device(NOTHING)
        self._found: NDArray[np.float64] = cuda.pinned_array(kernels.FOUND, np.float64)
        self._query: NDArray[np.void] = cuda.pinned_array(1, QUERY)
        self._view = self._view_of(state)
        n_runs = self._view.run_due.size
        self._of_runs = min(-(-n_runs // kernels.THREADS_OF_RUNS), kernels.MOST_BLOCKS)
        self._of_points = min(n_runs, kernels.MOST_BLOCKS)
        self._kernel = kernels.query_runs(kernels.THREADS)
        self._query[:] = np.zeros((), QUERY)
        self._query["number"], self._query["run"] = -1, 1
        self._launch_query()  # compiles them; no run is due yet
        self._launch_put_back()
        self._stream.synchronize()
        self._repeat()
        # held in the object: the kernel has the bare address alone
        self._called = FUNCTION(self._answer)
        state.follower["gpu_query"] = address_of(self._called)

    def _view_of(self, state: SessionState) -> kernels.DeviceView:
        """Memory of the GPU for a tool."""
        clusters, table = state.clusters, self._table
        n_points = len(clusters.points)
        n_runs = -(-n_points // clusters.run)
        room = min(n_points, max(ROOM[0], n_points // ROOM[1]))
        points = np.empty((3, n_points + 1))
        points[:, :-1], points[:, -1] = clusters.columns, clusters.center
        return kernels.DeviceView(
            points=cuda.to_device(points),
            spheres=cuda.to_device(clusters.spheres if len(clusters.spheres) else np.zeros((1, 4))),
            due=cuda.device_array(n_points, np.float64),
            run_due=cuda.to_device(np.full(n_runs, NEVER)),
            due_before=cuda.device_array(n_points, np.float64),
            run_due_before=cuda.device_array(n_runs, np.float64),
            epochs=cuda.to_device(np.full(n_runs, -1)),
            seen=cuda.to_device(np.zeros(n_runs, np.int64)),
            due_runs=cuda.device_array(n_runs, np.int64),
            query=cuda.device_array(1, QUERY),
            used=cuda.to_device(np.zeros(table.n_slots, np.uint8)),
            missed=cuda.to_device(np.full(kernels.ROOM_FOR_MISSED, -1)),
            found=cuda.to_device(NOTHING),
            points_near=cuda.mapped_array(room, np.int64),
            near=cuda.mapped_array((kernels.NEAR_NUMBERS, room), np.float64),
        )

    def check(self) -> None:
        """Raise an error or a signal during a query of the last period."""
        if isinstance(self._error, Exception):
            raise HapticDBError(f"the GPU has failed: {self._error}") from self._error
        if self._error is not None:
            raise self._error

    def _answer(self) -> int:
        """Answer a query; after an error the tool stays until `check`."""
        try:
            return self._query_near_points()
        except BaseException as error:  # noqa: BLE001 - no kernel can take it
            self._error = error
            return NOT_KNOWN

    def _query_near_points(self) -> int:
        """Near points at the tried pose, as `query_proximity` -> OPEN, SHUT or NOT_KNOWN."""
        follower, state = self._follower, self._state
        # the version of this frame, not the newest: tool and cells must be of one revision
        self._mirror.update(int(state.cells.readers["version"][state.reader]))
        self._mirror.seen()  # in the arrays that the launches read
        if self._n_queries % USED_EVERY == 0:
            self._mark_used()
        self._epoch += int(follower.anew) == POINTS_ANEW
        most, half = int(follower.merges_from), 1 - int(follower.side)
        near, bends = state.near_points[half], state.bends[half]
        while True:
            n_due, n_near, n_unknown, least = self._query_once().tolist()
            n, numbers = int(n_near), self._view.points_near
            # the query's writes go back first: a repeat must find the due times of before
            if n > numbers.size:
                self._put_back(-1, n_due)
                self._make_room(n)
                continue
            numbers = np.array(numbers[:n])
            shut = self._first_shut(numbers)
            if not (0 < most < n and follower.merged < MOST_MERGED):
                break
            # a forbidden point before the limit decides; then no merge is needed
            last = int(np.partition(numbers, most)[most])
            if shut < last:
                break
            self._put_back(last, n_due)
            follower.merged[()] *= 2
        # points beyond the first forbidden one keep their state, as if never queried
        if shut < NOBODY:
            self._put_back(shut, n_due)
            return SHUT
        # blocks append in any order: sorted, so the sums round alike in each run
        order = np.argsort(numbers)
        rows, first = self._view.near[:, order].T, kernels.CURVATURE
        near["point"][:n], near["is_hollow"][:n] = numbers[order], rows[:, first] > 0.0
        near.view(np.float64).reshape(len(near), -1)[:n, -first:] = rows[:, :first]
        bends.view(np.float64).reshape(len(bends), -1)[:n] = rows[:, first:]
        follower.n_tried[()], follower.n_unknown[()] = n, n_unknown
        follower.tried_clearance[()] = least - float(follower.travelled) + FAR
        self._list_missed(int(n_unknown))
        return NOT_KNOWN if n_unknown else OPEN

    def _first_shut(self, numbers: NDArray[np.int64]) -> int:
        """First forbidden near point; NOBODY without one."""
        if not self._follower.is_advancing:
            return NOBODY
        before = self._state.kept[numbers]
        u, bound = np.array(self._view.near[:2, : len(numbers)])
        is_shut = (u < FLOOR) & (u <= before["u"])
        is_shut |= (bound < LEAST_BOUND) & (bound <= before["bound"])
        return int(numbers[is_shut].min(initial=NOBODY))

    def _query_once(self) -> NDArray[np.float64]:
        """One query at the tried pose -> its result (FOUND,)."""
        follower = self._follower
        self._n_queries += 1
        self._query[0] = (
            self._n_queries, self._epoch, self._state.clusters.run, follower.is_large,
            follower.anew > 0, follower.is_bent, follower.merged, follower.travelled, follower.way,
            self._tried[:3], -1, 0,
        )  # fmt: skip
        follower.anew[()] = 0
        self._begin_query()
        self._stream.synchronize()
        return self._found

    def _put_back(self, last: int, n_due: float) -> None:
        """Undo the writes of a query beyond a point; a later launch waits for it."""
        self._query["last"], self._query["n_due"] = last, n_due
        self._begin_put_back()
        self._stream.synchronize()

    def _launch_query(self) -> None:
        """Launches and copies of a query."""
        place, stream, view = self._place, self._stream, self._view
        seen = self._mirror.seen()._replace(used=view.used)
        view.query.copy_to_device(self._query, stream=stream)
        kernels.list_due_runs[self._of_runs, kernels.THREADS_OF_RUNS, stream](place, seen, view)
        self._kernel[self._of_points, kernels.THREADS, stream](
            place, seen, self._mirror.arrays[-1], view
        )
        view.found.copy_to_host(self._found, stream=stream)
        # in this launch: the next query finds cleared sums without another copy
        view.found.copy_to_device(self._nothing, stream=stream)

    def _launch_put_back(self) -> None:
        """Launch and copy of an undo."""
        self._view.query.copy_to_device(self._query, stream=self._stream)
        kernels.put_back[self._of_runs, kernels.THREADS_OF_RUNS, self._stream](self._view)

    def _repeat(self) -> None:
        """Take both with their present arrays."""
        self._begin_query = _Repeated(self._stream, self._launch_query)
        self._begin_put_back = _Repeated(self._stream, self._launch_put_back)

    def _make_room(self, n: int) -> None:
        """Make room for n near points."""
        room = 1 << (n - 1).bit_length()
        # new arrays have other addresses: the recorded launches are taken again
        self._view = self._view._replace(
            points_near=cuda.mapped_array(room, np.int64),
            near=cuda.mapped_array((kernels.NEAR_NUMBERS, room), np.float64),
        )
        self._repeat()

    def _list_missed(self, n_unknown: int) -> None:
        """List the query's unknown cells, for the prefetch process."""
        missed, keys = self._state.missed, self._view.missed
        missed["n_cells"] = 0
        if n_unknown:
            found = keys.copy_to_host()
            keys.copy_to_device(np.full(kernels.ROOM_FOR_MISSED, -1))
            found = np.sort(found[found >= 0])[:MOST_MISSED]
            missed["n_cells"], missed["cells"][: len(found)] = len(found), found

    def _mark_used(self) -> None:
        """Mark the read cells in the table, so others are evicted."""
        used = self._view.used
        found = used.copy_to_host()
        self._table.cells.used[found > 0] = 1
        used.copy_to_device(np.zeros_like(found))

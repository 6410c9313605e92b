"""Looks of a session's coupling on a graphics processor, which the kernel of its periods calls."""

import ctypes

import numpy as np
from numba import cuda
from numpy.typing import NDArray

from hapticdb.batches.on_gpu import check_gpu
from hapticdb.errors import HapticDBError, UsageError
from hapticdb.kernels.gpu import looks as kernels
from hapticdb.kernels.hand.calling import FUNCTION
from hapticdb.kernels.hand.near_points import (
    BOUND,
    FAR,
    FLOOR,
    LAST_BOUND,
    LAST_U,
    LEAST_BOUND,
    MOST_MERGED,
    NEAR,
    NEAR_POINTS,
    NEAR_ROWS,
    NEVER,
    NOT_KNOWN,
    OPEN,
    POINTS_ANEW,
    SHUT,
    U,
)
from hapticdb.kernels.records import MOST_MISSED, views_of
from hapticdb.kernels.resident.cells import LISTED, READER_STRIDE, Place, Seen
from hapticdb.query.law import SMOOTH, ForceLaw, is_smooth
from hapticdb.realtime.stations import Station
from hapticdb.resident.mirror import CellMirror
from hapticdb.resident.table import CellTable

ROOM = 1 << 14
"""Near points for which the GPU has room at first; it doubles where there are more."""
USED_EVERY = 16
"""Looks after which the table learns which cells were read. Larger: less copying; a cell may be
evicted sooner after it was read."""


def check_frames(frames_on: str, law: ForceLaw | None, budget_points: int | None) -> None:
    """Refuse a session whose frames cannot be computed there."""
    if frames_on != "cuda":
        raise UsageError(f"frames on {frames_on!r}: choose 'cpu' or 'cuda'")
    if law is not None and not is_smooth(law):
        raise UsageError("frames on 'cuda' are of the smooth law, and the law here is the plane")
    if budget_points is not None:
        raise UsageError("a budget of points is for frames on 'cpu': a GPU looks at all points")
    check_gpu()


class GpuLooks:
    """The looks of a station's coupling on the GPU: same near points, in the same order.

    Parameters
    ----------
    station : Station
        Of a tool whose periods this process runs; from now on the GPU looks for it.
    table : CellTable
        Where the station reads its cells.

    Attributes
    ----------
    card : str
        Name of the GPU.
    """

    def __init__(self, station: Station, table: CellTable) -> None:
        check_gpu()
        name = getattr(cuda.current_context().device, "name", "simulated")
        self.card = name.decode() if isinstance(name, bytes) else str(name)
        self._station, self._table = station, table
        self._follower = views_of(station.follower)
        self._tried = station.servo["tool"]["tried_pose"]
        self._place = Place(*station.record["place"].tolist())
        self._mirror = CellMirror(table, SMOOTH.for_kernels, side=None)
        self._n_looks, self._epoch = 0, 0
        self._error: BaseException | None = None
        self._stream = cuda.stream()
        self._nothing = np.array([0.0, 0.0, 0.0, NEVER])
        self._found: NDArray[np.float64] = cuda.pinned_array(kernels.FOUND, np.float64)
        self._sight = self._sight_of(station)
        n_runs = self._sight.run_due.size
        self._of_runs = min(-(-n_runs // kernels.THREADS_OF_RUNS), kernels.MOST_BLOCKS)
        self._of_points = min(n_runs, kernels.MOST_BLOCKS)
        self._kernel = kernels.look_at_runs(kernels.THREADS)
        self._put_back(-1, 0, self._asked())  # compiles it
        self._called = FUNCTION(self._answer)  # kept as long as its address is used
        station.follower["looker"] = ctypes.cast(self._called, ctypes.c_void_p).value

    def _sight_of(self, station: Station) -> kernels.Sight:
        """Memory of the GPU for a tool."""
        clusters, table = station.clusters, self._table
        n_points = len(clusters.points)
        n_runs = -(-n_points // clusters.run)
        points = np.empty((3, n_points + 1))
        points[:, :-1], points[:, -1] = clusters.columns, clusters.center
        return kernels.Sight(
            points=cuda.to_device(points),
            spheres=cuda.to_device(clusters.spheres if len(clusters.spheres) else np.zeros((1, 4))),
            due=cuda.device_array(n_points, np.float64),
            run_due=cuda.device_array(n_runs, np.float64),
            due_before=cuda.device_array(n_points, np.float64),
            run_due_before=cuda.device_array(n_runs, np.float64),
            epochs=cuda.to_device(np.full(n_runs, -1)),
            seen=cuda.to_device(np.zeros(n_runs, np.int64)),
            due_runs=cuda.device_array(n_runs, np.int64),
            used=cuda.to_device(np.zeros(table.n_slots, np.uint8)),
            missed=cuda.to_device(np.full(kernels.ROOM_FOR_MISSED, -1)),
            found=cuda.to_device(self._nothing),
            numbers=cuda.mapped_array(ROOM, np.int64),
            rows=cuda.mapped_array((NEAR_ROWS, ROOM), np.float64),
        )

    def check(self) -> None:
        """Raise what went wrong in a look of the last period, or a signal that came in one."""
        if isinstance(self._error, Exception):
            raise HapticDBError(f"the GPU has failed: {self._error}") from self._error
        if self._error is not None:
            raise self._error

    def _answer(self) -> int:
        """Do what a look asks for; an error leaves the tool held until `check`."""
        try:
            return self._looked()
        except BaseException as error:  # noqa: BLE001 - no kernel can take it
            self._error = error
            return NOT_KNOWN

    def _looked(self) -> int:
        """Look at the tried pose, as `near_points.look` -> OPEN, SHUT or NOT_KNOWN."""
        follower, station = self._follower, self._station
        self._mirror.update(int(station.cells.readers[station.reader * READER_STRIDE]))
        if self._n_looks % USED_EVERY == 0:
            self._tell_used()
        self._epoch += int(follower.anew) == POINTS_ANEW
        most, half, field = int(follower.merges_from), 1 - int(follower.side), station.field
        while True:
            asked = self._asked()
            n_due, n_near, n_unknown, least = self._launch(asked).tolist()
            n = int(n_near)
            if n > self._sight.numbers.size:
                self._put_back(-1, int(n_due), asked)
                self._make_room(n)
                continue
            numbers = np.array(self._sight.numbers[:n])
            order = np.argsort(numbers)
            numbers, rows = numbers[order], np.array(self._sight.rows[:, :n])[:, order]
            shut = self._first_shut(numbers, rows)
            if not (0 < most < min(n, shut) and follower.merged < MOST_MERGED):
                break
            self._put_back(int(numbers[most]), int(n_due), asked)
            follower.merged[()] *= 2
        if shut < n:
            self._put_back(int(numbers[shut]), int(n_due), asked)
            return SHUT
        field[NEAR + half * NEAR_ROWS : NEAR + (half + 1) * NEAR_ROWS, :n] = rows
        station.met[NEAR_POINTS + half, :n] = numbers
        follower.n_tried[()], follower.n_unknown[()] = n, n_unknown
        follower.tried_clearance[()] = least - asked.travelled + FAR
        self._tell_missed(int(n_unknown))
        return NOT_KNOWN if n_unknown else OPEN

    def _first_shut(self, numbers: NDArray[np.int64], rows: NDArray[np.float64]) -> int:
        """First of the near points that may not be there; their number if all may."""
        if not self._follower.is_walking:
            return len(numbers)
        field, u, bound = self._station.field, rows[U], rows[BOUND]
        is_shut = (u < FLOOR) & (u <= field[LAST_U, numbers])
        is_shut |= (bound < LEAST_BOUND) & (bound <= field[LAST_BOUND, numbers])
        return int(is_shut.argmax()) if is_shut.any() else len(numbers)

    def _asked(self) -> kernels.Look:
        """Numbers of one look; what it forgets is forgotten then."""
        follower = self._follower
        is_anew, self._n_looks = int(follower.anew) > 0, self._n_looks + 1
        follower.anew[()] = 0
        return kernels.Look(
            number=self._n_looks,
            epoch=self._epoch,
            run=int(self._station.clusters.run),
            is_large=bool(follower.is_large),
            is_anew=is_anew,
            is_bent=bool(follower.is_bent),
            travelled=float(follower.travelled),
            way=float(follower.way),
            merged=int(follower.merged),
        )

    def _launch(self, asked: kernels.Look) -> NDArray[np.float64]:
        """Both launches of a look -> what they found (FOUND,)."""
        keys, slots, masks, _ = self._mirror.directory()
        transform = tuple(self._tried[:3].ravel().tolist())
        place, stream, sight = self._place, self._stream, self._sight
        seen = Seen(keys, slots, self._mirror.arrays[2], masks, sight.used, 0)
        kernels.list_due_runs[self._of_runs, kernels.THREADS_OF_RUNS, stream](
            place, transform, asked, seen, sight
        )
        self._kernel[self._of_points, kernels.THREADS, stream](
            place, transform, asked, seen, self._mirror.arrays[-1], sight
        )
        sight.found.copy_to_host(self._found, stream=stream)
        sight.found.copy_to_device(self._nothing, stream=stream)
        stream.synchronize()
        return self._found

    def _put_back(self, last: int, n_due: int, asked: kernels.Look) -> None:
        """Put back what a look wrote beyond a point; a later launch waits for it."""
        kernels.put_back[self._of_runs, kernels.THREADS_OF_RUNS, self._stream](
            last, n_due, asked, self._sight
        )

    def _make_room(self, n: int) -> None:
        """Make room for n near points."""
        self._stream.synchronize()
        room = 1 << (n - 1).bit_length()
        self._sight = self._sight._replace(
            numbers=cuda.mapped_array(room, np.int64),
            rows=cuda.mapped_array((NEAR_ROWS, room), np.float64),
        )

    def _tell_missed(self, n_unknown: int) -> None:
        """List the unknown cells that the look met, for the fetching process."""
        missed, keys = self._station.missed, self._sight.missed
        missed[LISTED] = 0
        if n_unknown:
            found = keys.copy_to_host()
            keys.copy_to_device(np.full(kernels.ROOM_FOR_MISSED, -1))
            found = np.sort(found[found >= 0])[:MOST_MISSED]
            missed[LISTED] = len(found)
            missed[LISTED + 1 : LISTED + 1 + len(found)] = found

    def _tell_used(self) -> None:
        """Mark the cells that were read in the table, which evicts others."""
        used = self._sight.used
        found = used.copy_to_host()
        self._table.cells.used[found > 0] = 1
        used.copy_to_device(np.zeros_like(found))

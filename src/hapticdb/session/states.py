"""States of sessions in the form of their kernel, and the clock of their periods."""

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import HapticDBError
from hapticdb.grid import Grid
from hapticdb.kernels.hand.calling import address_of_kernel
from hapticdb.kernels.hand.device_spring import DeviceSpring
from hapticdb.kernels.period import loop
from hapticdb.kernels.period.following import USUAL_GAP_NS
from hapticdb.kernels.records.cells import MISSED
from hapticdb.kernels.records.hand import BENDS, FRAME, NEAR, POINT, RESULT
from hapticdb.kernels.records.layout import pose_numbers
from hapticdb.kernels.records.session import LOOP_CLOCK, SLOT
from hapticdb.kernels.resident.cells import CellGrid, Cells, Clusters
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.law import ForceLaw, reads_distances
from hapticdb.recording.frame import Frames
from hapticdb.recording.header import Start
from hapticdb.resident.point_runs import clusters_of
from hapticdb.resident.table import CellTable
from hapticdb.session.coupling import DirectRendering, Rendering, rendering_of

LARGE_FROM = 4096
"""Least number of points for which the quasi-static coupling tests spheres of runs before their
points. The results are the same: a larger value only costs time."""
STALENESS_NS = 1_000_000_000
"""Longest silence (ns) of the database before all cells count as unknown for hosted hands."""
LEAVE_TIMEOUT = 5.0
"""Seconds until the loop must have left an ending session; normally one period."""
FOREVER = 1e9
"""Seconds for "no limit": thirty years."""

Record = NDArray[np.void]


@dataclass(frozen=True)
class SlotRequest:
    """Session for a worker process.

    slot, reader : its rows of the shared table and of the table of cells; grid : of the cells;
    shell : the tool, without triangles; coupling : between hand and tool.
    """

    slot: int
    reader: int
    grid: Grid
    shell: PointShell
    coupling: DirectRendering


class SessionState:
    """State of one session in its process: its slot, and the arrays at the slot's addresses.

    slot () : of `SLOT`, zero but for the fields of owner and client; cells, reader : of the
    session; request () : its row of the request queue; grid : of the cells; clusters : the tool.
    """

    def __init__(
        self,
        slot: Record,
        cells: Cells,
        reader: int,
        request: Record,
        grid: Grid,
        clusters: Clusters,
    ) -> None:
        self.slot, self.cells, self.reader, self.request = slot, cells, reader, request
        self.servo, self.follower = slot["servo"], slot["follower"]
        self.clusters, n_points = clusters, len(clusters.points)
        self.kept = np.zeros(n_points, POINT)
        self.near_points, self.bends = np.zeros((2, n_points), NEAR), np.zeros((2, n_points), BENDS)
        self.missed = np.zeros((), MISSED)
        # held here: the slot has bare addresses, and the collector does not see them
        self._arrays = {
            name: np.ascontiguousarray(array)
            for name, array in clusters._asdict().items()
            if name != "run"
        } | {
            "pose": np.eye(4), "felt": np.zeros((), RESULT), "missed": self.missed,
            "met": np.zeros(n_points, np.int64), "kept": self.kept,
            "near_points": self.near_points, "bends": self.bends,
        }  # fmt: skip
        for name, arrays in (("arrays", self._arrays), ("cells", cells._asdict())):
            for field, array in arrays.items():
                # address 0 stands for a missing array: cells without distances
                slot[name][field] = 0 if array is None else array.ctypes.data
        for field, value in (
            ("reader", reader), ("request", request.ctypes.data), ("staleness", STALENESS_NS),
            ("place", CellGrid(*grid.origin, grid.voxel_size, float(grid.side))),
            ("bits", grid.bits), ("curve", grid.curve_code), ("n_readers", len(cells.readers)),
            ("n_slots", len(cells.used)), ("capacity", cells.keys.shape[1]),
            ("n_points", n_points), ("n_spheres", len(clusters.spheres)),
            ("n_groups", len(clusters.groups)), ("run", clusters.run),
        ):  # fmt: skip
            slot[field] = value
        self.follower["is_large"] = n_points >= LARGE_FROM

    def set_spring(self, spring: DeviceSpring) -> None:
        """Replace the coupling; periods take the new one whole."""
        # double buffer: the index is written last, so no period reads half of a spring
        which = 1 - int(self.slot["spring"])
        self.slot["springs"][which] = spring
        self.slot["spring"] = which

    def rest_at(self, pose: NDArray[np.float64]) -> None:
        """Put hand and tool at a pose (7,), at rest."""
        tool, hand = self.servo["tool"], self.servo["hand"]
        tool[()] = np.zeros((), tool.dtype)
        pose_numbers(tool)[:] = pose_numbers(hand)[:] = pose

    def save(self) -> Start:
        """All that the next period depends on, except cells and hand."""
        tool = self.servo["tool"]
        of_points = (self.kept, self.near_points, self.bends) if tool["version"] else ()
        parts = (self.servo, self.follower, *of_points)
        return Start(*(part.tobytes() for part in parts))

    def restore(self, saved: Start) -> None:
        """Continue from a result of `save`, for the same tool and build."""
        # an address of this process must not come back from a saved one
        gpu_query, parts = (
            self.follower["gpu_query"].copy(),
            (self.servo, self.follower, self.kept, self.near_points, self.bends),
        )
        for part, content in zip(parts, saved, strict=True):
            if content:
                part[...] = np.frombuffer(content, part.dtype).reshape(part.shape)
        self.follower["gpu_query"] = gpu_query

    def arrive_at(self, pose: NDArray[np.float64]) -> None:
        """Take the hand from the slot's client; its first pose is (7,)."""
        segment = self.slot["segment"]
        segment["start"], segment["end"], segment["seconds"] = pose, pose, 1e-9
        self.slot["source"], self.slot["gap"] = loop.HOSTED, USUAL_GAP_NS


class PeriodClock:
    """Clock of all sessions of a process: runs their periods (`kernels.period.loop`).

    law, rendering : of all sessions; slots, rings : of the shared table, or of one session alone;
    worker : number of the process among those of the table.
    """

    def __init__(
        self,
        law: ForceLaw,
        slots: Record | None = None,
        rings: Frames | None = None,
        rendering: Rendering | None = None,
        worker: int = 1,
    ) -> None:
        self.law, self.rendering, self.worker = law, rendering_of(rendering, law), worker
        self.slots = np.zeros(1, SLOT) if slots is None else slots
        rings = np.zeros((1, 1), FRAME) if rings is None else rings
        self._record = record = np.zeros((), LOOP_CLOCK)
        is_coupled = self.rendering == "coupled"
        mover = loop.move_by_coupling if is_coupled else loop.move_directly
        record["worker"], record["mover"] = worker, address_of_kernel(mover, loop.MOVER)
        if not is_coupled:
            record["batch_tool"], record["law"], self._law = loop.feeler_of(law.for_kernels)
        self._arguments = (self.slots, rings, record)
        self._times = record["due"], record["begun"], record["dt"]

    def add(self, request: SlotRequest, table: CellTable) -> SessionState:
        """Make the state of a session; its periods run from `enter` on."""
        cells = table.cells if reads_distances(self.law) else table.cells.without_distances()
        state = SessionState(
            self.slots[request.slot, ...], cells, request.reader,
            table.queue.requests[request.reader, ...], request.grid,
            clusters_of(request.shell, request.grid.voxel_size),
        )  # fmt: skip
        state.set_spring(request.coupling.spring())
        return state

    def enter(self, state: SessionState) -> None:
        """Run the periods of a session."""
        # the slot must be complete: a running loop reads it from here on
        state.slot["worker"] = self.worker

    def leave(self, state: SessionState) -> None:
        """Run no more periods of a session; the loop of another thread leaves it within two."""
        state.slot["worker"] = 0
        periods = self._record["periods"]
        # two periods: the one under way may have read the field before the write above
        last, until = int(periods) + 2, time.monotonic() + LEAVE_TIMEOUT
        while int(periods) < last:
            if time.monotonic() > until:
                raise HapticDBError("a worker's loop hangs: end the host")
            time.sleep(0.5e-9 * float(self._record["period"]))

    def run(self, rate: float, seconds: float = FOREVER) -> float:
        """Run periods at a rate until `stop` or for so long -> their time, s.

        A long period misses the deadlines within it; the next one is due at the next deadline of
        the grid. The interpreter lock is free meanwhile.
        """
        begun, record = time.monotonic_ns(), self._record
        own = self.slots["worker"] == self.worker
        # sessions that waited for the loop have their first period from now on
        self.slots["began"][own] = self.slots["last"][own] = begun
        record["period"], record["most"] = round(1e9 / rate), max(round(seconds * rate), 1)
        record["due"] = begun + record["period"]
        loop.run(*self._arguments)
        return 1e-9 * (time.monotonic_ns() - begun)

    def step(self, dt: float, begun: int) -> None:
        """Run one period, begun at a time in ns, `dt` s after the last one."""
        times = self._times
        times[0][()], times[1][()], times[2][()] = begun, begun, dt
        loop.run(*self._arguments)

    def stop(self) -> None:
        """End `run` after its period."""
        self._record["is_over"] = 1

"""States of sessions in the form of their kernel, and the clock of their periods."""

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticdb.grid import Grid
from hapticdb.kernels.hand.calling import address_of_kernel
from hapticdb.kernels.hand.device_spring import DeviceSpring
from hapticdb.kernels.period import loop
from hapticdb.kernels.period.following import USUAL_GAP_NS
from hapticdb.kernels.records import (
    BENDS,
    FRAME,
    MOST_MISSED,
    NEAR,
    PACE,
    POINT,
    RESULTS,
    SEAT,
    STATION,
    pose_numbers,
)
from hapticdb.kernels.resident.cells import READER_STRIDE, Cells, Clusters, Place
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.law import ForceLaw, reads_distances
from hapticdb.recording.frame import Frames
from hapticdb.recording.header import Start
from hapticdb.resident.held import clusters_of
from hapticdb.resident.table import HEARTBEAT, CellTable
from hapticdb.session.coupling import DirectRendering, Rendering, rendering_of

LARGE_FROM = 4096
"""Least number of points for which the quasi-static coupling tests spheres of runs before their
points. The results are the same: a larger value only costs time."""
STALENESS_NS = 1_000_000_000
"""Longest silence (ns) of the database before all cells count as unknown for hosted hands."""
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
    """One session: its row of STATION, and the memory at the row's addresses.

    Parameters
    ----------
    row : array
        (1,) of STATION.
    cells, reader : Cells, int
        Cells of the session, and its row there.
    session : array
        (1,) of SESSION: its row on the request queue.
    grid : Grid
        Grid of the cells.
    clusters : Clusters
        The tool.
    """

    def __init__(
        self,
        row: Record,
        cells: Cells,
        reader: int,
        session: Record,
        grid: Grid,
        clusters: Clusters,
    ) -> None:
        row[:] = np.zeros((), STATION)
        self.row, self.cells, self.reader, self.session = row, cells, reader, session
        self.record = row[0, ...]
        self.servo, self.follower = self.record["servo"], self.record["follower"]
        self.clusters, n_points = clusters, len(clusters.points)
        self.place = Place(*grid.origin, grid.voxel_size, float(grid.side))
        self.kept = np.zeros(n_points, POINT)
        self.near_points, self.bends = np.zeros((2, n_points), NEAR), np.zeros((2, n_points), BENDS)
        self.met = np.zeros(n_points, dtype=np.int64)
        self.pose, self.felt = np.eye(4), np.zeros(RESULTS)
        self.missed = np.zeros(1 + MOST_MISSED, dtype=np.int64)
        row["reader"], row["session"] = reader, session.ctypes.data
        row["place"], row["bits"], row["curve"] = self.place, grid.bits, grid.curve_code
        row["staleness"] = STALENESS_NS
        self._write_cells()
        self._write_tool()

    def _write_cells(self) -> None:
        """Write the addresses of the table's arrays."""
        row, cells = self.row, self.cells
        for name, array in cells._asdict().items():
            row[name] = 0 if array is None else array.ctypes.data
        row["n_control"], row["heartbeat"] = len(cells.control), HEARTBEAT
        row["n_readers"] = len(cells.readers) // READER_STRIDE
        row["n_slots"], row["capacity"] = len(cells.used), cells.keys.shape[1]

    def _write_tool(self) -> None:
        """Write the addresses of the tool's arrays."""
        row, clusters = self.row, self.clusters
        self._arrays = {
            name: np.ascontiguousarray(getattr(clusters, name))
            for name in ("points", "center", "spheres", "groups", "columns", "scratch")
        }
        for name in ("met", "kept", "near_points", "bends", "pose", "felt", "missed"):
            self._arrays[name] = getattr(self, name)
        for name, array in self._arrays.items():
            row[name] = array.ctypes.data
        n_points = len(clusters.points)
        row["n_points"], row["run"] = n_points, clusters.run
        row["n_spheres"], row["n_groups"] = len(clusters.spheres), len(clusters.groups)
        self.follower["is_large"] = n_points >= LARGE_FROM

    def set_spring(self, spring: DeviceSpring) -> None:
        """Replace the coupling; periods take the new one whole."""
        which = 1 - int(self.row["coupling"][0])
        self.row["springs"][:, which] = spring
        self.row["coupling"] = which

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
        looker, parts = (
            self.follower["looker"].copy(),
            (self.servo, self.follower, self.kept, self.near_points, self.bends),
        )
        for part, content in zip(parts, saved, strict=True):
            if content:
                part[...] = np.frombuffer(content, part.dtype).reshape(part.shape)
        self.follower["looker"] = looker

    def arrive_at(self, pose: NDArray[np.float64]) -> None:
        """Take the hand from the shared table; its first pose is (7,)."""
        way = self.record["way"]
        way["start"], way["end"], way["seconds"] = pose, pose, 1e-9
        self.row["source"], self.row["gap"] = loop.BOARD, USUAL_GAP_NS


class PeriodClock:
    """Clock of all sessions of a process: runs their periods (`kernels.period.loop`).

    law : of all sessions; slots, rings : of the shared table, with a state for each slot; unless
    given, of one session alone; rendering : as of `rendering_of`.
    """

    def __init__(
        self,
        law: ForceLaw,
        slots: Record | None = None,
        rings: Frames | None = None,
        rendering: Rendering | None = None,
    ) -> None:
        self.law, self.rendering = law, rendering_of(rendering, law)
        self.slots = slots = np.zeros(1, SEAT) if slots is None else slots
        rings = np.zeros((1, 1), FRAME) if rings is None else rings
        self.rows, self.record = np.zeros(len(slots), STATION), np.zeros((), PACE)
        is_coupled = self.rendering == "coupled"
        mover = loop.move_by_coupling if is_coupled else loop.move_directly
        self.record["mover"] = address_of_kernel(mover, loop.MOVER)
        if not is_coupled:
            self.record["feeler"], self.record["law"], self._law = loop.feeler_of(law.for_kernels)
        self._arguments = (self.rows, slots, rings, self.record)
        self._times = self.record["due"], self.record["begun"], self.record["dt"]

    def add(self, request: SlotRequest, table: CellTable) -> SessionState:
        """Make the state of a session; its periods run once `is_running` of its row is set."""
        cells = table.cells if reads_distances(self.law) else table.cells.without_distances()
        n = int(np.flatnonzero(self.rows["is_running"] == 0)[0])
        state = SessionState(
            self.rows[n : n + 1], cells, request.reader, table.queue.sessions[request.reader, ...],
            request.grid, clusters_of(request.shell, request.grid.voxel_size),
        )  # fmt: skip
        state.row["seat"] = request.slot
        state.set_spring(request.coupling.spring())
        return state

    def run(self, rate: float, seconds: float = FOREVER) -> float:
        """Run periods at a rate until `stop` or for so long -> their time, s.

        A long period misses the deadlines within it; the next one is due at the next deadline of
        the grid. The interpreter lock is free meanwhile.
        """
        begun, record = time.monotonic_ns(), self.record
        self.rows["began"] = self.rows["last"] = begun
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
        self.record["is_over"] = 1

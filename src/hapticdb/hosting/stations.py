"""Stations: the sessions of a worker process, in the form that its loop reads."""

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hapticdb.grid import Grid
from hapticdb.hosting.board import Board
from hapticdb.kernels.hand.near_points import FIELD_ROWS
from hapticdb.kernels.hosting import loop
from hapticdb.kernels.hosting.following import USUAL_GAP_NS
from hapticdb.kernels.hosting.showing import HOSTED_ROWS
from hapticdb.kernels.large.budget import Asleep
from hapticdb.kernels.records import (
    FOLLOWER,
    MOST_MISSED,
    PACE,
    RESULTS,
    SERVO,
    STATION,
    TOLD,
    pose_numbers,
)
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.law import SMOOTH
from hapticdb.realtime.coupling import SettledCoupling
from hapticdb.realtime.drive import prepare_follower
from hapticdb.resident.held import held_tool
from hapticdb.resident.table import CONTROL_WORDS, HEARTBEAT, MOST_READERS, CellTable


@dataclass(frozen=True)
class SeatRequest:
    """What a worker needs to run a session.

    seat : row of the board; table, n_slots : name and slots of the table of cells, whose descriptor
    comes beside; reader : the session's row there; pose (7,) : where hand and tool start.
    """

    seat: int
    table: int
    n_slots: int
    reader: int
    grid: Grid
    shell: PointShell
    coupling: SettledCoupling
    pose: tuple[float, ...]

    def without_surface(self) -> "SeatRequest":
        """Return the same request without the tool's triangles, which no frame reads."""
        return replace(self, shell=replace(self.shell, surface=None))


class Stations:
    """Sessions of a worker, and the loop that runs them.

    A session's memory is made beside the loop. The loop sees the session when `is_running` of its
    station is set, which is done last, and leaves it between two periods when that is withdrawn.

    rate : periods a second; spin : seconds before a deadline at which the loop watches the clock.
    """

    def __init__(self, board: Board, rate: float, spin: float) -> None:
        most = len(board.seats)
        self._board = board
        self._stations = np.zeros(most, STATION)
        self._servos, self._followers = np.zeros(most, SERVO), np.zeros(most, FOLLOWER)
        self._tolds = np.zeros(most, TOLD)
        self._misseds = np.zeros((most, 1 + MOST_MISSED), dtype=np.int64)
        self._poses = np.tile(np.eye(4), (most, 1, 1, 1))
        self._felts = np.zeros((most, 1, RESULTS))
        self._pace = np.zeros((), PACE)
        self._pace["period"], self._pace["spin"] = round(1e9 / rate), round(1e9 * spin)
        self._requests: dict[int, SeatRequest] = {}
        self._tables: dict[int, CellTable] = {}
        self._arrays: dict[int, tuple[NDArray[np.generic], ...]] = {}
        self._asleep: dict[int, Asleep] = {}
        self._stations_of: dict[int, int] = {}  # by seat

    @property
    def n_periods(self) -> int:
        """Periods done so far."""
        return int(self._pace["periods"])

    def used_tables(self) -> set[int]:
        """Names of the tables that sessions use."""
        return {request.table for request in self._requests.values()}

    def run(self) -> None:
        """Run periods until `stop`; without the interpreter lock."""
        loop.run(
            self._stations, self._misseds, self._poses, self._felts, self._board.seats,
            self._board.rings, self._pace, np.zeros(4, dtype=np.int64),
        )  # fmt: skip

    def stop(self) -> None:
        """End the loop after its period."""
        self._pace["is_over"] = 1

    def begin(self, request: SeatRequest, table: CellTable) -> None:
        """Make a session and let the loop run it from its next period on."""
        n = int(np.flatnonzero(self._stations["is_running"] == 0)[0])
        station = self._stations[n : n + 1]
        station[:] = np.zeros((), STATION)
        self._servos[n], self._followers[n] = np.zeros((), SERVO), np.zeros((), FOLLOWER)
        self._tolds[n] = np.zeros((), TOLD)
        self._misseds[n] = 0
        servo = self._servos[n, ...]
        pose_numbers(servo["tool"])[:] = pose_numbers(servo["hand"])[:] = request.pose
        way = station["way"]
        way["start"], way["end"], way["seconds"] = request.pose, request.pose, 1e-9
        self._write_tool(n, request)
        self._write_cells(n, table)
        station["springs"][:, 0] = request.coupling.spring()
        sessions = table.desk.sessions
        station["session"] = sessions[request.reader : request.reader + 1].ctypes.data
        for name, rows in (
            ("servo", self._servos), ("follower", self._followers), ("told", self._tolds)
        ):  # fmt: skip
            station[name] = rows[n : n + 1].ctypes.data
        station["seat"], station["reader"] = request.seat, request.reader
        station["stiffness"] = SMOOTH.stiffness
        station["bits"], station["curve"] = request.grid.bits, request.grid.curve_code
        station["gap"] = USUAL_GAP_NS
        station["began"] = station["last"] = time.monotonic_ns()
        self._requests[n], self._tables[n] = request, table
        self._stations_of[request.seat] = n
        station["is_running"] = 1

    def _write_tool(self, n: int, request: SeatRequest) -> None:
        """Make the tool's arrays, and write their addresses."""
        grid, station = request.grid, self._stations[n : n + 1]
        clusters, asleep = held_tool(request.shell, grid.voxel_size)
        n_points = len(request.shell)
        prepare_follower(self._followers[n, ...], n_points, asleep)
        met = np.zeros((HOSTED_ROWS, n_points), dtype=np.int64)
        field = np.zeros((FIELD_ROWS, n_points))
        arrays = {
            name: np.ascontiguousarray(getattr(clusters, name))
            for name in ("points", "center", "spheres", "groups", "columns", "scratch")
        } | {"met": met, "field": field}
        for name, array in arrays.items():
            station[name] = array.ctypes.data
        station["n_points"], station["run"] = n_points, clusters.run
        station["n_spheres"], station["n_groups"] = len(clusters.spheres), len(clusters.groups)
        station["place"] = (*grid.origin, grid.voxel_size, float(grid.side))
        self._arrays[n] = tuple(arrays.values())
        self._write_sleepers(n, asleep)

    def _write_sleepers(self, n: int, asleep: Asleep) -> None:
        """Write the addresses of what may sleep of a tool."""
        station, sleepers = self._stations[n : n + 1], asleep.sleepers
        sleeping = station["sleeping"]
        for name, array in sleepers._asdict().items():
            sleeping[name] = array.ctypes.data
        sleeping["counts"], sleeping["budget"] = asleep.counts.ctypes.data, asleep.budget
        sleeping["n_blocks"], sleeping["n_chosen"] = len(sleepers.boxes), len(sleepers.indices)
        self._asleep[n] = asleep

    def _write_cells(self, n: int, table: CellTable) -> None:
        """Write the addresses of the table's arrays."""
        station = self._stations[n : n + 1]
        for name, array in table.cells._asdict().items():
            station[name] = 0 if array is None else array.ctypes.data
        station["n_control"], station["heartbeat"] = CONTROL_WORDS, HEARTBEAT
        station["n_readers"], station["n_slots"] = MOST_READERS, table.n_slots
        station["capacity"] = table.capacity

    def set_coupling(self, seat: int, coupling: SettledCoupling) -> None:
        """Replace a session's coupling; the loop takes the new one whole, between two frames."""
        n = self._stations_of[seat]
        which = 1 - int(self._stations["coupling"][n])
        self._stations["springs"][n, which] = coupling.spring()
        self._stations["coupling"][n] = which

    def withdraw(self, seat: int) -> None:
        """Have the loop leave a session; `free` may be called two periods later."""
        self._stations["is_running"][self._stations_of[seat]] = 0

    def free(self, seat: int) -> None:
        """Free a session's memory, and tell the fetching process that its tool is gone."""
        n = self._stations_of.pop(seat)
        request, table = self._requests.pop(n), self._tables.pop(n)
        table.desk.sessions["told"]["is_active"][request.reader] = False
        del self._arrays[n]
        self._asleep.pop(n, None)

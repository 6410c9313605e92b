"""A worker process of the host: one loop that runs the frames of many sessions, period by period.

The loop is one kernel in a thread of its own, which needs no interpreter. Commands of the host come
over its channel and are done beside it: a session is made there, and enters the loop between two
periods.
"""

import os
import threading
import time
from dataclasses import dataclass

import numpy as np

from hapticdb.errors import HapticDBError, UsageError
from hapticdb.grid import Grid
from hapticdb.kernels._jit import load_entries
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.law import ForceLaw, reads_distances
from hapticdb.recording.header import Start
from hapticdb.resident.held import clusters_of
from hapticdb.resident.table import CellTable
from hapticdb.session.board import Board
from hapticdb.session.coupling import DirectRendering, Rendering
from hapticdb.session.processes.channel import Message
from hapticdb.session.processes.process import MessageSender, parent_is_gone, reply_to_parent
from hapticdb.session.stations import Station, Stations
from hapticdb.session.timing import undisturbed

LOOK_EVERY = 0.25
"""Seconds between two checks whether the host still lives."""
LEAVE_PATIENCE = 5.0
"""Seconds in which the loop must have left a session that ends; normally it is one period."""


@dataclass(frozen=True)
class WorkerRequest:
    """board : of the host; rate : frames/s; law, rendering : of all its sessions."""

    board: Board
    rate: float
    law: ForceLaw
    rendering: Rendering


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
    coupling: DirectRendering
    pose: tuple[float, ...]


class Worker:
    """The sessions of one process and their loop.

    A session's memory is made beside the loop. The loop sees the session when `is_running` of its
    station is set, which is done last, and leaves it between two periods when that is withdrawn.
    """

    def __init__(self, request: WorkerRequest) -> None:
        self._rate, self._law = request.rate, request.law
        self._tables: dict[int, CellTable] = {}
        self._board = board = request.board
        self._stations = Stations(request.law, board.seats, board.rings, request.rendering)
        self._running: dict[int, tuple[SeatRequest, Station]] = {}  # by seat

    def obey(self) -> None:
        """Do what the host says until it ends; the work of the thread beside the loop's."""
        try:
            while not parent_is_gone():
                reply_to_parent(self._do, LOOK_EVERY)
        except (EOFError, OSError):
            pass
        finally:
            self._stations.stop()

    def _do(self, ask: Message, descriptors: list[int]) -> object:
        word, content = ask
        if word == "begin":
            self._begin(content[0], descriptors[0])
        elif word == "end":
            self._end(content[0])
        elif word == "state":
            return self._state(content[0])
        elif word == "set_coupling":
            seat, coupling = content
            self._running[seat][1].set_spring(coupling.spring())
        else:
            raise UsageError(f"a worker does not know the command {word!r}")
        return None

    def _begin(self, request: SeatRequest, descriptor: int) -> None:
        if request.table not in self._tables:
            self._tables[request.table] = CellTable(os.dup(descriptor), request.n_slots)
        table, rows = self._tables[request.table], self._stations.rows
        cells = table.cells if reads_distances(self._law) else table.cells.without_distances()
        n = int(np.flatnonzero(rows["is_running"] == 0)[0])
        row = rows[n : n + 1]
        station = Station(
            row, cells, request.reader, table.desk.sessions[request.reader, ...],
            request.grid, clusters_of(request.shell, request.grid.voxel_size),
        )  # fmt: skip
        pose = np.array(request.pose)
        station.rest_at(pose)
        station.arrive_at(pose)
        station.set_spring(request.coupling.spring())
        row["seat"], row["is_frame"] = request.seat, True
        row["began"] = row["last"] = time.monotonic_ns()
        self._running[request.seat] = request, station
        row["is_running"] = 1

    def _state(self, seat: int) -> tuple[int, Start]:
        """Number of a session's next frame, and its state before that frame."""
        station = self._running[seat][1]
        self._pause(station)
        try:
            return int(self._board.seats["n_frames"][seat]), station.state()
        finally:
            station.row["is_running"] = 1

    def _pause(self, station: Station) -> None:
        """Take a session out of the loop."""
        station.row["is_running"] = 0
        periods = self._stations.pace["periods"]
        last, until = int(periods) + 2, time.monotonic() + LEAVE_PATIENCE
        while int(periods) < last:
            if time.monotonic() > until:
                raise HapticDBError("a worker's loop hangs: end the host")
            time.sleep(0.5 / self._rate)

    def _end(self, seat: int) -> None:
        request, station = self._running[seat]
        self._pause(station)
        station.session["told"]["is_active"] = False
        del self._running[seat]
        used = {request.table for request, _ in self._running.values()}
        if request.table not in used:
            self._tables.pop(request.table).close()

    def run(self) -> None:
        """Run periods until the host ends; the work of the loop's thread."""
        with undisturbed():
            self._stations.run(self._rate)


def work(request: WorkerRequest, sender: MessageSender) -> None:
    """Run a worker; the work of the process."""
    load_entries("period.loop")
    worker = Worker(request)
    looping = threading.Thread(target=worker.run, daemon=True)
    looping.start()
    sender.send("ready", None)
    worker.obey()
    looping.join(LEAVE_PATIENCE)

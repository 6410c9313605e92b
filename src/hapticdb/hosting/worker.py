"""A worker process of the host: one loop that runs the frames of many sessions, period by period.

The loop is one kernel in a thread of its own, which needs no interpreter. Commands of the host come
over a channel and are done beside it: a session is made there, and enters the loop between two
periods.
"""

import os
import select
import socket
import threading
import time
from dataclasses import dataclass

from hapticdb.errors import HapticDBError, UsageError
from hapticdb.hosting.board import Board
from hapticdb.hosting.channel import Ask, Channel
from hapticdb.hosting.stations import SeatRequest, Stations
from hapticdb.kernels.compiling import load
from hapticdb.realtime.deadlines import SPIN, Timing, undisturbed
from hapticdb.realtime.processes import MessageSender, parent_is_gone
from hapticdb.resident.table import CellTable

ENTRIES = ("hosting.loop.run", "resident.feeling.bounding_spheres")
"""Kernels that a worker calls; the loop's has all others that a frame needs within it."""
LOOK_EVERY = 0.25
"""Seconds between two checks whether the host still lives."""
LEAVE_PATIENCE = 5.0
"""Seconds in which the loop must have left a session that ends; normally it is one period."""


@dataclass(frozen=True)
class WorkerRequest:
    """board, sock : descriptors of the board's memory and of the channel; rate : frames/s."""

    board: int
    sock: int
    rate: float


class Worker:
    """The sessions of one process and their loop."""

    def __init__(self, request: WorkerRequest) -> None:
        self._board = Board(request.board)
        self._channel = Channel(socket.socket(fileno=request.sock))
        self._rate = request.rate
        self._tables: dict[int, CellTable] = {}
        self._stations = Stations(self._board, request.rate, SPIN)

    # -- commands ----------------------------------------------------------------------------

    def obey(self) -> None:
        """Do what the host says until it ends; the work of the thread beside the loop's."""
        try:
            while not parent_is_gone():
                if select.select([self._channel.sock], [], [], LOOK_EVERY)[0]:
                    self._channel.reply(self._do)
        except (EOFError, OSError):
            pass
        finally:
            self._stations.stop()

    def _do(self, ask: Ask, descriptors: list[int]) -> None:
        word, content = ask
        if word == "begin":
            self._begin(content[0], descriptors[0])
        elif word == "end":
            self._end(content[0])
        elif word == "set_coupling":
            self._stations.set_coupling(*content)
        else:
            raise UsageError(f"a worker does not know the command {word!r}")

    def _begin(self, request: SeatRequest, descriptor: int) -> None:
        if request.table not in self._tables:
            self._tables[request.table] = CellTable(os.dup(descriptor), request.n_slots)
        self._stations.begin(request, self._tables[request.table])

    def _end(self, seat: int) -> None:
        self._stations.withdraw(seat)
        last, until = self._stations.n_periods + 2, time.monotonic() + LEAVE_PATIENCE
        while self._stations.n_periods < last:
            if time.monotonic() > until:
                raise HapticDBError("a worker's loop hangs: end the host")
            time.sleep(0.5 / self._rate)
        self._stations.free(seat)
        used = self._stations.used_tables()
        for name in [name for name in self._tables if name not in used]:
            self._tables.pop(name).close()

    def run(self) -> None:
        """Run periods until the host ends; the work of the loop's thread."""
        with undisturbed(Timing(self._rate)):
            self._stations.run()


def work(request: WorkerRequest, sender: MessageSender) -> None:
    """Run a worker; the work of the process."""
    load(ENTRIES)
    worker = Worker(request)
    looping = threading.Thread(target=worker.run, daemon=True)
    looping.start()
    sender.send("ready", None)
    worker.obey()
    looping.join(LEAVE_PATIENCE)

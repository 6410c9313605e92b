"""A worker process of the host: one loop that runs the frames of many sessions, period by period.

Commands of the host come over a channel and are done by a thread beside the loop: a session is made
there, and enters the loop between two periods.
"""

import os
import select
import socket
import threading
import time
from dataclasses import dataclass
from typing import Any

from hapticdb.errors import HapticDBError, UsageError
from hapticdb.hosting.board import Board
from hapticdb.hosting.channel import Ask, Channel, Reply
from hapticdb.hosting.seat import Seat, SeatRequest
from hapticdb.kernels.compiling import entries_for, load
from hapticdb.realtime.coupling import Coupling, SettledCoupling
from hapticdb.realtime.deadlines import SPIN, Timing, undisturbed
from hapticdb.realtime.processes import MessageSender, parent_is_gone
from hapticdb.resident.table import CellTable

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
    """The sessions of one process and their loop.

    Parameters
    ----------
    request : WorkerRequest
        From the host.
    """

    def __init__(self, request: WorkerRequest) -> None:
        self._board = Board(request.board)
        self._channel = Channel(socket.socket(fileno=request.sock))
        self._rate = request.rate
        self._tables: dict[int, CellTable] = {}
        self._seats: tuple[Seat, ...] = ()  # replaced as a whole, between two periods
        self._periods = 0
        self._is_over = False

    # -- commands ----------------------------------------------------------------------------

    def obey(self) -> None:
        """Do what the host says until it ends; the work of the thread beside the loop."""
        try:
            while not parent_is_gone():
                if select.select([self._channel.sock], [], [], LOOK_EVERY)[0]:
                    ask, descriptors = self._channel.receive()
                    self._channel.send(self._answer(ask, descriptors))
        except (EOFError, OSError):
            pass
        finally:
            self._is_over = True

    def _answer(self, ask: Ask, descriptors: list[int]) -> Reply:
        try:
            self._do(ask.word, ask.content, descriptors)
            return Reply()
        except HapticDBError as error:
            return Reply(error=error)
        finally:
            for descriptor in descriptors:
                os.close(descriptor)

    def _do(self, word: str, content: tuple[Any, ...], descriptors: list[int]) -> None:
        if word == "begin":
            self._begin(content[0], descriptors[0])
        elif word == "end":
            self._end(content[0])
        elif word == "set_coupling":
            self._set_coupling(*content)
        else:
            raise UsageError(f"a worker does not know the command {word!r}")

    def _begin(self, request: SeatRequest, descriptor: int) -> None:
        if request.table not in self._tables:
            self._tables[request.table] = CellTable(os.dup(descriptor), request.n_slots)
        seat = Seat(request, self._board, self._tables[request.table])
        seat.began = time.monotonic_ns()
        self._seats = (*self._seats, seat)

    def _end(self, row: int) -> None:
        leaving = [seat for seat in self._seats if seat.request.seat == row]
        self._seats = tuple(seat for seat in self._seats if seat.request.seat != row)
        periods, until = self._periods, time.monotonic() + LEAVE_PATIENCE
        while self._periods < periods + 2:
            if time.monotonic() > until:
                raise HapticDBError("a worker's loop hangs: end the host")
            time.sleep(0.5 / self._rate)
        for seat in leaving:
            seat.stop()
        used = {seat.request.table for seat in self._seats}
        for name in [name for name in self._tables if name not in used]:
            self._tables.pop(name).close()

    def _set_coupling(self, row: int, coupling: Coupling | SettledCoupling) -> None:
        for seat in self._seats:
            if seat.request.seat == row:
                seat.set_coupling(coupling)

    # -- the loop ----------------------------------------------------------------------------

    def run(self) -> None:
        """Run periods until the host ends."""
        clock, period = time.monotonic_ns, round(1e9 / self._rate)
        spin = round(SPIN * 1e9)
        due = clock() + period
        before = due - period
        while not self._is_over:
            left = due - clock() - spin
            if left > 0:
                time.sleep(left * 1e-9)
            begun = clock()
            while begun < due:
                begun = clock()
            dt, before = (begun - before) * 1e-9, begun
            seats = self._seats
            for seat in seats:
                seat.frame(clock(), due, dt, clock)
            self._periods += 1
            done = clock()
            due += period
            behind = max(-(-(done - due) // period), 0)
            for seat in seats:
                row = self._board.seats[seat.request.seat : seat.request.seat + 1]
                row["in_time"] += behind == 0
                row["missed"] += behind
            due += behind * period


def work(request: WorkerRequest, sender: MessageSender) -> None:
    """Run a worker; the work of the process."""
    load(entries_for("feel"))
    worker = Worker(request)
    obeying = threading.Thread(target=worker.obey, daemon=True)
    with undisturbed(Timing(request.rate)):
        obeying.start()
        sender.send("ready", None)
        worker.run()

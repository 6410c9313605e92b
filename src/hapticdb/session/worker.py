"""A worker process: one loop that runs the frames of its sessions, period by period.

The loop is one kernel without an interpreter, in a thread of its own. The main thread takes the
parent's commands: it makes a session's memory, and the session enters the loop between two periods.
A session with a device is alone, in the main thread: there a signal ends a hanging call of the
device.
"""

import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import HapticDBError
from hapticdb.query.law import ForceLaw
from hapticdb.recording.header import Start
from hapticdb.resident.table import CellTable
from hapticdb.session.coupling import DirectRendering, Rendering
from hapticdb.session.device_loop import DeviceRequest, run_device
from hapticdb.session.processes.channel import Message
from hapticdb.session.processes.process import (
    LOOK_EVERY,
    MessageSender,
    parent_is_gone,
    reply_to_parent,
)
from hapticdb.session.shared_table import SharedTable
from hapticdb.session.states import PeriodClock, SessionState, SlotRequest
from hapticdb.session.timing import Timing, undisturbed

LEAVE_PATIENCE = 5.0
"""Seconds until the loop must have left an ending session; normally one period."""


@dataclass(frozen=True)
class WorkerRequest:
    """Sessions of a worker, all with the same shared table, timing, law and rendering.

    alone : the only one, with a device; without it commands begin and end sessions.
    """

    shared: SharedTable
    timing: Timing
    law: ForceLaw
    rendering: Rendering
    alone: DeviceRequest | None = None


class Worker:
    """The sessions of one process and their loop.

    The loop runs a session as soon as `is_running` of its state is set, and leaves it between two
    periods after that is withdrawn.
    """

    def __init__(self, shared: SharedTable, rate: float, clock: PeriodClock) -> None:
        self._shared, self._rate, self._clock = shared, rate, clock
        self._tables: dict[int, CellTable] = {}
        self._running: dict[int, tuple[int, SessionState]] = {}  # table and state, by slot

    def obey(self) -> None:
        """Take commands until the parent ends; the work of the main thread."""
        try:
            while not parent_is_gone():
                reply_to_parent(self._do, LOOK_EVERY)
        except (EOFError, OSError):
            pass
        finally:
            self._clock.stop()

    def _do(self, ask: Message, descriptors: list[int]) -> object:
        known: dict[str, Callable[..., object]] = {
            "begin": self._begin, "end": self._end, "save": self._save,
            "set_coupling": self._set_coupling,
        }  # fmt: skip
        return known[ask.word](*descriptors, *ask.content)

    def _begin(
        self,
        descriptor: int,
        request: SlotRequest,
        pose: NDArray[np.float64],
        table: int,
        n_slots: int,
    ) -> None:
        """Begin a session, hand and tool at rest at a pose (7,); table : a name for its cells."""
        if table not in self._tables:
            self._tables[table] = CellTable(os.dup(descriptor), n_slots)
        state = self._clock.add(request, self._tables[table])
        state.rest_at(pose)
        state.arrive_at(pose)
        state.row["is_frame"] = True
        state.row["began"] = state.row["last"] = time.monotonic_ns()
        self._running[request.slot] = table, state
        state.row["is_running"] = 1

    def _set_coupling(self, slot: int, coupling: DirectRendering) -> None:
        self._running[slot][1].set_spring(coupling.spring())

    def _save(self, slot: int) -> tuple[int, Start]:
        """Number of a session's next frame, and its state before that frame."""
        state = self._running[slot][1]
        self._pause(state)
        try:
            return int(self._shared.slots["n_frames"][slot]), state.save()
        finally:
            state.row["is_running"] = 1

    def _pause(self, state: SessionState) -> None:
        """Take a session out of the loop."""
        state.row["is_running"] = 0
        periods = self._clock.record["periods"]
        last, until = int(periods) + 2, time.monotonic() + LEAVE_PATIENCE
        while int(periods) < last:
            if time.monotonic() > until:
                raise HapticDBError("a worker's loop hangs: end the host")
            time.sleep(0.5 / self._rate)

    def _end(self, slot: int) -> None:
        table, state = self._running[slot]
        self._pause(state)
        state.session["told"]["is_active"] = False
        del self._running[slot]
        if all(used != table for used, _ in self._running.values()):
            self._tables.pop(table).close()

    def run(self) -> None:
        """Run periods until the parent ends; the work of the loop's thread."""
        with undisturbed():
            self._clock.run(self._rate)


def work(request: WorkerRequest, sender: MessageSender) -> None:
    """Run a worker; the work of the process."""
    shared, timing = request.shared, request.timing
    clock = PeriodClock(request.law, shared.slots, shared.rings, request.rendering)
    if request.alone is not None:
        run_device(request.alone, timing, clock, sender)
        return
    worker = Worker(shared, timing.rate, clock)
    looping = threading.Thread(target=worker.run, daemon=True)
    looping.start()
    sender.send("ready", None)
    worker.obey()
    looping.join(LEAVE_PATIENCE)

"""A worker process: one loop that runs the frames of its sessions, period by period.

The loop is one kernel without an interpreter, in a thread of its own. The main thread takes the
parent's commands: it makes a session's memory, and the session enters the loop between two periods.
A session with a device is alone, in the main thread: there a signal ends a hanging call of the
device.
"""

import os
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticdb.query.law import ForceLaw
from hapticdb.recording.header import Start
from hapticdb.resident.table import CellTable
from hapticdb.session.coupling import DirectRendering, Rendering
from hapticdb.session.device_loop import DeviceRequest, run_device
from hapticdb.session.processes.channel import Message
from hapticdb.session.processes.process import (
    POLL_EVERY,
    MessageSender,
    Process,
    parent_is_gone,
    reply_to_parent,
)
from hapticdb.session.shared_table import SharedTable
from hapticdb.session.states import LEAVE_TIMEOUT, PeriodClock, SessionState, SlotRequest
from hapticdb.session.timing import Timing, undisturbed

WORK = "hapticdb.session.worker:work"
"""Function of a worker process."""
ANSWER_TIMEOUT = 30.0
"""Seconds for the answer to a command; normally milliseconds."""


@dataclass(frozen=True)
class WorkerRequest:
    """Sessions of a worker, all with the same shared table, timing, law and rendering.

    alone : the only session, with a device; without it commands begin sessions; number : of the
    worker, from 1.
    """

    shared: SharedTable
    timing: Timing
    law: ForceLaw
    rendering: Rendering
    alone: DeviceRequest | None = None
    number: int = 1


class WorkerProcess(Process):
    """A worker process, in its parent.

    request : its sessions; ready : content of its first message.
    """

    def __init__(self, request: WorkerRequest) -> None:
        self.request = request
        descriptors = [request.shared.descriptor]
        if request.alone is not None:
            descriptors.append(request.alone.table.descriptor)
        super().__init__(WORK, request, descriptors, with_kernels=True)
        self.ready = self.await_ready("worker")
        self._channel.sock.settimeout(ANSWER_TIMEOUT)

    def call(self, word: str, *content: object, descriptors: Sequence[int] = ()) -> Any:  # noqa: ANN401
        """Send a command and wait for its answer; see `Channel.call`."""
        return self._channel.call(word, *content, descriptors=descriptors)


class Worker:
    """The sessions of one process and their loop.

    The loop runs a session from `PeriodClock.enter` on, and leaves it between two periods.
    """

    def __init__(self, rate: float, clock: PeriodClock) -> None:
        self._rate, self._clock = rate, clock
        self._tables: dict[int, CellTable] = {}
        self._running: dict[int, tuple[int, SessionState]] = {}  # table and state, by slot

    def obey(self) -> None:
        """Take commands until the parent ends; the work of the main thread."""
        try:
            while not parent_is_gone():
                reply_to_parent(self._do, POLL_EVERY)
                self._forget_ended()
        except (EOFError, OSError):
            pass
        finally:
            # always: the loop's thread would run on in a process without a parent
            self._clock.stop()

    def _do(self, message: Message, descriptors: list[int]) -> object:
        known: dict[str, Callable[..., object]] = {
            "begin": self._begin, "save": self._save, "set_coupling": self._set_coupling,
        }  # fmt: skip
        return known[message.word](*descriptors, *message.content)

    def _begin(
        self,
        descriptor: int,
        request: SlotRequest,
        pose: NDArray[np.float64],
        table: int,
        n_slots: int,
    ) -> None:
        """Begin a session, hand and tool at rest at a pose (7,); table : a name for its cells."""
        self._forget_ended()  # a new table may have the name of theirs
        if table not in self._tables:
            self._tables[table] = CellTable(os.dup(descriptor), n_slots)
        state = self._clock.add(request, self._tables[table])
        # all of the state before `enter`: the loop's thread takes the session without a lock
        state.rest_at(pose)
        state.arrive_at(pose)
        state.slot["is_frame"] = True
        state.slot["began"] = state.slot["last"] = time.monotonic_ns()
        # held here: the loop has bare addresses of its arrays
        self._running[request.slot] = table, state
        self._clock.enter(state)

    def _set_coupling(self, slot: int, coupling: DirectRendering) -> None:
        self._running[slot][1].set_spring(coupling.spring())

    def _save(self, slot: int) -> tuple[int, Start]:
        """Number of a session's next frame, and its state before that frame."""
        state = self._running[slot][1]
        # between two periods: a copy during one would mix two frames
        self._clock.leave(state)
        try:
            return int(state.slot["n_frames"]), state.save()
        finally:
            self._clock.enter(state)

    def _forget_ended(self) -> None:
        """Free the memory of sessions that the loop has left."""
        for slot, (_, state) in list(self._running.items()):
            # only after the loop has left: it must not read freed memory
            if state.slot["worker"] != self._clock.worker:
                del self._running[slot]
        for table in self._tables.keys() - {table for table, _ in self._running.values()}:
            self._tables.pop(table).close()

    def run(self) -> None:
        """Run periods until the parent ends; the work of the loop's thread."""
        with undisturbed():
            self._clock.run(self._rate)


def work(request: WorkerRequest, sender: MessageSender) -> None:
    """Run a worker; the work of the process."""
    shared, timing = request.shared, request.timing
    clock = PeriodClock(request.law, shared.slots, shared.rings, request.rendering, request.number)
    if request.alone is not None:
        run_device(request.alone, timing, clock, sender)
        return
    worker = Worker(timing.rate, clock)
    # beside the main thread: the kernel returns at the end, commands come before
    looping = threading.Thread(target=worker.run, daemon=True)
    looping.start()
    sender.send("ready", None)
    worker.obey()
    looping.join(LEAVE_TIMEOUT)

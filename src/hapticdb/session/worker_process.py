"""Worker processes in their parent: of one session with a device, or of many."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hapticdb.query.law import ForceLaw
from hapticdb.session.coupling import Rendering
from hapticdb.session.processes.process import Process
from hapticdb.session.shared_table import SharedTable
from hapticdb.session.timing import Timing
from hapticdb.session.worker import WorkerRequest

WORK = "hapticdb.session.worker:work"
"""Function of a worker process."""
ANSWER_PATIENCE = 30.0
"""Seconds for the answer to a command; normally milliseconds."""
FILLED = 8
"""Sessions of a worker before another one is started, up to the host's most."""


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
        self._channel.sock.settimeout(ANSWER_PATIENCE)

    def ask(self, word: str, *content: object, descriptors: Sequence[int] = ()) -> Any:  # noqa: ANN401
        """Send a command and wait for its answer; see `Channel.ask`."""
        return self._channel.ask(word, *content, descriptors=descriptors)


class Workers:
    """Worker processes of a host, `most` at a time."""

    def __init__(self, shared: SharedTable, rate: float, most: int) -> None:
        self._shared, self._timing, self._most = shared, Timing(rate), most
        self._processes: list[WorkerProcess] = []
        self._next = 1

    @property
    def pids(self) -> list[int]:
        """Process ids of living workers."""
        return [process.pid for process in self._processes if process.is_alive]

    def least_busy(self, law: ForceLaw, rendering: Rendering) -> WorkerProcess:
        """Worker for one more such session: with the fewest, or a new one if all are filled."""
        for process in [process for process in self._processes if not process.is_alive]:
            self._processes.remove(process)
            process.end()
        slots = self._shared.slots
        request = WorkerRequest(self._shared, self._timing, law, rendering, number=self._next)
        alike = [
            process
            for process in self._processes
            if replace(process.request, number=self._next) == request
        ]
        counts = [
            int(np.count_nonzero(slots["worker"] == process.request.number)) for process in alike
        ]
        if not counts or (min(counts) >= FILLED and len(self._processes) < self._most):
            self._processes.append(WorkerProcess(request))
            self._next += 1
            return self._processes[-1]
        return alike[int(np.argmin(counts))]

    def close(self) -> None:
        """End all workers."""
        for process in self._processes:
            process.end()
        self._processes.clear()

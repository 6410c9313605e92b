"""The worker processes of a host, started when sessions need them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from hapticdb.query.law import ForceLaw
from hapticdb.session.board import TAKEN, Board
from hapticdb.session.coupling import Rendering
from hapticdb.session.processes.process import Process
from hapticdb.session.worker import WorkerRequest

START_PATIENCE = 120.0
"""Seconds in which a worker must be ready: it loads every kernel of a frame."""
ANSWER_PATIENCE = 30.0
"""Seconds in which a worker must answer a command; normally milliseconds."""
FILLED = 8
"""Sessions of a worker from which another process is started, while the host may have more."""


class WorkerProcess(Process):
    """A worker process, from the host; `number` counts from 0, `request` says what it runs."""

    def __init__(self, number: int, request: WorkerRequest) -> None:
        self.number, self.request = number, request
        work = "hapticdb.session.worker:work"
        super().__init__(work, request, [request.board.descriptor], with_kernels=True)
        self.await_ready("worker's", START_PATIENCE)
        self._channel.sock.settimeout(ANSWER_PATIENCE)

    def ask(self, word: str, *content: object, descriptors: Sequence[int] = ()) -> Any:  # noqa: ANN401
        """Tell the worker to do something, and wait for its answer; see `Channel.ask`."""
        return self._channel.ask(word, *content, descriptors=descriptors)


class Workers:
    """Worker processes of a host, `most` at a time."""

    def __init__(self, board: Board, rate: float, most: int) -> None:
        self._board, self._rate, self._most = board, rate, most
        self._processes: list[WorkerProcess] = []
        self._next = 0

    @property
    def pids(self) -> list[int]:
        """Process ids of those that run."""
        return [process.pid for process in self._processes if process.is_alive]

    def least_busy(self, law: ForceLaw, rendering: Rendering) -> WorkerProcess:
        """Worker for one more such session: with the fewest, or a new one if all are filled."""
        for process in [process for process in self._processes if not process.is_alive]:
            self._processes.remove(process)
            process.end()
        seats, request = self._board.seats, WorkerRequest(self._board, self._rate, law, rendering)
        alike = [process for process in self._processes if process.request == request]
        counts = [
            int(np.count_nonzero((seats["state"] == TAKEN) & (seats["worker"] == process.number)))
            for process in alike
        ]
        if not counts or (min(counts) >= FILLED and len(self._processes) < self._most):
            self._processes.append(WorkerProcess(self._next, request))
            self._next += 1
            return self._processes[-1]
        return alike[int(np.argmin(counts))]

    def close(self) -> None:
        """End all workers."""
        for process in self._processes:
            process.end()
        self._processes.clear()

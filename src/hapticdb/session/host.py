"""SessionHost: many hands in few worker processes, over shared tables of cells."""

import itertools
import os
import socket
import threading
from contextlib import ExitStack, suppress
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from hapticdb.closing import Closes
from hapticdb.devices.handle import Handle
from hapticdb.devices.profiles import SCRIPTED
from hapticdb.devices.scripted import pose_at
from hapticdb.errors import HapticDBError, UsageError
from hapticdb.kernels.rigid import is_rigid
from hapticdb.pointshell.shell import PointShell
from hapticdb.poses import row_of_pose
from hapticdb.query.law import DISTANCE, PLANE, ForceLaw
from hapticdb.resident.table import DEFAULT_BUDGET
from hapticdb.session.attached import serve_attached
from hapticdb.session.coupling import Coupling, Rendering, radius_of, rendering_of
from hapticdb.session.hosted import HostedSession, Recorded
from hapticdb.session.prefetch.resident_cells import ResidentCells, without_distances
from hapticdb.session.running import Running
from hapticdb.session.shared_table import SharedTable
from hapticdb.session.supervisor import Supervisor
from hapticdb.session.timing import Timing
from hapticdb.session.worker import WorkerProcess, WorkerRequest
from hapticdb.store.filtering import Filter
from hapticdb.store.finding import Words

FILLED = 8
"""Sessions of a worker before another one is started, up to the host's most."""
MOST_SESSIONS = 64
"""Most sessions of a host. Larger: more shared memory, 960 kB each."""


class SessionHost(Closes):
    """Hands in an environment, `MOST_SESSIONS` at once, each in real time.

    Sessions run in worker processes, many in each. All sessions with the same filter share
    one table of resident cells and its prefetch process. Also a context manager.

    url : the environment; rate : frames a second of each session; budget_bytes : memory of each
    table of cells; processes : most worker processes, one for each processor unless given, and one
    for each rendering; rendering : of all sessions. By default a session is coupled if its objects
    have distances to surfaces, and renders tangent planes directly otherwise.
    """

    _pid = 0
    """Id of the process of this object. In a forked copy `close` does nothing."""

    def __init__(
        self,
        url: str,
        *,
        rate: float = 1000.0,
        budget_bytes: int = DEFAULT_BUDGET,
        processes: int | None = None,
        rendering: Rendering | None = None,
    ) -> None:
        Timing(rate)  # checks it
        rendering_of(rendering, DISTANCE)  # likewise
        if processes is not None and processes < 1:
            raise UsageError(f"{processes} worker processes: give 1 or more")
        self.url, self.rate, self._rendering = url, rate, rendering
        self._budget_bytes, self._most = budget_bytes, processes or os.cpu_count() or 1
        self._tables: dict[Filter, ResidentCells] = {}
        self._workers: list[WorkerProcess] = []
        self._shared = SharedTable.create(MOST_SESSIONS)
        self._supervisor = Supervisor(self._shared, lambda: self.cells)
        self._ids, self._numbers = itertools.count(1), itertools.count(1)
        self._changing = threading.RLock()
        self._served: list[socket.socket] = []
        self._is_closed = False
        self._pid = os.getpid()

    @property
    def failure(self) -> HapticDBError | None:
        """Lasting error of a prefetch process; None without one."""
        return self._supervisor.failure

    def begin(
        self,
        shell: PointShell,
        start: ArrayLike,
        *,
        where: Words = (),
        exclude: Words = (),
        coupling: Coupling | None = None,
        scale: float = 1.0,
    ) -> HostedSession:
        """Begin a session; its tool waits at `start`, (4, 4), scene metres, until the hand moves.

        where, exclude : words as of `Environment.find`, of the objects in contact (all without
        `where`) and of exceptions; coupling : without a profile no force moves its hand; rendered
        directly, it gives caps alone; scale :
        metres of the scene for a metre of the device, for the coupling alone: poses of the hand are
        the scene's.

        Raises `UsageError` if a number is out of its range, no slot is free, or a hand is to be
        coupled without distances to surfaces; `ObjectNotFoundError` if a word
        chooses nothing; `DatabaseError` if the environment cannot be opened.
        """
        pose = pose_at(start)
        if not is_rigid(pose):
            raise UsageError("a session starts at a pose (4, 4) that is a rigid transform")
        Handle(scale=scale)  # checks it
        selection = Filter(where, exclude)
        with self._changing, ExitStack() as undo:
            if self._is_closed:
                raise UsageError("the host is closed: make another")
            # first, so it runs last: a table made for a failed session has no user
            undo.callback(self._free_tables)
            cells = self._cells_of(selection)
            law = DISTANCE if cells.has_distances else PLANE
            if self._rendering == "coupled" and law is PLANE:
                raise UsageError(without_distances(self.url, "leave out --rendering coupled"))
            rendering = rendering_of(self._rendering, law)
            settled = (coupling or Coupling()).of_session(
                rendering, SCRIPTED, self.rate, scale, radius_of(shell, cells.grid.voxel_size)
            )
            worker, number = self._least_busy(law, rendering), next(self._ids)
            running = Running(number, self._shared, cells, shell, settled)
            # a failure of the worker below must return the slot and the reader row
            undo.callback(running.close)
            running.worker = worker
            hand = np.array(row_of_pose(pose))
            # before `begin`: from then on the worker's loop may read it
            self._shared.slots["hand_pose"][running.slot] = hand
            table = cells.table
            worker.call(
                "begin", running.request, hand, id(cells), table.n_slots,
                descriptors=[table.descriptor],
            )  # fmt: skip
            # last: from here on the supervisor records its frames, and `end` finds it
            self._supervisor.sessions[number] = running
            undo.pop_all()
        return HostedSession(self._shared, running.slot, number, self._call)

    def _cells_of(self, selection: Filter) -> ResidentCells:
        """Table of a filter's objects, made when first needed."""
        if selection not in self._tables:
            self._tables[selection] = ResidentCells(
                self.url,
                budget_bytes=self._budget_bytes,
                where=selection.where,
                exclude=selection.exclude,
            )
        return self._tables[selection]

    def _free_tables(self) -> None:
        """Free the tables that no session uses."""
        used = [running.cells for running in self._supervisor.sessions.values()]
        for selection, cells in list(self._tables.items()):
            if cells not in used:
                del self._tables[selection]
                cells.close()

    def _least_busy(self, law: ForceLaw, rendering: Rendering) -> WorkerProcess:
        """Worker for one more such session: with the fewest, or a new one if all are filled."""
        for worker in [worker for worker in self._workers if not worker.is_alive]:
            self._workers.remove(worker)
            worker.end()
        counts = {
            # from the slots, not from a counter: a loop leaves an ended session by itself
            worker: int(np.count_nonzero(self._shared.slots["worker"] == worker.request.number))
            for worker in self._workers
            if (worker.request.law, worker.request.rendering) == (law, rendering)
        }
        least = min(counts.values(), default=FILLED)
        if not counts or (least >= FILLED and len(self._workers) < self._most):
            self._workers.append(WorkerProcess(WorkerRequest(
                self._shared, Timing(self.rate), law, rendering, number=next(self._numbers)
            )))  # fmt: skip
            return self._workers[-1]
        return min(counts, key=counts.__getitem__)

    def sessions(self) -> list[HostedSession]:
        """Sessions now, by their ids."""
        running = sorted(self._supervisor.sessions.items())
        return [HostedSession(self._shared, r.slot, number, self._call) for number, r in running]

    def _call(self, word: str, session: int, /, *content: object) -> object:
        """Do a session's request; see `HostedSession`."""
        with self._changing:
            running = self._supervisor.sessions.get(session)
            if running is None:
                if word == "end":
                    return None
                raise UsageError(f"the hosted session {session} is over: begin another")
            do = partial(self._end, running) if word == "end" else getattr(running, word)
            return do(*content)

    def _end(self, running: Running) -> Recorded:
        """End a session, working or not; returns the size of its recording."""
        # before the end: the supervisor must not read a slot that is free
        self._supervisor.sessions.pop(running.session, None)
        try:
            return running.end()
        finally:
            self._free_tables()

    def serve(self, sock: socket.socket) -> None:
        """Serve an `AttachedHost` in a thread; the host owns the socket from now on."""
        self._served.append(sock)
        threading.Thread(
            target=serve_attached,
            args=(sock, self._shared, self.begin, self._call),
            daemon=True,
            name="attached",
        ).start()

    @property
    def cells(self) -> list[ResidentCells]:
        """Tables of cells in use, one for each filter, with their figures."""
        return list(self._tables.values())

    @property
    def pids(self) -> list[int]:
        """Process ids of the workers."""
        return [worker.pid for worker in self._workers if worker.is_alive]

    def close(self) -> None:
        """End all sessions, processes and recordings; a second call does nothing."""
        if os.getpid() != self._pid or self._is_closed:
            return
        # before the lock: a `begin` that waits for the lock is refused then
        self._is_closed = True
        with self._changing, ExitStack() as ends:
            # a stack runs backwards: sessions first, then sockets, workers, and tables at last
            for cells in self.cells:
                ends.callback(cells.close)
            for worker in self._workers:
                ends.callback(worker.end)
            for sock in self._served:
                ends.callback(_shut, sock)
            ends.callback(self._supervisor.close)


def _shut(sock: socket.socket) -> None:
    with suppress(OSError):
        sock.shutdown(socket.SHUT_RDWR)

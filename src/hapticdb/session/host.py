"""SessionHost: many hands in few worker processes, over shared tables of cells."""

import itertools
import logging
import os
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from typing import Any

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
from hapticdb.query.law import DISTANCE, PLANE
from hapticdb.resident.table import DEFAULT_BUDGET
from hapticdb.session.attached import serve_attached
from hapticdb.session.coupling import Coupling, Rendering, radius_of, rendering_of
from hapticdb.session.hosted import HostedSession, Recorded
from hapticdb.session.prefetch.resident_cells import ResidentCells, without_distances
from hapticdb.session.prefetch.tables import SharedTables
from hapticdb.session.running import Running
from hapticdb.session.shared_table import SharedTable
from hapticdb.session.timing import Timing
from hapticdb.session.workers import Workers
from hapticdb.store.filtering import Filter
from hapticdb.store.finding import Words

LOG = logging.getLogger("hapticdb.session")
MOST_SESSIONS = 64
"""Most sessions of a host. Larger: more shared memory, 960 kB each."""
TEND_EVERY = 0.05
"""Seconds between two checks of recordings and processes. Larger: less work, and a death is noticed
later. A recording loses frames from 2 s on."""


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
        self._tables = SharedTables(url, budget_bytes)
        self._shared = SharedTable.create(MOST_SESSIONS)
        self._workers = Workers(self._shared, rate, processes or os.cpu_count() or 1)
        self._running: dict[int, Running] = {}
        self._ids = itertools.count(1)
        self._changing = threading.RLock()
        self._served: list[socket.socket] = []
        self._is_closed = threading.Event()
        self.failure: HapticDBError | None = None
        """Lasting error of a prefetch process; None without one."""
        self._pid = os.getpid()
        self._logged: set[str] = set()
        self._tending = [
            threading.Thread(target=self._tend, args=(look,), daemon=True, name="host")
            for look in (self._look_after_sessions, self._look_after_cells)
        ]
        for thread in self._tending:
            thread.start()

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
        felt = Filter(where, exclude)
        with self._changing:
            if self._is_closed.is_set():
                raise UsageError("the host is closed: make another")
            return self._begin(shell, pose, felt, coupling, scale)

    def _begin(
        self,
        shell: PointShell,
        pose: Any,  # noqa: ANN401 - (4, 4), checked
        felt: Filter,
        coupling: Coupling | None,
        scale: float,
    ) -> HostedSession:
        """Take slot, cells and worker for a session; all are given back if one is not to be had."""
        number = next(self._ids)
        with ExitStack() as undo:
            cells = self._tables.take(felt)
            undo.callback(self._tables.release, cells)
            law = DISTANCE if cells.has_distances else PLANE
            if self._rendering == "coupled" and law is PLANE:
                raise UsageError(without_distances(self.url, "leave out --rendering coupled"))
            rendering = rendering_of(self._rendering, law)
            settled = (coupling or Coupling()).of_session(
                rendering, SCRIPTED, self.rate, scale, radius_of(shell, cells.grid.voxel_size)
            )
            worker = self._workers.least_busy(law, rendering)
            running = Running(number, self._shared, cells, shell, settled, worker.number)
            undo.callback(running.close)
            running.worker = worker
            hand = np.array(row_of_pose(pose))
            self._shared.slots["hand_pose"][running.slot] = hand
            self._shared.slots["is_held"][running.slot] = 1
            table = cells.table
            worker.ask(
                "begin", running.request, hand, id(cells), table.n_slots,
                descriptors=[table.descriptor],
            )  # fmt: skip
            self._running[number] = running
            undo.pop_all()
        return HostedSession(self._shared, running.slot, number, self._call)

    def sessions(self) -> list[HostedSession]:
        """Sessions now, by their ids."""
        running = sorted(self._running.items())
        return [HostedSession(self._shared, r.slot, number, self._call) for number, r in running]

    def _call(self, word: str, session: int, /, *content: object) -> object:
        """Do a session's request; see `HostedSession`."""
        with self._changing:
            running = self._running.get(session)
            if running is None:
                if word == "end":
                    return None
                raise UsageError(f"the hosted session {session} is over: begin another")
            do = partial(self._end, running) if word == "end" else getattr(running, word)
            return do(*content)

    def _end(self, running: Running) -> Recorded:
        """End a session, working or not; returns the size of its recording."""
        self._running.pop(running.session, None)
        with ExitStack() as ends:  # the last one runs first, and each runs even if another fails
            ends.callback(self._tables.release, running.cells)
            ends.callback(running.close)
            try:
                if running.worker.is_alive:
                    running.worker.ask("end", running.slot)
            finally:
                recorded = running.stop_recording()
        return recorded

    def serve(self, sock: socket.socket) -> None:
        """Serve an `AttachedHost` in a thread; the host owns the socket from now on."""
        self._served.append(sock)
        threading.Thread(
            target=serve_attached,
            args=(sock, self._shared, self.begin, self._call),
            daemon=True,
            name="attached",
        ).start()

    def _tend(self, look: Callable[[], None]) -> None:
        """Repeat a check, without `_changing`: a slow begin has that lock."""
        while not self._is_closed.wait(TEND_EVERY):
            look()

    def _look_after_sessions(self) -> None:
        """Record frames, notice dead workers."""
        for running in list(self._running.values()):
            with self._surviving("recording a session"):
                if running.worker.is_alive:
                    running.take_frames()
                else:
                    self._shared.lose(running.slot, running.session)

    def _look_after_cells(self) -> None:
        """Start ended prefetch processes again."""
        for cells in self._tables.all():
            with self._surviving("starting a prefetch process again"):
                try:
                    cells.supervise()
                except HapticDBError as error:
                    self.failure = error

    @contextmanager
    def _surviving(self, work: str) -> Iterator[None]:
        """Go on after an error; its first occurrence is logged."""
        try:
            yield
        except Exception as error:
            said = f"{work}: {type(error).__name__}: {error}"
            if said not in self._logged:
                self._logged.add(said)
                LOG.exception("%s failed; later errors of this kind are not logged", work)

    @property
    def cells(self) -> list[ResidentCells]:
        """Tables of cells in use, one for each filter, with their figures."""
        return self._tables.all()

    @property
    def pids(self) -> list[int]:
        """Process ids of the workers."""
        return self._workers.pids

    def close(self) -> None:
        """End all sessions, processes and recordings; a second call does nothing."""
        if os.getpid() != self._pid or self._is_closed.is_set():
            return
        self._is_closed.set()
        for thread in self._tending:
            with suppress(RuntimeError):
                thread.join()
        with self._changing, ExitStack() as ends:
            ends.callback(self._shared.close)
            ends.callback(self._tables.close)
            ends.callback(self._workers.close)
            for sock in self._served:
                ends.callback(_shut, sock)
            for running in list(self._running.values()):
                ends.callback(self._end, running)


def _shut(sock: socket.socket) -> None:
    with suppress(OSError):
        sock.shutdown(socket.SHUT_RDWR)

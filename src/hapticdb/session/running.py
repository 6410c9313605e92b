"""Running: one session in its parent process, with a device or hosted."""

import threading
import time
from contextlib import ExitStack
from dataclasses import replace

from hapticdb.closing import Closes
from hapticdb.devices.profiles import SCRIPTED
from hapticdb.errors import HapticDBError, UsageError
from hapticdb.pointshell.shell import PointShell
from hapticdb.recording.file import Recorder
from hapticdb.recording.header import Start
from hapticdb.session.coupling import Coupling, DirectRendering
from hapticdb.session.hosted import Recorded
from hapticdb.session.prefetch.resident_cells import ResidentCells
from hapticdb.session.shared_table import SharedTable
from hapticdb.session.states import SlotRequest
from hapticdb.session.worker import WorkerProcess

END_TIMEOUT = 5.0
"""Seconds until the loop must have left an ending session; normally one period."""


class Running(Closes):
    """A running session: its slot and reader row, until `close`; its worker; its recording.

    session : its number.
    """

    def __init__(
        self,
        session: int,
        shared: SharedTable,
        cells: ResidentCells,
        shell: PointShell,
        coupling: DirectRendering,
    ) -> None:
        self.session, self.shared, self.cells = session, shared, cells
        self._worker: WorkerProcess | None = None
        self.recording: Recorder | None = None
        self._taking = threading.Lock()
        with ExitStack() as undo:
            # on a stack: the reader row goes back if no slot is free
            reader = cells.table.join()
            undo.callback(cells.table.leave, reader)
            self.slot = shared.take(session)
            undo.callback(shared.release, self.slot)
            self.request = SlotRequest(
                self.slot, reader, cells.grid, replace(shell, surface=None), coupling
            )
            self._ends = undo.pop_all()

    @property
    def worker(self) -> WorkerProcess:
        """Process of its periods."""
        assert self._worker is not None  # noqa: S101 - set before anybody else knows the session
        return self._worker

    @worker.setter
    def worker(self, worker: WorkerProcess) -> None:
        self._worker = worker
        # the worker reads the cells: its death frees the row's version
        self.cells.table.queue.pids[self.request.reader] = worker.pid

    @property
    def n_frames(self) -> int:
        """Number of frames so far."""
        return int(self.shared.slots["n_frames"][self.slot])

    def set_coupling(self, coupling: Coupling | None) -> None:
        """Replace the coupling between hand and tool, of a session without a device."""
        before, of_worker = self.request.coupling, self.worker.request
        settled = (coupling or Coupling()).of_session(
            of_worker.rendering, SCRIPTED, of_worker.timing.rate, before.scale, before.radius
        )
        self.worker.call("set_coupling", self.slot, settled)
        self.request = replace(self.request, coupling=settled)

    def record(self, path: str, is_replaced: bool) -> None:  # noqa: FBT001 - of a call
        """Begin a recording at the next frame; errors as of `HostedSession.record`."""
        if self.recording is not None:
            raise UsageError(
                f"the hosted session {self.session} is recorded already: stop it first"
            )
        recording = Recorder(path, replace=is_replaced)
        try:
            # first: a refused file needs no request to the worker
            recording.open()
            self.begin_recording(recording, *self.worker.call("save", self.slot))
        except BaseException:
            recording.discard()
            raise

    def begin_recording(
        self, recording: Recorder, first: int, start: Start, frames_on: str = "cpu"
    ) -> None:
        """Record from frame `first` on; `start` is the state before that frame."""
        request, of_worker = self.request, self.worker.request
        header = self.cells.header(
            request.shell, of_worker.timing.rate, of_worker.law, request.coupling, start, frames_on
        )
        recording.begin(header, first)
        self.recording = recording

    def take_frames(self) -> None:
        """Copy new frames of the slot into the recording, if there is one; in any thread."""
        with self._taking:
            recording = self.recording
            if recording is not None:
                try:
                    recording.take(self.shared.rings[self.slot], self.n_frames)
                except Exception:
                    recording.ended = "the recording ended early: the host failed at it"
                    raise

    def stop_recording(self) -> Recorded:
        """End the recording; its file stays."""
        try:
            self.take_frames()
        finally:
            with self._taking:
                # under the lock: the supervisor may be in the middle of a block of frames
                recording, self.recording = self.recording, None
            if recording is not None:
                recording.finish()
        return Recorded(0, 0) if recording is None else Recorded(len(recording), recording.n_lost)

    def request_end(self) -> None:
        """Make the loop leave the session after its next frame: the one way in which one ends."""
        self.shared.slots["is_asked_to_end"][self.slot] = True

    def end(self) -> Recorded:
        """End the session and its recording, and give slot and reader row back."""
        self.request_end()
        worker, until = self.shared.slots["worker"], time.monotonic() + END_TIMEOUT
        with self:
            try:
                # the loop clears the field; a dead worker never does
                while worker[self.slot] and self._worker is not None and self._worker.is_alive:
                    if time.monotonic() > until:
                        raise HapticDBError("a worker's loop hangs: end the host")
                    time.sleep(1e-3)
            finally:
                # after the last frame, before the slot is given to another session
                recorded = self.stop_recording()
        return recorded

    def close(self) -> None:
        """Give slot and reader row back."""
        self._ends.close()

"""Running: what a host keeps of a session while it runs."""

import threading

from hapticdb.errors import UsageError
from hapticdb.recording.file import Recorder
from hapticdb.session.board import Board
from hapticdb.session.hosted import Recorded
from hapticdb.session.prefetch.resident_cells import ResidentCells
from hapticdb.session.worker import SeatRequest
from hapticdb.session.workers import WorkerProcess


class Running:
    """A session that a host runs: what its worker was told, its cells, and its worker."""

    def __init__(
        self, request: SeatRequest, session: int, cells: ResidentCells, worker: WorkerProcess
    ) -> None:
        self.request, self.session, self.cells, self.worker = request, session, cells, worker
        self.seat = request.seat
        self._recording: Recorder | None = None
        self._taking = threading.Lock()

    def record(self, path: str, rate: float, *, replace: bool) -> None:
        """Begin a recording at the next frame; errors as of `HostedSession.record`."""
        if self._recording is not None:
            raise UsageError(
                f"the hosted session {self.session} is recorded already: stop it first"
            )
        asked, recording = self.request, Recorder(path, replace=replace)
        try:
            recording.open()
            first, start = self.worker.ask("state", self.seat)
            header = self.cells.header(
                asked.shell, rate, self.worker.request.law, asked.coupling, start
            )
            recording.begin(header, first)
        except BaseException:
            recording.discard()
            raise
        self._recording = recording

    def take_frames(self, board: Board) -> None:
        """Copy new frames from the board into the recording, if there is one; in any thread."""
        with self._taking:
            recording = self._recording
            if recording is not None:
                try:
                    recording.take(board.rings[self.seat], int(board.seats["n_frames"][self.seat]))
                except Exception:
                    recording.ended = "the recording ended early: the host failed at it"
                    raise

    def stop_recording(self, board: Board) -> Recorded:
        """End the recording, which stays."""
        try:
            self.take_frames(board)
        finally:
            with self._taking:
                recording, self._recording = self._recording, None
            if recording is not None:
                recording.finish()
        return Recorded(0, 0) if recording is None else Recorded(len(recording), recording.n_lost)

"""Running: what a host keeps of a session while it runs."""

import threading
import time
from pathlib import Path

from hapticdb.errors import HapticDBError, UsageError
from hapticdb.hosting.hosted import Recorded
from hapticdb.hosting.worker import SeatRequest
from hapticdb.hosting.workers import WorkerProcess
from hapticdb.realtime.board import Board
from hapticdb.realtime.resident_cells import ResidentCells
from hapticdb.recording.file import DEFAULT_LIMIT
from hapticdb.recording.header import Header
from hapticdb.recording.ring import SessionRecording

FRAMES_UNTIL_RECORDED = 2
"""Frames after which every frame has what a recording needs."""
FRAME_PATIENCE = 5.0
"""Seconds in which a worker must run those frames; normally milliseconds."""


class Running:
    """A session that a host runs: what its worker was told, its cells, and its worker."""

    def __init__(
        self, request: SeatRequest, session: int, cells: ResidentCells, worker: WorkerProcess
    ) -> None:
        self.request, self.session, self.cells, self.worker = request, session, cells, worker
        self.seat = request.seat
        self._recording: SessionRecording | None = None
        self._taking = threading.Lock()

    def record(self, path: str, header: Header, board: Board, *, replace: bool) -> None:
        """Begin a recording.

        Raises
        ------
        UsageError
            If there is one already, or the file exists.
        FileError
            If the file cannot be written.
        """
        if self._recording is not None:
            raise UsageError(
                f"the hosted session {self.session} is recorded already: stop it first"
            )
        recording = SessionRecording(
            Path(path), limit_bytes=DEFAULT_LIMIT, append=False, replace=replace
        )
        board.seats["is_recorded"][self.seat] = 1
        try:
            recording.begin(header, self._first_frame(board))
        except BaseException:
            board.seats["is_recorded"][self.seat] = 0
            raise
        self._recording = recording

    def _first_frame(self, board: Board) -> int:
        """Number of the first frame that has what a recording needs."""
        first = int(board.seats["n_frames"][self.seat]) + FRAMES_UNTIL_RECORDED
        until = time.monotonic() + FRAME_PATIENCE
        while int(board.seats["n_frames"][self.seat]) < first:
            if time.monotonic() > until or not self.worker.is_alive:
                raise HapticDBError("a worker runs no frames: end the session and begin another")
            time.sleep(1e-3)
        return first

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
            board.seats["is_recorded"][self.seat] = 0
            if recording is not None:
                recording.finish()
        return Recorded(0, 0) if recording is None else Recorded(len(recording), recording.n_lost)

"""A session's recording: copies frames from the loop's ring to a file."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from hapticdb.errors import FileError, UsageError
from hapticdb.recording.file import Header, Recorder
from hapticdb.recording.frame import Frames

FLUSH_EVERY = 1.0
"""Greatest time (s) whose frames are lost if this process is killed. Smaller: more writes."""
UNSAFE_FRAMES = 64
"""Oldest frames of the ring that are not read, because the loop may overwrite them meanwhile.
Larger: frames are lost after shorter pauses."""


class SessionRecording:
    """Records the frames of one session while the file's limit and the disk permit.

    A recording that ends early, because the disk is full or fails, does not end the session.

    Parameters
    ----------
    path : path
        The file.
    limit_bytes, append, replace :
        As for `hapticdb.recording.file.Recorder`.

    Attributes
    ----------
    ended : str or None
        One line: why the recording has ended before the session; None while it continues.
    n_lost : int
        Frames that the loop has overwritten before they were copied from the ring.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        limit_bytes: int | None,
        append: bool,
        replace: bool,
    ) -> None:
        self.ended: str | None = None
        self.n_lost = 0
        self._path = Path(path)
        self._limit_bytes = limit_bytes
        self._append, self._replace = append, replace
        self._new_file: Path | None = None
        self._recorder: Recorder | None = None
        self._is_going_on = False
        self._n_taken = 0
        self._is_late = False  # the recording begins after the session
        self._began = 0.0  # s of the session at which a late recording begins
        self._flushed_at = 0.0

    def __len__(self) -> int:
        """Count the frames in the file."""
        return 0 if self._recorder is None else len(self._recorder)

    def begin(self, header: Header, first_frame: int = 0) -> None:
        """Make or open the file. Frames are taken from number `first_frame` on, at time 0."""
        self._n_taken, self._is_late = first_frame, first_frame > 0
        # set before the file is made: a signal may interrupt that at any moment
        self._new_file = None if os.path.lexists(self._path) else self._path
        try:
            self._recorder = Recorder(
                self._path, header, limit_bytes=self._limit_bytes, append=self._append,
                replace=self._replace,
            )  # fmt: skip
        except UsageError:  # another process has made the file meanwhile
            self._new_file = None
            raise
        self._is_going_on = True
        self._flushed_at = time.monotonic()

    def remove_new_file(self) -> None:
        """Remove the file if `begin` made it; for a recording without frames."""
        if self._new_file is not None:
            with suppress(OSError):
                self._new_file.unlink()

    def take(self, ring: Frames, n_frames: int) -> None:
        """Record the frames that are new since the last call.

        ring (R,) of `FRAME` : frame n is at index n modulo R; n_frames : number of frames so far.
        """
        if self._recorder is None or not self._is_going_on:
            return
        self._is_going_on = False  # stays so if this fails: a failed recorder takes no more
        size = len(ring)
        if n_frames - self._n_taken > size - UNSAFE_FRAMES:
            self.n_lost += n_frames - self._n_taken - size // 2
            self._n_taken = n_frames - size // 2
        frames = ring[np.arange(self._n_taken, n_frames) % size]
        if self._is_late and len(frames):
            self._is_late, self._began = False, float(frames["time"].min())
        frames["time"] -= self._began
        with self._noting_the_end(self._recorder):
            self._recorder.append(frames)
            if time.monotonic() - self._flushed_at >= FLUSH_EVERY:
                self._recorder.flush()
                self._flushed_at = time.monotonic()
        self._n_taken = n_frames
        self._is_going_on = self.ended is None

    def finish(self) -> None:
        """Write the remaining frames and close the file; an error is stored in `ended`."""
        self._is_going_on = False
        if self._recorder is not None:
            with self._noting_the_end(self._recorder):
                self._recorder.close()

    def close(self) -> None:
        """Close the file; errors are raised."""
        if self._recorder is not None:
            self._recorder.close()

    @contextmanager
    def _noting_the_end(self, recorder: Recorder) -> Iterator[None]:
        """Store in `ended` why the recording has ended; a full disk must not end the session."""
        try:
            yield
        except FileError as error:
            self.ended = str(error)
        else:
            self.ended = self.ended or recorder.ended

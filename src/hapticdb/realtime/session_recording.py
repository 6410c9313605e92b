"""A session's recording: frames are taken out of the loop's ring and written to a file."""

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
"""Seconds of frames that are lost at most when this process is killed. A smaller value writes more
often."""
UNSAFE_FRAMES = 64
"""Frames beside the newest that the loop may be writing over while they are read. A larger value
gives frames up earlier."""


class SessionRecording:
    """Records the frames of one session as far as file and disk take them.

    A recording that ends early, because the disk is full or fails, does not end the session.

    Parameters
    ----------
    path : path
        The file.
    limit_bytes, append, replace :
        As `hapticdb.recording.file.Recorder` takes them.

    Attributes
    ----------
    ended : str or None
        Why it has ended before the session, in a line; None while it goes on.
    n_lost : int
        Frames that the loop has written over before they were taken out of the ring.
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
        self._flushed_at = 0.0

    def __len__(self) -> int:
        """Count the frames in the file."""
        return 0 if self._recorder is None else len(self._recorder)

    def begin(self, header: Header) -> None:
        """Make or open the file."""
        # noted before the file is made: a signal may interrupt the making at any moment
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
        """Remove the file if `begin` made it: no frame was recorded, and the name stays free."""
        if self._new_file is not None:
            with suppress(OSError):
                self._new_file.unlink()

    def take(self, ring: Frames, n_frames: int) -> None:
        """Record the frames that have come since the last time.

        ring (R,) of `FRAME` : frame n stands at n modulo R; n_frames : of the session so far.
        """
        if self._recorder is None or not self._is_going_on:
            return
        self._is_going_on = False  # unless this goes well: a recorder that failed takes no more
        size = len(ring)
        if n_frames - self._n_taken > size - UNSAFE_FRAMES:
            self.n_lost += n_frames - self._n_taken - size // 2
            self._n_taken = n_frames - size // 2
        frames = ring[np.arange(self._n_taken, n_frames) % size]
        with self._noting_the_end(self._recorder):
            self._recorder.append(frames)
            if time.monotonic() - self._flushed_at >= FLUSH_EVERY:
                self._recorder.flush()
                self._flushed_at = time.monotonic()
        self._n_taken = n_frames
        self._is_going_on = self.ended is None

    def finish(self) -> None:
        """Write what is left and close the file; an error is noted in `ended`."""
        self._is_going_on = False
        if self._recorder is not None:
            with self._noting_the_end(self._recorder):
                self._recorder.close()

    def close(self) -> None:
        """Close the file; an error is raised."""
        if self._recorder is not None:
            self._recorder.close()

    @contextmanager
    def _noting_the_end(self, recorder: Recorder) -> Iterator[None]:
        """Note why the recording has ended, if it has: a full disk must not end the session."""
        try:
            yield
        except FileError as error:
            self.ended = str(error)
        else:
            self.ended = self.ended or recorder.ended

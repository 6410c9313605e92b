"""Recorded sessions: one file (.hdbrec) each, a header and rows of frames, bit for bit.

docs/format.md describes the bytes; `numpy.memmap` reads the rows. A torn last row, after a killed
recorder, is not read. A recorder stops at its size limit, and before the disk is full.
"""

import contextlib
import io
import os
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hapticdb.closing import Closes
from hapticdb.errors import FileError, UsageError
from hapticdb.poses import poses_of
from hapticdb.recording.frame import FRAME, Frames, State
from hapticdb.recording.header import MAGIC, OLDER, Header

__all__ = ["FRAME", "Frames", "Header", "Recorder", "Recording", "State"]

DEFAULT_LIMIT = 4 << 30
"""Default of the greatest size of a recording, bytes: 3.5 hours at 1 kHz."""
LEFT_FREE = 64 << 20
"""Disk space reserved for other writers, such as the database, bytes."""
UNSAFE_FRAMES = 64
"""Oldest frames of the ring that are not read: the loop may be overwriting them. Larger: frames are
lost after shorter pauses."""


class Recording:
    """Reader of a recorded session.

    Frames appended to the file later are not read. Raises `FileError` if the file is missing, is no
    recording, or is cut off or damaged within its header.

    Attributes
    ----------
    path : Path
        The file.
    header : Header
        Environment, tool and settings of the session.
    n_torn : int
        Bytes behind the last whole row; more than 0 after a killed recorder.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        try:
            if self.path.exists() and not self.path.is_file():  # opening a pipe would wait for ever
                raise FileError(f"{self.path} is no file; give a recording")
            with io.FileIO(self.path, "rb") as file:
                self.header, self._start = Header.read(file, str(self.path))
                size = os.fstat(file.fileno()).st_size - self._start
        except FileNotFoundError:
            raise FileError(f"no recording at {self.path}") from None
        except OSError as error:
            raise FileError(f"cannot read {self.path}: {error.strerror}") from error
        self._n_frames, self.n_torn = divmod(size, FRAME.itemsize)

    def __repr__(self) -> str:
        return f"Recording({str(self.path)!r}, started {self.header.started})"

    def __len__(self) -> int:
        return self._n_frames

    def frames(self) -> Frames:
        """All frames (M,) of `FRAME`, mapped from the file."""
        if not self._n_frames:
            return np.empty(0, FRAME)
        return np.memmap(self.path, FRAME, "r", self._start, (self._n_frames,))

    def poses(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Times (M,), s, and poses (M, 4, 4) world_from_hand of the handle, for a `Player`."""
        frames = self.frames()
        return np.array(frames["time"]), poses_of(frames["hand"])

    def environment_beside(self) -> Path:
        """Path of the recorded environment: an SQLite file in the recording's own folder.

        The recording's author chose the name in its header. So nothing else is opened from it: no
        server's URL, no file in another folder, no symbolic link to one. `UsageError` if the header
        names anything else.
        """
        name = self.header.environment
        if not re.search(r"[/\\?:\0]", name):
            file, folder = self.path.parent / name, self.path.parent
            with contextlib.suppress(OSError, RuntimeError):  # a name too long, links in a circle
                if file.is_file() and file.resolve().parent == folder.resolve():
                    return file
        raise UsageError(
            f"{self.path} names the environment {name!a}, which is no file beside it: name the one "
            "to open, 'hapticdb replay FILE URL'"
        )


class Recorder(Closes):
    """Writes the frames of one session to a recording; a context manager, which closes it.

    `open` creates the file, `begin` writes its header, `append` and `take` write frames. Written
    rows survive the death of the process. `close` writes all to the disk (fsync).

    Parameters
    ----------
    path : path
        The file, `.hdbrec` by custom.
    replace : bool
        Replace an existing recording. The old one stays until the first frames of the new one are
        written; until then the new one has the temporary name ``.NAME.PID.new``.
    limit_bytes : int or None
        Greatest size of the file; None: the disk's free space less `LEFT_FREE`, which always
        applies. The first frame beyond the limit and all later ones are dropped: see `ended`.

    Attributes
    ----------
    path : Path
        The file.
    ended : str or None
        One line: reason of an end before the session's; None while frames are accepted. The file
        is complete and closed when this is set.
    n_lost : int
        Frames overwritten by the loop before they were copied from the ring.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        replace: bool = False,
        limit_bytes: int | None = DEFAULT_LIMIT,
    ) -> None:
        if limit_bytes is not None and not limit_bytes > 0:
            raise UsageError(f"a recording of {limit_bytes} bytes at most: give 1 or more")
        self.path = Path(path)
        self.ended: str | None = None
        self.n_lost = 0
        self._replace, self._limit = replace, limit_bytes
        self._file: io.FileIO | None = None
        self._made: Path | None = None  # the new file, while it may be removed
        self._n_written = self._end = self._n_taken = 0
        self._began: float | None = 0.0  # s of the session at which the recording begins

    def __len__(self) -> int:
        return self._n_written

    def open(self) -> None:
        """Create the file.

        Raises
        ------
        UsageError
            If it exists and is not to be replaced.
        FileError
            If it cannot be written, is no recording, or the disk has no room.
        """
        self._made = self.path
        if self._replace and os.path.lexists(self.path):
            self._made = None
            with self._as_file_errors("replace"), io.FileIO(self.path, "rb") as old:
                start = old.read(len(MAGIC))
            if start and start[: len(OLDER)] != OLDER and start != MAGIC:
                raise FileError(f"{self.path} is no recording of hapticdb: give another name")
            self._made = self.path.with_name(f".{self.path.name}.{os.getpid()}.new")
        elif os.path.lexists(self.path):
            self._made = None
            raise UsageError(
                f"{self.path} is there already: replace it (--replace), or give another name"
            )
        try:
            self._file = io.FileIO(self._made, "xb")
        except FileExistsError:  # another process has created it meanwhile
            self._made = None
            raise UsageError(f"{self.path} is being recorded: give another name") from None
        except OSError as error:
            raise FileError(f"cannot write {self.path}: {error.strerror}") from error
        self._check_room(0)

    def begin(self, header: Header, first_frame: int = 0) -> None:
        """Write the header. `take` begins with frame `first_frame`, at time 0."""
        content = header.packed()
        self._check_room(len(content))
        self._write(content)
        self._n_taken, self._began = first_frame, None if first_frame else 0.0

    def append(self, frames: Frames) -> None:
        """Write frames (n,) of `FRAME`, as many as have room; no effect after `ended`.

        If the disk is full or fails, `FileError`: the recorder is then closed, and the frames
        written before stay.
        """
        if self.ended is not None or not len(frames):
            return
        room, reason = self._room()
        n = min(max(room // FRAME.itemsize, 0), len(frames))
        if n:
            self._write(frames[:n].tobytes())
            self._n_written += n
            if self._made is not None and self._made != self.path:
                with self._as_file_errors():
                    self._made.replace(self.path)
                self._made = None
        if n < len(frames):
            self.ended = (
                f"{self.path}: the recording ends after {self._n_written:,} frames, {reason}"
            )
            self.close()

    def take(self, ring: Frames, n_frames: int) -> None:
        """Record the new frames since the last call; an error is stored in `ended`.

        ring (R,) of `FRAME` : frame n is at index n modulo R; n_frames : number of frames so far.
        """
        if self.ended is not None or not self._end:  # not begun
            return
        size = len(ring)
        if n_frames - self._n_taken > size - UNSAFE_FRAMES:
            self.n_lost += n_frames - self._n_taken - size // 2
            self._n_taken = n_frames - size // 2
        frames = ring[np.arange(self._n_taken, n_frames) % size]
        self._n_taken = n_frames
        if len(frames):
            self._began = float(frames["time"][0]) if self._began is None else self._began
            frames["time"] -= self._began
        with self._noting_the_end():
            self.append(frames)

    def finish(self) -> None:
        """Close the file; store an error in `ended`: a full disk must not end the session."""
        with self._noting_the_end():
            self.close()

    def discard(self) -> None:
        """Remove the file created by `open`; for a session that did not begin."""
        self._end = 0  # no frame is taken any more
        if self._file is not None:
            self._file.close()
        if self._made is not None:
            with contextlib.suppress(OSError):
                self._made.unlink()

    def close(self) -> None:
        """Write all to the disk (fsync), and close the file."""
        if self._file is None or self._file.closed:
            return
        try:
            with self._as_file_errors():
                os.fsync(self._file.fileno())
        finally:
            self._file.close()
            self._restore_old()

    @contextlib.contextmanager
    def _noting_the_end(self) -> Iterator[None]:
        try:
            yield
        except FileError as error:
            self.ended = str(error)

    def _restore_old(self) -> None:
        """Remove the new file if no frame was written; the old recording stays."""
        if self._made is not None and self._made != self.path:
            self._made.unlink(missing_ok=True)

    def _room(self) -> tuple[int, str]:
        """Bytes free for frames, and the words for their limit."""
        assert self._file is not None  # noqa: S101 - it is open
        free = free_bytes(self._file) - LEFT_FREE
        limit = free if self._limit is None else self._limit - self._end
        if limit <= free and self._limit is not None:
            return limit, f"at its limit of {_size(self._limit)}"
        return free, f"since its disk has no more than {_size(LEFT_FREE)} left"

    def _check_room(self, n_bytes: int) -> None:
        """Raise an error without room for a header of `n_bytes` bytes and one frame."""
        least = n_bytes + FRAME.itemsize
        if self._limit is not None and least > self._limit:
            raise UsageError(
                f"{self.path}: a recording of {self._limit:,} bytes at most, and its header and a "
                f"frame take {least:,}: give a higher limit"
            )
        assert self._file is not None  # noqa: S101 - it is open
        if (free := free_bytes(self._file)) < LEFT_FREE + least:
            raise FileError(
                f"cannot write {self.path}: its disk has {_size(free)} left, of which a recording "
                f"leaves {_size(LEFT_FREE)}: make room, or record elsewhere"
            )

    def _write(self, content: bytes) -> None:
        """Write all of `content`; on an error, remove the part written, close and raise."""
        assert self._file is not None  # noqa: S101 - it is open
        try:
            rest = memoryview(content)
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            with contextlib.suppress(OSError):
                self._file.truncate(self._end)
            self._file.close()
            self._restore_old()
            raise FileError(
                f"cannot write {self.path}: {error.strerror}; its first {self._n_written} frames "
                "are whole"
            ) from error
        self._end += len(content)

    @contextlib.contextmanager
    def _as_file_errors(self, what: str = "write") -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise FileError(f"cannot {what} {self.path}: {error.strerror}") from error


def free_bytes(file: io.FileIO) -> int:
    """Free bytes for this process on the disk of an open file."""
    found = os.fstatvfs(file.fileno())
    return found.f_bavail * found.f_frsize


def _size(n_bytes: int) -> str:
    return (
        f"{n_bytes / (1 << 30):.4g} GiB" if n_bytes >= 1 << 30 else f"{n_bytes / (1 << 20):.4g} MiB"
    )

"""Recorded sessions: one file (.hdbrec) each, a header and chunks of frames, bit for bit.

docs/format.md describes the bytes. A file that was cut off is read up to its last whole chunk; a
recorder that appends to the file first removes the rest. A recorder stops by itself at its size
limit, and before the disk is full.
"""

import contextlib
import fcntl
import io
import os
import re
import zlib
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hapticdb.closing import Closes
from hapticdb.errors import FileError, UsageError
from hapticdb.kernels.rigid import poses_of
from hapticdb.recording.chunks import HEAD, MOST_FRAMES, Chunk, Scan, read_bytes, scan
from hapticdb.recording.frame import FRAME, Frames, State
from hapticdb.recording.header import MAGIC, Header
from hapticdb.recording.packing import pack, unpack

__all__ = ["FRAME", "MOST_FRAMES", "Frames", "Header", "Recorder", "Recording", "State"]

CHUNK = 4096
"""Frames that a recorder packs into one chunk: 1.3 MB in memory. Larger: more memory."""
DEFAULT_LIMIT = 4 << 30
"""Default of the greatest size of a recording, bytes: six hours at 1 kHz, one at 5 kHz."""
LEFT_FREE = 64 << 20
"""Bytes of the disk that a recorder leaves free for other writers, such as the database."""


class Recording:
    """A recorded session, to be read. The file is open only during a call.

    Frames that are added to the file later are not read. Raises `FileError` if the file is missing,
    is no recording, or is cut off within its header.

    Attributes
    ----------
    path : Path
        The file.
    header : Header
        Environment, tool and settings of the session.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        with self._file() as file:
            self.header, self._start = Header.read(file, str(self.path))

    def __repr__(self) -> str:
        return f"Recording({str(self.path)!r}, started {self.header.started})"

    def __len__(self) -> int:
        return self._scan.n_frames

    def environment_beside(self) -> Path:
        """Path of the recorded environment: an SQLite file in the recording's own folder.

        Whoever wrote the recording chose what its header names. So nothing else is opened from it:
        no server's address, no file in another folder, no symbolic link to one. `UsageError` if the
        header names anything else.
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

    @property
    def damaged_at(self) -> int | None:
        """Index of the first unreadable frame that whole frames follow; None if there is none."""
        return None if self._scan.damaged < 0 else self._scan.damaged

    @property
    def n_torn(self) -> int:
        """Bytes behind the last whole chunk; more than 0 if the recorder was killed."""
        return 0 if self._scan.damaged >= 0 else self._size - self._scan.end

    def frames(self, *, until_damage: bool = False) -> Iterator[Frames]:
        """Yield the frames in order, chunk by chunk: (n,) of `FRAME`, n at most `MOST_FRAMES`.

        At a damaged chunk `FileError` is raised, or the frames end with `until_damage`.
        """
        for columns in self._chunks(FRAME.names or (), until_damage=until_damage):
            frames = np.empty(len(columns[0]), dtype=FRAME)
            for name, column in zip(FRAME.names or (), columns, strict=True):
                frames[name] = column
            yield frames

    def columns(self, *names: str, until_damage: bool = False) -> tuple[NDArray[np.generic], ...]:
        """Read whole columns, (M,) or (M, k) each, in the order of `names`; see `FRAME`.

        Raises `UsageError` if there is no such column, and `FileError` as `frames`.
        """
        unknown = [name for name in names if name not in (FRAME.names or ())]
        if unknown or not names:
            known = ", ".join(FRAME.names or ())
            raise UsageError(f"columns {', '.join(unknown) or 'of no name'}: choose of {known}")
        pieces = [[np.empty((0, *FRAME[name].shape), FRAME[name].base)] for name in names]
        for columns in self._chunks(names, until_damage=until_damage):
            for parts, column in zip(pieces, columns, strict=True):
                parts.append(column)
        return tuple(np.concatenate(parts) for parts in pieces)

    def poses(
        self, *, until_damage: bool = False
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Times (M,), s, and poses (M, 4, 4) world_from_hand of the handle, for a `Player`."""
        times, hands = self.columns("time", "hand", until_damage=until_damage)
        poses = np.empty((len(hands), 4, 4))
        poses_of(np.ascontiguousarray(hands, dtype=np.float64), poses)
        return times.astype(np.float64), poses

    def _chunks(
        self, names: tuple[str, ...], *, until_damage: bool
    ) -> Iterator[list[NDArray[np.generic]]]:
        """Yield the columns of each chunk."""
        with self._file() as file:
            for place, chunk in self._scan.chunks:
                file.seek(place)
                content = read_bytes(file, chunk.n_bytes)
                try:  # the file may have changed since the scan
                    if zlib.crc32(content) != chunk.crc:
                        raise ValueError("another checksum")  # noqa: TRY301 - as one that unpack finds
                    columns = list(unpack(content, chunk.n_frames, FRAME, names))
                except ValueError as error:
                    if until_damage:
                        return
                    raise self._damage(chunk.first) from error
                yield columns
        if self._scan.damaged >= 0 and not until_damage:
            raise self._damage(self._scan.damaged)

    def _damage(self, frame: int) -> FileError:
        return FileError(
            f"{self.path}: damaged at frame {frame}; the frames before it are whole: "
            "read them with until_damage, or 'hapticdb replay --until-damage'"
        )

    def _file(self) -> io.FileIO:
        try:
            if self.path.exists() and not self.path.is_file():  # a pipe would wait for ever
                raise FileError(f"{self.path} is no file; give a recording")
            return io.FileIO(self.path, "rb")
        except FileNotFoundError:
            raise FileError(f"no recording at {self.path}") from None
        except OSError as error:
            raise FileError(f"cannot read {self.path}: {error.strerror}") from error

    @cached_property
    def _size(self) -> int:
        return self.path.stat().st_size

    @cached_property
    def _scan(self) -> Scan:
        with self._file() as file:
            return scan(file, self._start, self._size)


class Recorder(Closes):
    """Writes frames to a recording; a context manager, which closes the recording.

    Chunks that `flush` or a full buffer has written survive the process. `close` writes all to
    the disk (fsync).

    Parameters
    ----------
    path : path
        The file, `.hdbrec` by custom.
    header : Header
        Environment, tool and settings of the session.
    append : bool
        Continue an existing recording. The header must be the same, except for the revision, the
        version and the start. Old frames stay; a cut-off end is removed. The caller sets the times
        of new frames; they count from the start in the attribute `header`.
    replace : bool
        Replace an existing recording. The old one stays until the first frames of the new one are
        written; until then the new one is a file ``.NAME.new`` beside it.
    limit_bytes : int or None
        Greatest size of the file; None: the disk's free space less `LEFT_FREE`, which always
        applies. The first frame beyond the limit and all later ones are left out: see `ended`.

    Raises
    ------
    UsageError
        If the file exists and neither `append` nor `replace` is given, the header to append has
        other values, another recorder writes the file, or the limit leaves no room for a frame.
    FileError
        If the file cannot be written, the disk has no room, or the file to append to or to replace
        is no whole recording.

    Attributes
    ----------
    path, header
        The file, and the header in it.
    ended : str or None
        One line: why the recorder stopped by itself; None while it takes frames. The file is whole
        and closed when this is set.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        header: Header,
        *,
        append: bool = False,
        replace: bool = False,
        limit_bytes: int | None = DEFAULT_LIMIT,
    ) -> None:
        if append and replace:
            raise UsageError("a recording is either appended to or replaced: choose one")
        if limit_bytes is not None and not limit_bytes > 0:
            raise UsageError(f"a recording of {limit_bytes} bytes at most: give 1 or more")
        self.path = Path(path)
        self.header = header
        self.ended: str | None = None
        self._limit = limit_bytes
        self._buffer: Frames = np.empty(CHUNK, dtype=FRAME)
        self._n_waiting = self._n_written = self._end = 0
        self._beside = self._beside_old() if replace else None
        self._file = self._open(may_exist=append or replace)
        try:
            self._begin(append=append)
        except BaseException:
            self._file.close()
            if self._beside is not None or not (append or replace):  # made just now
                (self._beside or self.path).unlink(missing_ok=True)
            raise

    def __len__(self) -> int:
        return self._n_written + self._n_waiting

    def append(self, frames: Frames) -> None:
        """Add frames (n,) of `FRAME`, and write each full chunk; does nothing if `ended` is set.

        Raises `UsageError` for another dtype or shape, or if the recorder is closed. If the disk is
        full or fails, `FileError`: the recorder is then closed, and the chunks written before stay.
        """
        if self.ended is None:
            self._check_open()
        if frames.dtype != FRAME or frames.ndim != 1:
            raise UsageError(f"frames of {frames.dtype} {frames.shape}: give (n,) of FRAME")
        at = 0
        while at < len(frames) and self.ended is None:
            n = min(len(frames) - at, CHUNK - self._n_waiting)
            self._buffer[self._n_waiting : self._n_waiting + n] = frames[at : at + n]
            self._n_waiting += n
            at += n
            if self._n_waiting == CHUNK:
                self.flush()

    def flush(self) -> None:
        """Write the waiting frames as one chunk, as many as there is room for."""
        if self.ended is not None:
            return
        self._check_open()
        n = self._n_waiting
        room, reason = self._room() if n else (0, "")
        content = self._packed(n)
        while n and len(content) > room:
            n //= 2
            content = self._packed(n)
        is_full, self._n_waiting = n < self._n_waiting, 0
        if n:
            self._write(content)
            self._n_written += n
            self._take_the_name()
        if is_full:
            self.ended = (
                f"{self.path}: the recording ends after {self._n_written:,} frames, {reason}"
            )
            self._finish()

    def close(self) -> None:
        """Write the waiting frames and the end mark, and wait until all is on the disk."""
        if self._file.closed:
            return
        try:
            self.flush()
            if self.ended is None:
                self._finish()
        finally:
            self._file.close()

    def _finish(self) -> None:
        """Write the end mark, wait until all is on the disk, and close."""
        try:
            self._write(Chunk(self._n_written, 0, 0, 0).packed())
            with self._told():
                os.fsync(self._file.fileno())
        finally:
            self._file.close()
            self._leave_old()

    def _beside_old(self) -> Path | None:
        """Path of the new file that will replace a recording; None if there is none to replace."""
        try:
            with io.FileIO(self.path, "rb") as old:
                if os.fstat(old.fileno()).st_size and old.read(len(MAGIC)) != MAGIC:
                    raise FileError(f"{self.path} is no recording of hapticdb: give another name")
                self._lock(old)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise FileError(f"cannot replace {self.path}: {error.strerror}") from error
        return self.path.with_name(f".{self.path.name}.new")

    def _leave_old(self) -> None:
        """Keep the old recording if no frame was written: remove the new file."""
        if self._beside is not None:
            self._beside.unlink(missing_ok=True)

    def _take_the_name(self) -> None:
        if self._beside is not None:
            with self._told():
                self._beside.replace(self.path)
            self._beside = None

    def _packed(self, n: int) -> bytes:
        """Pack the first n waiting frames into a chunk; empty for n = 0."""
        if not n:
            return b""
        payload = pack(self._buffer[:n])
        return Chunk(self._n_written, n, len(payload), zlib.crc32(payload)).packed() + payload

    def _room(self) -> tuple[int, str]:
        """Bytes left for a chunk with room for the end mark, and the words for what limits them."""
        free = free_bytes(self._file) - LEFT_FREE
        limit = free if self._limit is None else self._limit - self._end
        if limit <= free and self._limit is not None:
            return limit - HEAD.size, f"at its limit of {_size(self._limit)}"
        return free - HEAD.size, f"since its disk has no more than {_size(LEFT_FREE)} left"

    def _open(self, *, may_exist: bool) -> io.FileIO:
        flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | (0 if may_exist else os.O_EXCL)
        try:
            file = io.FileIO(os.open(self._beside or self.path, flags, 0o666), "r+b")
        except FileExistsError:
            raise UsageError(
                f"{self.path} is there already: append to it (--append), replace it (--replace), "
                "or give another name"
            ) from None
        except OSError as error:
            raise FileError(f"cannot write {self.path}: {error.strerror}") from error
        self._lock(file)
        return file

    def _lock(self, file: io.FileIO) -> None:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            file.close()
            raise UsageError(f"{self.path} is being recorded: give another name") from error

    def _begin(self, *, append: bool) -> None:
        """Write the header, or go to the end of the recording to append to."""
        size = os.fstat(self._file.fileno()).st_size
        if not (append and size):
            content = self.header.packed()
            self._check_room(len(content), freed=size)
            with self._told():
                self._file.truncate(0)
            self._write(content)
            return
        given, (self.header, start) = self.header, Header.read(self._file, str(self.path))
        if differing := self.header.differing(given):
            raise UsageError(
                f"{self.path} was recorded with another {', '.join(differing)}: give another name"
            )
        found = scan(self._file, start, size)
        if found.damaged >= 0:
            raise FileError(f"{self.path}: damaged at frame {found.damaged}; give another name")
        self._check_room(found.end, freed=size)
        with self._told():
            self._file.truncate(found.end)
            self._file.seek(found.end)
        self._n_written, self._end = found.n_frames, found.end

    def _check_room(self, n_bytes: int, freed: int) -> None:
        """Raise an error if no frame would fit behind the first `n_bytes` bytes of the file."""
        least = n_bytes + 2 * HEAD.size + FRAME.itemsize
        if self._limit is not None and least > self._limit:
            raise UsageError(
                f"{self.path}: a recording of {self._limit:,} bytes at most, and {n_bytes:,} come "
                "before the first new frame: give a higher limit"
            )
        free = free_bytes(self._file) + freed
        if free < LEFT_FREE + least:
            raise FileError(
                f"cannot write {self.path}: its disk has {_size(free)} left, of which a recording "
                f"leaves {_size(LEFT_FREE)}: make room, or record elsewhere"
            )

    def _write(self, content: bytes) -> None:
        """Write all of `content`; on an error, remove the part written, close and raise."""
        try:
            rest = memoryview(content)
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            with contextlib.suppress(OSError):
                self._file.truncate(self._end)
            self._file.close()
            self._leave_old()
            self._n_waiting = 0
            raise FileError(
                f"cannot write {self.path}: {error.strerror}; its first {self._n_written} frames "
                "are whole"
            ) from error
        self._end += len(content)

    @contextlib.contextmanager
    def _told(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise FileError(f"cannot write {self.path}: {error.strerror}") from error

    def _check_open(self) -> None:
        if self._file.closed:
            raise UsageError(f"{self.path}: the recorder is closed")


def free_bytes(file: io.FileIO) -> int:
    """Bytes that this process may still write on the disk of an open file."""
    found = os.fstatvfs(file.fileno())
    return found.f_bavail * found.f_frsize


def _size(n_bytes: int) -> str:
    return (
        f"{n_bytes / (1 << 30):.4g} GiB" if n_bytes >= 1 << 30 else f"{n_bytes / (1 << 20):.4g} MiB"
    )

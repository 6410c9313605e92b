"""The files that an open database consists of, and whether its path still leads to them.

In WAL mode SQLite does not check the path. It goes on writing into files that were deleted or
replaced, and reports every commit as done.
"""

import atexit
import contextlib
import os
import sys
import time
import weakref
from pathlib import Path

import apsw

from hapticdb.errors import BusyError, ConnectionLostError, DamagedError
from hapticdb.store.sqlite import log as sqlite_log
from hapticdb.store.sqlite import raw as sqlite_bytes
from hapticdb.store.sqlite.raw import PAGE_BYTES, PAGE_COUNT_AT

LOOK_SECONDS = 0.25
"""Longest time until a reader notices that its path leads to another file. A smaller value costs
more calls of the operating system."""

Identity = tuple[int, int]
"""Device and inode."""
Stamp = tuple[int, int, bool]
"""Time of the last write, size, and whether a log is there."""


class OpenedFile:
    """The file that a path led to when it was opened; its engine keeps reading that one.

    Raises `ConnectionLostError` when it cannot be reached. Raises `DamagedError` when the log
    beside it belongs to another file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._real = path.resolve()
        """The file itself, if the path is a link. SQLite keeps its log beside it."""
        self._log = f"{self._real}-wal"
        self.due = 0.0
        self._connection: apsw.Connection | None = None
        self._beside: dict[str, Identity] = {}
        self.stamp: Stamp | None = None
        self._size = 0
        """Greatest size so far, bytes."""
        self.identity = self._found()
        self._mark = sqlite_log.check_log(self._real)

    def settle(self, connection: apsw.Connection, *, is_immutable: bool) -> None:
        """Note the files that SQLite keeps beside the file, after the first read.

        Raises `ConnectionLostError` when the path leads to another file by now.
        """
        self._connection = connection
        _OPEN.add(self)
        if is_immutable:
            self.stamp = _stamp(self._path)
        else:
            for beside in (self._log, f"{self._real}-shm"):
                found = _identity(beside)
                if found:
                    self._beside[beside] = found
        self.look()

    def check(self) -> None:
        """Call `look` if the last one is `LOOK_SECONDS` ago: cheap enough for each read."""
        if time.monotonic() >= self.due:
            self.look()

    def look(self, *, has_committed: bool = False) -> None:
        """Refuse to go on when the path leads to another file or to other contents.

        Raises `ConnectionLostError` when the file, or SQLite's files beside it, were moved,
        deleted, replaced or cut short. Raises `DamagedError` when another file was copied over it.
        """
        lost = "what was written last is not in it; open it again"
        if self._found() != self.identity:
            what = lost if has_committed else "open it again"
            raise ConnectionLostError(f"{self._path} is another file than before: {what}")
        for beside, identity in self._beside.items():
            if _identity(beside) != identity:
                what = "what was written last may be lost; " if has_committed else ""
                raise ConnectionLostError(
                    f"{beside} was removed or replaced while {self._path.name} was open: {what}"
                    f"end all that has {self._path.name} open, then open it again"
                )
        self._check_mark()
        self.due = time.monotonic() + LOOK_SECONDS

    def check_stamp(self) -> None:
        """Refuse to read on after somebody else has written.

        For files that were opened as immutable: SQLite takes no locks on them.

        Raises `BusyError` when somebody has written.
        """
        if self.has_new_stamp():
            raise BusyError(f"{self._path} has been written since it was opened: open it again")

    def has_new_stamp(self) -> bool:
        """Whether somebody has written or removed a file that was opened as immutable."""
        return _stamp(self._path) != self.stamp

    def close(self) -> None:
        """Close the connection. The last one folds the log into the file that it belongs to."""
        if self._connection is None:
            return
        if not self._may_fold():
            self._connection.config(apsw.SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE, 1)
        self._connection.close()
        self._connection = None

    def __del__(self) -> None:
        """Close if nobody has, or SQLite would write its log into whatever file is there then."""
        if not sys.is_finalizing():  # names of modules may be gone; `_close_all` was there before
            with contextlib.suppress(Exception):
                self.close()

    def _may_fold(self) -> bool:
        """Whether the engine may write its log into the file when the connection closes."""
        try:
            self.look()
        except DamagedError:
            return False
        except ConnectionLostError:
            return self._owns_its_log()
        return True

    def _owns_its_log(self) -> bool:
        """Whether only the names beside the file are gone, so that its log can go into the file."""
        descriptor = sqlite_bytes.descriptor_of(self._beside.get(self._log, (0, 0)))
        if _identity(str(self._path)) != self.identity or descriptor is None:
            return False
        try:
            sqlite_log.check_log(self._real, sqlite_bytes.DESCRIPTORS / str(descriptor))
        except DamagedError:
            return False
        return True

    def _check_mark(self) -> None:
        if self._connection is None or self.stamp is not None:
            return
        _, page = self._connection.read("main", 0, sqlite_log.LINEAGE_AT, PAGE_BYTES)
        if (mark := sqlite_log.mark_in(page)) != self._mark:
            mark = sqlite_log.check_log(self._real)
            if mark is None:  # the log had a mark before, and a checkpoint keeps it
                raise sqlite_log.not_its_log(self._real)
            self._mark = mark

    def _is_cut(self, size: int) -> bool:
        """Whether a file of that size lacks pages that its header counts; a VACUUM leaves all."""
        if self._connection is None:
            return True
        _, count = self._connection.read("main", 0, PAGE_COUNT_AT, 4)
        pages = int.from_bytes(count, "big")
        return not pages or size < pages * PAGE_BYTES

    def _found(self) -> Identity:
        try:
            status = self._path.stat()
        except OSError as error:
            raise ConnectionLostError(
                f"{self._path} cannot be reached any more ({error.strerror}): put it back"
            ) from error
        if status.st_size < self._size and self._is_cut(status.st_size):
            raise ConnectionLostError(
                f"{self._path} has become shorter ({status.st_size} bytes of {self._size}): open "
                "it again"
            )
        self._size = status.st_size
        return status.st_dev, status.st_ino


_OPEN: "weakref.WeakSet[OpenedFile]" = weakref.WeakSet()


@atexit.register
def _close_all() -> None:
    """Close what is still open when the program ends, as long as its modules are there."""
    for file in list(_OPEN):
        with contextlib.suppress(Exception):
            file.close()


def _identity(path: str) -> Identity | None:
    try:
        status = os.stat(path)  # noqa: PTH116 - a tenth of making a Path, twice for each write
    except OSError:
        return None
    return status.st_dev, status.st_ino


def _stamp(path: Path) -> Stamp:
    try:
        status = path.stat()
    except FileNotFoundError:
        return 0, 0, False
    return status.st_mtime_ns, status.st_size, Path(f"{path}-wal").exists()

"""Identity of an opened database file, and checks of its path.

In WAL mode SQLite does not check the path. It goes on writing into a deleted or replaced file, and
reports every commit as done.
"""

import time
from pathlib import Path

from hapticdb.errors import BusyError, ConnectionLostError

CHECK_SECONDS = 0.25
"""Longest delay until a reader notices another file at its path, s."""

Stamp = tuple[int, int, bool]
"""Time of the last write, size, existence of a log."""


class OpenedFile:
    """The file of a path at its opening; ConnectionLostError when it is gone.

    identity : device and inode; stamp : of an immutable file, else None.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.due = 0.0
        self.stamp: Stamp | None = None
        self.identity = self._found()

    def settle(self, *, is_immutable: bool) -> None:
        """Record the stamp after the first read; ConnectionLostError for another file."""
        if is_immutable:
            self.stamp = _stamp(self._path)
        self.verify()

    def check(self) -> None:
        """Call `verify` if the last call was `CHECK_SECONDS` ago: cheap enough for each read."""
        if time.monotonic() >= self.due:
            self.verify()

    def verify(self, *, has_committed: bool = False) -> None:
        """Raise `ConnectionLostError` when the path leads to another file, or to none."""
        if self._found() != self.identity:
            lost = "what was written last is not in it; " if has_committed else ""
            raise ConnectionLostError(
                f"{self._path} is another file than before: {lost}open it again"
            )
        self.due = time.monotonic() + CHECK_SECONDS

    def check_stamp(self) -> None:
        """Raise `BusyError` after a write to an immutable file, opened without SQLite's locks."""
        if self.has_new_stamp():
            raise BusyError(f"{self._path} has been written since it was opened: open it again")

    def has_new_stamp(self) -> bool:
        """Whether an immutable file has been written or removed."""
        return _stamp(self._path) != self.stamp

    def _found(self) -> tuple[int, int]:
        try:
            status = self._path.stat()
        except OSError as error:
            raise ConnectionLostError(
                f"{self._path} cannot be reached any more ({error.strerror}): put it back"
            ) from error
        return status.st_dev, status.st_ino


def _stamp(path: Path) -> Stamp:
    try:
        status = path.stat()
    except FileNotFoundError:
        return 0, 0, False
    # a write goes into the log first, so a new log counts before the file changes
    return status.st_mtime_ns, status.st_size, Path(f"{path}-wal").exists()

"""The file that an open database is, and whether its path still leads to it.

In WAL mode SQLite does not check the path. It goes on writing into a file that was deleted or
replaced, and reports every commit as done.
"""

import time
from pathlib import Path

from hapticdb.errors import BusyError, ConnectionLostError

LOOK_SECONDS = 0.25
"""Longest time until a reader notices that its path leads to another file."""

Stamp = tuple[int, int, bool]
"""Time of the last write, size, and whether a log is there."""


class OpenedFile:
    """The file that a path led to when it was opened; ConnectionLostError when it is gone.

    identity : device and inode; stamp : of a file that was opened as immutable, else None.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.due = 0.0
        self.stamp: Stamp | None = None
        self.identity = self._found()

    def settle(self, *, is_immutable: bool) -> None:
        """Note the stamp after the first read; ConnectionLostError for another file."""
        if is_immutable:
            self.stamp = _stamp(self._path)
        self.look()

    def check(self) -> None:
        """Call `look` if the last one is `LOOK_SECONDS` ago: cheap enough for each read."""
        if time.monotonic() >= self.due:
            self.look()

    def look(self, *, has_committed: bool = False) -> None:
        """Raise `ConnectionLostError` when the path leads to another file, or to none."""
        if self._found() != self.identity:
            lost = "what was written last is not in it; " if has_committed else ""
            raise ConnectionLostError(
                f"{self._path} is another file than before: {lost}open it again"
            )
        self.due = time.monotonic() + LOOK_SECONDS

    def check_stamp(self) -> None:
        """Raise `BusyError` after a write to an immutable file, on which SQLite takes no locks."""
        if self.has_new_stamp():
            raise BusyError(f"{self._path} has been written since it was opened: open it again")

    def has_new_stamp(self) -> bool:
        """Whether somebody has written or removed a file that was opened as immutable."""
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
    return status.st_mtime_ns, status.st_size, Path(f"{path}-wal").exists()

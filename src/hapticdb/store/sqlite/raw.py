"""Raw bytes of database files, read without SQLite.

This module never uses `open`: closing any descriptor of a file releases all POSIX locks of the
process on this file, also those of its open connections (https://sqlite.org/howtocorrupt.html,
section 2.2). SQLite's own file object, used here, closes its descriptor when these locks are
released.
"""

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path

import apsw

READ_MAIN = apsw.SQLITE_OPEN_MAIN_DB | apsw.SQLITE_OPEN_READONLY
PAGE_BYTES = 8192
"""Bytes of a page: the paper's block size."""


@contextlib.contextmanager
def opened_bytes(path: Path, flags: int = READ_MAIN) -> Iterator[apsw.VFSFile]:
    """Access to the bytes of a database file inside; OSError without the right to read it."""
    os.stat(path)  # noqa: PTH116 - its error has the cause; SQLite's has not
    if not os.access(path, os.R_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
    try:
        file = apsw.VFSFile("", str(path.resolve()), [flags, 0])
    except apsw.Error as error:
        raise OSError(errno.EIO, str(error), str(path)) from error
    try:
        yield file
    finally:
        file.xClose()


def read_bytes(path: Path, amount: int, offset: int = 0) -> bytes:
    """Bytes of a database file; fewer at its end."""
    with opened_bytes(path) as file:
        try:
            # clipped: a read beyond the end is an error of SQLite's file object
            there = max(min(amount, file.xFileSize() - offset), 0)
            return file.xRead(there, offset) if there else b""
        except apsw.IOError as error:  # or truncated since its size was read
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(error)) from error


def forget_pages(path: Path) -> None:
    """Drop the operating system's cached pages of a database opened by this process."""
    status = path.stat()
    for descriptor in map(int, os.listdir("/proc/self/fd")):  # noqa: PTH208 - numbers
        try:
            is_it = os.path.samestat(os.fstat(descriptor), status)
        except OSError:  # closed since it was listed
            continue
        if is_it:
            # first: pages that are not yet on disk cannot be dropped
            os.fsync(descriptor)
            os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
            return


def sync_folder(path: Path) -> None:
    """Write a file's folder to disk (fsync): afterwards a rename survives a power cut."""
    descriptor = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)

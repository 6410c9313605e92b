"""Folders for the files of parsers, which cannot remove them when they are killed.

A process locks its folder for as long as it runs. So a folder without a lock is left from a process
that was killed, and the next one removes it.
"""

import contextlib
import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

PREFIX = "hapticdb-parser-"
YOUNG_S = 60.0
"""Age up to which a folder may be without a lock because it was made just now."""


@contextlib.contextmanager
def scratch_folder() -> Iterator[str]:
    """Folder of a parser, removed at the end; also removes those of processes that were killed."""
    _remove_left()
    with tempfile.TemporaryDirectory(prefix=PREFIX, ignore_cleanup_errors=True) as folder:
        lock = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield folder
        finally:
            os.close(lock)


def _remove_left() -> None:
    """Remove this user's folders that are not locked."""
    for folder in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        with contextlib.suppress(OSError):
            lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                found = os.fstat(lock)
                if found.st_uid == os.geteuid() and time.time() - found.st_mtime > YOUNG_S:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    shutil.rmtree(folder)
            finally:
                os.close(lock)

"""Temporary folders of parser processes, removed also after a kill.

A process locks its folder (flock) during its life. An unlocked folder belonged to a killed process;
the next process removes it.
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
"""Age, seconds, up to which an unlocked folder may be a new one, before its lock."""


@contextlib.contextmanager
def scratch_folder() -> Iterator[str]:
    """Temporary folder, removed on exit; also removes the folders of killed processes."""
    _remove_left()
    with tempfile.TemporaryDirectory(prefix=PREFIX, ignore_cleanup_errors=True) as folder:
        lock = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield folder
        finally:
            os.close(lock)


def _remove_left() -> None:
    """Remove this user's unlocked folders older than `YOUNG_S`."""
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

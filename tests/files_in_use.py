"""Small environments in SQLite files, for tests of files that are copied, replaced or damaged."""

import os
import signal
from contextlib import closing
from pathlib import Path

from children import exit_code
from hapticdb import Grid
from hapticdb.store.sqlite.sqlite_store import SQLiteStore
from voxels import blob, floor_voxels, write_voxels

GRID = Grid(0.005, (0, 0, 0), 6)


def make(path: Path, *numbers: int) -> Path:
    """A file that holds a floor and some blobs, and that no store has open."""
    with closing(SQLiteStore.create(path, GRID)) as store:
        write_voxels(store, floor_voxels(GRID), "floor")
        write(store, *numbers)
    return path


def write(store: SQLiteStore, *numbers: int) -> None:
    for n in numbers:
        write_voxels(store, blob(n, (30, 30, 30)), f"blob {n}")


def killed(path: Path, *numbers: int) -> None:
    """Write in a process that is killed right after, so that its log remains."""
    pid = os.fork()
    if pid == 0:  # fork is safe: all modules are imported, and no thread runs
        try:
            store = SQLiteStore.open(path)  # kept in a variable: a dropped store closes itself
            write(store, *numbers)
        finally:
            os.kill(os.getpid(), signal.SIGKILL)
    assert exit_code(pid) == -signal.SIGKILL

"""Whole copies of SQLite environments during writes, moved into place atomically.

SQLite's backup API copies pages in steps, and restarts after another connection's write between two
steps: with a busy writer it never ends. Here one read transaction covers all steps; in WAL mode no
writer changes the pages of this transaction, and the log grows meanwhile. VACUUM INTO could copy,
too, but sorts all rows again, in one statement without progress reports.
"""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import apsw

from hapticdb.errors import (
    BusyError,
    DamagedError,
    EnvironmentExistsError,
    NotAnEnvironmentError,
    ReadOnlyError,
    UsageError,
)
from hapticdb.store.base import Progress
from hapticdb.store.engines import BackupReport
from hapticdb.store.sqlite import database_file as sqlite_file
from hapticdb.store.sqlite import raw as sqlite_bytes
from hapticdb.store.sqlite.database_file import named_errors
from hapticdb.store.sqlite.raw import PAGE_BYTES

STEP_PAGES = 512
"""Pages copied between two progress reports: 4 MiB. Larger: the bar jumps."""
SOURCE_CACHE_KIB = 4096
"""KiB of the source's page cache. Larger: no gain, each page is read once."""


def back_up(
    source: Path, target: Path, *, replace: bool, progress: Progress | None
) -> BackupReport:
    """Copy an environment as of one moment into a file, created whole or not at all."""
    real = target.resolve()
    _check_target(source, real, replace=replace)
    with sqlite_file.unfinished_beside(real) as unfinished:
        revision, objects = _copied(source, unfinished, target, progress)
        # who could read the old file must be able to read the new one
        if replace and real.exists():
            shutil.copymode(real, unfinished)
        # content before name: after a power cut the name must not lead to an empty file
        with unfinished.open("rb") as file:
            os.fsync(file.fileno())
        if replace:
            _put_in_place(unfinished, real)
        else:
            sqlite_file.publish(unfinished, real)
        sqlite_bytes.sync_folder(real)
    return BackupReport(str(source), str(target), revision, objects, real.stat().st_size)


def _check_target(source: Path, target: Path, *, replace: bool) -> None:
    """Refuse an unsuitable target path before anything is copied."""
    if target == source.resolve():
        raise UsageError(f"{source} cannot be copied onto itself: give another path")
    if not replace and target.exists():
        raise EnvironmentExistsError(
            f"{target} exists already: give another path, or --replace to have the new copy there"
        )
    if not replace:
        sqlite_file.check_free(target)
    elif target.exists():
        first = b""
        if target.is_file():
            try:
                first = sqlite_bytes.read_bytes(target, sqlite_file.HEADER_BYTES)
            except OSError as error:
                raise ReadOnlyError(f"{target} cannot be read: {error.strerror}") from error
        if sqlite_file.application_id(first) != sqlite_file.APPLICATION_ID:
            raise NotAnEnvironmentError(
                f"{target} is no hapticdb environment, so it is not replaced; give another path"
            )
        if not os.access(target, os.W_OK):
            raise ReadOnlyError(f"{target} may not be written, so it is not replaced")
        with _alone(target):
            pass
    sqlite_file.check_folder(target)


def _copied(
    source: Path, unfinished: Path, target: Path, progress: Progress | None
) -> tuple[int, int]:
    """Copy all pages as of one moment; returns revision and number of objects."""
    connection, file = sqlite_file.open_file(source, read_only=True)
    with contextlib.closing(connection), named_errors(str(source)):
        connection.execute(f"PRAGMA cache_size = -{SOURCE_CACHE_KIB}")
        # a read transaction around count and pages: in WAL mode writers go on beside it
        connection.execute("BEGIN")
        ((revision, objects),) = connection.execute(
            "SELECT (SELECT coalesce(max(revision), 0) FROM change), (SELECT count(*) FROM object)"
        ).fetchall()
        with (
            named_errors(str(target)),
            contextlib.closing(apsw.Connection(str(unfinished))) as made,
        ):
            _copy_pages(connection, made, progress)
            found = made.execute("PRAGMA quick_check(1)").fetchall()
            if found != [("ok",)]:
                raise DamagedError(
                    f"what was to be copied is damaged ({found[0][0]}): copy an older copy, or "
                    "import the files again"
                )
        file.verify()  # the path must still lead to the copied file
        if file.stamp is not None:
            file.check_stamp()
    return int(str(revision)), int(str(objects))


def _copy_pages(source: apsw.Connection, made: apsw.Connection, progress: Progress | None) -> None:
    made.execute(f"PRAGMA page_size = {PAGE_BYTES}")
    made.execute("PRAGMA journal_mode = OFF").fetchall()
    made.execute("PRAGMA synchronous = OFF")  # the file is still private, and synced later
    with made.backup("main", source, "main") as copying:
        while not copying.done:
            # in steps, for progress and Ctrl-C; the transaction above keeps them of one moment
            copying.step(STEP_PAGES)
            if progress is not None:
                done = copying.page_count - copying.remaining
                progress(done * PAGE_BYTES, copying.page_count * PAGE_BYTES)


@contextlib.contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Lock out all others from an existing database inside; BusyError if another has it open.

    A reader in WAL mode has a lock until it closes; one without write access to the folder has
    none, and detects the change by the file's time.
    """
    with contextlib.ExitStack() as held:
        if path.exists():
            flags = apsw.SQLITE_OPEN_MAIN_DB | apsw.SQLITE_OPEN_READWRITE
            file = held.enter_context(sqlite_bytes.opened_bytes(path, flags))
            try:
                # SQLite's own order of locks: EXCLUSIVE is granted to a holder of SHARED alone
                file.xLock(apsw.SQLITE_LOCK_SHARED)
                file.xLock(apsw.SQLITE_LOCK_EXCLUSIVE)
            except apsw.BusyError as error:
                raise BusyError(
                    f"{path} is open: end all that has it open, then run the same command again"
                ) from error
        yield


def _put_in_place(unfinished: Path, path: Path) -> None:
    """Replace a database, deleting its log first.

    After a kill, SQLite would apply the log to the new file.
    """
    # locked again: somebody may have opened it during the copy
    with _alone(path):
        for suffix in ("-wal", "-shm"):
            Path(f"{path}{suffix}").unlink(missing_ok=True)
        sqlite_bytes.sync_folder(path)
        # atomic, after the folder's sync: the old log must be gone before the new file is there
        unfinished.replace(path)

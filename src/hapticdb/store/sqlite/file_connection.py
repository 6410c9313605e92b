"""Connection to one file: statements, snapshots, transactions, owning thread."""

import atexit
import contextlib
import time
import weakref
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import apsw

from hapticdb.store.sqlite import database_file as sqlite_file
from hapticdb.store.sqlite.raw import PAGE_BYTES
from hapticdb.store.store_errors import check_outside
from hapticdb.store.threads import check_thread, this_thread

MOST_COMPACTED = 1 << 29
"""Largest file rewritten by `compact`, bytes; other writers wait 1 s for 100 MB."""
NO_ROOM = (apsw.BusyError, apsw.FullError, apsw.CantOpenError, apsw.IOError)
"""Errors after which `compact` leaves the file unchanged, also on creating its temporary file."""


class FileConnection:
    """One connection to one environment's file; only the thread that opened it may use it.

    Locks would take 13 % of a lookup of 40 bricks; instead, every call checks its thread.

    driver : apsw's connection; file : identity of the opened file.
    """

    def __init__(self, path: Path, *, read_only: bool) -> None:
        self.driver, self.file = sqlite_file.open_file(path, read_only=read_only)
        self._cursor = self.driver.cursor()
        self.path = path
        self.url = str(path)
        self.is_read_only = read_only
        self._depth = 0
        self._seen = self._noticed = -1
        self._thread = this_thread()
        _OPEN.add(self)

    def close(self) -> None:
        """Close the connection. The last one folds the write-ahead log into its file."""
        self.driver.close()

    def check_thread(self) -> None:
        """Refuse a call from any thread but the connection's own."""
        check_thread(self._thread, self.url)

    def fetch(self, sql: str, bindings: Sequence[Any] = ()) -> list[Any]:
        """Run one statement to its end."""
        check_thread(self._thread, self.url)
        try:
            if self.file.stamp is not None:
                self.file.check_stamp()
            return self._cursor.execute(sql, bindings).fetchall()
        except (apsw.Error, UnicodeDecodeError):
            with sqlite_file.named_errors(self.url):
                raise

    @contextlib.contextmanager
    def snapshot(self) -> Iterator[None]:
        """All reads inside see one committed revision. May be nested."""
        if self._depth == 0:
            # deferred: the revision is that of the first read inside, and no writer waits
            self.fetch("BEGIN")
        self._depth += 1
        try:
            yield
        finally:
            self._depth -= 1
            if self._depth == 0:
                self.fetch("COMMIT")

    @contextlib.contextmanager
    def writing(self) -> Iterator[None]:
        """One transaction, with the write lock from its beginning."""
        check_thread(self._thread, self.url)
        with sqlite_file.named_errors(self.url):
            self.driver.execute("BEGIN IMMEDIATE")
            try:
                # with the lock: SQLite would write into a replaced file without an error
                self.file.verify()
                yield
            except BaseException:
                if self.driver.in_transaction:  # else SQLite has done so, as on a full disk
                    self.driver.execute("ROLLBACK")
                raise
            self.driver.execute("COMMIT")
            # again: the path may have changed during the transaction
            self.file.verify(has_committed=True)

    def compact(self) -> None:
        """Rewrite the file with full pages, unless it is large, in use, or the disk is full."""
        if self.driver.pragma("page_count") * PAGE_BYTES > MOST_COMPACTED:
            return
        # else the copy that VACUUM writes would be in memory, as set for all writers
        self.driver.pragma("temp_store", "file")
        with sqlite_file.named_errors(self.url), contextlib.suppress(*NO_ROOM):
            self.driver.execute("VACUUM")
        self.driver.pragma("temp_store", "memory")

    def version(self) -> int:
        """SQLite's data version: changes when another connection's commit has been seen."""
        seen = self.driver.data_version()
        # a new one may belong to another file: files of the same path share a log
        if seen != self._seen or time.monotonic() >= self.file.due:
            self.file.verify()
            self._seen = seen
        return seen

    def newest(self) -> int:
        """As `version`, from the present state of the log, read by the pragma."""
        self.fetch("PRAGMA data_version")
        return self.version()

    def watch(self, *, is_prompt: bool = False) -> None:  # noqa: ARG002 - a file's loss always is
        """Begin to notice commits; may be called again."""
        self.has_changed()

    def has_changed(self) -> bool:
        """Whether another connection has committed since `watch` or the last call.

        The pragma reads the file's log; apsw's own `data_version` is as of the last read. An
        immutable file is compared with its stamp; once changed, it counts as changed. Raises
        ConnectionLostError when the path leads to another file than before.
        """
        check_outside(self._depth, self.url)
        if self.file.stamp is not None:
            self.check_thread()
            return self.file.has_new_stamp()
        self.file.check()
        before = self._noticed
        self._noticed = self.fetch("PRAGMA data_version")[0][0]
        return self._noticed != before


_OPEN: "weakref.WeakSet[FileConnection]" = weakref.WeakSet()


@atexit.register
def _close_all() -> None:
    """Close open connections at exit, so that no log stays with a file."""
    for connection in list(_OPEN):
        with contextlib.suppress(Exception):
            connection.close()

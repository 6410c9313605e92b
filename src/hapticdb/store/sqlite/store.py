"""SQLite through apsw: the embedded engine, one file."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import apsw

from hapticdb.grid import Grid
from hapticdb.store.base import Layout
from hapticdb.store.sqlite import file as sqlite_file
from hapticdb.store.sqlite import log as sqlite_log
from hapticdb.store.sqlite import raw as sqlite_bytes
from hapticdb.store.sqlite.connection import FileConnection
from hapticdb.store.sqlite.tables.reading import SQLiteReader


class SQLiteStore(SQLiteReader):
    """An environment in one SQLite file. Open with `open`, make with `create`."""

    def __init__(self, connection: FileConnection) -> None:
        super().__init__(connection)
        self.path = connection.path
        self.name = connection.path.name
        self.engine = f"SQLite {apsw.sqlite_lib_version()}"
        self.identity = connection.file.identity
        self.version, self.watch = connection.version, connection.watch
        self.has_changed = connection.has_changed

    @classmethod
    def open(cls, path: str | Path, *, read_only: bool = False) -> "SQLiteStore":
        """Open an existing environment."""
        connection = FileConnection(Path(path), read_only=read_only)
        try:
            with sqlite_file.named_errors(connection.url):
                return cls(connection)
        except BaseException:
            connection.close()
            raise

    @classmethod
    def create(
        cls, path: str | Path, grid: Grid, layout: Layout = "brick", *, distances: bool = False
    ) -> "SQLiteStore":
        """Make a new environment with its grid; its file appears whole or not at all."""
        lineage = sqlite_log.first_lineage()
        told = (grid.voxel_size, *grid.origin, grid.bits, grid.curve, layout, lineage)
        row = (*told, int(distances))

        def fill(connection: apsw.Connection) -> None:
            connection.execute("INSERT INTO environment VALUES (1, ?, ?, ?, ?, ?, ?, ?, ?, ?)", row)

        sqlite_file.create_file(Path(path), fill)
        return cls.open(path)

    def discard(self) -> None:
        """Close and delete an environment to which nothing was written."""
        self._connection.file.look()  # another environment's file must not be deleted
        self.close()
        sqlite_file.remove_file(self.path)

    @contextlib.contextmanager
    def loading(self) -> Iterator[None]:
        """At the end the pages of an environment that was empty are filled.

        Rows of each object go between those of others, which leaves an eighth of the pages unused.
        """
        was_empty = not self.revision()
        yield
        if was_empty and self.revision():
            self._connection.compact()

    def drop_caches(self) -> None:
        """Forget all pages: the connection's, and the file's in the operating system's cache."""
        self._connection.check_thread()
        self._connection.driver.release_memory()
        sqlite_bytes.forget_pages(self.path)

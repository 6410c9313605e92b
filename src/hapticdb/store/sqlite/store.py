"""SQLite through apsw: the embedded engine, one file."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import apsw

from hapticdb.grid import Grid
from hapticdb.store.base import Layout
from hapticdb.store.refusals import check_distances
from hapticdb.store.sqlite import file as sqlite_file
from hapticdb.store.sqlite import log as sqlite_log
from hapticdb.store.sqlite import raw as sqlite_bytes
from hapticdb.store.sqlite.connection import FileConnection
from hapticdb.store.sqlite.tables.pairs import SQLitePairs
from hapticdb.store.sqlite.tables.reading import SQLiteReader, read_environment
from hapticdb.store.sqlite.tables.statistics import SQLiteStatistics
from hapticdb.store.sqlite.tables.writing import SQLiteWriter


class SQLiteStore:
    """An environment in one SQLite file. Open with `open`, make with `create`.

    Reading, writing and statistics are classes of their own. The store takes over their methods.
    """

    def __init__(self, connection: FileConnection) -> None:
        self._connection = connection
        self.path = connection.path
        self.url = connection.url
        self.name = connection.path.name
        self.engine = f"SQLite {apsw.sqlite_lib_version()}"
        self.is_read_only = connection.is_read_only
        self.identity = connection.file.identity
        self.grid, self.layout, self.wants_distances = read_environment(connection)
        self.snapshot, self.version = connection.snapshot, connection.version
        reader = SQLiteReader(connection, self.grid, self.layout)
        self.revision = reader.revision
        self.lookup, self.lookup_each = reader.lookup, reader.lookup_each
        self.scan, self.count, self.rows_of = reader.scan, reader.count, reader.rows_of
        self.rows_after = reader.rows_after
        self.statement, self.statement_hits = reader.statement, reader.statement_hits
        self.objects, self.object = reader.objects, reader.object
        self.outlines = reader.outlines
        self.removed, self.changes = reader.removed, reader.changes
        self.surfaces, self.surface_digests = reader.surfaces, reader.surface_digests
        writer = SQLiteWriter(connection, self.grid, self.layout, reader)
        self.add, self.replace, self.remove = writer.add, writer.replace, writer.remove
        self.add_surface, self._write_wish = writer.add_surface, writer.want_distances
        kept = SQLitePairs(connection, reader)
        self.pairs, self.put_pairs = kept.pairs, kept.put_pairs
        self.accept_pair = kept.accept_pair
        known = SQLiteStatistics(connection, self.layout, reader)
        self.size, self.quantiles, self.freshness = known.size, known.quantiles, known.freshness
        self.analyze, self.costs, self.save_costs = known.analyze, known.costs, known.save_costs
        self.findings = known.findings
        self.watch, self.has_changed = connection.watch, connection.has_changed

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

    @property
    def is_closed(self) -> bool:
        """Whether `close` was called."""
        return self._connection.is_closed

    def close(self) -> None:
        """Close the connection. Only the last one folds the write-ahead log into its file."""
        self._connection.close()

    def give_to(self, thread: int) -> None:
        """Give the store to another thread, or to `NOBODY`; only while nobody uses it."""
        self._connection.give_to(thread)

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

    def want_distances(self) -> None:
        """Note that parts get distances when they are imported."""
        check_distances(self.layout, distances=True)
        self._write_wish()
        self.wants_distances = True

    def drop_caches(self) -> None:
        """Forget all pages: the connection's, and the file's in the operating system's cache."""
        self._connection.check_thread()
        self._connection.driver.release_memory()
        sqlite_bytes.forget_pages(self.path)

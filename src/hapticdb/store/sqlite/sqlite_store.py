"""SQLite through apsw: the embedded engine, paths and ``sqlite:///path``, one file an environment.

Three traps of the binding, each covered by a test: an ``np.int64`` binds as an eight-byte blob, a
bare array for ``carray(?)`` binds as nothing (both in silence), and an empty array cannot be bound.
So keys are passed as ``apsw.carray`` of contiguous, non-empty int64 arrays, and single numbers as
Python's own.
"""

import contextlib
import re
from collections.abc import Iterator
from itertools import accumulate
from pathlib import Path
from typing import Any

import apsw
import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import UsageError
from hapticdb.grid import Grid
from hapticdb.store import parsing
from hapticdb.store.base import (
    NO_OCCUPANCY,
    Band,
    Columns,
    Keys,
    Layout,
    LocatedShell,
    Progress,
    Rows,
    no_rows,
)
from hapticdb.store.engines import BackupReport, unknown_scheme
from hapticdb.store.sqlite import database_file as sqlite_file
from hapticdb.store.sqlite import raw as sqlite_bytes
from hapticdb.store.sqlite.file_connection import FileConnection
from hapticdb.store.sqlite.tables import force as sqlite_force
from hapticdb.store.sqlite.tables.file_tables import FileTables
from hapticdb.store.sqlite.tables.ranges import LISTS, RangeStatements
from hapticdb.store.tables import HELD, TABLES, Form

# CROSS JOIN fixes the order: keys outside, for each a descent of the index
LOOKUP: dict[Columns, str] = {
    columns: f"""
SELECT {LISTS[columns]}
  FROM carray(?1) AS requested CROSS JOIN {table}
 WHERE z_val = requested.value AND {HELD[columns]}"""
    for columns, table in TABLES.items()
}
LOOKUP_ONE: dict[Columns, str] = {
    columns: f"SELECT {LISTS[columns]} FROM {table} WHERE z_val = ?1 AND {HELD[columns]}"
    for columns, table in TABLES.items()
}
# for `check`: all rows, with or without voxels or distances
AFTER: dict[Columns, str] = {
    columns: f"""
SELECT {LISTS[columns].replace(" distances", " coalesce(distances, x'')")} FROM {table}
 WHERE (z_val, id) > (?1, ?2) ORDER BY z_val, id LIMIT ?3"""
    for columns, table in TABLES.items()
}
PREFIX = "sqlite:///"
# libpq's keyword form, or a URL without its slashes: either may contain a password
KEYWORDS = re.compile(r"^postgres(ql)?:|(^|\s)\w*password\s*=", re.IGNORECASE)


class SQLiteStore(FileTables):
    """An environment in one SQLite file; its class is the engine, for paths and URLs of files."""

    title = "SQLite"

    def __init__(self, connection: FileConnection) -> None:
        super().__init__(connection)
        self._ranges = RangeStatements(connection.driver, self.layout, self.grid.bits)
        sqlite_force.register(connection.driver, self.grid, self.layout)
        self.path = connection.path
        self.name = connection.path.name
        self.engine = f"SQLite {apsw.sqlite_lib_version()}"
        self.identity = connection.file.identity
        self.version, self.newest = connection.version, connection.newest
        self.watch, self.has_changed = connection.watch, connection.has_changed

    @classmethod
    def open(cls, url: str | Path, *, read_only: bool = False) -> "SQLiteStore":
        connection = FileConnection(_path_of(url), read_only=read_only)
        try:
            with sqlite_file.named_errors(connection.url):
                return cls(connection)
        except BaseException:
            connection.close()
            raise

    @classmethod
    def create(
        cls, url: str | Path, grid: Grid, layout: Layout = "brick", *, distances: bool = False
    ) -> "SQLiteStore":
        """Its file is created whole or not at all."""
        row = (grid.voxel_size, *grid.origin, grid.bits, grid.curve, layout, int(distances))

        def fill(connection: apsw.Connection) -> None:
            connection.execute("INSERT INTO environment VALUES (1, ?, ?, ?, ?, ?, ?, ?, ?)", row)

        sqlite_file.create_file(_path_of(url), fill)
        return cls.open(url)

    @staticmethod
    def exists(url: str) -> bool:
        return _path_of(url).exists()

    @staticmethod
    def back_up(url: str, copy: str, *, replace: bool, progress: Progress | None) -> BackupReport:
        from hapticdb.store.sqlite.backup import back_up  # noqa: PLC0415 - seldom needed

        return back_up(_path_of(url), _path_of(copy), replace=replace, progress=progress)

    def discard(self) -> None:
        self._connection.file.verify()  # another environment's file must not be deleted
        self.close()
        sqlite_file.remove_file(self.path)

    @contextlib.contextmanager
    def loading(self) -> Iterator[None]:
        """Compact a formerly empty environment at the end: an eighth of its pages is unused."""
        was_empty = not self.revision()
        yield
        if was_empty and self.revision():
            self._connection.compact()

    def drop_caches(self) -> None:
        self._connection.check_thread()
        self._connection.driver.release_memory()
        sqlite_bytes.forget_pages(self.path)

    # -- reads -----------------------------------------------------------------------------------

    def _read(self, form: Form, *arguments: Any, distances: bool) -> Rows:  # noqa: ANN401 - keys or numbers
        columns: Columns = "distances" if distances else self.layout
        if form != "after" and not arguments[0].size:
            return no_rows(distances=distances)
        fetch = self._connection.fetch
        if form == "lookup_one":
            one = LOOKUP_ONE[columns]
            found = [row for key in arguments[0].tolist() for row in fetch(one, (key,))]
        elif form == "lookup":
            found = fetch(LOOKUP[columns], (apsw.carray(arguments[0]),))
        elif form == "after":
            found = fetch(AFTER[columns], arguments)
        else:
            sql, bindings = self._ranges.scan(columns, *arguments[:2])
            if form == "rows_of":
                sql, bindings = f"{sql} AND id = ?4", (*bindings, arguments[2])
            found = fetch(sql, bindings)
        return _rows_of(self.url, found, columns)

    def count(self, lows: Keys, highs: Keys) -> int:
        if not lows.size:
            return 0
        return int(self._connection.fetch(*self._ranges.count(lows, highs))[0][0])

    def statement(self, frame: LocatedShell) -> NDArray[np.float64]:
        found = self._connection.fetch(*sqlite_force.wrench_statement(self.layout, frame))
        return np.frombuffer(found[0][0], dtype=np.float64)

    def statement_hits(self, frame: LocatedShell) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        found = self._connection.fetch(*sqlite_force.hits_statement(self.layout, frame))
        try:
            pairs = np.array(found, dtype=np.int64).reshape(-1, 2)
        except (TypeError, ValueError, OverflowError) as error:
            raise parsing.damaged(self.url, f"a row of another kind: {error}") from error
        return pairs[:, 0] - 1, pairs[:, 1].copy()


def _rows_of(url: str, found: list[Any], columns: Columns) -> Rows:
    """Rows from the tuples of a statement with the columns of `ranges.LISTS`."""
    if not found:
        return no_rows(distances=columns == "distances")
    keys, ids, *more = zip(*found, strict=True)
    count = len(keys)
    occupancy, distances = NO_OCCUPANCY, None
    try:
        # by Python's own functions: a frame has few rows, and each call of NumPy takes 2 us
        if columns == "distances":
            lengths = list(map(len, more[1]))
            ends = np.fromiter(accumulate(lengths), np.int64, count)
            distances = Band(np.frombuffer(b"".join(more[1]), np.uint8), ends)
            parsing.check_lengths(url, max(lengths))
            more[0] = tuple([parsing.NO_VOXEL if brick is None else brick for brick in more[0]])
        if more:
            occupancy = parsing.bricks_of(url, b"".join(more[0]), count)
        rows = Rows(
            np.fromiter(keys, np.int64, count), np.fromiter(ids, np.int64, count), occupancy,
            distances,
        )  # fmt: skip
    except (TypeError, ValueError, OverflowError) as error:
        raise parsing.damaged(url, f"a row of another kind: {error}") from error
    return rows


ENGINE = SQLiteStore


def _path_of(url: str | Path) -> Path:
    """Path of the file that a URL or a path names."""
    text = str(url)
    if text.startswith(PREFIX):
        text = text.removeprefix(PREFIX)
    elif "://" in text:
        raise unknown_scheme(text.split("://", 1)[0])
    if KEYWORDS.search(text):  # not shown: it holds a password
        raise UsageError("libpq's keywords are not read here: give postgresql://user@host/database")
    if not text:
        raise UsageError("an empty path: name the environment's file")
    if text.startswith((":memory:", "file:")):
        raise UsageError(f"{text!r}: an environment is a file; give its path")
    return Path(text)

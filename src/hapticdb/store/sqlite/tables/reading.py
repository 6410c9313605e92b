"""Reads of a file: rows by key and by range, the paper's Figure 3, surfaces.

Three traps of the binding, each covered by a test: an ``np.int64`` binds as an eight-byte blob, a
bare array to ``carray(?)`` binds as nothing (both in silence), and an empty array cannot be bound.
So keys are passed as ``apsw.carray`` of contiguous, non-empty int64 arrays, and single numbers as
Python's own.
"""

import json
from collections.abc import Sequence
from typing import Any

import apsw
import numpy as np
from numpy.typing import NDArray

from hapticdb.store import parsing
from hapticdb.store.base import LAYOUTS, Keys, LocatedShell, Rows, Table, no_rows, row_shift
from hapticdb.store.sqlite.connection import FileConnection
from hapticdb.store.sqlite.tables import force as sqlite_force
from hapticdb.store.sqlite.tables import rows as sqlite_rows
from hapticdb.store.sqlite.tables.asking import FileTables
from hapticdb.store.sqlite.tables.ranges import COLUMNS, TABLES, RangeStatements

LOOKUP: dict[Table, str] = {
    table: f"""
SELECT {columns}
  FROM carray(?1) AS asked CROSS JOIN {TABLES[table]}
 WHERE {table}.z_val = asked.value"""
    for table, columns in COLUMNS.items()
}
LOOKUP_ONE: dict[Table, str] = {
    table: f"SELECT {COLUMNS[table]} FROM {table} WHERE z_val = ?1" for table in LAYOUTS
} | {  # a statement of one key takes 5 us more with a LEFT JOIN, even if it finds nothing
    "band": """
SELECT z_val, id, (SELECT occupancy FROM brick WHERE brick.z_val = ?1 AND brick.id = band.id),
       distances
  FROM band WHERE z_val = ?1""",
}
AFTER: dict[Table, str] = {
    table: f"""
SELECT {columns} FROM {TABLES[table]}
 WHERE ({table}.z_val, {table}.id) > (?1, ?2) ORDER BY {table}.z_val, {table}.id LIMIT ?3"""
    for table, columns in COLUMNS.items()
}


class SQLiteReader(FileTables):
    """Reads of one environment."""

    def __init__(self, connection: FileConnection) -> None:
        super().__init__(connection)
        self._has_bricks = row_shift(self.layout) > 0
        self._ranges = RangeStatements(connection.driver, self.layout, self.grid.bits)
        sqlite_force.register(connection.driver, self.grid, self.layout)

    def _unpacked(self, found: list[Any], *, distances: bool = False) -> Rows:
        """Rows as arrays, from the tuples of a statement."""
        if distances:
            return sqlite_rows.rows_with_distances(self.url, found)
        return sqlite_rows.rows_of(self.url, found, has_bricks=self._has_bricks)

    def _table(self, *, distances: bool, is_nothing: bool = False) -> Table | None:
        """Table that answers a read; None if it is not there, or nothing is asked for."""
        if is_nothing or (distances and not self.has_table(parsing.BAND)):
            return None
        return "band" if distances else self.layout

    def lookup(self, keys: Keys, *, distances: bool = False) -> Rows:
        """Rows of distinct ascending keys (U,), in one statement."""
        table = self._table(distances=distances, is_nothing=not keys.size)
        if table is None:
            return no_rows(distances=distances)
        found = self._connection.fetch(LOOKUP[table], (apsw.carray(keys),))
        return self._unpacked(found, distances=distances)

    def lookup_each(self, keys: Keys, *, distances: bool = False) -> Rows:
        """Rows of distinct ascending keys (U,), one statement a key."""
        table = self._table(distances=distances)
        if table is None:
            return no_rows(distances=distances)
        sql = LOOKUP_ONE[table]
        found: list[Any] = []
        for key in keys.tolist():
            found += self._connection.fetch(sql, (key,))
        return self._unpacked(found, distances=distances)

    def scan(self, lows: Keys, highs: Keys, *, distances: bool = False) -> Rows:
        """Rows with a key in any of the closed ranges, ascending and disjoint."""
        return self._in_ranges(lows, highs, distances=distances)

    def rows_of(self, object_id: int, lows: Keys, highs: Keys, *, distances: bool = False) -> Rows:
        """Rows of one object with a key in any of the closed ranges, ascending and disjoint."""
        return self._in_ranges(lows, highs, object_id, distances=distances)

    def _in_ranges(
        self, lows: Keys, highs: Keys, object_id: int | None = None, *, distances: bool
    ) -> Rows:
        table = self._table(distances=distances, is_nothing=not lows.size)
        if table is None:
            return no_rows(distances=distances)
        sql, bindings = self._ranges.scan(table, lows, highs)
        if object_id is not None:
            sql, bindings = f"{sql} AND {table}.id = ?4", (*bindings, object_id)
        return self._unpacked(self._connection.fetch(sql, bindings), distances=distances)

    def count(self, lows: Keys, highs: Keys) -> int:
        """How many rows `scan` would return, counted inside the engine."""
        if not lows.size:
            return 0
        return int(self._connection.fetch(*self._ranges.count(lows, highs))[0][0])

    def rows_after(self, key: int, object_id: int, limit: int, *, distances: bool = False) -> Rows:
        """At most that many rows after (key, id), ascending by both."""
        table = self._table(distances=distances)
        if table is None:
            return no_rows(distances=distances)
        found = self._connection.fetch(AFTER[table], (key, object_id, limit))
        return self._unpacked(found, distances=distances)

    def statement(self, frame: LocatedShell) -> NDArray[np.float64]:
        """Wrench (6,) of the frame by one statement, computed by force() inside the engine."""
        found = self._connection.fetch(*sqlite_force.wrench_statement(self.layout, frame))
        return np.frombuffer(found[0][0], dtype=np.float64)

    def statement_hits(self, frame: LocatedShell) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Ordinals (P,) and object ids (P,) of all hits, by the second statement."""
        found = self._connection.fetch(*sqlite_force.hits_statement(self.layout, frame))
        pairs = sqlite_rows.pairs_of(self.url, found)
        return pairs[:, 0] - 1, pairs[:, 1].copy()

    def removed(self, link: str) -> set[str]:
        """Names of a file's parts that were removed and are not there again."""
        found = self._connection.fetch("SELECT name FROM removed WHERE link = ?", (link,))
        return {row[0] for row in found}

    def surfaces(self, digests: Sequence[str]) -> dict[str, bytes]:
        """Packed surfaces of the digests that have one, in one statement."""
        if not self.has_table(parsing.SURFACE):
            return {}
        found = self._connection.fetch(
            "SELECT digest, geometry FROM surface WHERE digest IN (SELECT value FROM json_each(?))",
            (json.dumps(list(digests)),),
        )
        return parsing.surfaces_of(self.url, found)

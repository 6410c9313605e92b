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
from hapticdb.store.base import LAYOUTS, Keys, LocatedShell, Rows, Table
from hapticdb.store.sqlite.connection import FileConnection
from hapticdb.store.sqlite.tables import force as sqlite_force
from hapticdb.store.sqlite.tables import rows as sqlite_rows
from hapticdb.store.sqlite.tables.file_tables import FileTables
from hapticdb.store.sqlite.tables.ranges import COLUMNS, TABLES, RangeStatements
from hapticdb.store.tables import Form

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
        self._ranges = RangeStatements(connection.driver, self.layout, self.grid.bits)
        sqlite_force.register(connection.driver, self.grid, self.layout)

    def _read(self, table: Table, form: Form, asked: Sequence[Any]) -> Rows:
        fetch = self._connection.fetch
        if form == "lookup_one":
            one = LOOKUP_ONE[table]
            found = [row for key in asked[0].tolist() for row in fetch(one, (key,))]
        elif form == "lookup":
            found = fetch(LOOKUP[table], (apsw.carray(asked[0]),))
        elif form == "after":
            found = fetch(AFTER[table], asked)
        else:
            sql, bindings = self._ranges.scan(table, *asked[:2])
            if form == "rows_of":
                sql, bindings = f"{sql} AND {table}.id = ?4", (*bindings, asked[2])
            found = fetch(sql, bindings)
        return sqlite_rows.rows_of(self.url, found, table)

    def count(self, lows: Keys, highs: Keys) -> int:
        """How many rows `scan` would return, counted inside the engine."""
        if not lows.size:
            return 0
        return int(self._connection.fetch(*self._ranges.count(lows, highs))[0][0])

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

"""Reads of a file: rows by key and by range, the paper's Figure 3, objects, changes.

Three traps of the binding, each covered by a test: an ``np.int64`` binds as an eight-byte blob, a
bare array to ``carray(?)`` binds as nothing (both in silence), and an empty array cannot be bound.
So keys are passed as ``apsw.carray`` of contiguous, non-empty int64 arrays, and single numbers as
Python's own.
"""

import json
from collections.abc import Collection, Iterator, Sequence
from typing import Any

import apsw
import numpy as np
from numpy.typing import NDArray

from hapticdb.grid import Grid
from hapticdb.store import parsing
from hapticdb.store.base import (
    Change,
    Keys,
    Layout,
    LocatedShell,
    Object,
    Rows,
    Table,
    no_rows,
    row_shift,
)
from hapticdb.store.pairs import Outlines
from hapticdb.store.refusals import no_object
from hapticdb.store.sqlite.connection import FileConnection
from hapticdb.store.sqlite.tables import force as sqlite_force
from hapticdb.store.sqlite.tables import rows as sqlite_rows
from hapticdb.store.sqlite.tables.ranges import COLUMNS, TABLES, RangeStatements

OBJECTS = (
    "SELECT id, name, link, digest, transform, voxels, bounds, attributes, revision FROM object"
)
HAS_TABLE = "SELECT count(*) FROM sqlite_master WHERE name = ? AND type = 'table'"
LOOKUP: dict[Table, str] = {
    table: f"""
SELECT {columns}
  FROM carray(?1) AS asked CROSS JOIN {TABLES[table]}
 WHERE {table}.z_val = asked.value"""
    for table, columns in COLUMNS.items()
}
# a statement of one key takes 5 us more with a LEFT JOIN, even if it finds nothing
LOOKUP_ONE: dict[Table, str] = {
    "voxel": "SELECT z_val, id FROM voxel WHERE z_val = ?1",
    "brick": "SELECT z_val, id, occupancy FROM brick WHERE z_val = ?1",
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


def read_environment(connection: FileConnection) -> tuple[Grid, Layout, bool]:
    """Grid and layout of an environment, and whether it wants distances, all checked."""
    kinds = dict(connection.fetch(sqlite_rows.KINDS))
    parsing.check_tables(connection.url, kinds)
    # a reader may have opened a file of an older format
    wish = "wants_distances" if parsing.BAND in kinds else "0"
    rows = connection.fetch(
        "SELECT voxel_size, origin_x, origin_y, origin_z, bits, curve, layout, "
        f"{wish} FROM environment"
    )
    grid, layout = parsing.grid_of(connection.url, rows)
    return grid, layout, parsing.wish_of(connection.url, rows[0][7])


class SQLiteReader:
    """Reads of one environment."""

    def __init__(self, connection: FileConnection, grid: Grid, layout: Layout) -> None:
        self._connection = connection
        self._layout = layout
        self._has_bricks = row_shift(layout) > 0
        self._found: set[str] = set()
        self._ranges = RangeStatements(connection.driver, layout, grid.bits)
        sqlite_force.register(connection.driver, grid, layout)

    def revision(self) -> int:
        """Number of the last committed write; 0 for an empty environment."""
        self._connection.file.check()
        found = self._connection.fetch("SELECT coalesce(max(revision), 0) FROM change")
        return parsing.number_of(self._connection.url, found[0][0], "the revision")

    # -- rows -----------------------------------------------------------------------------------

    def unpacked(self, found: list[Any], *, distances: bool = False) -> Rows:
        """Rows as arrays, from the tuples of a statement."""
        url = self._connection.url
        if distances:
            return sqlite_rows.rows_with_distances(url, found)
        return sqlite_rows.rows_of(url, found, has_bricks=self._has_bricks)

    def has_table(self, name: str) -> bool:
        """Whether a table of a later format is there; another may make it at any time."""
        if name not in self._found and self._connection.fetch(HAS_TABLE, (name,))[0][0]:
            self._found.add(name)
        return name in self._found

    def _table(self, *, distances: bool, is_nothing: bool = False) -> Table | None:
        """Table that answers a read; None if it is not there, or nothing is asked for."""
        if is_nothing or (distances and not self.has_table(parsing.BAND)):
            return None
        return "band" if distances else self._layout

    def lookup(self, keys: Keys, *, distances: bool = False) -> Rows:
        """Rows of distinct ascending keys (U,), in one statement."""
        table = self._table(distances=distances, is_nothing=not keys.size)
        if table is None:
            return no_rows(distances=distances)
        found = self._connection.fetch(LOOKUP[table], (apsw.carray(keys),))
        return self.unpacked(found, distances=distances)

    def lookup_each(self, keys: Keys, *, distances: bool = False) -> Rows:
        """Rows of distinct ascending keys (U,), one statement a key."""
        table = self._table(distances=distances)
        if table is None:
            return no_rows(distances=distances)
        sql = LOOKUP_ONE[table]
        found: list[Any] = []
        for key in keys.tolist():
            found += self._connection.fetch(sql, (key,))
        return self.unpacked(found, distances=distances)

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
        return self.unpacked(self._connection.fetch(sql, bindings), distances=distances)

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
        return self.unpacked(found, distances=distances)

    def statement(self, frame: LocatedShell) -> NDArray[np.float64]:
        """Wrench (6,) of the frame by one statement, computed by force() inside the engine."""
        found = self._connection.fetch(*sqlite_force.wrench_statement(self._layout, frame))
        return np.frombuffer(found[0][0], dtype=np.float64)

    def statement_hits(self, frame: LocatedShell) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Ordinals (P,) and object ids (P,) of all hits, by the second statement."""
        found = self._connection.fetch(*sqlite_force.hits_statement(self._layout, frame))
        pairs = sqlite_rows.pairs_of(self._connection.url, found)
        return pairs[:, 0] - 1, pairs[:, 1].copy()

    # -- objects --------------------------------------------------------------------------------

    def objects(self, ids: Collection[int] | None = None) -> list[Object]:
        """All objects, or those of some ids that are there, ordered by id."""
        self._connection.file.check()
        some = "" if ids is None else "WHERE id IN (SELECT value FROM json_each(?))"
        bindings = [] if ids is None else [json.dumps(list(ids))]
        found = self._connection.fetch(f"{OBJECTS} {some} ORDER BY id", bindings)
        return [parsing.object_of(self._connection.url, row) for row in found]

    def object(self, object_id: int) -> Object:
        """One object; raises ObjectNotFoundError when there is none of that id."""
        found = self.objects([object_id])
        if not found:
            raise no_object(object_id, self._connection.url)
        return found[0]

    def outlines(self) -> Outlines:
        """What is short of all objects, ordered by id."""
        self._connection.file.check()
        found = self._connection.fetch(
            "SELECT name, digest, id, revision, bounds FROM object ORDER BY id"
        )
        return parsing.outlines_of(self._connection.url, found)

    def removed(self, link: str) -> set[str]:
        """Names of a file's parts that were removed and are not there again."""
        found = self._connection.fetch("SELECT name FROM removed WHERE link = ?", (link,))
        return {row[0] for row in found}

    def changes(self, since: int = 0) -> Iterator[Change]:
        """Committed writes after that revision, oldest first."""
        for row in self._connection.fetch(
            "SELECT revision, action, id, ranges FROM change WHERE revision > ? ORDER BY revision",
            (since,),
        ):
            yield parsing.change_of(self._connection.url, row)

    def surfaces(self, digests: Sequence[str]) -> dict[str, bytes]:
        """Packed surfaces of the digests that have one, in one statement."""
        if not self.has_table(parsing.SURFACE):
            return {}
        found = self._connection.fetch(
            "SELECT digest, geometry FROM surface WHERE digest IN (SELECT value FROM json_each(?))",
            (json.dumps(list(digests)),),
        )
        return parsing.surfaces_of(self._connection.url, found)

    def surface_digests(self) -> set[str]:
        """Digests of all surfaces."""
        if not self.has_table(parsing.SURFACE):
            return set()
        found = self._connection.fetch("SELECT digest FROM surface")
        return parsing.digests_of(self._connection.url, found)

"""Writes into a file: each object in one transaction, with its rows and its change."""

from typing import get_args

import apsw
import numpy as np

from hapticdb.grid import Grid
from hapticdb.store.base import (
    BRICK_BYTES,
    Covering,
    Keys,
    Layout,
    Object,
    Rows,
    Table,
    touched_ranges,
)
from hapticdb.store.refusals import check_unwritten, present_already
from hapticdb.store.sqlite.connection import FileConnection
from hapticdb.store.sqlite.tables import rows as sqlite_rows
from hapticdb.store.sqlite.tables.reading import SQLiteReader

# whole arrays are bound at once: 8 times faster than executemany, without the interpreter lock
INSERT = {
    "voxel": "INSERT INTO voxel SELECT value, ?2 FROM carray(?1)",
    "brick": f"""INSERT INTO brick SELECT value, ?2,
                        substr(?3, {BRICK_BYTES} * rowid - {BRICK_BYTES - 1}, {BRICK_BYTES})
                   FROM carray(?1)""",
}
INSERT_BAND = """
INSERT INTO band SELECT value, ?2, substr(?3, nth(?4, rowid, 0), nth(?5, rowid, 0))
  FROM carray(?1)"""
CHUNK = 1 << 14
"""Rows that one statement inserts. A larger value takes more memory: to undo the statement, up to a
page for each row."""
INSERT_OBJECT = """
INSERT INTO object (id, name, link, digest, transform, voxels, bounds, attributes, revision)
SELECT CASE WHEN ?9 > 0 AND NOT EXISTS (SELECT 1 FROM object WHERE id = ?9) THEN ?9 END,
       ?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8"""
UPDATE_OBJECT = """
UPDATE object SET digest = ?, transform = ?, voxels = ?, bounds = ?, attributes = ?, revision = ?
 WHERE id = ?"""
PUT_SURFACE = """
INSERT INTO surface
SELECT ?1, ?2
 WHERE EXISTS (SELECT 1 FROM object WHERE digest = ?1)
   AND NOT EXISTS (SELECT 1 FROM surface WHERE digest = ?1)"""
DROP_SURFACE = """
DELETE FROM surface
 WHERE digest = ?1 AND NOT EXISTS (SELECT 1 FROM object WHERE digest = ?1)"""

DELETE: dict[Table, str] = {
    table: f"DELETE FROM {table} WHERE z_val BETWEEN ? AND ? AND id = ? RETURNING z_val"
    for table in get_args(Table)
}


class SQLiteWriter:
    """Writes to one environment."""

    def __init__(
        self, connection: FileConnection, grid: Grid, layout: Layout, reader: SQLiteReader
    ) -> None:
        self._connection = connection
        self._grid = grid
        self._layout = layout
        self._reader = reader

    def add(self, record: Object, rows: Rows, surface: bytes | None = None) -> int:
        """Write an object, its rows and its surface in one transaction; returns its id."""
        with self._connection.writing():
            revision = self._reader.revision() + 1
            try:
                self._connection.execute(
                    INSERT_OBJECT,
                    (
                        record.name,
                        record.link,
                        *sqlite_rows.contents(record, rows),
                        revision,
                        record.id,
                    ),
                )
            except apsw.ConstraintError as error:
                raise present_already(record, self._connection.url) from error
            object_id = self._connection.driver.last_insert_rowid()
            self._insert(rows, object_id)
            self._put_surface(record.digest, surface)
            self._log(revision, "add", object_id, rows.keys)
        return object_id

    def replace(
        self, record: Object, rows: Rows, covering: Covering, surface: bytes | None = None
    ) -> None:
        """Exchange an object's rows in one transaction; `covering` says where the old ones are."""
        with self._connection.writing():
            revision = self._reader.revision() + 1
            known = self._reader.object(record.id)
            check_unwritten(record, known, self._connection.url)
            gone = self._delete(known, covering)
            contents = sqlite_rows.contents(record, rows)
            self._connection.execute(UPDATE_OBJECT, (*contents, revision, record.id))
            self._insert(rows, record.id)
            self._connection.execute(DROP_SURFACE, (known.digest,))
            self._put_surface(record.digest, surface)
            self._log(revision, "move", record.id, np.concatenate([gone, rows.keys]))

    def remove(self, object_id: int, covering: Covering) -> None:
        """Remove an object and its rows in one transaction; `covering` says where they are."""
        with self._connection.writing():
            revision = self._reader.revision() + 1
            known = self._reader.object(object_id)
            gone = self._delete(known, covering)
            self._connection.execute("DELETE FROM object WHERE id = ?", (object_id,))
            self._connection.execute(DROP_SURFACE, (known.digest,))
            self._log(revision, "remove", object_id, gone)

    def add_surface(self, digest: str, surface: bytes) -> None:
        """Write the surface of objects that lack it; nothing if no object has the digest."""
        with self._connection.writing():
            self._put_surface(digest, surface)

    def want_distances(self) -> None:
        """Note in the environment that its parts get distances."""
        with self._connection.writing():
            self._connection.execute("UPDATE environment SET wants_distances = 1")

    def _insert(self, union: Rows, object_id: int) -> None:
        """Insert rows, ascending by key, and their distances: a statement for each chunk."""
        rows = union.occupied()
        for at in range(0, len(rows), CHUNK):
            keys = apsw.carray(rows.keys[at : at + CHUNK])
            if self._layout == "voxel":
                self._connection.execute(INSERT["voxel"], (keys, object_id))
            else:
                part = rows.occupancy[BRICK_BYTES * at : BRICK_BYTES * (at + CHUNK)]
                self._connection.execute(INSERT["brick"], (keys, object_id, part.tobytes()))
        for at in range(0, len(union) if union.distances is not None else 0, CHUNK):
            band = union.part(at, at + CHUNK)
            assert band.distances is not None  # noqa: S101 - a part of what has some
            data, ends = band.distances
            lengths = band.distances.lengths
            places = (apsw.pyobject((ends - lengths + 1).tolist()), apsw.pyobject(lengths.tolist()))
            keys = apsw.carray(np.ascontiguousarray(band.keys))
            self._connection.execute(INSERT_BAND, (keys, object_id, data.tobytes(), *places))

    def _put_surface(self, digest: str, surface: bytes | None) -> None:
        if surface is not None:
            self._connection.execute(PUT_SURFACE, (digest, surface))

    def _delete(self, known: Object, covering: Covering) -> Keys:
        """Delete the rows of an object as it is now, from both tables; returns their keys."""
        tables: list[Table] = [self._layout]
        if known.has_distances:
            tables.append("band")
        gone: list[int] = []
        for low, high in covering(known):
            for table in tables:
                deleted = self._connection.execute(DELETE[table], (low, high, known.id))
                gone += [row[0] for row in deleted]
        return np.array(gone, dtype=np.int64)

    def _log(self, revision: int, action: str, object_id: int, row_keys: Keys) -> None:
        """Record which keys a write touched."""
        ranges = touched_ranges(self._grid, self._layout, row_keys)
        row = (revision, action, object_id, ranges.astype("<i8").tobytes())
        self._connection.execute("INSERT INTO change VALUES (?, ?, ?, ?)", row)

"""Writes into a file: each object in one transaction, with its rows and its change."""

from collections.abc import Sequence
from typing import get_args

import apsw
import numpy as np

from hapticdb.store.base import BRICK_BYTES, NO_KEYS, Covering, Keys, Object, Rows, Table
from hapticdb.store.pairs import PUT, Ids, PairRow
from hapticdb.store.sqlite.tables.asking import FileTables

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
PUT_PAIR = PUT.format(values=f"VALUES ({', '.join('?' * 14)})")
DELETE_PAIR = "DELETE FROM pair WHERE (a, b) = (?, ?)"
DELETE: dict[Table, str] = {
    table: f"DELETE FROM {table} WHERE z_val BETWEEN ? AND ? AND id = ? RETURNING z_val"
    for table in get_args(Table)
}


class SQLiteWriter(FileTables):
    """Writes to one environment."""

    def _exchange_pairs(self, gone: Ids, rows: Sequence[PairRow]) -> None:
        self._connection.driver.executemany(DELETE_PAIR, gone)
        self._connection.driver.executemany(PUT_PAIR, [row.columns for row in rows])

    def _put(self, union: Rows, object_id: int) -> None:
        """Insert rows, ascending by key, and their distances: a statement for each chunk."""
        rows = union.occupied()
        for at in range(0, len(rows), CHUNK):
            keys = apsw.carray(rows.keys[at : at + CHUNK])
            if self.layout == "voxel":
                self._do(INSERT["voxel"], (keys, object_id))
            else:
                part = rows.occupancy[BRICK_BYTES * at : BRICK_BYTES * (at + CHUNK)]
                self._do(INSERT["brick"], (keys, object_id, part.tobytes()))
        for at in range(0, len(union) if union.distances is not None else 0, CHUNK):
            band = union.part(at, at + CHUNK)
            assert band.distances is not None  # noqa: S101 - a part of what has some
            data, ends = band.distances
            lengths = band.distances.lengths
            places = (apsw.pyobject((ends - lengths + 1).tolist()), apsw.pyobject(lengths.tolist()))
            keys = apsw.carray(np.ascontiguousarray(band.keys))
            self._do(INSERT_BAND, (keys, object_id, data.tobytes(), *places))

    def _take(self, known: Object, covering: Covering, keys: Keys = NO_KEYS) -> Keys:  # noqa: ARG002
        tables: list[Table] = [self.layout]
        if known.has_distances:
            tables.append("band")
        gone: list[int] = []
        for low, high in covering(known):
            for table in tables:
                deleted = self._do(DELETE[table], (low, high, known.id))
                gone += [row[0] for row in deleted]
        return np.array(gone, dtype=np.int64)

"""Tables in a file: statements, writes, sizes, quantiles of the keys."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import apsw
import numpy as np
from numpy.typing import NDArray

from hapticdb.grid import Grid
from hapticdb.store import parsing
from hapticdb.store.base import LAYOUTS, NO_KEYS, Keys, Layout, Object, Rows, Size
from hapticdb.store.covering import Ranges
from hapticdb.store.pairs import PUT, Ids, PairRow
from hapticdb.store.sqlite.file_connection import FileConnection
from hapticdb.store.tables import LAST_REVISION, SIZE_OF_SURFACES, Tables

Result = TypeVar("Result")
KINDS = """
SELECT name, CASE WHEN sql LIKE 'CREATE VIRTUAL%' THEN 'virtual table' ELSE type END
  FROM sqlite_master"""

# whole arrays bound at once: 8 times faster than executemany, without the interpreter lock
INSERT = {
    "voxel": "INSERT INTO voxel SELECT value, ?2 FROM carray(?1)",
    "brick": """INSERT INTO brick SELECT value, ?2, nth(?3, rowid, 0), nth(?4, rowid, 0)
                  FROM carray(?1)""",
}
CHUNK = 1 << 14
"""Rows inserted by one statement; to undo it takes up to a page of memory for each."""
PUT_PAIR = PUT.format(values=f"VALUES ({', '.join('?' * 14)})")
DELETE_PAIR = "DELETE FROM pair WHERE (a, b) = (?, ?)"
DELETE: dict[Layout, str] = {
    layout: f"DELETE FROM {layout} WHERE z_val BETWEEN ? AND ? AND id = ? RETURNING z_val"
    for layout in LAYOUTS
}


def read_environment(connection: FileConnection) -> tuple[Grid, Layout, bool]:
    """Grid and layout of an environment, and whether imports compute distances, all checked."""
    kinds = dict(connection.fetch(KINDS))
    parsing.check_tables(connection.url, kinds)
    rows = connection.fetch(
        "SELECT voxel_size, origin_x, origin_y, origin_z, bits, curve, layout, wants_distances"
        "  FROM environment"
    )
    grid, layout = parsing.grid_of(connection.url, rows)
    return grid, layout, parsing.distances_wanted(connection.url, rows[0][7])


class FileTables(Tables):
    """The tables in a file."""

    AMONG = "id IN (SELECT value FROM json_each(%s))"
    LISTED = "SELECT value FROM json_each(%s)"
    AS_TEXT = ""
    TAKEN = apsw.ConstraintError
    _connection: FileConnection

    def __init__(self, connection: FileConnection) -> None:
        super().__init__(connection)
        self.url = connection.url
        self.grid, self.layout, self.wants_distances = read_environment(connection)

    def _rows(
        self,
        text: str,
        parameters: Sequence[Any] = (),
        *,
        binary: bool = False,  # noqa: ARG002 - a file has one format
    ) -> list[Any]:
        self._connection.file.check()
        return self._connection.fetch(text.replace("%s", "?"), parameters)

    def _do(self, text: str, parameters: Sequence[Any] = ()) -> list[Any]:
        return self._connection.driver.execute(text.replace("%s", "?"), parameters).fetchall()

    def _save(self, text: str, parameters: Sequence[Any] = ()) -> None:
        self._commit(lambda: self._do(text, parameters))

    def _commit(self, work: Callable[[], Result]) -> Result:
        with self._connection.writing():
            return work()

    _alone = _commit

    def _next_revision(self) -> int:
        return self.revision() + 1

    def _new_id(self, revision: int) -> None:
        """None: the table assigns an id that no object ever had."""

    def _packed(self, values: NDArray[Any]) -> bytes:
        return np.ascontiguousarray(values, values.dtype.newbyteorder("<")).tobytes()

    def _note(self, change: tuple[Any, ...]) -> None:
        self._do("INSERT INTO change VALUES (?, ?, ?, ?)", change)

    def revision(self) -> int:
        return parsing.number_of(
            self.url, self._rows(f"SELECT {LAST_REVISION}")[0][0], "the revision"
        )

    # -- writes ----------------------------------------------------------------------------------

    def _exchange_pairs(self, gone: Ids, rows: Sequence[PairRow]) -> None:
        self._connection.driver.executemany(DELETE_PAIR, gone)
        self._connection.driver.executemany(PUT_PAIR, [row.columns for row in rows])

    def _put(self, rows: Rows, object_id: int) -> None:
        """Insert rows, ascending by key: a statement for each chunk."""
        for at in range(0, len(rows), CHUNK):
            part = rows.part(at, at + CHUNK)
            fields = zip(*parsing.fields_of(part), strict=True) if self.layout == "brick" else ()
            keys = apsw.carray(np.ascontiguousarray(part.keys))
            self._do(INSERT[self.layout], (keys, object_id, *map(apsw.pyobject, fields)))

    def _take(self, known: Object, ranges: Ranges, keys: Keys = NO_KEYS) -> Keys:  # noqa: ARG002
        gone: list[int] = []
        # one statement a range: one descent of the index each, without a join
        for low, high in zip(ranges.lows.tolist(), ranges.highs.tolist(), strict=True):
            gone += [row[0] for row in self._do(DELETE[self.layout], (low, high, known.id))]
        return np.array(gone, dtype=np.int64)

    # -- statistics ------------------------------------------------------------------------------

    def size(self) -> Size:
        with self._connection.snapshot():
            rows = self._connection.fetch(f"SELECT count(*) FROM {self.layout}")[0][0]
            blocks = self._connection.fetch(
                "SELECT pageno FROM dbstat WHERE name = ?1 AND aggregate = TRUE", (self.layout,)
            )
            (surfaces,) = self._connection.fetch(SIZE_OF_SURFACES)
        wal = Path(f"{self._connection.path}-wal")
        total = self._connection.path.stat().st_size + (wal.stat().st_size if wal.exists() else 0)
        n_blocks = int(blocks[0][0]) if blocks else 1
        return Size(int(rows), total, n_blocks, *map(int, surfaces))

    def findings(self) -> Iterator[str]:
        for (line,) in self._connection.fetch("PRAGMA integrity_check(100)"):
            if line != "ok":
                yield " ".join(str(line).split())
        yield from super().findings()

    def _exact(self, resolution: int) -> tuple[Keys, int]:
        """Bounds (v + 1,) of the v-quantile vector (the paper's Definition 2), and the rows N.

        Bound i is the key of the row of rank ceil(i N / v), bound 0 the lowest. Each step skips,
        inside the engine, from one rank to the next. ``sqlite_stat4`` has only 24 samples.
        """

        def row_of(sql: str, *bindings: int) -> tuple[int, int]:
            found = self._connection.fetch(sql, bindings)
            if not found:
                raise parsing.damaged(self.url, "fewer rows than are counted")
            key, object_id = found[0]
            return key, object_id

        with self.snapshot():
            ((n_rows,),) = self._connection.fetch(f"SELECT count(*) FROM {self.layout}")
            if n_rows == 0:
                return np.zeros(2, dtype=np.int64), 0
            key, object_id = row_of(
                f"SELECT z_val, id FROM {self.layout} ORDER BY z_val, id LIMIT 1"
            )
            # by row value from the last bound: OFFSET from the first row would read
            # all rows before each bound again
            step = (
                f"SELECT z_val, id FROM {self.layout} WHERE (z_val, id) >= (?1, ?2)"
                " ORDER BY z_val, id LIMIT 1 OFFSET ?3"
            )
            bounds = [key]
            rank = 1
            for i in range(1, resolution + 1):
                # ceiling in integers: a float would round ranks of large tables
                target = max(1, -(-i * n_rows // resolution))
                if target > rank:
                    key, object_id = row_of(step, key, object_id, target - rank)
                    rank = target
                bounds.append(key)
            return np.array(bounds, dtype=np.int64), n_rows

"""Statistics of a file: sizes, quantiles of the keys."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hapticdb.store import parsing
from hapticdb.store.base import Keys, Size
from hapticdb.store.sqlite.tables.asking import FileTables

SIZE_OF_BAND = "SELECT ncell, pgsize FROM dbstat WHERE name = 'band' AND aggregate = TRUE"
"""Rows and bytes by one pass: in a table WITHOUT ROWID each cell is a row."""
SIZE_OF_SURFACES = "SELECT count(*), coalesce(sum(length(geometry)), 0) FROM surface"


class SQLiteStatistics(FileTables):
    """Sizes and statistics of one environment's tables."""

    def size(self) -> Size:
        """Rows, bytes of the file and its log, leaf blocks; rows of distances; surfaces."""
        band = surfaces = (0, 0)
        with self._connection.snapshot():
            rows = self._connection.fetch(f"SELECT count(*) FROM {self.layout}")[0][0]
            blocks = self._connection.fetch(
                "SELECT pageno FROM dbstat WHERE name = ?1 AND aggregate = TRUE", (self.layout,)
            )
            if self.has_table(parsing.BAND):
                (band,) = self._connection.fetch(SIZE_OF_BAND)  # a row for an empty table, too
            if self.has_table(parsing.SURFACE):
                (surfaces,) = self._connection.fetch(SIZE_OF_SURFACES)
        wal = Path(f"{self._connection.path}-wal")
        total = self._connection.path.stat().st_size + (wal.stat().st_size if wal.exists() else 0)
        n_blocks = int(blocks[0][0]) if blocks else 1
        return Size(int(rows), total, n_blocks, *map(int, (*band, *surfaces)))

    def findings(self) -> Iterator[str]:
        """What is wrong with indexes and kept statistics, a line each."""
        for (line,) in self._connection.fetch("PRAGMA integrity_check(100)"):
            if line != "ok":
                yield " ".join(str(line).split())
        yield from super().findings()

    def _exact(self, resolution: int) -> tuple[Keys, int]:
        """Bounds (v + 1,) of the v-quantile vector (the paper's Definition 2), and the rows N.

        SQLite's own statistics (``sqlite_stat4``) hold only 24 samples.
        Bound i is the key of the row of rank j = ceil(i N / v), i = 1 .. v; bound 0 is the lowest.
        Each step skips, inside the engine, from the row of one rank to the row of the next, in the
        order of (z_val, id). Rows with the same key count one by one.
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
            step = (
                f"SELECT z_val, id FROM {self.layout} WHERE (z_val, id) >= (?1, ?2)"
                " ORDER BY z_val, id LIMIT 1 OFFSET ?3"
            )
            bounds = [key]
            rank = 1
            for i in range(1, resolution + 1):
                target = max(1, -(-i * n_rows // resolution))
                if target > rank:
                    key, object_id = row_of(step, key, object_id, target - rank)
                    rank = target
                bounds.append(key)
            return np.array(bounds, dtype=np.int64), n_rows

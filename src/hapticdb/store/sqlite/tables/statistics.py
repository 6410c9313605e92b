"""Statistics of a file: sizes, quantiles of the keys, cost figures."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hapticdb.store import parsing
from hapticdb.store.base import Freshness, Histogram, Keys, Layout, Size
from hapticdb.store.sqlite.connection import FileConnection
from hapticdb.store.sqlite.tables.reading import SQLiteReader

SIZE_OF_BAND = "SELECT ncell, pgsize FROM dbstat WHERE name = 'band' AND aggregate = TRUE"
"""Rows and bytes by one pass: in a table WITHOUT ROWID each cell is a row."""
SIZE_OF_SURFACES = "SELECT count(*), coalesce(sum(length(geometry)), 0) FROM surface"


class SQLiteStatistics:
    """Sizes and statistics of one environment's tables, and the figures kept beside them."""

    def __init__(self, connection: FileConnection, layout: Layout, reader: SQLiteReader) -> None:
        self._connection = connection
        self._layout = layout
        self._reader = reader

    def size(self) -> Size:
        """Rows, bytes of the file and its log, leaf blocks; rows of distances; surfaces."""
        band = surfaces = (0, 0)
        with self._connection.snapshot():
            rows = self._connection.fetch(f"SELECT count(*) FROM {self._layout}")[0][0]
            blocks = self._connection.fetch(
                "SELECT pageno FROM dbstat WHERE name = ?1 AND aggregate = TRUE", (self._layout,)
            )
            if self._reader.has_table(parsing.BAND):
                (band,) = self._connection.fetch(SIZE_OF_BAND)  # a row for an empty table, too
            if self._reader.has_table(parsing.SURFACE):
                (surfaces,) = self._connection.fetch(SIZE_OF_SURFACES)
        wal = Path(f"{self._connection.path}-wal")
        total = self._connection.path.stat().st_size + (wal.stat().st_size if wal.exists() else 0)
        n_blocks = int(blocks[0][0]) if blocks else 1
        return Size(int(rows), total, n_blocks, *map(int, (*band, *surfaces)))

    def quantiles(self, resolution: int) -> Histogram:
        """Equi-count histogram of all row keys, of R buckets.

        The kept one while no object was written since, else by a scan of the whole index.
        """
        with self._connection.snapshot():
            kept = self._kept_quantiles(resolution)
            if kept:
                return parsing.histogram_of(self._connection.url, *kept[0])
            bounds, n_rows = _exact_quantiles(self._connection, self._layout, resolution)
            return Histogram(bounds, n_rows, "computed")

    def freshness(self, resolution: int) -> Freshness:
        """How old the kept histogram is."""
        with self._connection.snapshot():
            revision = self._reader.revision()
            kept = self._connection.fetch(
                "SELECT revision FROM quantile WHERE resolution = ?", (resolution,)
            )
        since = int(kept[0][0]) if kept else 0
        return Freshness(since if kept else None, revision - since)

    def _kept_quantiles(self, resolution: int) -> list[Any]:
        """Bounds and rows of the vector that was kept at this revision, if any."""
        return self._connection.fetch(
            "SELECT bounds, n_rows FROM quantile WHERE resolution = ?"
            " AND revision = (SELECT coalesce(max(revision), 0) FROM change)",
            (resolution,),
        )

    def analyze(self, resolution: int, *, anew: bool = False) -> None:
        """Compute and keep the quantile vector of that resolution, unless a fresh one is kept."""
        if self._kept_quantiles(resolution) and not anew:
            return
        bounds, n_rows = _exact_quantiles(self._connection, self._layout, resolution)
        with self._connection.writing():
            # another process may have written since: then the vector carries the older revision's
            # rows under the newer number, off by that one write, as statistics are allowed to be
            self._connection.execute(
                "INSERT OR REPLACE INTO quantile"
                " SELECT ?, coalesce(max(revision), 0), ?, ? FROM change",
                (resolution, n_rows, bounds.astype("<i8").tobytes()),
            )

    def findings(self) -> Iterator[str]:
        """What is wrong with indexes and kept statistics, a line each."""
        for (line,) in self._connection.fetch("PRAGMA integrity_check(100)"):
            if line != "ok":
                yield " ".join(str(line).split())
        kept = self._connection.fetch("SELECT bounds, n_rows FROM quantile")
        costs = self._connection.fetch("SELECT figures FROM cost")
        yield from parsing.findings_of_kept(self._connection.url, kept, costs)

    def costs(self, machine: str) -> Mapping[str, float] | None:
        """Figures that `save_costs` kept for that machine."""
        kept = self._connection.fetch("SELECT figures FROM cost WHERE machine = ?", (machine,))
        return parsing.figures_of(self._connection.url, kept[0][0]) if kept else None

    def save_costs(self, machine: str, figures: Mapping[str, float]) -> None:
        """Keep the fitted cost figures of a machine."""
        with self._connection.writing():
            self._connection.execute(
                "INSERT OR REPLACE INTO cost VALUES (?, ?)", (machine, json.dumps(dict(figures)))
            )


def _exact_quantiles(
    connection: FileConnection, layout: Layout, resolution: int
) -> tuple[Keys, int]:
    """Bounds (v + 1,) of the v-quantile vector (the paper's Definition 2), and the rows N.

    SQLite's own statistics (``sqlite_stat4``) hold only 24 samples.
    Bound i is the key of the row of rank j = ceil(i N / v), i = 1 .. v; bound 0 is the lowest key.
    Each step skips, inside the engine, from the row of one rank to the row of the next, in the
    order of (z_val, id). Rows with the same key count one by one.
    """

    def row_of(sql: str, *bindings: int) -> tuple[int, int]:
        found = connection.fetch(sql, bindings)
        if not found:
            raise parsing.damaged(connection.url, "fewer rows than are counted")
        key, object_id = found[0]
        return key, object_id

    ((n_rows,),) = connection.fetch(f"SELECT count(*) FROM {layout}")
    if n_rows == 0:
        return np.zeros(2, dtype=np.int64), 0
    key, object_id = row_of(f"SELECT z_val, id FROM {layout} ORDER BY z_val, id LIMIT 1")
    step = (
        f"SELECT z_val, id FROM {layout} WHERE (z_val, id) >= (?1, ?2)"
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

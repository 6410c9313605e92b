"""Statistics of a file: sizes, quantiles of the keys, cost figures."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hapticdb.store import believed
from hapticdb.store.base import Freshness, Histogram, Layout, Size
from hapticdb.store.sqlite.connection import FileConnection
from hapticdb.store.sqlite.tables.quantiles import exact_quantiles
from hapticdb.store.sqlite.tables.reading import SQLiteReader

SIZE_OF_BAND = "SELECT ncell, pgsize FROM dbstat WHERE name = 'band' AND aggregate = TRUE"
"""Rows and bytes by one pass: in a table WITHOUT ROWID each cell is a row."""


class SQLiteStatistics:
    """Sizes and statistics of one environment's tables, and the figures kept beside them."""

    def __init__(self, connection: FileConnection, layout: Layout, reader: SQLiteReader) -> None:
        self._connection = connection
        self._layout = layout
        self._reader = reader

    def size(self) -> Size:
        """Rows, bytes of the file and its write-ahead log, leaf blocks; rows of distances."""
        band = (0, 0)
        with self._connection.snapshot():
            rows = self._connection.fetch(f"SELECT count(*) FROM {self._layout}")[0][0]
            blocks = self._connection.fetch(
                "SELECT pageno FROM dbstat WHERE name = ?1 AND aggregate = TRUE", (self._layout,)
            )
            if self._reader.has_band():
                (band,) = self._connection.fetch(SIZE_OF_BAND)  # a row for an empty table, too
        wal = Path(f"{self._connection.path}-wal")
        total = self._connection.path.stat().st_size + (wal.stat().st_size if wal.exists() else 0)
        return Size(int(rows), total, int(blocks[0][0]) if blocks else 1, *map(int, band))

    def quantiles(self, resolution: int) -> Histogram:
        """Equi-count histogram of all row keys, of R buckets.

        The kept one while no object was written since, else by a scan of the whole index.
        """
        with self._connection.snapshot():
            kept = self._kept_quantiles(resolution)
            if kept:
                return believed.histogram_of(self._connection.url, *kept[0])
            bounds, n_rows = exact_quantiles(self._connection, self._layout, resolution)
            return Histogram(bounds, n_rows, "computed")

    def freshness(self, resolution: int) -> Freshness:
        """How old the kept histogram is; its rows are the voxels of objects written since."""
        with self._connection.snapshot():
            revision = self._reader.revision()
            kept = self._connection.fetch(
                "SELECT revision FROM quantile WHERE resolution = ?", (resolution,)
            )
            since = int(kept[0][0]) if kept else 0
            rows = self._connection.fetch(
                "SELECT coalesce(sum(voxels), 0) FROM object WHERE revision > ?", (since,)
            )
        return Freshness(since if kept else None, revision - since, int(rows[0][0]))

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
        bounds, n_rows = exact_quantiles(self._connection, self._layout, resolution)
        with self._connection.writing():
            # another process may have written since: then the vector carries the older revision's
            # rows under the newer number, off by that one write, as statistics are allowed to be
            self._connection.execute(
                "INSERT OR REPLACE INTO quantile"
                " SELECT ?, coalesce(max(revision), 0), ?, ? FROM change",
                (resolution, n_rows, bounds.astype("<i8").tobytes()),
            )

    def costs(self, machine: str) -> Mapping[str, float] | None:
        """Figures that `save_costs` kept for that machine."""
        kept = self._connection.fetch("SELECT figures FROM cost WHERE machine = ?", (machine,))
        return believed.figures_of(self._connection.url, kept[0][0]) if kept else None

    def save_costs(self, machine: str, figures: Mapping[str, float]) -> None:
        """Keep the fitted cost figures of a machine."""
        with self._connection.writing():
            self._connection.execute(
                "INSERT OR REPLACE INTO cost VALUES (?, ?)", (machine, json.dumps(dict(figures)))
            )

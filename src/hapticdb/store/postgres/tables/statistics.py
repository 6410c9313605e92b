"""Statistics on a server: sizes, quantiles of the keys, cost figures."""

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from hapticdb.store import parsing
from hapticdb.store.base import Freshness, Histogram, Keys, Layout, Size
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.tables.histogram import (
    ENOUGH_ROWS,
    SERVER_RESOLUTION,
    exact_histogram,
    server_histogram,
)
from hapticdb.store.postgres.tables.reading import PostgresReader

SIZE_OF_BAND = "SELECT count(*), pg_total_relation_size('band') FROM band"
SIZE_OF_PARTITIONS = "SELECT sum(bytes), sum(pages), sum(band) FROM size"
SIZE_OF_SURFACES = "SELECT count(*), coalesce(sum(octet_length(geometry)), 0) FROM surface"


class PostgresStatistics:
    """Sizes and statistics of one environment's tables, and the figures kept beside them."""

    def __init__(
        self,
        connection: ServerConnection,
        layout: Layout,
        reader: PostgresReader,
        *,
        is_spread: bool,
    ) -> None:
        self._is_spread = is_spread
        self._connection = connection
        self._layout = layout
        self._reader = reader

    def size(self) -> Size:
        """Rows, bytes of all tables and indexes, leaf blocks; rows of distances; surfaces."""
        with self._connection.snapshot(), self._connection.without_limit():
            self._reader.revision()
            band = surfaces = (0, 0)
            counted = (
                "SELECT count(*) FROM brick"
                if self._layout == "brick"
                else "SELECT coalesce(sum(voxels), 0) FROM object"  # a row for each voxel
            )
            ((rows,),) = self._connection.execute(counted).fetchall()
            total, index = self._bytes()
            if self._reader.has_table(parsing.BAND):
                (band,) = self._connection.execute(SIZE_OF_BAND).fetchall()
            if self._is_spread:
                ((more, index, of_band),) = self._connection.execute(SIZE_OF_PARTITIONS).fetchall()
                total, index, band = total + int(more), int(index), (band[0], of_band)
            if self._reader.has_table(parsing.SURFACE):
                (surfaces,) = self._connection.execute(SIZE_OF_SURFACES).fetchall()
            return Size(int(rows), total, max(index, 1), *map(int, (*band, *surfaces)))

    def quantiles(self, resolution: int) -> Histogram:
        """Equi-count histogram of all row keys, of R buckets.

        At 10,000 from the server's statistics once there are enough rows; else the kept one while
        no object was written since, else computed exactly.
        """
        if resolution == SERVER_RESOLUTION:
            found = server_histogram(self._connection, self._layout)
            if found is not None and found[1] >= ENOUGH_ROWS:
                return Histogram(*found, "server statistics")
        kept = self._connection.rows(
            "SELECT bounds, n_rows FROM quantile WHERE resolution = %s AND bounds IS NOT NULL"
            " AND revision = (SELECT revision FROM environment)",
            (resolution,),
        )
        if kept:
            return parsing.histogram_of(self._connection.shown, *kept[0])
        return Histogram(*self._exact(resolution), "computed")

    def freshness(self, resolution: int) -> Freshness:
        """How old the histogram of that resolution is, by the revision stored with it."""
        ((revision, made),) = self._connection.rows(
            "SELECT e.revision, q.revision"
            "  FROM environment e LEFT JOIN quantile q ON q.resolution = %s",
            (resolution,),
        )
        return Freshness(made, int(revision) - (made or 0))

    def analyze(self, resolution: int, *, anew: bool = False) -> None:
        """Renew the server's statistics, or compute and keep a histogram, unless it is fresh."""
        if not anew and self.freshness(resolution) == (self._reader.revision(), 0):
            return
        bounds: list[int] | None = None
        with self._connection.snapshot():
            revision = self._reader.revision()
            n_rows = self.size().rows
            is_computed = resolution != SERVER_RESOLUTION or n_rows < ENOUGH_ROWS
            if is_computed:
                keys, n_rows = self._exact(resolution)
                bounds = keys.tolist()
        if not is_computed:
            with self._connection.without_limit("statement_timeout", "lock_timeout"):
                self._connection.execute("SELECT refresh_statistics()")
        self._save(
            "INSERT INTO quantile VALUES (%s, %s, %s, %s)"
            " ON CONFLICT (resolution) DO UPDATE SET revision = EXCLUDED.revision,"
            " n_rows = EXCLUDED.n_rows, bounds = EXCLUDED.bounds"
            " WHERE quantile.revision <= EXCLUDED.revision",
            (resolution, revision, n_rows, bounds),
        )

    def _exact(self, resolution: int) -> tuple[Keys, int]:
        return exact_histogram(self._connection, self._layout, resolution)

    def findings(self) -> Iterator[str]:
        """What is wrong with kept statistics, a line each; the server checks its own pages."""
        kept = self._connection.rows("SELECT bounds, n_rows FROM quantile WHERE bounds IS NOT NULL")
        costs = self._connection.rows("SELECT figures::text FROM cost")
        yield from parsing.findings_of_kept(self._connection.shown, kept, costs)

    def costs(self, machine: str) -> Mapping[str, float] | None:
        """Figures that `save_costs` kept for that machine."""
        kept = self._connection.rows(
            "SELECT figures::text FROM cost WHERE machine = %s", (machine,)
        )
        return parsing.figures_of(self._connection.shown, kept[0][0]) if kept else None

    def save_costs(self, machine: str, figures: Mapping[str, float]) -> None:
        """Keep the fitted cost figures of a machine."""
        self._save(
            "INSERT INTO cost VALUES (%s, %s)"
            " ON CONFLICT (machine) DO UPDATE SET figures = EXCLUDED.figures",
            (machine, json.dumps(dict(figures))),
        )

    def _save(self, text: str, parameters: Sequence[Any]) -> None:
        self._connection.write(lambda: self._connection.execute(text, parameters))

    def _bytes(self) -> tuple[int, int]:
        """Bytes of all tables and indexes of the schema, and pages of the index of its rows."""
        ((total, pages),) = self._connection.execute(
            "SELECT (SELECT coalesce(sum(pg_total_relation_size(oid)), 0) FROM pg_class"
            "         WHERE relkind = 'r'"
            "           AND relnamespace = quote_ident(current_schema())::regnamespace),"
            "       coalesce(pg_relation_size(to_regclass(%s)), 0)"
            "         / current_setting('block_size')::int",
            (f"{self._layout}_key",),
        ).fetchall()
        return int(total), int(pages)

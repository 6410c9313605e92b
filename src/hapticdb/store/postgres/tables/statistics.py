"""Statistics on a server: sizes, quantiles of the keys."""

from hapticdb.store import parsing
from hapticdb.store.base import Histogram, Keys, Size
from hapticdb.store.postgres.tables.asking import ServerTables
from hapticdb.store.postgres.tables.histogram import (
    ENOUGH_ROWS,
    SERVER_RESOLUTION,
    exact_histogram,
    server_histogram,
)

SIZE_OF_BAND = "SELECT count(*), pg_total_relation_size('band') FROM band"
SIZE_OF_PARTITIONS = "SELECT sum(bytes), sum(pages), sum(band) FROM size"
SIZE_OF_SURFACES = "SELECT count(*), coalesce(sum(octet_length(geometry)), 0) FROM surface"


class PostgresStatistics(ServerTables):
    """Sizes and statistics of one environment's tables."""

    def size(self) -> Size:
        """Rows, bytes of all tables and indexes, leaf blocks; rows of distances; surfaces."""
        with self._connection.snapshot(), self._connection.without_limit():
            self.revision()
            band = surfaces = (0, 0)
            counted = (
                "SELECT count(*) FROM brick"
                if self.layout == "brick"
                else "SELECT coalesce(sum(voxels), 0) FROM object"  # a row for each voxel
            )
            ((rows,),) = self._connection.execute(counted).fetchall()
            total, index = self._bytes()
            if self.has_table(parsing.BAND):
                (band,) = self._connection.execute(SIZE_OF_BAND).fetchall()
            if self._is_spread:
                ((more, index, of_band),) = self._connection.execute(SIZE_OF_PARTITIONS).fetchall()
                total, index, band = total + int(more), int(index), (band[0], of_band)
            if self.has_table(parsing.SURFACE):
                (surfaces,) = self._connection.execute(SIZE_OF_SURFACES).fetchall()
            return Size(int(rows), total, max(index, 1), *map(int, (*band, *surfaces)))

    def quantiles(self, resolution: int) -> Histogram:
        """Equi-count histogram of all row keys, of R buckets.

        At 10,000 from the server's statistics once there are enough rows; else the kept one while
        no object was written since, else computed exactly.
        """
        if resolution == SERVER_RESOLUTION:
            found = server_histogram(self._connection, self.layout)
            if found is not None and found[1] >= ENOUGH_ROWS:
                return Histogram(*found, "server statistics")
        return super().quantiles(resolution)

    def _measured(self, resolution: int) -> tuple[int, int, Keys | None]:
        """The server's own statistics once there are enough rows."""
        if resolution == SERVER_RESOLUTION:
            revision, n_rows = self.revision(), self.size().rows
            if n_rows >= ENOUGH_ROWS:
                with self._connection.without_limit("statement_timeout", "lock_timeout"):
                    self._connection.execute("SELECT refresh_statistics()")
                return revision, n_rows, None
        return super()._measured(resolution)

    def _exact(self, resolution: int) -> tuple[Keys, int]:
        return exact_histogram(self._connection, self.layout, resolution)

    def _bytes(self) -> tuple[int, int]:
        """Bytes of all tables and indexes of the schema, and pages of the index of its rows."""
        ((total, pages),) = self._connection.execute(
            "SELECT (SELECT coalesce(sum(pg_total_relation_size(oid)), 0) FROM pg_class"
            "         WHERE relkind = 'r'"
            "           AND relnamespace = quote_ident(current_schema())::regnamespace),"
            "       coalesce(pg_relation_size(to_regclass(%s)), 0)"
            "         / current_setting('block_size')::int",
            (f"{self.layout}_key",),
        ).fetchall()
        return int(total), int(pages)

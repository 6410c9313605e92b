"""Tables on a server: statements, writes, sizes, quantiles of the keys."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from psycopg import errors

from hapticdb.store.base import LAYOUTS, NO_KEYS, Histogram, Keys, Layout, Object, Rows, Size
from hapticdb.store.covering import Ranges
from hapticdb.store.pairs import PUT, Ids, PairRow
from hapticdb.store.postgres import environment_schema
from hapticdb.store.postgres.connecting import failures, wire
from hapticdb.store.postgres.connecting.server_connection import ServerConnection
from hapticdb.store.postgres.tables import statements
from hapticdb.store.postgres.tables.loading import Loading
from hapticdb.store.postgres.watching import REVISION, channel_of
from hapticdb.store.tables import SIZE_OF_SURFACES, Tables

Result = TypeVar("Result")

WRITE_LOCK = "SELECT 1 FROM environment WHERE id = 1 FOR UPDATE"
# writers take revisions one after the other; no reader waits for this lock
NEXT_REVISION = "UPDATE environment SET revision = revision + 1 WHERE id = 1 RETURNING revision"
COPY_CHUNK = 1 << 14
"""Rows packed for COPY at a time. Larger: more memory, not less time."""
COLUMNS: dict[Layout, str] = {
    "voxel": "z_val, id",
    "brick": "z_val, id, occupancy, distances",
}
# not from a sequence, which also counts rolled-back writes: a repeated import would give other ids
HIGHEST_ID = "SELECT coalesce(max(id), 0) FROM change WHERE revision > %s"
NEXT_ID = "SELECT setval('object_id_seq', greatest(nextval('object_id_seq'), %s))"
# columns of the table `pair`
PAIR_TYPES = (
    "bigint[]", "bigint[]", "text[]", *["double precision[]"] * 8, "text[]", "bigint[]", "text[]",
)  # fmt: skip
PUT_PAIRS = PUT.format(
    values=f"SELECT * FROM unnest({', '.join(f'%s::{kind}' for kind in PAIR_TYPES)})"
)
DELETE_PAIRS = """
DELETE FROM pair USING unnest(%s::bigint[], %s::bigint[]) AS gone (a, b)
 WHERE (pair.a, pair.b) = (gone.a, gone.b)"""
SIZE_OF_PARTITIONS = "SELECT sum(bytes), sum(pages) FROM size"
SERVER_RESOLUTION = 10_000
"""Buckets of the server's histogram: the server's maximum, and the paper's best resolution."""
ENOUGH_ROWS = 10 * SERVER_RESOLUTION
"""Least number of rows for the server's statistics. With fewer, an exact histogram is fast."""

# one row, of NULLs before the first ANALYZE
STATISTICS = """
SELECT histogram_bounds::text::bigint[], most_common_vals::text::bigint[],
       most_common_freqs::float8[],
       (SELECT reltuples::bigint FROM pg_class
         WHERE oid = to_regclass(quote_ident(schemaname) || '.' || quote_ident(tablename)))
  FROM (SELECT) AS one LEFT JOIN pg_stats
    ON schemaname = $1::text::name AND tablename = $2::text::name AND attname = 'z_val'"""
# (r - 0.5) / N, because r / N may be rounded to the neighbour of rank r
EXACT = {
    layout: f"""
SELECT percentile_disc((SELECT array_agg((r - 0.5) / $2 ORDER BY n)
                          FROM unnest($1) WITH ORDINALITY AS rank(r, n)))
         WITHIN GROUP (ORDER BY z_val)
  FROM {layout}"""
    for layout in LAYOUTS
}


class ServerTables(Tables):
    """Tables on a server, with the revision seen by the last read."""

    AMONG = "id = ANY (ARRAY(SELECT json_array_elements_text(%s::json)::bigint))"
    LISTED = "SELECT json_array_elements_text(%s::json)"
    AS_TEXT = "::text"
    TAKEN = errors.UniqueViolation
    _connection: ServerConnection

    def __init__(self, connection: ServerConnection) -> None:
        super().__init__(connection)
        self.url = connection.shown
        made = environment_schema.read_environment(connection)
        self.grid, self.layout, self.wants_distances, self.identity, self._is_partitioned = made
        self._seen = -1
        self._loading = Loading(connection, None if self._is_partitioned else self.layout)
        self._written: tuple[Any, ...] = ()
        self._highest_id = (0, 0)  # and its revision

    def _rows(
        self, text: str, parameters: Sequence[Any] = (), *, binary: bool = False
    ) -> list[Any]:
        return self._connection.rows(text, parameters, binary=binary)

    def _do(self, text: str, parameters: Sequence[Any] = ()) -> list[Any]:
        cursor = self._connection.execute(text, parameters)
        return cursor.fetchall() if cursor.description else []

    def _save(self, text: str, parameters: Sequence[Any] = ()) -> None:
        self._connection.write(lambda: self._do(text, parameters))

    def _alone(self, work: Callable[[], Result]) -> Result:
        def locked() -> Result:
            self._do(WRITE_LOCK)
            return work()

        return self._connection.write(locked)

    def _next_revision(self) -> int:
        return int(self._do(NEXT_REVISION)[0][0])

    def _packed(self, values: NDArray[Any]) -> list[Any]:
        return values.reshape(-1).tolist()

    def version(self) -> int:
        """Revision seen by the last read; -1 after an own write."""
        return self._seen

    def revision(self) -> int:
        ((self._seen, identity),) = self._rows(REVISION)
        if identity != self.identity:
            raise failures.remade(self.url)
        return self._seen

    # -- writes ----------------------------------------------------------------------------------

    def _exchange_pairs(self, gone: Ids, rows: Sequence[PairRow]) -> None:
        self._do(DELETE_PAIRS, [list(column) for column in zip(*gone, strict=True)])
        columns = zip(*(row.columns for row in rows), strict=True)
        self._do(PUT_PAIRS, [list(column) for column in columns])

    def drop_rows(self, object_id: int) -> None:
        """Delete the orphan rows of a crash, unless the object exists."""

        def work() -> None:
            if not self._do("SELECT 1 FROM object WHERE id = %s", (object_id,)):
                self._do(f"DELETE FROM {self.layout} WHERE id = %s", (object_id,))

        self._alone(work)

    def _new_id(self, revision: int) -> int:
        """One above all ids ever assigned, under the write lock.

        On partitions the id of a failed add is never reused: its orphan rows may exist.
        """
        # of the changes since the last call alone, not of the whole log
        since, highest = self._highest_id
        found = self._do(HIGHEST_ID, (since,))
        self._highest_id = revision - 1, max(highest, int(found[0][0]))
        if self._is_partitioned:
            return int(self._do(NEXT_ID, (self._highest_id[1] + 1,))[0][0])
        return self._highest_id[1] + 1

    def _commit(self, work: Callable[[], Result]) -> Result:
        result = self._connection.write(work, self._is_written)
        self._seen = -1  # no read has seen this write
        self._loading.note()
        return result

    def _note(self, change: tuple[Any, ...]) -> None:
        """Write the row of `change`, and notify the channel at the commit."""
        ((transaction, _),) = self._do(
            "INSERT INTO change VALUES (%s, %s, %s, %s)"
            " RETURNING xmin::text, pg_notify(%s, revision::text)",
            (*change, channel_of(self._connection.address.environment)),
        )
        # with the transaction's id: another writer may commit the same revision
        self._written = (*change[:3], transaction)

    def _is_written(self) -> bool:
        """Whether a write was committed although the connection broke during its commit."""
        # the commit may still be in progress: wait for its lock first
        self._rows(WRITE_LOCK)
        found = "SELECT 1 FROM change WHERE (revision, action, id, xmin::text) = (%s, %s, %s, %s)"
        return bool(self._rows(found, self._written))

    def _put(self, rows: Rows, object_id: int) -> None:
        """Write the rows of an object without rows."""
        target = f"{self.layout} ({COLUMNS[self.layout]})"
        with self._connection.driver.cursor().copy(
            f"COPY {target} FROM STDIN (FORMAT binary)"
        ) as copy:
            copy.write(wire.COPY_HEADER)
            for at in range(0, len(rows), COPY_CHUNK):
                copy.write(wire.copy_rows(rows.part(at, at + COPY_CHUNK), object_id))
            copy.write(wire.COPY_TRAILER)

    def _take(self, known: Object, ranges: Ranges, keys: Keys = NO_KEYS) -> Keys:
        """Delete the present rows of an object; returns their keys.

        keys : of its new rows; on partitions a failed attempt may have left such rows.
        """
        lows, highs = ranges
        if self._is_partitioned and keys.size:
            # one range over all new keys: an orphan row at a new key would collide with its insert
            lows, highs = np.append(lows, keys.min()), np.append(highs, keys.max())
        chosen = wire.int8s(lows), wire.int8s(highs), wire.int8(known.id)
        (found,) = self._connection.fetch(statements.DELETE_ROWS[self.layout], *chosen)
        return wire.read_int8s(found)

    # -- statistics ------------------------------------------------------------------------------

    def size(self) -> Size:
        with self._connection.snapshot(), self._connection.without_limit():
            self.revision()
            counted = (
                "SELECT count(*) FROM brick"
                if self.layout == "brick"
                else "SELECT coalesce(sum(voxels), 0) FROM object"  # a row a voxel
            )
            ((rows,),) = self._connection.execute(counted).fetchall()
            total, index = self._bytes()
            if self._is_partitioned:
                ((more, index),) = self._connection.execute(SIZE_OF_PARTITIONS).fetchall()
                total, index = total + int(more), int(index)
            (surfaces,) = self._connection.execute(SIZE_OF_SURFACES).fetchall()
            return Size(int(rows), total, max(index, 1), *map(int, surfaces))

    def quantiles(self, resolution: int) -> Histogram:
        """At 10,000 from the server's statistics, from `ENOUGH_ROWS` rows on."""
        found = self._server_histogram() if resolution == SERVER_RESOLUTION else None
        return found or super().quantiles(resolution)

    def _server_histogram(self) -> Histogram | None:
        """Histogram of 10,000 buckets from `pg_stats`; None for few rows, or without an ANALYZE.

        The bounds of `pg_stats` omit the most common keys, which have shares of all rows. The rows
        of a bucket count at its upper bound, those of a common key at the key itself. Bound i is
        the least key with a cumulative share of rows of i / R, exact to within a bucket.
        """
        parameters = wire.text(self._connection.address.environment), wire.text(self.layout)
        *found, frequencies, n_rows = self._connection.fetch(STATISTICS, *parameters)
        rows = wire.read_int8(n_rows) if n_rows is not None else 0
        if rows < ENOUGH_ROWS:
            return None
        bounds, common = map(wire.read_int8s, found)
        shares = wire.read_float8s(frequencies) if frequencies else np.empty(0)
        # cumulative shares: R equal buckets at their upper bounds, merged with the common keys
        keys = np.concatenate([bounds[1:], common])
        equal: Keys = np.zeros(SERVER_RESOLUTION + 1, dtype=np.int64)
        if len(keys):
            rest = max(1.0 - float(shares.sum()), 0.0)
            in_buckets = np.full(len(bounds[1:]), rest / max(len(bounds) - 1, 1))
            order = np.argsort(keys, kind="stable")
            up_to = np.cumsum(np.concatenate([in_buckets, shares])[order])
            targets = np.arange(SERVER_RESOLUTION + 1) / SERVER_RESOLUTION * up_to[-1]
            equal = keys[order][np.searchsorted(up_to, targets)]
            # the least key of all, since a bucket counts at its upper bound
            equal[0] = np.append(keys, bounds[:1]).min()
        return Histogram(equal, rows, "server statistics")

    def _measured(self, resolution: int) -> tuple[int, int, Keys | None]:
        """The server's own statistics, from `ENOUGH_ROWS` rows on."""
        if resolution == SERVER_RESOLUTION:
            revision, n_rows = self.revision(), self.size().rows
            if n_rows >= ENOUGH_ROWS:
                with self._connection.without_limit("statement_timeout", "lock_timeout"):
                    self._connection.execute("SELECT refresh_statistics()")
                return revision, n_rows, None
        return super()._measured(resolution)

    def _exact(self, resolution: int) -> tuple[Keys, int]:
        """The paper's Definition 2: bound i is the key of the row of rank ceil(i N / R)."""
        connection = self._connection
        with connection.snapshot(), connection.without_limit():
            counted = connection.execute(f"SELECT count(*) FROM {self.layout}").fetchone()
            n_rows = int(counted[0]) if counted else 0
            if n_rows == 0:
                return np.zeros(2, dtype=np.int64), 0
            # ceiling in integers: a float would round ranks of large tables
            ranks = -(-np.arange(resolution + 1, dtype=np.int64) * n_rows // resolution)
            (bounds,) = connection.fetch(
                EXACT[self.layout], wire.int8s(np.maximum(ranks, 1)), wire.float8(float(n_rows))
            )
        return wire.read_int8s(bounds), n_rows

    def _bytes(self) -> tuple[int, int]:
        """Bytes of all tables and indexes of the schema, and pages of the rows' index."""
        ((total, pages),) = self._connection.execute(
            "SELECT (SELECT coalesce(sum(pg_total_relation_size(oid)), 0) FROM pg_class"
            "         WHERE relkind = 'r'"
            "           AND relnamespace = quote_ident(current_schema())::regnamespace),"
            "       coalesce(pg_relation_size(to_regclass(%s)), 0)"
            "         / current_setting('block_size')::int",
            (f"{self.layout}_key",),
        ).fetchall()
        return int(total), int(pages)

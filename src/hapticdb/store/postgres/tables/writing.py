"""Writes on a server: each object in one transaction, with its rows and its change."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np

from hapticdb.store.base import NO_KEYS, Covering, Keys, Object, Rows, Table
from hapticdb.store.pairs import PUT, Ids, PairRow
from hapticdb.store.postgres.connecting import wire
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.tables import statements
from hapticdb.store.postgres.tables.asking import WRITE_LOCK, ServerTables
from hapticdb.store.postgres.tables.loading import TABLES, Loading
from hapticdb.store.postgres.watching import channel_of

Result = TypeVar("Result")

COPY_CHUNK = 1 << 17
"""Rows that are packed for COPY at a time. A larger value takes more memory, not less time."""
COLUMNS: dict[Table, str] = {
    "voxel": "z_val, id",
    "brick": "z_val, id, occupancy",
    "band": "z_val, id, distances",
}
# not from a sequence, which also counts rolled-back writes: an import that is run again would
# give other ids
HIGHEST_ID = "SELECT coalesce(max(id), 0) FROM change WHERE revision > %s"
NEXT_ID = "SELECT setval('object_id_seq', greatest(nextval('object_id_seq'), %s))"
# of the table `pair`, a column each
PAIR_TYPES = (
    "bigint[]", "bigint[]", "text[]", *["double precision[]"] * 8, "text[]", "bigint[]", "text[]",
)  # fmt: skip
PUT_PAIRS = PUT.format(
    values=f"SELECT * FROM unnest({', '.join(f'%s::{kind}' for kind in PAIR_TYPES)})"
)
DELETE_PAIRS = """
DELETE FROM pair USING unnest(%s::bigint[], %s::bigint[]) AS gone (a, b)
 WHERE (pair.a, pair.b) = (gone.a, gone.b)"""


class PostgresWriter(ServerTables):
    """Writes to one environment."""

    def __init__(self, connection: ServerConnection) -> None:
        super().__init__(connection)
        self._loading = Loading(connection, self.layout, is_spread=self._is_spread)
        self._written: tuple[Any, ...] = ()
        self._highest_id = (0, 0)  # at which revision

    def _exchange_pairs(self, gone: Ids, rows: Sequence[PairRow]) -> None:
        self._do(DELETE_PAIRS, [list(column) for column in zip(*gone, strict=True)])
        columns = zip(*(row.columns for row in rows), strict=True)
        self._do(PUT_PAIRS, [list(column) for column in columns])

    def drop_rows(self, object_id: int) -> None:
        """Delete the rows that a crash has left of an object that is not there."""

        def work() -> None:
            if not self._do("SELECT 1 FROM object WHERE id = %s", (object_id,)):
                for table in TABLES[self.layout]:
                    self._do(f"DELETE FROM {table} WHERE id = %s", (object_id,))

        self._alone(work)

    def _new_id(self, revision: int) -> int:
        """One above all ids ever given. The write lock is held, so nobody else adds an object.

        On partitions an id of an add that failed is never given again: rows of it may be there.
        """
        since, highest = self._highest_id
        found = self._do(HIGHEST_ID, (since,))
        self._highest_id = revision - 1, max(highest, int(found[0][0]))
        if self._is_spread:
            return int(self._do(NEXT_ID, (self._highest_id[1] + 1,))[0][0])
        return self._highest_id[1] + 1

    def _commit(self, work: Callable[[], Result]) -> Result:
        result = self._connection.write(work, self._is_written)
        self._loading.note()
        return result

    def _note(self, change: tuple[Any, ...]) -> None:
        """Write the row of `change`, and notify those who watch when it is committed."""
        ((transaction, _),) = self._do(
            "INSERT INTO change VALUES (%s, %s, %s, %s)"
            " RETURNING xmin::text, pg_notify(%s, revision::text)",
            (*change, channel_of(self._connection.address.environment)),
        )
        self._written = (*change[:3], transaction)

    def _is_written(self) -> bool:
        """Whether a write was committed although the connection broke during its commit."""
        # the commit may still be under way: wait for its lock before looking
        self._rows(WRITE_LOCK)
        found = "SELECT 1 FROM change WHERE (revision, action, id, xmin::text) = (%s, %s, %s, %s)"
        return bool(self._rows(found, self._written))

    def _put(self, rows: Rows, object_id: int) -> None:
        """Write the rows of an object that has none."""
        self._copy_into(self.layout, rows.occupied(), object_id)
        if rows.distances is not None:
            self._copy_into("band", rows, object_id)

    def _take(self, known: Object, covering: Covering, keys: Keys = NO_KEYS) -> Keys:
        """Delete the rows of an object as it is now, from both tables; returns their keys.

        keys : of its new rows; on partitions a try that failed may have left such rows.
        """
        ends = np.array(list(covering(known)), dtype=np.int64).reshape(-1, 2)
        if self._is_spread and keys.size:
            ends = np.concatenate([ends, [[keys.min(), keys.max()]]])
        chosen = wire.int8s(ends[:, 0]), wire.int8s(ends[:, 1]), wire.int8(known.id)
        tables: list[Table] = [self.layout]
        if known.has_distances:
            tables.append("band")
        gone = []
        for table in tables:
            (found,) = self._connection.fetch(statements.DELETE_ROWS[table], *chosen)
            gone.append(wire.read_int8s(found))
        return np.concatenate(gone)

    def _copy_into(self, table: Table, rows: Rows, object_id: int) -> None:
        target = f"{table} ({COLUMNS[table]})"
        with self._connection.driver.cursor().copy(
            f"COPY {target} FROM STDIN (FORMAT binary)"
        ) as copy:
            copy.write(wire.COPY_HEADER)
            for at in range(0, len(rows), COPY_CHUNK):
                copy.write(wire.copy_rows(rows.part(at, at + COPY_CHUNK), object_id))
            copy.write(wire.COPY_TRAILER)

"""Rows of an object in the tables of a server: copied in, and deleted."""

import numpy as np

from hapticdb.store.base import Covering, Keys, Layout, Object, Rows, Table
from hapticdb.store.postgres.connecting import wire
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.tables import statements

COPY_CHUNK = 1 << 17
"""Rows that are packed for COPY at a time. A larger value takes more memory, not less time."""
COLUMNS: dict[Table, str] = {
    "voxel": "z_val, id",
    "brick": "z_val, id, occupancy",
    "band": "z_val, id, distances",
}


class PostgresRows:
    """Writes and takes away rows of objects, inside the transaction of a write."""

    def __init__(self, connection: ServerConnection, layout: Layout) -> None:
        self._connection = connection
        self._layout = layout

    def put(self, rows: Rows, object_id: int) -> None:
        """Write the rows of an object that has none."""
        self._copy_into(self._layout, rows.occupied(), object_id)
        if rows.distances is not None:
            self._copy_into("band", rows, object_id)

    def put_band(self, rows: Rows, object_id: int) -> None:
        """Write rows of distances beside the object's bricks."""
        self._copy_into("band", rows, object_id)

    def take(self, known: Object, covering: Covering) -> Keys:
        """Delete the rows of an object as it is now, from both tables; returns their keys."""
        ends = np.array(list(covering(known)), dtype=np.int64).reshape(-1, 2)
        chosen = wire.int8s(ends[:, 0]), wire.int8s(ends[:, 1]), wire.int8(known.id)
        tables: list[Table] = [self._layout]
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

"""Writes on a server: each object in one transaction, with its rows and its change."""

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from psycopg import errors

from hapticdb.grid import Grid
from hapticdb.store import parsing
from hapticdb.store.base import NO_KEYS, Covering, Keys, Layout, Object, Rows, Table, touched_ranges
from hapticdb.store.postgres.connecting import wire
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.tables import statements
from hapticdb.store.postgres.tables.loading import TABLES, Loading
from hapticdb.store.postgres.tables.reading import PostgresReader
from hapticdb.store.postgres.watching import channel_of
from hapticdb.store.refusals import check_unwritten, older_format, present_already

Result = TypeVar("Result")

COPY_CHUNK = 1 << 17
"""Rows that are packed for COPY at a time. A larger value takes more memory, not less time."""
COLUMNS: dict[Table, str] = {
    "voxel": "z_val, id",
    "brick": "z_val, id, occupancy",
    "band": "z_val, id, distances",
}
INSERT_OBJECT = """
INSERT INTO object (id, name, link, digest, transform, voxels, bounds, attributes, revision)
VALUES (CASE WHEN %(id)s > 0 AND NOT EXISTS (SELECT 1 FROM object WHERE id = %(id)s)
             THEN %(id)s ELSE %(new_id)s END,
        %(name)s, %(link)s, %(digest)s, %(transform)s, %(voxels)s, %(bounds)s, %(attributes)s,
        %(revision)s)
RETURNING id"""
UPDATE_OBJECT = """
UPDATE object SET digest = %(digest)s, transform = %(transform)s, voxels = %(voxels)s,
       bounds = %(bounds)s, attributes = %(attributes)s, revision = %(revision)s
 WHERE id = %(id)s"""
DROP_SURFACE = """
DELETE FROM surface
 WHERE digest = %(digest)s AND NOT EXISTS (SELECT 1 FROM object WHERE digest = %(digest)s)"""
# asked before the bytes are sent
LACKS_SURFACE = """
SELECT EXISTS (SELECT 1 FROM object WHERE digest = %(digest)s)
       AND NOT EXISTS (SELECT 1 FROM surface WHERE digest = %(digest)s)"""
# not from a sequence, which also counts rolled-back writes: an import that is run again would
# give other ids
HIGHEST_ID = "SELECT coalesce(max(id), 0) FROM change WHERE revision > %s"
NEXT_ID = "SELECT setval('object_id_seq', greatest(nextval('object_id_seq'), %s))"
# the write lock: writers take revisions one after the other, and no reader waits for it
NEXT_REVISION = "UPDATE environment SET revision = revision + 1 WHERE id = 1 RETURNING revision"


class PostgresWriter:
    """Writes to one environment."""

    def __init__(
        self,
        connection: ServerConnection,
        grid: Grid,
        layout: Layout,
        reader: PostgresReader,
        loading: Loading,
        *,
        is_spread: bool,
    ) -> None:
        self._is_spread = is_spread
        self._connection = connection
        self._grid = grid
        self._layout = layout
        self._reader = reader
        self._loading = loading
        self._written: tuple[int, str, int, str] = (0, "", 0, "")
        self._highest_id = (0, 0)  # at which revision

    def add(self, record: Object, rows: Rows, surface: bytes | None = None) -> int:
        """Write an object, its rows and its surface in one transaction; returns its id."""

        def work() -> int:
            revision = self._next_revision()
            try:
                new = {"new_id": self._new_id(revision), **_contents(record, rows, revision)}
                object_id = self._execute(INSERT_OBJECT, new)[0][0]
            except errors.UniqueViolation as error:
                raise present_already(record, self._connection.shown) from error
            self._put(rows, object_id)
            self._put_surface(record.digest, surface)
            self._log(revision, "add", object_id, rows.keys)
            return int(object_id)

        return self._commit(work)

    def replace(
        self, record: Object, rows: Rows, covering: Covering, surface: bytes | None = None
    ) -> None:
        """Exchange an object's rows in one transaction; `covering` says where the old ones are."""

        def work() -> None:
            revision = self._next_revision()
            known = self._reader.object(record.id)
            check_unwritten(record, known, self._connection.shown)
            gone = self._take(known, covering, rows.keys)
            self._execute(UPDATE_OBJECT, _contents(record, rows, revision))
            self._put(rows, record.id)
            self._drop_surface(known.digest)
            self._put_surface(record.digest, surface)
            self._log(revision, "move", record.id, np.concatenate([gone, rows.keys]))

        self._commit(work)

    def remove(self, object_id: int, covering: Covering) -> None:
        """Remove an object and its rows in one transaction; `covering` says where they are."""

        def work() -> None:
            revision = self._next_revision()
            known = self._reader.object(object_id)
            gone = self._take(known, covering)
            self._execute("DELETE FROM object WHERE id = %s", (object_id,))
            self._drop_surface(known.digest)
            self._log(revision, "remove", object_id, gone)

        self._commit(work)

    def add_surface(self, digest: str, surface: bytes) -> None:
        """Write the surface of objects that lack it; nothing if no object has the digest."""

        def work() -> None:
            self._execute("SELECT 1 FROM environment WHERE id = 1 FOR UPDATE")  # the write lock
            self._put_surface(digest, surface)

        if not self._reader.has_table(parsing.SURFACE):
            raise older_format(self._connection.shown)
        self._connection.write(work)

    def drop_rows(self, object_id: int) -> None:
        """Delete the rows that a crash has left of an object that is not there."""

        def work() -> None:
            self._execute("SELECT 1 FROM environment WHERE id = 1 FOR UPDATE")  # the write lock
            if not self._execute("SELECT 1 FROM object WHERE id = %s", (object_id,)):
                for table in TABLES[self._layout]:
                    self._execute(f"DELETE FROM {table} WHERE id = %s", (object_id,))

        self._connection.write(work)

    def want_distances(self) -> None:
        """Note in the environment that its parts get distances."""
        self._connection.write(
            lambda: self._connection.execute("UPDATE environment SET wants_distances = true")
        )

    def _next_revision(self) -> int:
        """Take the write lock; returns the number of the new revision."""
        return int(self._execute(NEXT_REVISION)[0][0])

    def _new_id(self, revision: int) -> int:
        """One above all ids ever given. The write lock is held, so nobody else adds an object.

        On partitions an id of an add that failed is never given again: rows of it may be there.
        """
        since, highest = self._highest_id
        found = self._execute(HIGHEST_ID, (since,))
        self._highest_id = revision - 1, max(highest, int(found[0][0]))
        if self._is_spread:
            return int(self._execute(NEXT_ID, (self._highest_id[1] + 1,))[0][0])
        return self._highest_id[1] + 1

    def _commit(self, work: Callable[[], Result]) -> Result:
        result = self._connection.write(work, self._is_written)
        self._loading.note()
        return result

    def _execute(self, text: str, parameters: Any = ()) -> list[tuple[Any, ...]]:  # noqa: ANN401 - a sequence or a mapping, as psycopg takes them
        """One statement of a write; its rows, when it returns some."""
        cursor = self._connection.execute(text, parameters)
        return cursor.fetchall() if cursor.description else []

    def _log(self, revision: int, action: str, object_id: int, row_keys: Keys) -> None:
        """Record which keys a write touched, and notify those who watch when it is committed."""
        ranges = touched_ranges(self._grid, self._layout, row_keys).reshape(-1).tolist()
        ((transaction, _),) = self._execute(
            "INSERT INTO change VALUES (%s, %s, %s, %s)"
            " RETURNING xmin::text, pg_notify(%s, revision::text)",
            (revision, action, object_id, ranges, channel_of(self._connection.address.environment)),
        )
        self._written = (revision, action, object_id, transaction)

    def _is_written(self) -> bool:
        """Whether a write was committed although the connection broke during its commit."""
        # the commit may still be under way: wait for its lock before looking
        self._connection.rows("SELECT 1 FROM environment WHERE id = 1 FOR UPDATE")
        found = "SELECT 1 FROM change WHERE (revision, action, id, xmin::text) = (%s, %s, %s, %s)"
        return bool(self._connection.rows(found, self._written))

    def _put(self, rows: Rows, object_id: int) -> None:
        """Write the rows of an object that has none."""
        self._copy_into(self._layout, rows.occupied(), object_id)
        if rows.distances is not None:
            self._copy_into("band", rows, object_id)

    def _put_surface(self, digest: str, surface: bytes | None) -> None:
        """Write a surface; an editor of an older environment, whose owner makes the table, none."""
        if surface is None or not self._reader.has_table(parsing.SURFACE):
            return
        if self._execute(LACKS_SURFACE, {"digest": digest}) == [(True,)]:
            self._execute("INSERT INTO surface VALUES (%s, %b)", (digest, surface))

    def _drop_surface(self, digest: str) -> None:
        """Delete a surface that no object has any more."""
        if self._reader.has_table(parsing.SURFACE):
            self._execute(DROP_SURFACE, {"digest": digest})

    def _take(self, known: Object, covering: Covering, keys: Keys = NO_KEYS) -> Keys:
        """Delete the rows of an object as it is now, from both tables; returns their keys.

        keys : of its new rows; on partitions a try that failed may have left such rows.
        """
        ends = np.array(list(covering(known)), dtype=np.int64).reshape(-1, 2)
        if self._is_spread and keys.size:
            ends = np.concatenate([ends, [[keys.min(), keys.max()]]])
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


def _contents(record: Object, rows: Rows, revision: int) -> dict[str, Any]:
    """Bindings of an object's columns."""
    return {
        "id": record.id,
        "name": record.name,
        "link": record.link,
        "digest": record.digest,
        "transform": np.asarray(record.transform, dtype=np.float64).reshape(-1).tolist(),
        "voxels": int(record.voxels),
        "bounds": np.asarray(record.bounds, dtype=np.float64).reshape(-1).tolist(),
        "attributes": parsing.attributes_text(record, rows),
        "revision": revision,
    }

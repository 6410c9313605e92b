"""SQLite through apsw: the embedded engine, one file.

Three traps of the binding, each covered by a test: an ``np.int64`` binds as an eight-byte blob, a
bare array to ``carray(?)`` binds as nothing (both in silence), and an empty array cannot be bound.
So keys cross as ``apsw.carray`` of contiguous int64 arrays that are not empty, and single numbers
as Python's own.
"""

import contextlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import apsw
import numpy as np
from numpy.typing import NDArray

from hapticdb.grid import Grid
from hapticdb.store import believed
from hapticdb.store.base import (
    BRICK_BYTES,
    NO_ROWS,
    Change,
    Covering,
    Frame,
    Freshness,
    Histogram,
    Keys,
    Layout,
    Object,
    Rows,
    Size,
    check_outside,
    check_thread,
    check_unwritten,
    no_object,
    present_already,
    row_shift,
    this_thread,
    touched_ranges,
)
from hapticdb.store.sqlite import checking as sqlite_check
from hapticdb.store.sqlite import file as sqlite_file
from hapticdb.store.sqlite import force as sqlite_force
from hapticdb.store.sqlite import log as sqlite_log
from hapticdb.store.sqlite import place as sqlite_place
from hapticdb.store.sqlite import raw as sqlite_bytes
from hapticdb.store.sqlite import rows as sqlite_rows
from hapticdb.store.sqlite.quantiles import exact_quantiles
from hapticdb.store.sqlite.ranges import RangeStatements

LOOKUP = {
    "voxel": "SELECT z_val, id FROM carray(?1) AS asked CROSS JOIN voxel ON z_val = asked.value",
    "brick": """SELECT z_val, id, occupancy
                  FROM carray(?1) AS asked CROSS JOIN brick ON z_val = asked.value""",
}
LOOKUP_ONE = {
    "voxel": "SELECT z_val, id FROM voxel WHERE z_val = ?1",
    "brick": "SELECT z_val, id, occupancy FROM brick WHERE z_val = ?1",
}
# whole arrays cross at once: 8 times faster than executemany, and without the interpreter lock
INSERT = {
    "voxel": "INSERT INTO voxel SELECT value, ?2 FROM carray(?1)",
    "brick": f"""INSERT INTO brick SELECT value, ?2,
                        substr(?3, {BRICK_BYTES} * rowid - {BRICK_BYTES - 1}, {BRICK_BYTES})
                   FROM carray(?1)""",
}
CHUNK = 1 << 22
INSERT_OBJECT = """
INSERT INTO object (id, name, link, digest, transform, voxels, bounds, attributes, revision)
SELECT CASE WHEN ?9 > 0 AND NOT EXISTS (SELECT 1 FROM object WHERE id = ?9) THEN ?9 END,
       ?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8"""


class SQLiteStore:
    """An environment in one SQLite file. Open with `open`, make with `create`.

    Its connection takes no locks between threads (a lookup of 40 bricks is 13 % faster so), and
    every call checks that it comes from the thread that opened it.
    """

    def __init__(
        self,
        connection: apsw.Connection,
        path: Path,
        file: sqlite_place.OpenedFile,
        *,
        read_only: bool,
    ) -> None:
        self._connection = connection
        self._cursor = connection.cursor()
        self.path = path
        self.url = str(path)
        self.name = path.name
        self.engine = f"SQLite {apsw.sqlite_lib_version()}"
        self.is_read_only = read_only
        self._file = file
        self.identity = self._file.identity
        self._depth = 0
        self._noticed = self._seen = -1
        self._thread = this_thread()
        self.is_closed = False
        self.grid, self.layout = self._read_environment()
        self._shift = row_shift(self.layout)
        self._ranges = RangeStatements(connection, self.layout, self.grid.bits)
        sqlite_force.register(connection, self.grid, self.layout)

    @classmethod
    def open(cls, path: str | Path, *, read_only: bool = False) -> "SQLiteStore":
        """Open an existing environment."""
        where = Path(path)
        connection, file = sqlite_file.open_file(where, read_only=read_only)
        try:
            with sqlite_file.named_errors(str(where)):
                return cls(connection, where, file, read_only=read_only)
        except BaseException:
            file.close()
            raise

    @classmethod
    def create(cls, path: str | Path, grid: Grid, layout: Layout = "brick") -> "SQLiteStore":
        """Make a new environment with its grid; its file appears whole or not at all."""
        lineage = sqlite_log.first_lineage()
        row = (grid.voxel_size, *grid.origin, grid.bits, grid.curve, layout, lineage)

        def fill(connection: apsw.Connection) -> None:
            connection.execute("INSERT INTO environment VALUES (1, ?, ?, ?, ?, ?, ?, ?, ?)", row)

        sqlite_file.create_file(Path(path), fill)
        return cls.open(path)

    def close(self) -> None:
        """Close the connection; the last one folds the write-ahead log into its file, no other."""
        self.is_closed = True
        self._file.close()

    def give_to(self, thread: int) -> None:
        """Belong to another thread from now on, or to none (0); only while nobody uses it."""
        self._thread = thread

    def discard(self) -> None:
        """Close and delete an environment that nothing went into."""
        self._file.look()  # another's file is not to be deleted
        self.close()
        sqlite_file.remove_file(self.path)

    # -- reading -----------------------------------------------------------------------------

    def _fetch(self, sql: str, bindings: Sequence[Any] = ()) -> list[Any]:
        """Run one statement to its end."""
        check_thread(self._thread, self.url)
        try:
            if self._file.stamp is not None:
                self._file.check_stamp()
            return self._cursor.execute(sql, bindings).fetchall()
        except apsw.Error:
            with sqlite_file.named_errors(self.url):
                raise

    def _read_environment(self) -> tuple[Grid, Layout]:
        believed.check_tables(self.url, dict(self._fetch(sqlite_rows.KINDS)))
        rows = self._fetch(
            "SELECT voxel_size, origin_x, origin_y, origin_z, bits, curve, layout FROM environment"
        )
        return believed.grid_of(self.url, rows)

    @contextlib.contextmanager
    def snapshot(self) -> Iterator[None]:
        """All reads inside see one committed revision. May be nested."""
        if self._depth == 0:
            self._fetch("BEGIN")
        self._depth += 1
        try:
            yield
        finally:
            self._depth -= 1
            if self._depth == 0:
                self._fetch("COMMIT")

    def version(self) -> int:
        """SQLite's data version: changes when another connection's commit has been seen."""
        seen = self._connection.data_version()
        if seen == self._seen:
            self._file.check()
        else:  # by whom? Connections of two files that had one path share the log between them
            self._file.look()
            self._seen = seen
        return seen

    def revision(self) -> int:
        """Number of the last committed write; 0 for an empty environment."""
        self._file.check()
        found = self._fetch("SELECT coalesce(max(revision), 0) FROM change")
        return believed.number_of(self.url, found[0][0], "the revision")

    # -- the haptic query --------------------------------------------------------------------

    def _rows(self, found: list[Any]) -> Rows:
        return sqlite_rows.rows_of(self.url, found, has_bricks=self._shift > 0)

    def lookup(self, keys: Keys) -> Rows:
        """Rows of distinct ascending keys (U,), in one statement."""
        if not keys.size:
            return NO_ROWS
        return self._rows(self._fetch(LOOKUP[self.layout], (apsw.carray(keys),)))

    def lookup_each(self, keys: Keys) -> Rows:
        """Rows of distinct ascending keys (U,), one statement a key."""
        sql = LOOKUP_ONE[self.layout]
        found: list[Any] = []
        for key in keys.tolist():
            found += self._fetch(sql, (key,))
        return self._rows(found)

    def scan(self, lows: Keys, highs: Keys) -> Rows:
        """Rows with a key in any of the closed ranges, ascending and disjoint."""
        if not lows.size:
            return NO_ROWS
        return self._rows(self._fetch(*self._ranges.scan(lows, highs)))

    def rows_of(self, object_id: int, lows: Keys, highs: Keys) -> Rows:
        """Rows of one object with a key in any of the closed ranges, ascending and disjoint."""
        if not lows.size:
            return NO_ROWS
        sql, bindings = self._ranges.scan(lows, highs)
        return self._rows(self._fetch(f"{sql} AND id = ?4", (*bindings, object_id)))

    def count(self, lows: Keys, highs: Keys) -> int:
        """How many rows `scan` would return, counted inside the engine."""
        if not lows.size:
            return 0
        return int(self._fetch(*self._ranges.count(lows, highs))[0][0])

    # -- the paper's Figure 3 ----------------------------------------------------------------

    def statement(self, frame: Frame) -> NDArray[np.float64]:
        """Wrench (6,) of the frame by one statement, computed by force() inside the engine."""
        found = self._fetch(*sqlite_force.wrench_statement(self.layout, frame))
        return np.frombuffer(found[0][0], dtype=np.float64)

    def statement_hits(self, frame: Frame) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Ordinals (P,) and object ids (P,) of all hits, by the second statement."""
        found = self._fetch(*sqlite_force.hits_statement(self.layout, frame))
        pairs = sqlite_rows.pairs_of(self.url, found)
        return pairs[:, 0] - 1, pairs[:, 1].copy()

    # -- objects -----------------------------------------------------------------------------

    def objects(self) -> list[Object]:
        """All objects, ordered by id."""
        return self._objects("TRUE")

    def object(self, object_id: int) -> Object:
        """One object; raises ObjectNotFoundError when there is none of that id."""
        found = self._objects("id = ?", object_id)
        if not found:
            raise no_object(object_id, self.url)
        return found[0]

    def _objects(self, condition: str, *bindings: int) -> list[Object]:
        self._file.check()
        return [
            believed.object_of(self.url, row)
            for row in self._fetch(
                "SELECT id, name, link, digest, transform, voxels, bounds, attributes, revision "
                f"FROM object WHERE {condition} ORDER BY id",
                bindings,
            )
        ]

    def removed(self, link: str) -> set[str]:
        """Names of a file's parts that were removed and are not there again."""
        return {row[0] for row in self._fetch("SELECT name FROM removed WHERE link = ?", (link,))}

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """One transaction that begins by taking the write lock."""
        check_thread(self._thread, self.url)
        with sqlite_file.named_errors(self.url):
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                self._file.look()
                self._connection.execute(sqlite_log.RENEW_LINEAGE)
                yield
            except BaseException:
                self._connection.execute("ROLLBACK")
                raise
            self._connection.execute("COMMIT")
            self._file.look(has_committed=True)

    def loading(self) -> contextlib.AbstractContextManager[None]:
        """Nothing is put off here: rows go into the tree in which they stay."""
        return contextlib.nullcontext()

    def add(self, record: Object, rows: Rows) -> int:
        """Write an object and its rows in one transaction; returns its id."""
        with self._writing():
            revision = self.revision() + 1
            try:
                self._connection.execute(
                    INSERT_OBJECT,
                    (
                        record.name,
                        record.link,
                        *sqlite_rows.contents(record, rows),
                        revision,
                        record.id,
                    ),
                )
            except apsw.ConstraintError as error:
                raise present_already(record, self.url) from error
            object_id = self._connection.last_insert_rowid()
            self._insert(rows, object_id)
            self._log(revision, "add", object_id, rows.keys)
        return object_id

    def replace(self, record: Object, rows: Rows, covering: Covering) -> None:
        """Exchange an object's rows in one transaction; `covering` says where the old ones are."""
        with self._writing():
            revision = self.revision() + 1
            check_unwritten(record, self.object(record.id), self.url)
            gone = self._delete(record.id, covering)
            self._connection.execute(
                "UPDATE object SET digest = ?, transform = ?, voxels = ?, bounds = ?,"
                " attributes = ?, revision = ? WHERE id = ?",
                (*sqlite_rows.contents(record, rows), revision, record.id),
            )
            self._insert(rows, record.id)
            self._log(revision, "move", record.id, np.concatenate([gone, rows.keys]))

    def remove(self, object_id: int, covering: Covering) -> None:
        """Remove an object and its rows in one transaction; `covering` says where they are."""
        with self._writing():
            revision = self.revision() + 1
            gone = self._delete(object_id, covering)
            self._connection.execute("DELETE FROM object WHERE id = ?", (object_id,))
            self._log(revision, "remove", object_id, gone)

    def _insert(self, rows: Rows, object_id: int) -> None:
        """Insert a batch of rows, ascending by key: one statement for up to CHUNK of them."""
        for at in range(0, len(rows), CHUNK):
            keys = apsw.carray(rows.keys[at : at + CHUNK])
            if self._shift == 0:
                self._connection.execute(INSERT["voxel"], (keys, object_id))
            else:
                part = rows.occupancy[BRICK_BYTES * at : BRICK_BYTES * (at + CHUNK)]
                self._connection.execute(INSERT["brick"], (keys, object_id, part.tobytes()))

    def _delete(self, object_id: int, covering: Covering) -> Keys:
        """Delete the rows of an object as it stands now; returns their keys."""
        known = self.object(object_id)
        sql = f"DELETE FROM {self.layout} WHERE z_val BETWEEN ? AND ? AND id = ? RETURNING z_val"
        gone: list[int] = []
        for low, high in covering(known):
            gone += [row[0] for row in self._connection.execute(sql, (low, high, object_id))]
        return np.array(gone, dtype=np.int64)

    def _log(self, revision: int, action: str, object_id: int, row_keys: Keys) -> None:
        """Record which keys a write touched."""
        ranges = touched_ranges(self.grid, self.layout, row_keys)
        row = (revision, action, object_id, ranges.astype("<i8").tobytes())
        self._connection.execute("INSERT INTO change VALUES (?, ?, ?, ?)", row)

    def changes(self, since: int = 0) -> Iterator[Change]:
        """Committed writes after that revision, oldest first."""
        for row in self._fetch(
            "SELECT revision, action, id, ranges FROM change WHERE revision > ? ORDER BY revision",
            (since,),
        ):
            yield believed.change_of(self.url, row)

    def watch(self) -> None:
        """Begin to notice commits from now on; may be called again."""
        self.has_changed()

    def has_changed(self) -> bool:
        """Whether another connection has committed since `watch` or the last call.

        By the pragma, which looks at the file's log: the binding's own `data_version` says what the
        last read has seen. Of an immutable opening by its stamp, and then for good. Raises
        ConnectionLostError when the path leads to another file than the one that was opened.
        """
        check_outside(self._depth, self.url)
        if self._file.stamp is not None:
            check_thread(self._thread, self.url)
            return self._file.has_new_stamp()
        self._file.check()
        before = self._noticed
        self._noticed = self._fetch("PRAGMA data_version")[0][0]
        return self._noticed != before

    def checker(self) -> sqlite_check.SQLiteChecker:
        """What `hapticdb check` asks beside the rest."""
        return sqlite_check.SQLiteChecker(self.path, self.layout, self._fetch, self._rows)

    # -- caches ------------------------------------------------------------------------------

    def limit_cache(self, size_bytes: int) -> None:
        """Pages that the connection may keep in memory, from now on."""
        self._fetch(f"PRAGMA cache_size = -{max(int(size_bytes) // 1024, 1)}")

    def drop_caches(self) -> None:
        """Forget all pages: the connection's, and the file's in the operating system's cache."""
        check_thread(self._thread, self.url)
        self._connection.release_memory()
        sqlite_bytes.forget_pages(self.path)

    # -- statistics --------------------------------------------------------------------------

    def size(self) -> Size:
        """Rows, bytes of the file and its write-ahead log, leaf blocks of the index table."""
        with self.snapshot():
            rows = self._fetch(f"SELECT count(*) FROM {self.layout}")[0][0]
            blocks = self._fetch(
                "SELECT pageno FROM dbstat WHERE name = ?1 AND aggregate = TRUE", (self.layout,)
            )
        wal = Path(f"{self.path}-wal")
        total = self.path.stat().st_size + (wal.stat().st_size if wal.exists() else 0)
        return Size(int(rows), total, int(blocks[0][0]) if blocks else 1)

    def quantiles(self, resolution: int) -> Histogram:
        """Equi-count histogram of all row keys, of R buckets.

        The kept one while no object was written since, else by a scan of the whole index.
        """
        with self.snapshot():
            kept = self._kept_quantiles(resolution)
            if kept:
                return believed.histogram_of(self.url, *kept[0])
            bounds, n_rows = exact_quantiles(self._connection, self.layout, resolution)
            return Histogram(bounds, n_rows, "computed")

    def freshness(self, resolution: int) -> Freshness:
        """How old the kept histogram of that resolution is; rows are those of later writes' ids."""
        with self.snapshot():
            revision = self.revision()
            kept = self._fetch("SELECT revision FROM quantile WHERE resolution = ?", (resolution,))
            since = int(kept[0][0]) if kept else 0
            rows = self._fetch(
                "SELECT coalesce(sum(voxels), 0) FROM object WHERE revision > ?", (since,)
            )
        return Freshness(since if kept else None, revision - since, int(rows[0][0]))

    def _kept_quantiles(self, resolution: int) -> list[Any]:
        """Bounds and rows of the vector that was kept at this revision, if any."""
        return self._fetch(
            "SELECT bounds, n_rows FROM quantile WHERE resolution = ?"
            " AND revision = (SELECT coalesce(max(revision), 0) FROM change)",
            (resolution,),
        )

    def analyze(self, resolution: int, *, anew: bool = False) -> None:
        """Compute and keep the quantile vector of that resolution, unless a fresh one is kept."""
        if self._kept_quantiles(resolution) and not anew:
            return
        bounds, n_rows = exact_quantiles(self._connection, self.layout, resolution)
        with self._writing():
            # another process may have written since: then the vector carries the older revision's
            # rows under the newer number, off by that one write, as statistics are allowed to be
            self._connection.execute(
                "INSERT OR REPLACE INTO quantile"
                " SELECT ?, coalesce(max(revision), 0), ?, ? FROM change",
                (resolution, n_rows, bounds.astype("<i8").tobytes()),
            )

    def costs(self, machine: str) -> Mapping[str, float] | None:
        """Figures that `save_costs` kept for that machine."""
        kept = self._fetch("SELECT figures FROM cost WHERE machine = ?", (machine,))
        return believed.figures_of(self.url, kept[0][0]) if kept else None

    def save_costs(self, machine: str, figures: Mapping[str, float]) -> None:
        """Keep the fitted cost figures of a machine."""
        with self._writing():
            self._connection.execute(
                "INSERT OR REPLACE INTO cost VALUES (?, ?)", (machine, json.dumps(dict(figures)))
            )

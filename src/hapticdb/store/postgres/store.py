"""An environment in a schema of a PostgreSQL database."""

import contextlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from psycopg import errors, sql

from hapticdb.grid import Grid
from hapticdb.store import believed
from hapticdb.store.base import (
    NO_OCCUPANCY,
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
    Store,
    check_unwritten,
    no_object,
    present_already,
    row_shift,
    touched_ranges,
)
from hapticdb.store.postgres import records, schema_of, statements, wire
from hapticdb.store.postgres.checking import PostgresChecker
from hapticdb.store.postgres.histogram import (
    ENOUGH_ROWS,
    SERVER_RESOLUTION,
    exact_histogram,
    server_histogram,
)
from hapticdb.store.postgres.loading import Loading
from hapticdb.store.postgres.looping import LoopInServer
from hapticdb.store.postgres.session import Session
from hapticdb.store.postgres.watching import Watch, channel_of

Result = TypeVar("Result")

COPY_CHUNK = 1 << 17
GROUPS_KEYS_ITSELF = 170_000
"""Server version, as libpq numbers it, from which `= ANY` reads each leaf page once."""
GROUPING_THRESHOLD = 256
"""Distinct keys from which `auto` groups on older servers: docs/decisions/0014."""

# no sequence: it would count what was rolled back, and an import run again end with other ids
HIGHEST_ID = "SELECT coalesce(max(id), 0) FROM change WHERE revision > %s"
# the write lock: revisions follow one another, and no reader waits for it
NEXT_REVISION = "UPDATE environment SET revision = revision + 1 WHERE id = 1 RETURNING revision"


class PostgresStore:
    """An environment on a PostgreSQL server. Open with `open`, make with `create`."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self.url = session.shown
        self.name = session.address.environment
        self.engine = "PostgreSQL {}.{}".format(*divmod(session.server_version, 10_000))
        groups_keys_itself = session.server_version >= GROUPS_KEYS_ITSELF
        self.grouping_threshold = None if groups_keys_itself else GROUPING_THRESHOLD
        self.is_read_only = session.is_read_only
        try:
            self.grid, self.layout, self.identity = schema_of.read_environment(session)
        except BaseException:
            session.close()
            raise
        self._shift = row_shift(self.layout)
        self._seen = -1
        self._written: tuple[int, str, int, str] = (0, "", 0, "")
        self._highest_id = (0, 0)  # at which revision
        self._loading = Loading(session, self.layout)
        self._watch = Watch(session, self.identity)
        if not self.is_read_only:
            self._loading.mend()

    @classmethod
    def open(cls, url: str, *, read_only: bool = False) -> "PostgresStore":
        """Open an existing environment."""
        return cls(schema_of.opened(url, read_only=read_only))

    @classmethod
    def create(cls, url: str, grid: Grid, layout: Layout = "brick") -> "PostgresStore":
        """Make a new environment with its grid: a schema that appears whole or not at all."""
        schema_of.created(url, grid, layout)
        return cls.open(url)

    @property
    def session(self) -> Session:
        """The connection below: for what only this engine has."""
        return self._session

    def close(self) -> None:
        """Close the connection."""
        self._session.close()

    @property
    def is_closed(self) -> bool:
        """Whether `close` was called."""
        return self._session.is_closed

    def give_to(self, thread: int) -> None:
        """Belong to another thread from now on, or to none (0); only while nobody uses it."""
        self._session.give_to(thread)

    def discard(self) -> None:
        """Close and delete an environment that nothing went into, unless another writes to it."""
        self._loading.drop_unused()
        self.close()

    def snapshot(self) -> contextlib.AbstractContextManager[None]:
        """All reads inside see one committed revision. May be nested."""
        return self._session.snapshot()

    def version(self) -> int:
        """The revision that the last read has seen."""
        return self._seen

    def revision(self) -> int:
        """Number of the last committed write; 0 for an empty environment."""
        rows = self._session.rows("SELECT revision FROM environment WHERE id = 1")
        self._seen = int(rows[0][0])
        return self._seen

    # -- the haptic query --------------------------------------------------------------------

    def _rows(self, found: list[bytes | None]) -> Rows:
        """Rows of one packed row; its last value is the revision that it has seen."""
        seen = found[-1]
        self._seen = wire.read_int8(seen) if seen is not None else -1
        if found[0] is None:
            return NO_ROWS
        keys, ids = wire.read_int8s(found[0]), wire.read_int8s(found[1])
        occupancy = np.frombuffer(found[2] or b"", np.uint8) if self._shift else NO_OCCUPANCY
        rows = Rows(keys, ids, occupancy)
        return rows if _is_in_order(rows) else _in_order(rows)

    def lookup(self, keys: Keys) -> Rows:
        """Rows of distinct ascending keys (U,), in one statement."""
        if not keys.size:
            return NO_ROWS
        return self._rows(self._session.fetch(statements.LOOKUP[self.layout], wire.int8s(keys)))

    def lookup_each(self, keys: Keys) -> Rows:
        """Rows of distinct ascending keys (U,), one statement a key."""
        text = statements.LOOKUP_ONE[self.layout]
        parts = [
            rows
            for key in keys.tolist()
            if len(rows := self._rows(self._session.fetch(text, wire.int8(key))))
        ]
        if not parts:
            return NO_ROWS
        bits = b"".join(part.occupancy.tobytes() for part in parts)
        return Rows(
            np.concatenate([part.keys for part in parts]),
            np.concatenate([part.ids for part in parts]),
            np.frombuffer(bits, np.uint8),
        )

    def scan(self, lows: Keys, highs: Keys) -> Rows:
        """Rows with a key in any of the closed ranges, ascending and disjoint."""
        if not lows.size:
            return NO_ROWS
        text = statements.SCAN[self.layout]
        return self._rows(self._session.fetch(text, wire.int8s(lows), wire.int8s(highs)))

    def rows_of(self, object_id: int, lows: Keys, highs: Keys) -> Rows:
        """Rows of one object with a key in any of the closed ranges, ascending and disjoint."""
        if not lows.size:
            return NO_ROWS
        ends = wire.int8s(lows), wire.int8s(highs)
        text = statements.ROWS_OF[self.layout]
        return self._rows(self._session.fetch(text, *ends, wire.int8(object_id)))

    def count(self, lows: Keys, highs: Keys) -> int:
        """How many rows `scan` would return, counted inside the engine."""
        if not lows.size:
            return 0
        text = statements.COUNT[self.layout]
        (found,) = self._session.fetch(text, wire.int8s(lows), wire.int8s(highs))
        return wire.read_int8(found or b"")

    # -- the paper's Figure 3 ----------------------------------------------------------------

    def statement(self, frame: Frame) -> NDArray[np.float64]:
        """Wrench (6,) of the frame by one statement, computed by force() inside the engine."""
        text = statements.WRENCH[self.layout]
        parameters = wire.shell(frame)
        if frame.exclude.size:
            text = statements.without_excluded(text, self.layout, len(parameters) + 1)
            parameters.append(wire.int8s(frame.exclude))
        (found,) = self._session.fetch(text, *parameters)
        return np.zeros(6) if found is None else wire.read_float8s(found)

    def statement_hits(self, frame: Frame) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Ordinals (P,) and object ids (P,) of all hits, by the second statement."""
        text = statements.HITS[self.layout]
        parameters = [wire.int8s(frame.addresses)]
        if frame.exclude.size:
            text = statements.without_excluded(text, self.layout, 2)
            parameters.append(wire.int8s(frame.exclude))
        ordinals, ids, seen = self._session.fetch(text, *parameters)
        self._seen = wire.read_int8(seen or b"")
        return wire.read_int8s(ordinals) - 1, wire.read_int8s(ids)

    # -- what benchmarks ask -----------------------------------------------------------------

    def looping(self) -> Store:
        """The same store, but its `scan` loops over the ranges inside the server, one at a time."""
        return cast("Store", LoopInServer(self, self._session))

    def server_cache(self) -> int:
        """Bytes of pages that the server keeps in memory, for all its connections."""
        rows = self._session.rows("SELECT pg_size_bytes(current_setting('shared_buffers'))")
        return int(rows[0][0])

    # -- objects -----------------------------------------------------------------------------

    def objects(self) -> list[Object]:
        """All objects, ordered by id."""
        self.revision()  # before: what is written in between is then noticed later, not never
        return [
            believed.object_of(self.url, row)
            for row in self._session.rows(f"{records.OBJECTS} ORDER BY id")
        ]

    def object(self, object_id: int) -> Object:
        """One object; raises ObjectNotFoundError when there is none of that id."""
        rows = self._session.rows(f"{records.OBJECTS} WHERE id = %s", (object_id,))
        if not rows:
            raise no_object(object_id, self.url)
        return believed.object_of(self.url, rows[0])

    def removed(self, link: str) -> set[str]:
        """Names of a file's parts that were removed and are not there again."""
        if self._session.rows("SELECT to_regprocedure('removed_parts(text)')") == [(None,)]:
            return set()  # of format 2 or older, and not ours to bring up to date
        return {row[0] for row in self._session.rows("SELECT removed_parts(%s)", (link,))}

    def loading(self) -> contextlib.AbstractContextManager[None]:
        """Inside, an empty table has no index."""
        return self._loading

    def add(self, record: Object, rows: Rows) -> int:
        """Write an object and its rows in one transaction; returns its id."""

        def work() -> int:
            revision = self._next_revision()
            try:
                new = {"new_id": self._new_id(revision), **records.contents(record, rows, revision)}
                object_id = self._execute(records.INSERT_OBJECT, new)[0][0]
            except errors.UniqueViolation as error:
                raise present_already(record, self.url) from error
            self._copy(rows, object_id)
            self._log(revision, "add", object_id, rows.keys)
            return int(object_id)

        return self._commit(work)

    def replace(self, record: Object, rows: Rows, covering: Covering) -> None:
        """Exchange an object's rows in one transaction; `covering` says where the old ones are."""

        def work() -> None:
            revision = self._next_revision()
            known = self.object(record.id)
            check_unwritten(record, known, self.url)
            gone = self._delete(known, covering)
            self._execute(records.UPDATE_OBJECT, records.contents(record, rows, revision))
            self._copy(rows, record.id)
            self._log(revision, "move", record.id, np.concatenate([gone, rows.keys]))

        self._commit(work)

    def remove(self, object_id: int, covering: Covering) -> None:
        """Remove an object and its rows in one transaction; `covering` says where they are."""

        def work() -> None:
            revision = self._next_revision()
            gone = self._delete(self.object(object_id), covering)
            self._execute("DELETE FROM object WHERE id = %s", (object_id,))
            self._log(revision, "remove", object_id, gone)

        self._commit(work)

    def _next_revision(self) -> int:
        """Take the write lock, and the number of the revision to come."""
        return int(self._execute(NEXT_REVISION)[0][0])

    def _new_id(self, revision: int) -> int:
        """One above all that were ever given. The write lock is held: nobody adds meanwhile."""
        since, highest = self._highest_id
        found = self._execute(HIGHEST_ID, (since,))
        self._highest_id = revision - 1, max(highest, int(found[0][0]))
        return self._highest_id[1] + 1

    def _commit(self, work: Callable[[], Result]) -> Result:
        result = self._session.write(work, self._is_written)
        self._loading.note()
        return result

    def _execute(self, text: str, parameters: Any = ()) -> list[tuple[Any, ...]]:  # noqa: ANN401 - a sequence or a mapping, as psycopg takes them
        """One statement of a write; its rows, when it returns some."""
        cursor = self._session.execute(text, parameters)
        return cursor.fetchall() if cursor.description else []

    def _copy(self, rows: Rows, object_id: int) -> None:
        columns = "z_val, id, occupancy" if self._shift else "z_val, id"
        text = f"COPY {self.layout} ({columns}) FROM STDIN (FORMAT binary)"
        cursor = self._session.connection.cursor()
        with cursor.copy(text) as copy:
            copy.write(wire.COPY_HEADER)
            for at in range(0, len(rows), COPY_CHUNK):
                part = slice(at, at + COPY_CHUNK)
                bits = rows.occupancy[64 * at : 64 * (at + COPY_CHUNK)]
                copy.write(wire.copy_rows(Rows(rows.keys[part], rows.ids[part], bits), object_id))
            copy.write(wire.COPY_TRAILER)

    def _delete(self, known: Object, covering: Covering) -> Keys:
        """Delete the rows of an object as it stands now; returns their keys."""
        ends = np.array(list(covering(known)), dtype=np.int64).reshape(-1, 2)
        (found,) = self._session.fetch(
            statements.DELETE_ROWS[self.layout],
            wire.int8s(ends[:, 0]),
            wire.int8s(ends[:, 1]),
            wire.int8(known.id),
        )
        return wire.read_int8s(found)

    def _log(self, revision: int, action: str, object_id: int, row_keys: Keys) -> None:
        """Record which keys a write touched; who watches is told when it is committed."""
        ranges = touched_ranges(self.grid, self.layout, row_keys).reshape(-1).tolist()
        ((transaction, _),) = self._execute(
            "INSERT INTO change VALUES (%s, %s, %s, %s)"
            " RETURNING xmin::text, pg_notify(%s, revision::text)",
            (revision, action, object_id, ranges, channel_of(self.name)),
        )
        self._written = (revision, action, object_id, transaction)

    def _is_written(self) -> bool:
        """Whether the write whose commit was under way when the connection was lost counts."""
        # the commit may still be under way: wait for its lock, and only then look
        self._session.rows("SELECT 1 FROM environment WHERE id = 1 FOR UPDATE")
        found = "SELECT 1 FROM change WHERE (revision, action, id, xmin::text) = (%s, %s, %s, %s)"
        return bool(self._session.rows(found, self._written))

    def changes(self, since: int = 0) -> Iterator[Change]:
        """Committed writes after that revision, oldest first."""
        for row in self._session.rows(
            "SELECT revision, action, id, ranges FROM change WHERE revision > %s ORDER BY revision",
            (since,),
        ):
            yield believed.change_of(self.url, row)

    def watch(self) -> None:
        """Begin to notice commits from now on; may be called again."""
        self._watch.begin()

    def has_changed(self) -> bool:
        """Whether something was committed since `watch` or the last call; see `watching`."""
        return self._watch.has_changed()

    def checker(self) -> PostgresChecker:
        """What `hapticdb check` asks beside the rest."""
        return PostgresChecker(self._session, self.layout, self._rows)

    # -- statistics --------------------------------------------------------------------------

    def size(self) -> Size:
        """Rows, bytes of all tables and indexes, leaf blocks of the index."""
        with self._session.snapshot(), self._session.without_limit():
            self.revision()
            counted = (
                "SELECT count(*) FROM brick"
                if self._shift
                else "SELECT coalesce(sum(voxels), 0) FROM object"  # a row for each voxel
            )
            ((rows,),) = self._session.execute(counted).fetchall()
            ((total, index),) = self._session.execute(
                "SELECT (SELECT sum(pg_total_relation_size(c.oid)) FROM pg_class c"
                "         WHERE c.relnamespace = to_regnamespace(%s) AND c.relkind = 'r'),"
                "       coalesce(pg_relation_size(to_regclass(%s)), 0)"
                "         / current_setting('block_size')::int",
                (_quoted(self._session), f"{_quoted(self._session)}.{self.layout}_key"),
            ).fetchall()
        return Size(int(rows), int(total), max(int(index), 1))

    def quantiles(self, resolution: int) -> Histogram:
        """Equi-count histogram of all row keys, of R buckets.

        At 10,000 from the server's statistics once there are enough rows; else the kept one while
        no object was written since, else computed exactly.
        """
        if resolution == SERVER_RESOLUTION:
            found = server_histogram(self._session, self.layout)
            if found is not None and found[1] >= ENOUGH_ROWS:
                return Histogram(*found, "server statistics")
        kept = self._session.rows(
            "SELECT bounds, n_rows FROM quantile WHERE resolution = %s AND bounds IS NOT NULL"
            " AND revision = (SELECT revision FROM environment)",
            (resolution,),
        )
        if kept:
            return believed.histogram_of(self.url, *kept[0])
        return Histogram(*exact_histogram(self._session, self.layout, resolution), "computed")

    def freshness(self, resolution: int) -> Freshness:
        """How old the histogram of that resolution is, by its own revision."""
        ((revision, made, changed, unseen),) = self._session.rows(
            "SELECT e.revision, q.revision,"
            "       (SELECT coalesce(sum(voxels), 0) FROM object WHERE object.revision > "
            "               coalesce(q.revision, 0)),"
            "       CASE WHEN q.bounds IS NULL THEN (SELECT n_mod_since_analyze"
            "         FROM pg_stat_user_tables WHERE schemaname = %s AND relname = %s) END"
            "  FROM environment e LEFT JOIN quantile q ON q.resolution = %s",
            (self._session.address.environment, self.layout, resolution),
        )
        since = 0 if made is None else int(made)
        rows = int(changed if made is None or unseen is None else unseen)
        changes = int(revision) - since
        # the server counts a moment late: what it adds after its own ANALYZE was there before
        return Freshness(None if made is None else since, changes, rows if changes else 0)

    def analyze(self, resolution: int, *, anew: bool = False) -> None:
        """Renew the server's statistics, or compute and keep a histogram, unless it is fresh."""
        if not anew and self.freshness(resolution)[:2] == (self.revision(), 0):
            return
        bounds: list[int] | None = None
        with self.snapshot():
            revision = self.revision()
            n_rows = self.size().rows
            is_computed = resolution != SERVER_RESOLUTION or n_rows < ENOUGH_ROWS
            if is_computed:
                keys, n_rows = exact_histogram(self._session, self.layout, resolution)
                bounds = keys.tolist()
        if not is_computed:
            with self._session.without_limit("statement_timeout", "lock_timeout"):
                self._session.execute("SELECT refresh_statistics()")
        self._save(
            "INSERT INTO quantile VALUES (%s, %s, %s, %s)"
            " ON CONFLICT (resolution) DO UPDATE SET revision = EXCLUDED.revision,"
            " n_rows = EXCLUDED.n_rows, bounds = EXCLUDED.bounds"
            " WHERE quantile.revision <= EXCLUDED.revision",
            (resolution, revision, n_rows, bounds),
        )

    def costs(self, machine: str) -> Mapping[str, float] | None:
        """Figures that `save_costs` kept for that machine."""
        kept = self._session.rows("SELECT figures::text FROM cost WHERE machine = %s", (machine,))
        return believed.figures_of(self.url, kept[0][0]) if kept else None

    def save_costs(self, machine: str, figures: Mapping[str, float]) -> None:
        """Keep the fitted cost figures of a machine."""
        self._save(
            "INSERT INTO cost VALUES (%s, %s)"
            " ON CONFLICT (machine) DO UPDATE SET figures = EXCLUDED.figures",
            (machine, json.dumps(dict(figures))),
        )

    def _save(self, text: str, parameters: Sequence[Any]) -> None:
        self._session.write(lambda: self._execute(text, parameters))


def _quoted(session: Session) -> str:
    return sql.Identifier(session.address.environment).as_string(session.connection)


def _is_in_order(rows: Rows) -> bool:
    keys, ids = rows.keys, rows.ids
    if len(keys) < 2:
        return True
    return bool(((keys[1:] > keys[:-1]) | ((keys[1:] == keys[:-1]) & (ids[1:] > ids[:-1]))).all())


def _in_order(rows: Rows) -> Rows:
    """Rows that came without the index, sorted: while a first import has none yet."""
    order = np.lexsort((rows.ids, rows.keys))
    bits = rows.occupancy
    if bits.size:
        bits = np.frombuffer(bits.reshape(-1, 64)[order].tobytes(), np.uint8)
    return Rows(rows.keys[order], rows.ids[order], bits)

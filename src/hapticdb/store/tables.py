"""Statements and writes on an environment's SQL tables, common to the engines.

Parameters are ``%s``.
"""

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar, Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import DamagedError, UsageError
from hapticdb.grid import Grid
from hapticdb.store import parsing
from hapticdb.store.base import (
    CELL_SHIFT,
    NO_KEYS,
    Change,
    Columns,
    Freshness,
    Histogram,
    Keys,
    Layout,
    Object,
    Replacements,
    Rows,
    row_shift,
)
from hapticdb.store.covering import EVERYWHERE, Ranges, object_ranges
from hapticdb.store.pairs import (
    ALL,
    COUNT,
    MARK,
    MARKED,
    Ids,
    Mark,
    MaybeMark,
    Outlines,
    PairRow,
    Rule,
    StoredPairs,
)
from hapticdb.store.store_errors import check_unwritten, no_object, present_already

Result = TypeVar("Result")
Form = Literal["lookup", "lookup_one", "scan", "rows_of", "after"]
"""Queries for rows, named as the methods of `Tables`; `lookup_one`: a statement a key."""

TABLES: dict[Columns, Layout] = {"voxel": "voxel", "brick": "brick", "distances": "brick"}
HELD: dict[Columns, str] = {
    "voxel": "TRUE",
    "brick": "occupancy IS NOT NULL",
    "distances": "distances IS NOT NULL",
}
"""Tables of the reads, and conditions on their rows."""
INSERT_OBJECT = """
INSERT INTO object (id, name, link, digest, transform, voxels, bounds, attributes, revision)
VALUES (%s, %s, %s, %s, %s, %s, %s, %s, %s) RETURNING id"""
UPDATE_OBJECT = """
UPDATE object SET digest = %s, transform = %s, voxels = %s, bounds = %s, attributes = %s,
       revision = %s
 WHERE id = %s"""
# before the bytes are sent
LACKS_SURFACE = "SELECT NOT EXISTS (SELECT 1 FROM surface WHERE digest = %s)"
DROP_SURFACE = """
DELETE FROM surface
 WHERE digest = %s AND NOT EXISTS (SELECT 1 FROM object WHERE digest = %s)"""
LAST_REVISION = "(SELECT coalesce(max(revision), 0) FROM change)"
# a slow scan of an earlier revision never replaces a later histogram
SAVE_HISTOGRAM = """
INSERT INTO quantile VALUES (%s, %s, %s, %s) ON CONFLICT (resolution) DO UPDATE
   SET revision = excluded.revision, n_rows = excluded.n_rows, bounds = excluded.bounds
 WHERE quantile.revision <= excluded.revision"""
SIZE_OF_SURFACES = "SELECT count(*), coalesce(sum(octet_length(geometry)), 0) FROM surface"
RULES = "SELECT one, other, says, kinds, length, because FROM rule ORDER BY number"
SAVE_COSTS = """
INSERT INTO cost VALUES (%s, %s) ON CONFLICT (machine) DO UPDATE SET figures = excluded.figures"""


def touched_ranges(grid: Grid, layout: Layout, row_keys: Keys) -> NDArray[np.int64]:
    """Ranges of voxel keys (C, 2) touched by a write of these rows, for `Change`.

    Rounded outwards to cells; in lexicographic order to slabs, each of all voxels of one i.
    """
    shift = CELL_SHIFT if grid.is_hierarchical else 2 * grid.bits
    cubes = np.unique(row_keys >> (shift - row_shift(layout)))
    # a step of more than one cell begins a range; -2 lets the first cell begin one
    starts = np.flatnonzero(np.diff(cubes, prepend=-2) > 1)
    ends = np.append(starts[1:], len(cubes))[: len(starts)] - 1
    return np.stack([cubes[starts] << shift, ((cubes[ends] + 1) << shift) - 1], axis=1)


class _Connection(Protocol):
    """Connection of any engine."""

    is_read_only: bool

    def close(self) -> None: ...
    def snapshot(self) -> AbstractContextManager[None]: ...


class Tables(ABC):
    """The tables of one environment: objects, changes, surfaces, pairs, statistics, writes.

    A subclass runs statements, and reads and writes the tables of rows; attributes as of `Store`.
    """

    AMONG: ClassVar[str]
    """Condition: id in a JSON list."""
    LISTED: ClassVar[str]
    """Query: texts of a JSON list."""
    AS_TEXT: ClassVar[str]
    """Suffix: column of JSON as text."""
    TAKEN: ClassVar[type[Exception]]
    """Driver's error for a second object of this link and name."""

    url: str
    grid: Grid
    layout: Layout
    wants_distances: bool

    def __init__(self, connection: _Connection) -> None:
        self._connection = connection
        self.is_read_only = connection.is_read_only

    # -- what an engine adds ---------------------------------------------------------------------

    @abstractmethod
    def _rows(
        self, text: str, parameters: Sequence[Any] = (), *, binary: bool = False
    ) -> list[Any]:
        """Rows of a reading statement; binary : in the engine's own format, if faster."""

    @abstractmethod
    def _read(self, form: Form, *arguments: Any, distances: bool) -> Rows:  # noqa: ANN401 - keys or numbers
        """Rows of a query; none for no keys."""

    @abstractmethod
    def _do(self, text: str, parameters: Sequence[Any] = ()) -> list[Any]:
        """Run one statement of a write; returns its rows, if any."""

    @abstractmethod
    def _save(self, text: str, parameters: Sequence[Any] = ()) -> None:
        """Write by one statement in a transaction of its own."""

    @abstractmethod
    def _alone(self, work: Callable[[], Result]) -> Result:
        """Run `work`, without a new revision, in one transaction with the write lock."""

    @abstractmethod
    def _commit(self, work: Callable[[], Result]) -> Result:
        """Run a write in one transaction; `work` begins with `_next_revision`."""

    @abstractmethod
    def _next_revision(self) -> int:
        """Revision of this write."""

    @abstractmethod
    def _new_id(self, revision: int) -> int | None:
        """Id of a new object; None if the table assigns it."""

    @abstractmethod
    def _packed(self, values: NDArray[Any]) -> object:
        """Numbers of any shape in the format of the engine's columns."""

    @abstractmethod
    def _put(self, rows: Rows, object_id: int) -> None:
        """Write the rows of an object without rows."""

    @abstractmethod
    def _take(self, known: Object, ranges: Ranges, keys: Keys = NO_KEYS) -> Keys:
        """Delete the rows of an object in ranges from all its tables; keys : of its new rows."""

    @abstractmethod
    def _note(self, change: tuple[Any, ...]) -> None:
        """Write the row of `change`: revision, action, id, ranges."""

    @abstractmethod
    def _exchange_pairs(self, gone: Ids, rows: Sequence[PairRow]) -> None:
        """Delete rows of the table `pair`, and write others, except over a later revision's."""

    @abstractmethod
    def _exact(self, resolution: int) -> tuple[Keys, int]:
        """Bounds of the quantile vector over all rows, and their number."""

    @abstractmethod
    def revision(self) -> int:
        """Number of the last committed write; 0 for an empty environment."""

    # -- the connection --------------------------------------------------------------------------

    def close(self) -> None:
        self._connection.close()

    def snapshot(self) -> AbstractContextManager[None]:
        return self._connection.snapshot()

    # -- reads of rows ---------------------------------------------------------------------------

    def lookup(self, keys: Keys, *, distances: bool = False) -> Rows:
        return self._read("lookup", keys, distances=distances)

    def lookup_each(self, keys: Keys, *, distances: bool = False) -> Rows:
        return self._read("lookup_one", keys, distances=distances)

    def scan(self, lows: Keys, highs: Keys, *, distances: bool = False) -> Rows:
        return self._read("scan", lows, highs, distances=distances)

    def rows_of(self, object_id: int, lows: Keys, highs: Keys, *, distances: bool = False) -> Rows:
        return self._read("rows_of", lows, highs, object_id, distances=distances)

    def rows_after(self, key: int, object_id: int, limit: int) -> Rows:
        return self._read("after", key, object_id, limit, distances=self.layout == "brick")

    # -- reads -----------------------------------------------------------------------------------

    def objects(self, ids: Collection[int] | None = None) -> list[Object]:
        if ids is not None:
            return self._objects(self.AMONG, json.dumps(list(ids)))
        self.revision()  # first: the next read notices a write between the two statements
        return self._objects("TRUE")

    def object(self, object_id: int) -> Object:
        for found in self._objects("id = %s", object_id):
            return found
        raise no_object(object_id, self.url)

    def outlines(self) -> Outlines:
        text = "SELECT name, digest, id, revision, bounds FROM object ORDER BY id"
        return parsing.outlines_of(self.url, self._rows(text, binary=True))

    def _objects(self, condition: str, *parameters: int | str) -> list[Object]:
        found = self._rows(
            "SELECT id, name, link, digest, transform, voxels, bounds,"
            f" attributes{self.AS_TEXT}, revision FROM object WHERE {condition} ORDER BY id",
            parameters,
        )
        return [parsing.object_of(self.url, row) for row in found]

    def changes(self, since: int = 0) -> Iterator[Change]:
        text = "SELECT revision, action, id, ranges FROM change WHERE revision > %s"
        for row in self._rows(f"{text} ORDER BY revision", (since,)):
            yield parsing.change_of(self.url, row)

    def surfaces(self, digests: Sequence[str]) -> dict[str, bytes]:
        text = f"SELECT digest, geometry FROM surface WHERE digest IN ({self.LISTED})"
        found = self._rows(text, (json.dumps(list(digests)),), binary=True)
        return parsing.surfaces_of(self.url, found)

    def surface_digests(self) -> set[str]:
        return parsing.digests_of(self.url, self._rows("SELECT digest FROM surface"))

    def pairs(self) -> StoredPairs:
        return StoredPairs(self._rows(ALL, binary=True), partial(parsing.pair_of, self.url))

    def rules(self) -> tuple[Rule, ...]:
        return tuple(parsing.rule_of(self.url, row) for row in self._rows(RULES))

    def removed(self, link: str) -> set[str]:
        return {row[0] for row in self._rows("SELECT name FROM removed WHERE link = %s", (link,))}

    # -- writes ----------------------------------------------------------------------------------

    def add(self, record: Object, rows: Rows, surface: bytes | None = None) -> int:
        def work() -> int:
            revision = self._next_revision()
            own: int | None = record.id
            # a given id stays if it is free, as in a copy
            if record.id <= 0 or self._do("SELECT 1 FROM object WHERE id = %s", (own,)):
                own = self._new_id(revision)
            named = (own, record.name, record.link)
            contents = self._contents(record, rows)
            try:
                ((object_id,),) = self._do(INSERT_OBJECT, (*named, *contents, revision))
            except self.TAKEN as error:
                raise present_already(record, self.url) from error
            self._put(rows, object_id)
            self._put_surface(record.digest, surface)
            self._log(revision, "add", object_id, rows.keys)
            return int(object_id)

        return self._commit(work)

    def replace(
        self, record: Object, rows: Rows, surface: bytes | None = None, *, everywhere: bool = False
    ) -> None:
        def work() -> None:
            ranges = EVERYWHERE if everywhere else None
            self._exchange(self._next_revision(), record, rows, surface, ranges)

        self._commit(work)

    def replace_all(self, made: Replacements) -> None:
        def work() -> None:
            revision = self._next_revision()  # locks, so nobody writes what `made` reads
            for n, (record, rows) in enumerate(made()):
                revision = self._next_revision() if n else revision
                self._exchange(revision, record, rows)

        self._commit(work)

    def _exchange(
        self,
        revision: int,
        record: Object,
        rows: Rows,
        surface: bytes | None = None,
        ranges: Ranges | None = None,
    ) -> None:
        """Exchange an object's rows, inside a transaction."""
        # read under the write lock: no other write comes between this check and the commit
        known = self.object(record.id)
        check_unwritten(record, known, self.url)
        ranges = ranges or object_ranges(self.grid, self.layout, known)
        gone = self._take(known, ranges, rows.keys)
        self._do(UPDATE_OBJECT, (*self._contents(record, rows), revision, record.id))
        self._put(rows, record.id)
        # after the update, when only other objects can have the former digest
        self._do(DROP_SURFACE, (known.digest, known.digest))
        self._put_surface(record.digest, surface)
        self._log(revision, "move", record.id, np.concatenate([gone, rows.keys]))

    def remove(self, object_id: int, revision: int | None = None) -> Object:
        def work() -> Object:
            own = self._next_revision()
            known = self.object(object_id)
            check_unwritten(replace(known, revision=revision or 0), known, self.url)
            surface = self.surfaces([known.digest]).get(known.digest)
            gone = self._take(known, object_ranges(self.grid, self.layout, known))
            self._do("DELETE FROM object WHERE id = %s", (object_id,))
            self._do(DROP_SURFACE, (known.digest, known.digest))
            self._log(own, "remove", object_id, gone)
            return replace(known, surface=surface)

        return self._commit(work)

    def put_pairs(
        self, rows: Sequence[PairRow], gone: Ids = (), was: MaybeMark = None, now: MaybeMark = None
    ) -> MaybeMark:
        def work() -> MaybeMark:
            mark, row = Mark.after(self._do(MARKED, MARK), was, now)
            self._exchange_pairs([*gone, MARK], [*rows, row])
            self._do(COUNT, MARK)
            return mark

        return self._alone(work)

    def accept_pair(self, a: int, b: int, because: str | None, shapes: str | None) -> None:
        text = "UPDATE pair SET because = %s, shapes = %s WHERE (a, b) = (%s, %s)"
        self._save(text, (because, shapes, a, b))

    def change_rules(self, change: Callable[[tuple[Rule, ...]], Sequence[Rule]]) -> None:
        def work() -> None:
            rules = change(tuple(parsing.rule_of(self.url, row) for row in self._do(RULES)))
            self._do("DELETE FROM rule")
            for n, rule in enumerate(rules, start=1):
                row = (*rule[:3], ",".join(rule.kinds), *rule[4:])
                try:
                    # parsed as a later read parses it: no stored rule can then count as damage
                    parsing.rule_of(self.url, row)
                except DamagedError:
                    raise UsageError(f"rule {n}, {row}: give what parse_rule returns") from None
                self._do("INSERT INTO rule VALUES (%s, %s, %s, %s, %s, %s, %s)", (n, *row))

        self._alone(work)

    def _contents(self, record: Object, rows: Rows) -> tuple[Any, ...]:
        """Values of an object's columns from digest to attributes."""
        return (
            record.digest,
            self._packed(np.asarray(record.transform, np.float64)),
            int(record.voxels),
            self._packed(np.asarray(record.bounds, np.float64)),
            parsing.attributes_text(record, rows),
        )

    def _put_surface(self, digest: str, surface: bytes | None) -> None:
        """Write a surface, unless its digest has one."""
        if surface is not None and self._do(LACKS_SURFACE, (digest,)) == [(True,)]:
            self._do("INSERT INTO surface VALUES (%s, %s)", (digest, surface))

    def _log(self, revision: int, action: str, object_id: int, row_keys: Keys) -> None:
        """Record the keys touched by a write."""
        ranges = touched_ranges(self.grid, self.layout, row_keys)
        self._note((revision, action, object_id, self._packed(ranges)))

    # -- statistics ------------------------------------------------------------------------------

    def quantiles(self, resolution: int) -> Histogram:
        """The stored one while no object was written since, else from a scan of the whole index."""
        kept = self._rows(
            "SELECT bounds, n_rows FROM quantile WHERE resolution = %s AND bounds IS NOT NULL"
            f" AND revision = {LAST_REVISION}",
            (resolution,),
        )
        if kept:
            return parsing.histogram_of(self.url, *kept[0])
        return Histogram(*self._exact(resolution), "computed")

    def freshness(self, resolution: int) -> Freshness:
        text = f"SELECT {LAST_REVISION}, (SELECT revision FROM quantile WHERE resolution = %s)"
        ((revision, made),) = self._rows(text, (resolution,))
        return Freshness(made, int(revision) - int(made or 0))

    def analyze(self, resolution: int, *, anew: bool = False) -> None:
        """Compute and store a histogram, unless a fresh one is stored."""
        freshness = self.freshness(resolution)
        if anew or freshness.revision is None or freshness.changes:
            revision, n_rows, bounds = self._measured(resolution)
            packed = None if bounds is None else self._packed(bounds)
            self._save(SAVE_HISTOGRAM, (resolution, revision, n_rows, packed))

    def _measured(self, resolution: int) -> tuple[int, int, Keys | None]:
        """Revision, rows and bounds of a new histogram; None for statistics of the server."""
        with self.snapshot():
            revision = self.revision()
            # in one snapshot: the revision stored with the bounds is theirs
            bounds, n_rows = self._exact(resolution)
        return revision, n_rows, bounds

    def findings(self) -> Iterator[str]:
        stored: tuple[tuple[str, Callable[..., object]], ...] = (
            ("SELECT bounds, n_rows FROM quantile WHERE bounds IS NOT NULL", parsing.histogram_of),
            (f"SELECT figures{self.AS_TEXT} FROM cost", parsing.figures_of),
        )
        for text, parse in stored:
            for row in self._rows(text):
                try:
                    parse(self.url, *row)
                except DamagedError as error:
                    yield parsing.cause_of(error)

    def costs(self, machine: str) -> Mapping[str, float] | None:
        text = f"SELECT figures{self.AS_TEXT} FROM cost WHERE machine = %s"
        kept = self._rows(text, (machine,))
        return parsing.figures_of(self.url, kept[0][0]) if kept else None

    def save_costs(self, machine: str, figures: Mapping[str, float]) -> None:
        self._save(SAVE_COSTS, (machine, json.dumps(dict(figures))))

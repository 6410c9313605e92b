"""Reads of an environment on several servers: the client asks all shards that hold keys at once.

A read sends its statements to the shards and, at the same moment, asks the coordinator for the
revision. If that is the one that the reader knows, the answers are of that revision: rows that were
published before the reader knew it are there, and rows in other versions are left out. If it is a
newer one, the reader learns what has changed and asks again.

Rows of a past revision may have been swept or moved meanwhile; the mark of each answer tells.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from hapticdb.errors import DamagedError, OutdatedError
from hapticdb.store import believed
from hapticdb.store.base import NO_KEYS, NO_OCCUPANCY, Keys, Layout, Rows, Table, row_shift
from hapticdb.store.batches import PartialRows, joined, no_rows
from hapticdb.store.postgres.connecting import wire
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.shards import statements
from hapticdb.store.postgres.shards.connecting.away import AwayShards
from hapticdb.store.postgres.shards.connecting.links import (
    Answer,
    ShardQuery,
    Shards,
    lost_writes,
    older_coordinator,
)
from hapticdb.store.postgres.shards.pieces import pieces_of_keys, pieces_of_ranges
from hapticdb.store.postgres.shards.view import NEWEST, LiveView, Views
from hapticdb.store.postgres.tables.loading import TABLES
from hapticdb.store.postgres.tables.reading import PostgresReader, is_in_order

TRIES = 20
"""Times that a read begins again because others have written. A larger value waits longer where
writes come faster than reads."""
LAST = int(np.iinfo(np.int64).max)
Plan = Callable[[LiveView], Sequence[ShardQuery]]


class _Marks(NamedTuple):
    """The latest revision whose dead rows are swept, the latest epoch whose rows are moved."""

    swept: int
    moved: int

    def are_of(self, view: LiveView) -> bool:
        """Whether all rows of that view were there when the shards answered."""
        return self.swept <= view.revision and self.moved <= view.epoch


class _Asker(Protocol):
    """How shards are asked: all have to answer (`Shards`), or some may be away (`AwayShards`)."""

    def ask(
        self, asks: Sequence[ShardQuery], first: str | None
    ) -> tuple[Answer, Sequence[Answer | None]]:
        """Answer of the coordinator to `first`, and those of the shards; None if one is away."""

    def catch_up(self, shard: int, writes: int) -> None:
        """Have a shard whose standby was behind answer with so many writes next time."""


class ShardedReader:
    """Reads of rows; objects and changes are read by `objects`, from the coordinator."""

    def __init__(
        self, connection: ServerConnection, shards: Shards, layout: Layout, objects: PostgresReader
    ) -> None:
        self._connection = connection
        self._shards = shards
        self._url = connection.shown
        self._layout = layout
        self._objects = objects
        self._depth = 0
        self._held: LiveView | None = None
        scans = [statements.SCAN[table] for table in TABLES[layout]]
        self.away = AwayShards(shards, [(text, [wire.INT8_ARRAY] * 2) for text in scans])
        self.views = Views(connection, row_shift(layout))

    # -- at which revision -----------------------------------------------------------------------

    @contextlib.contextmanager
    def snapshot(self) -> Iterator[None]:
        """All reads inside see one committed revision. May be nested."""
        with self._connection.snapshot():
            self._depth += 1
            try:
                if self._held is None:  # now: later its rows may have been swept
                    self._held = self.views.hold()
                yield
            finally:
                self._depth -= 1
                if not self._depth:
                    self._held = None

    def ask(self, plan: Plan) -> tuple[LiveView, list[Answer]]:
        """Answers of shards to the statements that `plan` makes, and the view that they belong to.

        Raises
        ------
        OutdatedError
            Inside a snapshot, when rows that belong to it are gone.
        ShardAwayError
            When a shard that is asked cannot be reached.
        """
        view, _, answers = self._asked(plan, self._shards)
        return view, [answer for answer in answers if answer is not None]

    def _asked(
        self, plan: Plan, asker: _Asker
    ) -> tuple[LiveView, Sequence[ShardQuery], Sequence[Answer | None]]:
        """View, statements and answers; None for an answer that did not come."""
        if self._held is not None:
            asks, _, answers = self._answered(plan, self._held, asker, None)
            if not _marks_of(answers).are_of(self._held):
                raise _outdated(self._url)
            return self._seen(self._held), asks, answers
        is_renewed = False
        for _ in range(TRIES):
            view = self.views.known
            if view.revision < 0:
                view, is_renewed = self.views.load(), True
            asks, first, answers = self._answered(plan, view, asker, None if is_renewed else NEWEST)
            is_newest = is_renewed or self.views.is_known(first)
            marks = _marks_of(answers)
            if is_newest and marks.are_of(view):
                return self._seen(view), asks, answers
            if not marks.are_of(self.views.load()) and not self._connection.is_standby:
                raise older_coordinator(self._url)
            is_renewed = True
        raise _outdated(self._url)

    def _seen(self, view: LiveView) -> LiveView:
        self._objects.see(view.revision)
        return view

    def _answered(
        self, plan: Plan, view: LiveView, asker: _Asker, first: str | None
    ) -> tuple[Sequence[ShardQuery], Answer, Sequence[Answer | None]]:
        """Statements, the coordinator's answer to `first`, and answers with all writes of a view.

        Raises
        ------
        DamagedError
            When a shard has lost writes.
        """
        asks = plan(view)
        for _ in range(TRIES):
            found, answers = asker.ask(asks, first)
            behind = self._behind(view, asks, answers)
            if not behind:
                return asks, found, answers
            for shard in behind:  # standbys that have not replayed them
                asker.catch_up(shard, int(view.writes[shard]))
        raise _outdated(self._url)

    def _behind(
        self, view: LiveView, asks: Sequence[ShardQuery], answers: Sequence[Answer | None]
    ) -> list[int]:
        """Shards whose standbys have answered, without all writes that the view knows of."""
        behind = []
        for ask, answer in zip(asks, answers, strict=True):
            if answer is None:
                continue
            writes = _mark(answer)[0]
            if writes >= view.writes[ask.shard]:
                continue
            if not self._shards.connection(ask.shard).is_standby:
                name = f"{self._shards.name(ask.shard)} of {self._url}"
                raise lost_writes(name, writes, int(view.writes[ask.shard]))
            behind.append(ask.shard)
        return behind

    # -- rows ------------------------------------------------------------------------------------

    def unpacked(self, answer: Answer, *, distances: bool) -> tuple[Rows, Keys]:
        """Rows of a shard's answer, in any version, and their versions."""
        if answer[0] is None:
            return no_rows(distances=distances), NO_KEYS
        keys, ids = wire.read_int8s(answer[0]), wire.read_int8s(answer[1])
        has_bits = self._layout == "brick"
        rows = Rows(
            keys, ids, np.frombuffer(answer[2] or b"", np.uint8) if has_bits else NO_OCCUPANCY
        )
        versions = wire.read_int8s(answer[-2])
        if distances:
            lengths = wire.read_int8s(answer[4])
            rows = rows.having(believed.band_of(self._url, answer[3] or b"", lengths))
        if not len(keys) == len(ids) == len(versions):
            raise DamagedError(f"{self._url}: a shard's answer has columns of different lengths")
        return rows, versions

    def live(self, view: LiveView, answers: Sequence[Answer], *, distances: bool) -> Rows:
        """The rows of a view among the answers of shards, in the order of the shards."""
        parts = []
        for answer in answers:
            rows, versions = self.unpacked(answer, distances=distances)
            rows = view.live_of(rows, versions)
            if not is_in_order(rows):  # a first import has no index yet
                rows = rows.picked(np.lexsort((rows.ids, rows.keys)))
            if len(rows):
                parts.append(rows)
        if len(parts) == 1:
            return parts[0]
        return joined(parts, distances=distances)

    def lookup(self, keys: Keys, *, distances: bool = False) -> Rows:
        """Rows of distinct ascending keys (U,), by one statement a shard."""
        if not keys.size or self._has_no(distances=distances):
            return no_rows(distances=distances)
        text = statements.LOOKUP[self._table(distances=distances)]

        def plan(view: LiveView) -> list[ShardQuery]:
            return [
                ShardQuery(shard, text, (wire.int8s(keys[some]),))
                for shard, some in pieces_of_keys(view.firsts, keys)
            ]

        return self.live(*self.ask(plan), distances=distances)

    def lookup_each(self, keys: Keys, *, distances: bool = False) -> Rows:
        """Rows of distinct ascending keys (U,), one statement a key."""
        if self._has_no(distances=distances):
            return no_rows(distances=True)
        text = statements.LOOKUP_ONE[self._table(distances=distances)]
        parts = []
        for at in range(len(keys)):
            key = keys[at : at + 1]

            def plan(view: LiveView, key: Keys = key) -> list[ShardQuery]:
                ((shard, _),) = pieces_of_keys(view.firsts, key)
                return [ShardQuery(shard, text, (wire.int8(int(key[0])),))]

            parts.append(self.live(*self.ask(plan), distances=distances))
        return joined([part for part in parts if len(part)], distances=distances)

    def scan(self, lows: Keys, highs: Keys, *, distances: bool = False) -> Rows:
        """Rows with a key in any of the closed ranges, ascending and disjoint."""
        if not lows.size or self._has_no(distances=distances):
            return no_rows(distances=distances)
        text = statements.SCAN[self._table(distances=distances)]
        return self.live(*self.ask(_ranges_plan(text, lows, highs)), distances=distances)

    def scan_partly(self, lows: Keys, highs: Keys, *, distances: bool = False) -> PartialRows:
        """Rows as of `scan` of the shards that answer, and the ranges of those that are away."""
        if not lows.size or self._has_no(distances=distances):
            return PartialRows(no_rows(distances=distances), NO_KEYS.reshape(0, 2))
        text = statements.SCAN[self._table(distances=distances)]
        view, asks, answers = self._asked(_ranges_plan(text, lows, highs), self.away)
        there = [answer for answer in answers if answer is not None]
        is_away = {ask.shard for ask, answer in zip(asks, answers, strict=True) if answer is None}
        away = [
            np.stack([piece.lows, piece.highs], axis=1)
            for piece in pieces_of_ranges(view.firsts, lows, highs)
            if piece.shard in is_away
        ]
        rows = self.live(view, there, distances=distances)
        return PartialRows(rows, np.concatenate([NO_KEYS.reshape(0, 2), *away]))

    def rows_of(self, object_id: int, lows: Keys, highs: Keys, *, distances: bool = False) -> Rows:
        """Rows of one object with a key in any of the closed ranges, ascending and disjoint."""
        if not lows.size or self._has_no(distances=distances):
            return no_rows(distances=distances)
        text = statements.ROWS_OF[self._table(distances=distances)]
        plan = _ranges_plan(text, lows, highs, wire.int8(object_id))
        return self.live(*self.ask(plan), distances=distances)

    def count(self, lows: Keys, highs: Keys) -> int:
        """How many rows `scan` would return, counted on the shards."""
        if not lows.size:
            return 0
        view, answers = self.ask(_ranges_plan(statements.COUNT[self._layout], lows, highs))
        total = 0
        for answer in answers:
            ids, versions, counts = (wire.read_int8s(value) for value in answer[:3])
            total += int(counts[view.are_live(ids, versions)].sum())
        return total

    def rows_after(self, key: int, object_id: int, limit: int, *, distances: bool = False) -> Rows:
        """At most that many rows after (key, id), ascending by both."""
        if self._has_no(distances=distances):
            return no_rows(distances=True)
        after, n_found = (key, object_id, LAST), 0
        parts: list[Rows] = []
        while n_found < limit:
            plan = _After(self._table(distances=distances), after, limit)
            view, (answer,) = self.ask(plan)
            shard = plan.shard  # by the view that the answer is of
            rows, versions = self.unpacked(answer, distances=distances)
            end = view.firsts[shard + 1] if shard + 1 < len(view.firsts) else LAST
            is_own = (rows.keys >= view.firsts[shard]) & (rows.keys < end)
            chosen = np.flatnonzero(is_own & view.are_live(rows.ids, versions))[: limit - n_found]
            if len(chosen):
                parts.append(rows.picked(chosen))
                n_found += len(chosen)
            if len(rows):
                after = int(rows.keys[-1]), int(rows.ids[-1]), int(versions[-1])
            if len(rows) < limit or rows.keys[-1] >= end:
                if shard + 1 == len(view.firsts):
                    break
                after = int(end) - 1, LAST, LAST
        return joined(parts, distances=distances)

    def _has_no(self, *, distances: bool) -> bool:
        """Whether distances are asked for where no row has any."""
        return distances and self._layout == "voxel"

    def _table(self, *, distances: bool) -> Table:
        return "band" if distances else self._layout


def _mark(answer: Answer) -> list[int]:
    """Writes, swept revision and moved epoch of the shard that has answered."""
    return wire.read_int8s(answer[-1]).tolist() if answer[-1] else [0, 0, 0]


def _marks_of(answers: Sequence[Answer | None]) -> _Marks:
    """The latest marks of shards among their answers."""
    marks = [_Marks(*_mark(answer)[1:]) for answer in answers if answer is not None]
    return _Marks(
        max((mark.swept for mark in marks), default=0),
        max((mark.moved for mark in marks), default=0),
    )


class _After:
    """Plan that asks the shard for rows after a place that holds the next of them."""

    def __init__(self, table: Table, after: tuple[int, int, int], limit: int) -> None:
        self._text = statements.AFTER[table]
        self._parameters = *map(wire.int8, after), wire.int8(limit)
        self._key = after[0] + (after[1] == LAST)  # the first that a row may have
        self.shard = 0

    def __call__(self, view: LiveView) -> list[ShardQuery]:
        self.shard = max(int(np.searchsorted(view.firsts, self._key, "right")) - 1, 0)
        return [ShardQuery(self.shard, self._text, self._parameters)]


def _ranges_plan(text: str, lows: Keys, highs: Keys, *others: wire.Parameter) -> Plan:
    """Plan that asks each shard for its pieces of ranges."""

    def plan(view: LiveView) -> list[ShardQuery]:
        return [
            ShardQuery(
                piece.shard, text, (wire.int8s(piece.lows), wire.int8s(piece.highs), *others)
            )
            for piece in pieces_of_ranges(view.firsts, lows, highs)
        ]

    return plan


def _outdated(url: str) -> OutdatedError:
    return OutdatedError(
        f"{url} was written by others faster than it could be read at one revision: try again"
    )

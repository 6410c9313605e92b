"""Answers to requests for rows, objects and statistics, from a store at one revision."""

import json
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import NamedTuple, TypeVar

import numpy as np

from hapticdb.errors import HapticDBError, ObjectNotFoundError
from hapticdb.protocol import cells as bodies
from hapticdb.protocol.cells import Asked
from hapticdb.protocol.fields import FieldsRead, FieldsWritten
from hapticdb.protocol.header import Kind, Refusal
from hapticdb.query.figures import QueryFigures
from hapticdb.server.cells.limits import MOST_ANSWER_BYTES
from hapticdb.store.base import BRICK_BYTES, Keys, Rows, Store, row_shift
from hapticdb.store.messages import change_body, object_body, rows_body

Found = TypeVar("Found")

SMALL_SPAN = 1 << 16
"""Keys in the ranges of a scan up to which its rows are not counted first. Larger: fewer counts,
and more rows are read in vain where many objects share the keys."""
MOST_RESOLUTION = 1 << 17
"""Most buckets of a histogram: 1 MiB. Larger: one answer may hold a client up for longer."""
REMEMBERED = 4
"""Histograms, lists of objects and sizes that are remembered. Larger: more memory."""
RANGES_END = 16
"""Bytes of a change in an answer for each of its ranges."""


class RequestRefusedError(HapticDBError):
    """A request that is answered by a refusal."""

    def __init__(self, code: Refusal, text: str) -> None:
        super().__init__(text)
        self.code = code


class CellsAnswer(NamedTuple):
    """An answer before it is sent: its kind, the revision that it was read at, and its body.

    asked : ranges of a scan, for those who want to know what the client has read.
    """

    kind: Kind
    revision: int
    body: bytes
    asked: Asked | None = None


class _Remembered:
    """What is the same for all clients, once one of them has found it."""

    def __init__(self) -> None:
        self.finding = threading.Lock()
        self.is_found = False
        self.found: object = None


class Answers:
    """Answers requests of all clients of one environment. Threads may share it.

    What many clients ask for alike, such as the list of objects, is remembered by its revision.
    """

    def __init__(self) -> None:
        self._remembered: dict[tuple[object, ...], _Remembered] = {}
        self._remembering = threading.Lock()
        self._answers: dict[int, Callable[[Store, int, FieldsRead], tuple[Kind, bytes]]] = {
            Kind.REVISION: self._revision,
            Kind.WATCH: self._revision,
            Kind.COUNT: self._count,
            Kind.CHANGES: self._changes,
            Kind.OBJECTS: self._objects,
            Kind.OBJECT: self._object,
            Kind.SIZE: self._size,
            Kind.QUANTILES: self._quantiles,
            Kind.FRESHNESS: self._freshness,
            Kind.COSTS: self._costs,
        }

    def answer(self, store: Store, kind: int, body: FieldsRead) -> CellsAnswer:
        """CellsAnswer a request at one revision.

        Raises
        ------
        ProtocolError
            When the request is malformed.
        RequestRefusedError
            When it cannot be answered.
        """
        asked = _asked_of(kind, body)
        if asked is None and kind not in self._answers:
            raise RequestRefusedError(Refusal.USAGE, f"a message of the unknown kind {kind}")
        with store.snapshot():
            revision = store.revision()
            if asked is not None:
                rows, resume = read_rows(store, kind, asked)
                body_of = rows_body(rows, resume).write(FieldsWritten()).joined()
                return CellsAnswer(
                    Kind.ROWS, revision, body_of, asked if kind == Kind.SCAN else None
                )
            answered, found = self._answers[kind](store, revision, body)
        return CellsAnswer(answered, revision, found)

    def _once(self, key: tuple[object, ...], find: Callable[[], Found]) -> Found:
        """Find something that stays the same for its key, once for all clients."""
        with self._remembering:
            if key not in self._remembered:
                alike = [known for known in self._remembered if known[0] == key[0]]
                for known in alike[: max(len(alike) - REMEMBERED + 1, 0)]:
                    del self._remembered[known]
                self._remembered[key] = _Remembered()
            remembered = self._remembered[key]
        with remembered.finding:  # those who ask for something else do not wait for it
            if not remembered.is_found:
                remembered.found, remembered.is_found = find(), True
            found: Found = remembered.found  # type: ignore[assignment]
            return found

    @staticmethod
    def _revision(_: Store, __: int, body: FieldsRead) -> tuple[Kind, bytes]:
        body.end()
        return Kind.NUMBERS, bodies.pack_numbers()

    @staticmethod
    def _count(store: Store, _: int, body: FieldsRead) -> tuple[Kind, bytes]:
        asked = bodies.ranges_of(body)
        return Kind.NUMBERS, bodies.pack_numbers(store.count(*_inside(store, asked)))

    @staticmethod
    def _changes(store: Store, _: int, body: FieldsRead) -> tuple[Kind, bytes]:
        (since,) = bodies.numbers_of(body, 1)
        changes, n_bytes, has_all = [], 0, True
        for change in store.changes(max(since, 0)):
            if n_bytes > MOST_ANSWER_BYTES:
                has_all = False
                break
            changes.append(change_body(change))
            n_bytes += RANGES_END * (2 + len(change.ranges))
        found = bodies.write_changes(FieldsWritten().u4(has_all), changes)
        return Kind.CHANGES_ARE, found.joined()

    def _objects(self, store: Store, revision: int, body: FieldsRead) -> tuple[Kind, bytes]:
        (after,) = bodies.numbers_of(body, 1)

        def find() -> tuple[Keys, list[bytes]]:
            objects = store.objects()
            ids = np.array([obj.id for obj in objects], dtype=np.int64)
            return ids, [object_body(obj).packed() for obj in objects]

        ids, packed = self._once(("objects", store.identity, revision), find)
        some: list[bytes] = []
        n_bytes = 0
        rest = packed[int(np.searchsorted(ids, after, side="right")) :]
        for one in rest:
            if some and n_bytes + len(one) > MOST_ANSWER_BYTES:
                break
            some.append(one)
            n_bytes += len(one)
        found = bodies.write_objects(FieldsWritten().u4(len(some) == len(rest)), some)
        return Kind.OBJECTS_ARE, found.joined()

    @staticmethod
    def _object(store: Store, _: int, body: FieldsRead) -> tuple[Kind, bytes]:
        (object_id,) = bodies.numbers_of(body, 1)
        packed: Sequence[bytes] = []
        with suppress(ObjectNotFoundError):
            packed = [object_body(store.object(object_id)).packed()]
        return Kind.OBJECTS_ARE, bodies.write_objects(FieldsWritten().u4(1), packed).joined()

    def _size(self, store: Store, revision: int, body: FieldsRead) -> tuple[Kind, bytes]:
        body.end()
        size = self._once(("size", store.identity, revision), store.size)
        numbers = size.rows, size.bytes, size.leaf_blocks, size.band_rows, size.band_bytes
        return Kind.NUMBERS, bodies.pack_numbers(*numbers)

    def _quantiles(self, store: Store, revision: int, body: FieldsRead) -> tuple[Kind, bytes]:
        resolution = _resolution(body)
        # analyze makes statistics anew without a revision, so their age is part of the key
        age = store.freshness(resolution).revision
        key = ("quantiles", store.identity, revision, resolution, age)
        found = self._once(key, lambda: store.quantiles(resolution))
        body_of = FieldsWritten().text(found.source).i8(found.n_rows).u4(len(found.bounds))
        return Kind.HISTOGRAM, body_of.array(found.bounds, "<i8").joined()

    @staticmethod
    def _freshness(store: Store, _: int, body: FieldsRead) -> tuple[Kind, bytes]:
        known = store.freshness(_resolution(body))
        revision = -1 if known.revision is None else known.revision
        return Kind.NUMBERS, bodies.pack_numbers(revision, known.changes, known.rows)

    def _costs(self, store: Store, _: int, body: FieldsRead) -> tuple[Kind, bytes]:
        body.end()
        figures = self._once(
            ("costs", store.identity),
            lambda: QueryFigures(store).both()[1].figures(),  # noqa: PLW0108 - measured when called
        )
        return Kind.FIGURES, FieldsWritten().text(json.dumps(figures)).joined()


def _resolution(body: FieldsRead) -> int:
    (resolution,) = bodies.numbers_of(body, 1)
    if not 1 <= resolution <= MOST_RESOLUTION:
        raise RequestRefusedError(
            Refusal.TOO_MUCH, f"{resolution} quantiles: a server gives 1 to {MOST_RESOLUTION}"
        )
    return resolution


def _asked_of(kind: int, body: FieldsRead) -> Asked | None:
    """Keys or ranges of a request for rows; None for another request."""
    if kind in {Kind.LOOKUP, Kind.LOOKUP_EACH}:
        return bodies.keys_of(body)
    if kind == Kind.SCAN:
        return bodies.ranges_of(body)
    return bodies.rows_asked_of(body) if kind == Kind.ROWS_OF else None


def read_rows(store: Store, kind: int, asked: Asked) -> tuple[Rows, int]:
    """Rows of a request, at most as many as an answer may have, and the first key they lack."""
    distances = asked.distances
    if kind == Kind.LOOKUP:
        return _cut(store.lookup(asked.lows, distances=distances), bodies.COMPLETE)
    if kind == Kind.LOOKUP_EACH:
        return _cut(store.lookup_each(asked.lows, distances=distances), bodies.COMPLETE)
    lows, highs = _inside(store, asked)
    resume = bodies.COMPLETE
    if int((highs - lows).sum()) > SMALL_SPAN:
        lows, highs, resume = _fitting(store, lows, highs)
    if kind == Kind.ROWS_OF:
        rows = store.rows_of(asked.object_id, lows, highs, distances=distances)
    else:
        rows = store.scan(lows, highs, distances=distances)
    return _cut(rows, resume)


def _inside(store: Store, asked: Asked) -> tuple[Keys, Keys]:
    """Ranges without the keys beyond the grid, so that no sum over them overflows."""
    last = (1 << max(3 * store.grid.bits - row_shift(store.layout), 0)) - 1
    n_inside = int(np.searchsorted(asked.lows, last, side="right"))
    lows = asked.lows[:n_inside].copy()
    return lows, np.minimum(asked.highs[:n_inside], last)


def _fitting(store: Store, lows: Keys, highs: Keys) -> tuple[Keys, Keys, int]:
    """Ranges from the first on whose rows fit into an answer, and the first key left out."""
    if store.count(lows, highs) <= bodies.MOST_ROWS:
        return lows, highs, bodies.COMPLETE
    fits, too_many = 0, len(lows)
    while too_many - fits > 1:
        middle = (fits + too_many) // 2
        is_fitting = store.count(lows[:middle], highs[:middle]) <= bodies.MOST_ROWS
        fits, too_many = (middle, too_many) if is_fitting else (fits, middle)
    if fits:
        return lows[:fits], highs[:fits], int(lows[fits])
    low, high = int(lows[0]), int(highs[0])
    while high > low:  # one range has too many rows: its first part
        high = (low + high) // 2
        if store.count(lows[:1], np.array([high])) <= bodies.MOST_ROWS:
            break
    return lows[:1], np.array([high]), high + 1


def _cut(rows: Rows, resume: int) -> tuple[Rows, int]:
    """Rows up to the limits of an answer, whole keys alone, and the first key that they lack."""
    if not len(rows):
        return rows, resume
    each = 18 + (BRICK_BYTES if rows.occupancy.size else 0)
    n_bytes = each * np.arange(1, len(rows) + 1)
    if rows.distances is not None:
        n_bytes += rows.distances.ends
    fits = min(int(np.searchsorted(n_bytes, MOST_ANSWER_BYTES, side="right")), bodies.MOST_ROWS)
    if fits >= len(rows):
        return rows, resume
    next_key = rows.keys[fits]
    end = int(np.searchsorted(rows.keys, next_key))
    if not end:  # one key has more rows than fit: all of them, or none
        end = int(np.searchsorted(rows.keys, next_key, side="right"))
        if n_bytes[end - 1] > bodies.MOST_ANSWER // 2:
            raise RequestRefusedError(Refusal.TOO_MUCH, "too many objects in one place")
        if end == len(rows):
            return rows, resume
    return rows.part(0, end), int(rows.keys[end])

"""Reads on a server: rows by key and by range, the paper's Figure 3, objects, changes."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from hapticdb.store import believed
from hapticdb.store.base import (
    NO_OCCUPANCY,
    NO_ROWS,
    Change,
    Keys,
    Layout,
    LocatedShell,
    Object,
    Rows,
    no_object,
    row_shift,
)
from hapticdb.store.postgres.connecting import wire
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.tables import records, statements


class PostgresReader:
    """Reads of one environment. The reader remembers the revision that its last read has seen."""

    def __init__(self, connection: ServerConnection, layout: Layout) -> None:
        self._connection = connection
        self._url = connection.shown
        self._layout = layout
        self._shift = row_shift(layout)
        self._seen = -1

    def version(self) -> int:
        """The revision that the last read has seen."""
        return self._seen

    def revision(self) -> int:
        """Number of the last committed write; 0 for an empty environment."""
        rows = self._connection.rows("SELECT revision FROM environment WHERE id = 1")
        self._seen = int(rows[0][0])
        return self._seen

    # -- rows -----------------------------------------------------------------------------------

    def unpacked(self, found: list[bytes | None]) -> Rows:
        """Rows from a statement's one packed row; its last value is the revision that was read."""
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
        return self.unpacked(
            self._connection.fetch(statements.LOOKUP[self._layout], wire.int8s(keys))
        )

    def lookup_each(self, keys: Keys) -> Rows:
        """Rows of distinct ascending keys (U,), one statement a key."""
        text = statements.LOOKUP_ONE[self._layout]
        parts = [
            rows
            for key in keys.tolist()
            if len(rows := self.unpacked(self._connection.fetch(text, wire.int8(key))))
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
        text = statements.SCAN[self._layout]
        return self.unpacked(self._connection.fetch(text, wire.int8s(lows), wire.int8s(highs)))

    def rows_of(self, object_id: int, lows: Keys, highs: Keys) -> Rows:
        """Rows of one object with a key in any of the closed ranges, ascending and disjoint."""
        if not lows.size:
            return NO_ROWS
        ends = wire.int8s(lows), wire.int8s(highs)
        text = statements.ROWS_OF[self._layout]
        return self.unpacked(self._connection.fetch(text, *ends, wire.int8(object_id)))

    def count(self, lows: Keys, highs: Keys) -> int:
        """How many rows `scan` would return, counted inside the engine."""
        if not lows.size:
            return 0
        text = statements.COUNT[self._layout]
        (found,) = self._connection.fetch(text, wire.int8s(lows), wire.int8s(highs))
        return wire.read_int8(found or b"")

    def statement(self, frame: LocatedShell) -> NDArray[np.float64]:
        """Wrench (6,) of the frame by one statement, computed by force() inside the engine."""
        text = statements.WRENCH[self._layout]
        parameters = wire.shell(frame)
        if frame.exclude.size:
            text = statements.without_excluded(text, self._layout, len(parameters) + 1)
            parameters.append(wire.int8s(frame.exclude))
        (found,) = self._connection.fetch(text, *parameters)
        return np.zeros(6) if found is None else wire.read_float8s(found)

    def statement_hits(self, frame: LocatedShell) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Ordinals (P,) and object ids (P,) of all hits, by the second statement."""
        text = statements.HITS[self._layout]
        parameters = [wire.int8s(frame.addresses)]
        if frame.exclude.size:
            text = statements.without_excluded(text, self._layout, 2)
            parameters.append(wire.int8s(frame.exclude))
        ordinals, ids, seen = self._connection.fetch(text, *parameters)
        self._seen = wire.read_int8(seen or b"")
        return wire.read_int8s(ordinals) - 1, wire.read_int8s(ids)

    # -- objects --------------------------------------------------------------------------------

    def objects(self) -> list[Object]:
        """All objects, ordered by id."""
        self.revision()  # first: a write between the two statements is noticed by the next read
        return [
            believed.object_of(self._url, row)
            for row in self._connection.rows(f"{records.OBJECTS} ORDER BY id")
        ]

    def object(self, object_id: int) -> Object:
        """One object; raises ObjectNotFoundError when there is none of that id."""
        rows = self._connection.rows(f"{records.OBJECTS} WHERE id = %s", (object_id,))
        if not rows:
            raise no_object(object_id, self._url)
        return believed.object_of(self._url, rows[0])

    def removed(self, link: str) -> set[str]:
        """Names of a file's parts that were removed and are not there again."""
        if self._connection.rows("SELECT to_regprocedure('removed_parts(text)')") == [(None,)]:
            return set()  # the format is 2 or older, and only the owner can bring it up to date
        return {row[0] for row in self._connection.rows("SELECT removed_parts(%s)", (link,))}

    def changes(self, since: int = 0) -> Iterator[Change]:
        """Committed writes after that revision, oldest first."""
        for row in self._connection.rows(
            "SELECT revision, action, id, ranges FROM change WHERE revision > %s ORDER BY revision",
            (since,),
        ):
            yield believed.change_of(self._url, row)


def _is_in_order(rows: Rows) -> bool:
    keys, ids = rows.keys, rows.ids
    if len(keys) < 2:
        return True
    return bool(((keys[1:] > keys[:-1]) | ((keys[1:] == keys[:-1]) & (ids[1:] > ids[:-1]))).all())


def _in_order(rows: Rows) -> Rows:
    """Rows in order of key and id. They come unsorted while a first import has no index yet."""
    order = np.lexsort((rows.ids, rows.keys))
    bits = rows.occupancy
    if bits.size:
        bits = np.frombuffer(bits.reshape(-1, 64)[order].tobytes(), np.uint8)
    return Rows(rows.keys[order], rows.ids[order], bits)

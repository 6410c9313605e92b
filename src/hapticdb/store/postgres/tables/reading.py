"""Reads on a server: rows by key and by range, the paper's Figure 3, surfaces."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticdb.store import parsing
from hapticdb.store.base import (
    NO_KEYS,
    NO_OCCUPANCY,
    Keys,
    LocatedShell,
    Rows,
    Table,
    joined,
    no_rows,
    row_shift,
)
from hapticdb.store.postgres.connecting import wire
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.tables import statements
from hapticdb.store.postgres.tables.server_tables import ServerTables
from hapticdb.store.tables import Form

MOST_BITS = 1 << 20
"""Ids from the least to the greatest excluded one up to which a bit for each is sent: 128 KiB. A
larger value sends more; beyond it the ids are sent, and each row is compared with each of them."""


class PostgresReader(ServerTables):
    """Reads of one environment."""

    def __init__(self, connection: ServerConnection) -> None:
        super().__init__(connection)
        self._sql = statements.SPREAD if self._is_spread else statements.ONE_SERVER
        self._shift = row_shift(self.layout)
        self._excluded = NO_KEYS
        self._excluded_parameters: list[wire.Parameter] = []

    def _unpacked(self, found: list[bytes | None], *, distances: bool = False) -> Rows:
        """Rows from a statement's one packed row; its last value is the revision that was read."""
        seen = found[-1]
        self._seen = wire.read_int8(seen) if seen is not None else -1
        if found[0] is None:
            return no_rows(distances=distances)
        keys, ids = wire.read_int8s(found[0]), wire.read_int8s(found[1])
        occupancy = np.frombuffer(found[2] or b"", np.uint8) if self._shift else NO_OCCUPANCY
        rows = Rows(keys, ids, occupancy)
        if distances:
            lengths = wire.read_int8s(found[4])
            rows = rows.having(parsing.band_of(self.url, found[3] or b"", lengths))
        return rows if _is_in_order(rows) else rows.picked(np.lexsort((ids, keys)))

    def _read(self, table: Table, form: Form, asked: Sequence[Any]) -> Rows:
        text, distances = getattr(self._sql, form)[table], table == "band"
        if form == "lookup_one":
            each = (self._connection.fetch(text, wire.int8(key)) for key in asked[0].tolist())
            parts = [self._unpacked(found, distances=distances) for found in each]
            return joined([part for part in parts if len(part)], distances=distances)
        parameters = (wire.int8(one) if isinstance(one, int) else wire.int8s(one) for one in asked)
        return self._unpacked(self._connection.fetch(text, *parameters), distances=distances)

    def count(self, lows: Keys, highs: Keys) -> int:
        """How many rows `scan` would return, counted inside the engine."""
        if not lows.size:
            return 0
        text = self._sql.counts[self.layout]
        (found,) = self._connection.fetch(text, wire.int8s(lows), wire.int8s(highs))
        return wire.read_int8(found or b"")

    def statement(self, frame: LocatedShell) -> NDArray[np.float64]:
        """Wrench (6,) of the frame by one statement, computed by force() inside the engine."""
        text = self._sql.wrench[self.layout]
        parameters = wire.shell(frame)
        text, parameters = self._without_excluded(text, parameters, frame.exclude)
        (found,) = self._connection.fetch(text, *parameters)
        return np.zeros(6) if found is None else wire.read_float8s(found)

    def statement_hits(self, frame: LocatedShell) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Ordinals (P,) and object ids (P,) of all hits, by the second statement."""
        text = self._sql.hits[self.layout]
        parameters = [wire.int8s(frame.addresses)]
        text, parameters = self._without_excluded(text, parameters, frame.exclude)
        ordinals, ids, seen = self._connection.fetch(text, *parameters)
        self._seen = wire.read_int8(seen or b"")
        return wire.read_int8s(ordinals) - 1, wire.read_int8s(ids)

    def _without_excluded(
        self, text: str, parameters: list[wire.Parameter], exclude: Keys
    ) -> tuple[str, list[wire.Parameter]]:
        """A statement and its parameters with a condition that leaves objects out."""
        if not exclude.size:
            return text, parameters
        if exclude is not self._excluded:
            self._excluded, self._excluded_parameters = exclude, _excluded_parameters(exclude)
        leave_out = statements.without_excluded
        if len(self._excluded_parameters) == 1:
            leave_out = statements.without_few
        text = leave_out(text, self.layout, len(parameters) + 1)
        return text, [*parameters, *self._excluded_parameters]

    def removed(self, link: str) -> set[str]:
        """Names of a file's parts that were removed and are not there again."""
        if self._rows("SELECT to_regprocedure('removed_parts(text)')") == [(None,)]:
            return set()  # the format is 2 or older, and only the owner can bring it up to date
        return {row[0] for row in self._rows("SELECT removed_parts(%s)", (link,))}

    def surfaces(self, digests: Sequence[str]) -> dict[str, bytes]:
        """Packed surfaces of the digests that have one, in one statement."""
        if not self.has_table(parsing.SURFACE):
            return {}
        text = "SELECT digest, geometry FROM surface WHERE digest = ANY (%s)"
        return parsing.surfaces_of(self.url, self._rows(text, (list(digests),), binary=True))


def _excluded_parameters(exclude: Keys) -> list[wire.Parameter]:
    """Parameters that stand for ids (E,), ascending; a single one where they are far apart."""
    low, high = int(exclude[0]), int(exclude[-1])
    if high - low >= MOST_BITS:
        return [wire.int8s(exclude)]
    is_excluded = np.zeros(high - low + 1, dtype=np.bool_)
    is_excluded[exclude - low] = True
    bits = np.packbits(is_excluded, bitorder="little").tobytes()
    return [wire.int8(low), wire.int8(high), wire.Parameter(wire.BYTEA, bits)]


def _is_in_order(rows: Rows) -> bool:
    """Whether rows are ordered by key and id. They are not while a first import has no index."""
    keys, ids = rows.keys, rows.ids
    if len(keys) < 2:
        return True
    return bool(((keys[1:] > keys[:-1]) | ((keys[1:] == keys[:-1]) & (ids[1:] > ids[:-1]))).all())

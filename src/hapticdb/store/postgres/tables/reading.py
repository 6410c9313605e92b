"""Reads on a server: rows by key and by range, the paper's Figure 3, objects, changes."""

from collections.abc import Collection, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from hapticdb.store import parsing
from hapticdb.store.base import (
    NO_KEYS,
    NO_OCCUPANCY,
    Change,
    Keys,
    Layout,
    LocatedShell,
    Object,
    Rows,
    Table,
    joined,
    no_rows,
    row_shift,
)
from hapticdb.store.pairs import Outlines
from hapticdb.store.postgres.connecting import wire
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.tables import statements
from hapticdb.store.refusals import no_object

MOST_BITS = 1 << 20
"""Ids from the least to the greatest excluded one up to which a bit for each is sent: 128 KiB. A
larger value sends more; beyond it the ids are sent, and each row is compared with each of them."""
OBJECTS = (
    "SELECT id, name, link, digest, transform, voxels, bounds, attributes::text, revision"
    " FROM object"
)
HAS_TABLE = "SELECT to_regclass(%s) IS NOT NULL"


class PostgresReader:
    """Reads of one environment. The reader remembers the revision that its last read has seen."""

    def __init__(
        self, connection: ServerConnection, layout: Layout, *, is_spread: bool = False
    ) -> None:
        self._connection = connection
        self._sql = statements.SPREAD if is_spread else statements.ONE_SERVER
        self._url = connection.shown
        self._layout = layout
        self._shift = row_shift(layout)
        self._seen = -1
        self._found: set[str] = set()
        self._excluded = NO_KEYS
        self._excluded_parameters: list[wire.Parameter] = []

    def version(self) -> int:
        """The revision that the last read has seen."""
        return self._seen

    def revision(self) -> int:
        """Number of the last committed write; 0 for an empty environment."""
        rows = self._connection.rows("SELECT revision FROM environment WHERE id = 1")
        self._seen = int(rows[0][0])
        return self._seen

    # -- rows -----------------------------------------------------------------------------------

    def unpacked(self, found: list[bytes | None], *, distances: bool = False) -> Rows:
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
            rows = rows.having(parsing.band_of(self._url, found[3] or b"", lengths))
        return rows if _is_in_order(rows) else rows.picked(np.lexsort((ids, keys)))

    def has_table(self, name: str) -> bool:
        """Whether a table of a later format is there; another may make it at any time."""
        if name not in self._found and self._connection.rows(HAS_TABLE, (name,)) == [(True,)]:
            self._found.add(name)
        return name in self._found

    def _read(
        self,
        texts: dict[Table, str],
        *parameters: wire.Parameter,
        distances: bool,
        is_nothing: bool = False,
    ) -> Rows:
        """Rows by the statement of the table that answers; none if that table is not there."""
        if is_nothing or (distances and not self.has_table(parsing.BAND)):
            return no_rows(distances=distances)
        text = texts["band" if distances else self._layout]
        return self.unpacked(self._connection.fetch(text, *parameters), distances=distances)

    def lookup(self, keys: Keys, *, distances: bool = False) -> Rows:
        """Rows of distinct ascending keys (U,), in one statement."""
        asked = wire.int8s(keys)
        return self._read(self._sql.lookup, asked, distances=distances, is_nothing=not keys.size)

    def lookup_each(self, keys: Keys, *, distances: bool = False) -> Rows:
        """Rows of distinct ascending keys (U,), one statement a key."""
        parts = [
            self._read(self._sql.lookup_one, wire.int8(key), distances=distances)
            for key in keys.tolist()
        ]
        return joined([part for part in parts if len(part)], distances=distances)

    def scan(self, lows: Keys, highs: Keys, *, distances: bool = False) -> Rows:
        """Rows with a key in any of the closed ranges, ascending and disjoint."""
        ends = wire.int8s(lows), wire.int8s(highs)
        return self._read(self._sql.scan, *ends, distances=distances, is_nothing=not lows.size)

    def rows_of(self, object_id: int, lows: Keys, highs: Keys, *, distances: bool = False) -> Rows:
        """Rows of one object with a key in any of the closed ranges, ascending and disjoint."""
        chosen = wire.int8s(lows), wire.int8s(highs), wire.int8(object_id)
        return self._read(self._sql.rows_of, *chosen, distances=distances, is_nothing=not lows.size)

    def rows_after(self, key: int, object_id: int, limit: int, *, distances: bool = False) -> Rows:
        """At most that many rows after (key, id), ascending by both."""
        place = wire.int8(key), wire.int8(object_id), wire.int8(limit)
        return self._read(self._sql.after, *place, distances=distances)

    def count(self, lows: Keys, highs: Keys) -> int:
        """How many rows `scan` would return, counted inside the engine."""
        if not lows.size:
            return 0
        text = self._sql.counts[self._layout]
        (found,) = self._connection.fetch(text, wire.int8s(lows), wire.int8s(highs))
        return wire.read_int8(found or b"")

    def statement(self, frame: LocatedShell) -> NDArray[np.float64]:
        """Wrench (6,) of the frame by one statement, computed by force() inside the engine."""
        text = self._sql.wrench[self._layout]
        parameters = wire.shell(frame)
        text, parameters = self._without_excluded(text, parameters, frame.exclude)
        (found,) = self._connection.fetch(text, *parameters)
        return np.zeros(6) if found is None else wire.read_float8s(found)

    def statement_hits(self, frame: LocatedShell) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Ordinals (P,) and object ids (P,) of all hits, by the second statement."""
        text = self._sql.hits[self._layout]
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
        text = leave_out(text, self._layout, len(parameters) + 1)
        return text, [*parameters, *self._excluded_parameters]

    # -- objects --------------------------------------------------------------------------------

    def objects(self, ids: Collection[int] | None = None) -> list[Object]:
        """All objects, or those of some ids that are there, ordered by id."""
        if ids is None:
            self.revision()  # first: the next read notices a write between the two statements
            found = self._connection.rows(f"{OBJECTS} ORDER BY id")
        else:
            found = self._connection.rows(f"{OBJECTS} WHERE id = ANY (%s) ORDER BY id", [list(ids)])
        return [parsing.object_of(self._url, row) for row in found]

    def object(self, object_id: int) -> Object:
        """One object; raises ObjectNotFoundError when there is none of that id."""
        found = self.objects([object_id])
        if not found:
            raise no_object(object_id, self._url)
        return found[0]

    def outlines(self) -> Outlines:
        """What is short of all objects, ordered by id."""
        found = self._connection.rows(
            "SELECT name, digest, id, revision, bounds FROM object ORDER BY id", binary=True
        )
        return parsing.outlines_of(self._url, found)

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
            yield parsing.change_of(self._url, row)

    def surfaces(self, digests: Sequence[str]) -> dict[str, bytes]:
        """Packed surfaces of the digests that have one, in one statement."""
        if not self.has_table(parsing.SURFACE):
            return {}
        text = "SELECT digest, geometry FROM surface WHERE digest = ANY (%s)"
        found = self._connection.rows(text, (list(digests),), binary=True)
        return parsing.surfaces_of(self._url, found)

    def surface_digests(self) -> set[str]:
        """Digests of all surfaces."""
        if not self.has_table(parsing.SURFACE):
            return set()
        found = self._connection.rows("SELECT digest FROM surface")
        return parsing.digests_of(self._url, found)


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

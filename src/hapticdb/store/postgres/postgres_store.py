"""PostgreSQL as an engine: ``postgresql://...``, an environment in a schema of a database."""

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticdb.grid import Grid
from hapticdb.store import parsing
from hapticdb.store.base import (
    NO_KEYS,
    NO_OCCUPANCY,
    Columns,
    Keys,
    Layout,
    LocatedShell,
    Rows,
    is_ascending,
    joined,
    no_rows,
    row_shift,
)
from hapticdb.store.engines import Lag, Right
from hapticdb.store.postgres import environment_schema, rights
from hapticdb.store.postgres.connecting import wire
from hapticdb.store.postgres.connecting.server_connection import ServerConnection
from hapticdb.store.postgres.tables import statements
from hapticdb.store.postgres.tables.server_tables import SIZE_OF_PARTITIONS, ServerTables
from hapticdb.store.postgres.watching import Watch
from hapticdb.store.tables import Form

GROUPS_KEYS_ITSELF = 170_000
"""Least server version, in libpq's form, whose `= ANY` reads each leaf page once."""
GROUPING_THRESHOLD = 256
"""Least number of distinct keys grouped by `auto` on older servers: docs/decisions/0014."""


REPLAYED = """
SELECT pg_last_wal_replay_lsn()::text,
       extract(epoch FROM clock_timestamp() - pg_last_xact_replay_timestamp())::float8
 WHERE pg_is_in_recovery()"""
MOST_BITS = 1 << 20
"""Range of excluded ids up to which a bitmap is sent, 128 KiB; else each row is compared with each
id."""


class PostgresStore(ServerTables):
    """An environment on a PostgreSQL server; its class is the engine, for URLs of servers."""

    title = "PostgreSQL"

    def __init__(self, connection: ServerConnection) -> None:
        super().__init__(connection)
        self._sql = statements.PARTITIONED if self._is_partitioned else statements.ONE_SERVER
        self._shift = row_shift(self.layout)
        self._excluded = NO_KEYS
        self._excluded_parameters: list[wire.Parameter] = []
        self.name = connection.address.environment
        self.engine = "PostgreSQL {}.{}".format(*divmod(connection.server_version, 10_000))
        groups_keys_itself = connection.server_version >= GROUPS_KEYS_ITSELF
        self.grouping_threshold = None if groups_keys_itself else GROUPING_THRESHOLD
        self._watch = watch = Watch(connection, self.identity)
        self.watch, self.has_changed = watch.begin, watch.has_changed
        if not self.is_read_only:
            self._loading.build_missing_index()

    @classmethod
    def open(cls, url: str, *, read_only: bool = False) -> "PostgresStore":
        connection = environment_schema.opened(url, read_only=read_only)
        try:
            return cls(connection)
        except BaseException:
            connection.close()
            raise

    @classmethod
    def create(
        cls, url: str, grid: Grid, layout: Layout = "brick", *, distances: bool = False
    ) -> "PostgresStore":
        """A schema, created whole or not at all."""
        environment_schema.created(url, grid, layout, distances=distances)
        return cls.open(url)

    @staticmethod
    def exists(url: str) -> bool:
        return environment_schema.exists(url)

    @staticmethod
    def grant(url: str, role: str, right: Right) -> None:
        with environment_schema.connected(url) as connection:
            environment_schema.check(connection)
            rights.grant(connection, role, right)

    def discard(self) -> None:
        self._loading.drop_unused()
        self.close()

    def loading(self) -> contextlib.AbstractContextManager[None]:
        """Inside, an empty table may lack its index, which is built at the end."""
        return self._loading

    @contextlib.contextmanager
    def snapshot(self) -> Iterator[None]:
        """As of the base; those of partitions begin one after the other on entry."""
        with self._connection.snapshot():
            if self._is_partitioned:
                # reads every partition: each remote snapshot begins with the first statement there
                self._connection.rows(SIZE_OF_PARTITIONS)
            yield

    def newest(self) -> int:
        # notifications arrive between transactions alone
        if self._connection.is_in_transaction:
            return self.revision()
        if self._watch.poll():
            self._seen = self._watch.revision
        return self._seen

    def lag(self) -> Lag | None:
        if not self._connection.is_standby:
            return None
        found = self._connection.rows(REPLAYED)
        return Lag(*found[0]) if found else None

    # -- reads -----------------------------------------------------------------------------------

    def _unpacked(self, found: list[bytes | None], *, distances: bool = False) -> Rows:
        """Rows of a statement's one packed row; its last value is the revision."""
        seen = found[-1]
        self._seen = wire.read_int8(seen) if seen is not None else -1
        if found[0] is None:
            return no_rows(distances=distances)
        keys, ids = wire.read_int8s(found[0]), wire.read_int8s(found[1])
        occupancy = NO_OCCUPANCY
        if self._shift:
            occupancy = parsing.bricks_of(self.url, found[2] or b"", len(keys))
        rows = Rows(keys, ids, occupancy)
        if distances:
            lengths = wire.read_int8s(found[4])
            rows = rows.having(parsing.band_of(self.url, found[3] or b"", lengths))
        # out of order while a first import has no index
        return rows if is_ascending(keys, ids) else rows.picked(np.lexsort((ids, keys)))

    def _read(self, form: Form, *arguments: Any, distances: bool) -> Rows:  # noqa: ANN401 - keys or numbers
        columns: Columns = "distances" if distances else self.layout
        if form != "after" and not arguments[0].size:
            return no_rows(distances=distances)
        text = getattr(self._sql, form)[columns]
        if form == "lookup_one":
            each = (self._connection.fetch(text, wire.int8(key)) for key in arguments[0].tolist())
            parts = [self._unpacked(found, distances=distances) for found in each]
            return joined([part for part in parts if len(part)], distances=distances)
        parameters = (
            wire.int8(one) if isinstance(one, int) else wire.int8s(one) for one in arguments
        )
        return self._unpacked(self._connection.fetch(text, *parameters), distances=distances)

    def count(self, lows: Keys, highs: Keys) -> int:
        if not lows.size:
            return 0
        text = self._sql.counts[self.layout]
        (found,) = self._connection.fetch(text, wire.int8s(lows), wire.int8s(highs))
        return wire.read_int8(found or b"")

    def statement(self, frame: LocatedShell) -> NDArray[np.float64]:
        text = self._sql.wrench[self.layout]
        parameters = wire.shell(frame)
        text, parameters = self._without_excluded(text, parameters, frame.exclude)
        (found,) = self._connection.fetch(text, *parameters)
        return np.zeros(6) if found is None else wire.read_float8s(found)

    def statement_hits(self, frame: LocatedShell) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        text = self._sql.hits[self.layout]
        parameters = [wire.int8s(frame.addresses)]
        text, parameters = self._without_excluded(text, parameters, frame.exclude)
        ordinals, ids, seen = self._connection.fetch(text, *parameters)
        self._seen = wire.read_int8(seen or b"")
        return wire.read_int8s(ordinals) - 1, wire.read_int8s(ids)

    def _without_excluded(
        self, text: str, parameters: list[wire.Parameter], exclude: Keys
    ) -> tuple[str, list[wire.Parameter]]:
        """A statement and its parameters with the condition on excluded objects."""
        if not exclude.size:
            return text, parameters
        # by identity: most frames exclude the same array, and packing it takes time each frame
        if exclude is not self._excluded:
            self._excluded, self._excluded_parameters = exclude, _excluded_parameters(exclude)
        leave_out = statements.without_excluded
        if len(self._excluded_parameters) == 1:
            leave_out = statements.without_few
        text = leave_out(text, self.layout, len(parameters) + 1)
        return text, [*parameters, *self._excluded_parameters]


def _excluded_parameters(exclude: Keys) -> list[wire.Parameter]:
    """Parameters of excluded ids (E,), ascending: a bitmap with its ends, or an array if sparse."""
    low, high = int(exclude[0]), int(exclude[-1])
    if high - low >= MOST_BITS:
        return [wire.int8s(exclude)]
    is_excluded = np.zeros(high - low + 1, dtype=np.bool_)
    is_excluded[exclude - low] = True
    # `get_bit` numbers the bits of a byte from the least significant one
    bits = np.packbits(is_excluded, bitorder="little").tobytes()
    return [wire.int8(low), wire.int8(high), wire.Parameter(wire.BYTEA, bits)]


ENGINE = PostgresStore

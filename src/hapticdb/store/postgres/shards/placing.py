"""Rows of objects, written to their shards in a version of their own.

A write copies its rows to all shards that they touch, at the same time, and commits there. No
reader believes them until the coordinator's commit names their version in the table `live`. So the
rows of an object appear and vanish together, whatever ends in between; what it leaves is swept
(`hapticdb.store.postgres.shards.sweeping`).
"""

import secrets
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hapticdb.errors import ShardAwayError
from hapticdb.grid import Grid
from hapticdb.store.base import (
    CELL_SHIFT,
    Covering,
    Keys,
    Layout,
    Object,
    Rows,
    Table,
    row_shift,
    touched_ranges,
)
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.shards.connecting.links import (
    ShardConnection,
    Shards,
    lost_writes,
    older_coordinator,
)
from hapticdb.store.postgres.shards.pieces import pieces_of_keys
from hapticdb.store.postgres.shards.schemas import COLUMNS
from hapticdb.store.postgres.shards.sweeping import Left, Sweeper
from hapticdb.store.postgres.tables.placing import copy_into

VERSION_BITS = 62
"""Bits of a version, drawn at random for each write. Versions of two writes of one object are equal
once in 2^62 times; the index refuses the second then, and the write fails."""
# a server may be set not to wait for the disk: rows that the coordinator names must outlive a crash
DURABLE = """
CASE WHEN current_setting('synchronous_commit') = 'off'
     THEN set_config('synchronous_commit', 'local', true) END"""
COUNT_WRITE = f"UPDATE mark SET writes = writes + 1 RETURNING writes, swept, {DURABLE}"
LIST_WRITTEN = "INSERT INTO written VALUES (%s, %s, %s)"
PUBLISH = """
INSERT INTO live VALUES (%s, %s, %s, %s)
ON CONFLICT (id) DO UPDATE SET version = EXCLUDED.version, ranges = EXCLUDED.ranges,
                               revision = EXCLUDED.revision"""
# the coordinator is idle while rows are copied, and must not end the transaction because of that
BEGIN = f"""
SELECT {DURABLE},
       set_config('idle_in_transaction_session_timeout', '0', true)"""
# read inside the write: its lock keeps the borders where they are
BORDERS = """
SELECT array_agg(first_key ORDER BY number), array_agg(writes ORDER BY number) FROM shard"""
KNOWN = "SELECT version, ranges FROM live WHERE id = %s"


class Listed(NamedTuple):
    """A version of an object, as a shard's table `written` has it.

    ranges : lowest and highest voxel key of each range that holds its rows, one after the other;
    revision : of the write that makes it.
    """

    object_id: int
    version: int
    ranges: list[int]
    revision: int


class RowsOnShards:
    """Writes rows to shards inside a write's transaction on the coordinator."""

    def __init__(
        self,
        connection: ServerConnection,
        shards: Shards,
        sweeper: Sweeper,
        shape: tuple[Grid, Layout],
    ) -> None:
        self._connection = connection
        self._shards = shards
        self._sweeper = sweeper
        self._grid, self._layout = shape
        self._left: Left | None = None

    def put(self, rows: Rows, object_id: int, revision: int) -> None:
        """Write the rows of an object and publish them with the commit of the write."""
        left = self._left
        if left is not None and (left.object_id, left.died) != (object_id, revision):
            self._left = None  # of a write that has failed
        version = secrets.randbits(VERSION_BITS)
        ranges = touched_ranges(self._grid, self._layout, rows.keys).reshape(-1).tolist()
        self._connection.execute(BEGIN)
        ((borders, writes),) = self._connection.execute(BORDERS).fetchall()
        listed = Listed(object_id, version, ranges, revision)
        firsts = np.array(borders, dtype=np.int64) >> row_shift(self._layout)
        batches: dict[int, list[tuple[Table, Rows]]] = {}
        tables: list[tuple[Table, Rows]] = [(self._layout, rows.occupied())]
        if rows.distances is not None:
            tables.append(("band", rows))
        for table, some in tables:
            for shard, where in pieces_of_keys(firsts, some.keys):
                batches.setdefault(shard, []).append((table, some.part(where.start, where.stop)))

        def copy(shard: int, connection: ShardConnection) -> int:
            return self._copied(connection, batches[shard], listed, writes[shard])

        touched = sorted(batches)
        try:
            counts = self._shards.each(copy, touched) if touched else []
        except ShardAwayError as error:
            raise ShardAwayError(f"nothing is written: {error}") from error
        for shard, count in zip(touched, counts, strict=True):
            self._connection.execute(
                "UPDATE shard SET writes = greatest(writes, %s) WHERE number = %s",
                (count, self._shards.places[shard].number),
            )
        self._connection.execute(PUBLISH, (object_id, version, ranges, revision))

    def put_band(self, rows: Rows, object_id: int, revision: int) -> None:
        """Write an object's rows again, with distances."""
        self._leave(object_id, revision)
        self.put(rows, object_id, revision)

    def take(self, known: Object, covering: Covering, revision: int) -> Keys:
        """Take an object's rows away with the commit; returns a key in each cell they are in."""
        for _ in covering(known):  # `live` knows the ranges; but the caller may refuse here
            break
        self._connection.execute(BEGIN)
        ranges = self._leave(known.id, revision)
        self._connection.execute(PUBLISH, (known.id, None, [], revision))
        shift = CELL_SHIFT if self._grid.is_hierarchical else 2 * self._grid.bits
        low, high = ranges.T >> shift
        cells = [np.arange(first, last + 1) for first, last in zip(low, high, strict=True)]
        return np.concatenate([np.empty(0, np.int64), *cells]) << (shift - row_shift(self._layout))

    def _leave(self, object_id: int, revision: int) -> Keys:
        """Note the rows of an object that this write leaves behind; returns their ranges (C, 2)."""
        found = self._connection.execute(KNOWN, (object_id,)).fetchone()
        version, ranges = found if found is not None else (None, [])
        self._left = None
        if version is not None:
            self._left = Left(object_id, version, revision, tuple(ranges))
        return np.array(ranges, dtype=np.int64).reshape(-1, 2)

    def committed(self) -> None:
        """Sweep what the write has left behind, where nobody reads it any more."""
        left, self._left = self._left, None
        if left is not None:
            self._sweeper.sweep_after_write(left)

    def _copied(
        self,
        connection: ShardConnection,
        batches: Sequence[tuple[Table, Rows]],
        listed: Listed,
        least: int,
    ) -> int:
        """Copy rows to one shard in one transaction; returns the number of its writes.

        least : writes that the shard has committed at least, as the coordinator knows.
        """
        object_id, version, ranges, revision = listed

        def work() -> int:
            # the row of `mark` is locked until the end: one write at a time on a shard
            ((count, swept, _),) = connection.execute(COUNT_WRITE).fetchall()
            if count <= least:
                raise lost_writes(connection.shown, count - 1, least)
            if swept >= revision:
                raise older_coordinator(self._connection.shown)
            connection.execute(LIST_WRITTEN, (object_id, version, ranges))
            for table, rows in batches:
                target = f"{table} ({COLUMNS[table]})"
                copy_into(connection, target, rows, object_id, version)
            return int(count)

        def is_committed() -> bool:
            # the commit may still be under way: wait for its lock before looking
            connection.rows("SELECT 1 FROM mark FOR UPDATE")
            asked = "SELECT 1 FROM written WHERE (id, version) = (%s, %s)"
            return bool(connection.rows(asked, (object_id, version)))

        return connection.write(work, is_committed)

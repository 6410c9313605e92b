"""Sweeping: deletes rows on shards that no reader believes, and that nobody will.

Such rows are of versions that a later write has replaced, and of writes that never reached the
coordinator's commit. A snapshot that somebody holds keeps the rows of its revision: it has an
advisory lock whose number is the revision (`hapticdb.store.postgres.shards.view`). A snapshot that
begins at an older revision at that very moment may lose rows; the shard's mark tells it so.
"""

import contextlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hapticdb.errors import DatabaseError
from hapticdb.store.base import Layout, Table, row_shift
from hapticdb.store.postgres.connecting import wire
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.shards import statements
from hapticdb.store.postgres.shards.links import ShardConnection, Shards
from hapticdb.store.postgres.shards.pieces import pieces_of_ranges

HELD = """
SELECT min(objid::bigint) FROM pg_locks
 WHERE locktype = 'advisory' AND objsubid = 1
   AND classid = 'environment'::regclass
   AND database = (SELECT oid FROM pg_database WHERE datname = current_database())"""
HELD_AND_BORDERS = f"SELECT ({HELD}), array_agg(first_key ORDER BY number) FROM shard"
LOCK = "SELECT revision FROM environment WHERE id = 1 FOR UPDATE"
WRITTEN = "SELECT id, version, ranges FROM written"
LIVE = "SELECT id, coalesce(version, -1), revision FROM live"
FORGET = "DELETE FROM written WHERE (id, version) = (%s, %s)"
NEVER = 0
"""Revision at which rows died that no revision ever had."""


class Left(NamedTuple):
    """Rows of one version of an object that do not count any more.

    died : first revision at which they do not count; `NEVER` if they never did; ranges : lowest and
    highest voxel key of each range that holds them, one after the other.
    """

    object_id: int
    version: int
    died: int
    ranges: tuple[int, ...]


class Swept(NamedTuple):
    """Result of a sweep: versions of objects whose rows were deleted, and those left for later."""

    versions: int
    kept: int


class Sweeper:
    """Sweeps the shards of one environment."""

    def __init__(self, connection: ServerConnection, shards: Shards, layout: Layout) -> None:
        self._connection = connection
        self._shards = shards
        self._shift = row_shift(layout)
        self._tables: tuple[Table, ...] = ("brick", "band") if layout == "brick" else ("voxel",)

    def sweep_after_write(self, left: Left) -> None:
        """Sweep what a committed write has replaced. What cannot be swept now is swept later."""
        with contextlib.suppress(DatabaseError):
            ((oldest, borders),) = self._connection.rows(HELD_AND_BORDERS)
            if oldest is None or left.died <= oldest:
                ends = np.array(left.ranges, dtype=np.int64).reshape(-1, 2) >> self._shift
                firsts = np.array(borders, dtype=np.int64) >> self._shift
                some = [p.shard for p in pieces_of_ranges(firsts, ends[:, 0], ends[:, 1])]
                self._shards.each(lambda _, shard: self._delete(shard, [left]), some)

    def sweep(self) -> Swept:
        """Sweep all shards. Waits for the write that is under way; writers wait only for the list.

        Raises
        ------
        ShardAwayError
            When a shard cannot be reached; the others are swept all the same.
        """
        listed: list[list[tuple[int, int, list[int]]]] = []
        live: dict[int, tuple[int, int]] = {}
        oldest = 0

        def look() -> None:
            nonlocal oldest
            # no write is under way now, so rows that are not live will never be
            ((revision,),) = self._connection.execute(LOCK).fetchall()
            ((held,),) = self._connection.execute(HELD).fetchall()
            oldest = revision if held is None else min(held, revision)
            listed[:] = self._shards.each(lambda _, shard: shard.rows(WRITTEN))
            live.clear()
            live.update({i: (v, r) for i, v, r in self._connection.execute(LIVE).fetchall()})

        self._connection.write(look)
        found = [[left for row in rows if (left := _dead(row, live))] for rows in listed]
        chosen = [[left for left in some if left.died <= oldest] for some in found]
        some = [shard for shard, lefts in enumerate(chosen) if lefts]
        if some:
            self._shards.each(lambda at, shard: self._delete(shard, chosen[at]), some)
        swept = {left[:2] for lefts in chosen for left in lefts}
        return Swept(len(swept), len({left[:2] for lefts in found for left in lefts} - swept))

    def _delete(self, shard: ShardConnection, lefts: Sequence[Left]) -> None:
        def work() -> None:
            shard.execute(
                "UPDATE mark SET swept = greatest(swept, %s)", (max(left.died for left in lefts),)
            )
            for left in lefts:
                ends = np.array(left.ranges, dtype=np.int64).reshape(-1, 2) >> self._shift
                which = wire.int8(left.object_id), wire.int8(left.version)
                for table in self._tables:
                    text = statements.DELETE_VERSION[table]
                    shard.fetch(text, wire.int8s(ends[:, 0]), wire.int8s(ends[:, 1]), *which)
                shard.execute(FORGET, (left.object_id, left.version))

        shard.write(work)


def _dead(row: tuple[int, int, list[int]], live: dict[int, tuple[int, int]]) -> Left | None:
    """What a row of `written` leaves to sweep; None if its version is live."""
    object_id, version, ranges = row
    current, revision = live.get(object_id, (-1, NEVER))
    return None if current == version else Left(object_id, version, revision, tuple(ranges))

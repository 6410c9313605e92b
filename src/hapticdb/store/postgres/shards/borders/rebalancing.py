"""Rebalancing: moves the borders between shards so that each holds equally many rows.

Readers and writers go on. The borders move in batches of whole cells. For each batch:

1. The coordinator's write lock is taken: no row is written while the batch moves.
2. The new shard copies the batch's rows and commits. No reader asks it for them yet.
3. The coordinator moves the border and counts the epoch up. Its commit moves the batch.

After the last batch, each shard deletes the rows that lie outside its borders, and its mark says of
which epoch. It waits for snapshots that began before. A reader of an older epoch that asks the old
shard either still finds the rows there, or learns from the mark that they are gone.

Whatever dies in between leaves rows that no reader asks for; the next rebalance deletes them.

Rebalances are numbered. Each transaction on a shard notes the number in the shard's mark, and is
refused where a higher one is noted. So a rebalance that has lost its connection to the coordinator,
and with it its lock, cannot change what a later one has moved.
"""

import contextlib
import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import psycopg

from hapticdb.errors import AccessError, BusyError, OutdatedError, ShardAwayError
from hapticdb.store.base import Keys, Layout, row_shift
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.shards import foreign
from hapticdb.store.postgres.shards.borders.carrying import Carried, Carrier, overtaken
from hapticdb.store.postgres.shards.borders.moves import (
    LAST,
    Move,
    all_moves,
    borders_after,
    next_move,
    part_of,
)
from hapticdb.store.postgres.shards.connecting.links import ShardConnection, Shards, named_away
from hapticdb.store.postgres.shards.loading import IndexesOnShards
from hapticdb.store.postgres.shards.pieces import borders_by_rows
from hapticdb.store.postgres.shards.statistics import ShardedStatistics
from hapticdb.store.postgres.shards.sweeping import LOCK
from hapticdb.store.postgres.tables.loading import KEY, TABLES
from hapticdb.store.sharding import RebalanceCallback, Rebalanced, RebalanceProgress

REBALANCERS = 0x48415056
"""First half of the advisory lock of the one who rebalances; see `loading.LOADERS`."""
SNAPSHOT_SECONDS = 60.0
"""Longest wait for snapshots that began before the borders moved. With a larger value fewer long
reads have to begin again, but a rebalance beside them takes longer."""
LOOK_SECONDS = 0.05
"""Pause between two looks whether such snapshots have ended."""
PAUSE_SECONDS = 0.01
"""Pause between two batches, in which writers that wait take the write lock. A larger value lets
them write more often beside a rebalance."""
DELETED_ROWS = 1 << 16
"""Rows of a table that a shard deletes in one transaction. While it lasts, writers of that shard
wait."""
# a large object may take a writer longer than the usual limit
WAIT = "SET LOCAL lock_timeout = 0"
BEGIN = "UPDATE distribution SET rebalance = rebalance + 1 RETURNING rebalance"
STATE = """
SELECT epoch, rebalance, (SELECT array_agg(first_key ORDER BY number) FROM shard)
  FROM distribution"""
MOVE_BORDERS = """
UPDATE shard SET first_key = after.first_key
  FROM unnest(%s::bigint[]) WITH ORDINALITY AS after(first_key, number)
 WHERE shard.number = after.number AND shard.first_key <> after.first_key"""
COUNT_WRITES = "UPDATE shard SET writes = greatest(writes, %s) WHERE number = %s"
COUNT_EPOCH = "UPDATE distribution SET epoch = epoch + 1"
# the locks of snapshots (`view.HOLDING`)
SNAPSHOTS = """
SELECT virtualtransaction FROM pg_locks
 WHERE locktype = 'advisory' AND objsubid = 1
   AND classid = 'environment'::regclass
   AND database = (SELECT oid FROM pg_database WHERE datname = current_database())"""
NOTE_MOVED = """
UPDATE mark SET moved = greatest(moved, %s), rebalance = %s
 WHERE rebalance <= %s RETURNING moved"""


class _State(NamedTuple):
    """What the coordinator says: epoch, number of the latest rebalance, borders (S,)."""

    epoch: int
    number: int
    borders: Keys


class _Plan(NamedTuple):
    """Live rows of each shard (S,), wanted borders (S,), and rows that have to move."""

    rows: Keys
    wanted: Keys
    n_moving: int


class Rebalancer:
    """Rebalances the shards of one environment."""

    def __init__(
        self, connection: ServerConnection, shards: Shards, layout: Layout, known: ShardedStatistics
    ) -> None:
        self._connection = connection
        self._shards = shards
        self._layout: Layout = layout
        self._known = known
        self._indexes = IndexesOnShards(shards, layout)

    def rebalance(self, progress: RebalanceCallback | None = None) -> Rebalanced:
        """Move the borders; see `hapticdb.store.sharding.SupportsShards`."""
        shown = self._connection.shown
        if not self._connection.is_owner():
            raise AccessError(
                f"{shown}: only the owner of the environment may rebalance it; connect as the owner"
            )
        with self._alone():
            if not self._indexes.are_there():
                raise BusyError(f"{shown} is being imported into: rebalance it afterwards")
            number = self._begun()
            plan = self._planned()
            rows = n_bytes = 0
            while (batch := self._moved(plan.wanted, number)) is not None:
                rows, n_bytes = rows + batch.rows, n_bytes + batch.bytes
                if progress is not None:
                    progress(RebalanceProgress(rows, max(rows, plan.n_moving)))
                time.sleep(PAUSE_SECONDS)
            has_deleted = self._deleted(number)
            if rows or has_deleted:
                self._indexes.vacuum()
                self._known.refresh()
            after = self._known.rows_of_shards()
        names = tuple(self._shards.name(at) for at in range(len(self._shards)))
        return Rebalanced(
            shown, rows, n_bytes, names, tuple(plan.rows.tolist()), tuple(after.tolist())
        )

    @contextlib.contextmanager
    def _alone(self) -> Iterator[None]:
        """Refuse a second rebalance at the same time."""
        connection = self._connection
        asked = f"SELECT pg_try_advisory_lock({KEY})"
        if connection.rows(asked, (REBALANCERS,)) != [(True,)]:
            raise BusyError(
                f"{connection.shown} is being rebalanced by another: wait until that has ended"
            )
        session = connection.driver
        try:
            yield
        finally:
            # a session that is lost has no lock any more
            if connection.driver is session:
                with contextlib.suppress(psycopg.Error):
                    connection.execute(f"SELECT pg_advisory_unlock({KEY})", (REBALANCERS,))

    def _begun(self) -> int:
        """Take the next number of a rebalance."""

        def work() -> int:
            self._connection.execute(WAIT)
            self._connection.execute(LOCK)
            ((number,),) = self._connection.execute(BEGIN).fetchall()
            return int(number)

        return self._connection.write(work)

    # -- what has to move ------------------------------------------------------------------------

    def _planned(self) -> _Plan:
        try:
            rows, wanted = self._counted()
        except OutdatedError:  # others have swept just as the snapshot began
            rows, wanted = self._counted()
        moves = all_moves(self._state().borders, wanted)

        def count(shard: int, connection: ShardConnection) -> int:
            shift = row_shift(self._layout)
            ranges = [(m.low >> shift, m.high >> shift) for m in moves if m.source == shard]
            text = f"SELECT count(*) FROM {self._layout} WHERE z_val >= %s AND z_val < %s"
            with connection.without_limit():
                return sum(int(connection.rows(text, ends)[0][0]) for ends in ranges)

        sources = sorted({move.source for move in moves})
        return _Plan(rows, wanted, sum(self._shards.each(count, sources)) if sources else 0)

    def _counted(self) -> tuple[Keys, Keys]:
        """Live rows of each shard (S,), and the borders (S,) of shards with equally many."""
        rows = self._known.rows_of_shards()
        bounds, n_rows = self._known.exact_histogram(len(self._shards))
        if not n_rows:
            return rows, self._state().borders
        return rows, borders_by_rows(bounds, row_shift(self._layout), len(self._shards))

    def _state(self) -> _State:
        ((epoch, number, borders),) = self._connection.rows(STATE)
        return _State(int(epoch), int(number), np.array(borders, dtype=np.int64))

    # -- a batch ---------------------------------------------------------------------------------

    def _moved(self, wanted: Keys, number: int) -> Carried | None:
        """Move one batch; None if all borders are where they are wanted."""
        connection = self._connection
        expected = -1

        def work() -> Carried | ShardAwayError | None:
            nonlocal expected
            connection.execute(WAIT)
            connection.execute(LOCK)
            state = self._state()
            if state.number != number:
                raise overtaken(connection.shown)
            move = next_move(state.borders, wanted)
            if move is None:
                return None
            try:
                move, carried = self._carried(move, number, state.epoch)
            except ShardAwayError as error:  # the coordinator is not: nothing is to be repeated
                return error
            borders = borders_after(state.borders, move)
            # tables for SQL have the old borders: none is better than one that lacks rows
            foreign.withdraw(connection)
            connection.execute(MOVE_BORDERS, (borders.tolist(),))
            connection.execute(
                COUNT_WRITES, (carried.writes, self._shards.places[move.target].number)
            )
            connection.execute(COUNT_EPOCH)
            expected = state.epoch + 1
            return carried

        def is_committed() -> bool:
            # the commit may still be under way: wait for its lock before looking
            connection.rows(LOCK)
            return self._state()[:2] == (expected, number)

        found = connection.write(work, is_committed)
        if isinstance(found, ShardAwayError):
            raise found
        return found

    def _carried(self, move: Move, number: int, epoch: int) -> tuple[Move, Carried]:
        """Copy a batch of a move to its new shard; returns the part that the batch is."""
        carrier = Carrier(self._layout, row_shift(self._layout), number)
        with named_away():
            source = self._shards.connection(move.source)
            target = self._shards.connection(move.target)
            batch = part_of(move, carrier.end_of_batch(source, move))
            return batch, carrier.carry(source, target, batch, epoch)

    # -- what is left behind ---------------------------------------------------------------------

    def _deleted(self, number: int) -> bool:
        """Delete the rows outside the borders of their shards; whether there were any."""
        state = self._state()
        ends = self._row_ends(state.borders)
        outside = self._shards.each(lambda at, shard: self._has_outside(shard, ends[at]))
        some = [at for at, has in enumerate(outside) if has]
        if some:
            self._wait_for_snapshots()
            self._shards.each(
                lambda at, shard: self._delete(shard, ends[at], state.epoch, number), some
            )
        return bool(some)

    def _row_ends(self, borders: Keys) -> list[tuple[int, int]]:
        """First row key of each shard, and the first one behind its last."""
        firsts = borders >> row_shift(self._layout)
        return list(zip(firsts.tolist(), [*firsts[1:].tolist(), LAST], strict=True))

    def _has_outside(self, shard: ShardConnection, ends: tuple[int, int]) -> bool:
        texts = [
            f"EXISTS (SELECT FROM {table} WHERE z_val {side} %s)"
            for table in TABLES[self._layout]
            for side in ("<", ">=")
        ]
        found = shard.rows(f"SELECT {' OR '.join(texts)}", ends * (len(texts) // 2))
        return found == [(True,)]

    def _wait_for_snapshots(self) -> None:
        """Wait until the snapshots that others hold now have ended, but not for ever."""
        deadline = time.monotonic() + SNAPSHOT_SECONDS
        left = set(self._connection.rows(SNAPSHOTS))
        while left and time.monotonic() < deadline:
            time.sleep(LOOK_SECONDS)
            left &= set(self._connection.rows(SNAPSHOTS))

    def _delete(
        self, shard: ShardConnection, ends: tuple[int, int], epoch: int, number: int
    ) -> None:
        """Delete the rows outside `ends`; readers of epochs before that one learn it.

        Nothing is deleted that a later rebalance may have moved here.
        """

        def work() -> int:
            shard.execute(WAIT)
            if not shard.execute(NOTE_MOVED, (epoch, number, number)).fetchall():
                raise overtaken(shard.shown)
            n_deleted = 0
            for table in TABLES[self._layout]:
                places = " UNION ALL ".join(
                    f"(SELECT ctid FROM {table} WHERE z_val {side} %s LIMIT {DELETED_ROWS})"
                    for side in ("<", ">=")
                )
                text = f"DELETE FROM {table} WHERE ctid = ANY (ARRAY({places}))"
                n_deleted += shard.execute(text, ends).rowcount
            return n_deleted

        while shard.write(work):
            pass

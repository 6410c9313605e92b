"""Sweeping: deletes rows on shards that no reader believes, and that nobody will.

Such rows are of versions that a later write has replaced, and of writes that never reached the
coordinator's commit. A snapshot that somebody holds keeps the rows of its revision: it has an
advisory lock whose number is the revision (`hapticdb.store.postgres.shards.view`). A snapshot that
begins at an older revision at that very moment may lose rows; the shard's mark tells it so.
"""

import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np

from hapticdb.errors import DatabaseError
from hapticdb.store.base import Layout, row_shift
from hapticdb.store.postgres.connecting import failures, wire
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.shards import statements
from hapticdb.store.postgres.shards.connecting.links import ShardConnection, Shards
from hapticdb.store.postgres.shards.pieces import pieces_of_ranges
from hapticdb.store.postgres.tables.loading import TABLES

Result = TypeVar("Result")

HELD = """
SELECT min(objid::bigint) FROM pg_locks
 WHERE locktype = 'advisory' AND objsubid = 1
   AND classid = 'environment'::regclass
   AND database = (SELECT oid FROM pg_database WHERE datname = current_database())"""
NOW = f"""
SELECT ({HELD}), array_agg(first_key ORDER BY number),
       (SELECT coalesce(array_agg(version), '{{}}')
          FROM live WHERE id = ANY (%s) AND version = ANY (%s))
  FROM shard"""
LOCK = "SELECT revision FROM environment WHERE id = 1 FOR UPDATE"
WRITTEN = "SELECT id, version, ranges FROM written"
LIVE = "SELECT id, coalesce(version, -1), revision FROM live"
FORGET = "DELETE FROM written WHERE (id, version) = (%s, %s)"
MARK = "UPDATE mark SET swept = %s WHERE swept < %s"
MOST_WAITING = 1000
"""Versions that a writer remembers to sweep after later writes. A larger value leaves less to
`sweep` after a long snapshot; each takes some hundred bytes."""
AT_ONCE = 8
"""Versions that are swept after one write at most. A larger value catches up sooner, but delays the
writer longer."""
PAUSE_S = 5.0
"""Seconds without sweeps after writes when a shard could not be swept. A larger value delays
writers less often while a shard is away."""
CONNECT_S = 2.0
"""Seconds that a writer waits for a new connection of a shard that is to be swept. A larger value
bears slower servers, but delays writers while one hangs."""
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


class SweptVersions(NamedTuple):
    """Result of a sweep: versions of objects whose rows were deleted, and those left for later."""

    versions: int
    kept: int


class Sweeper:
    """Sweeps the shards of one environment."""

    def __init__(self, connection: ServerConnection, shards: Shards, layout: Layout) -> None:
        self._connection = connection
        self._shards = shards
        self._shift = row_shift(layout)
        self._tables = TABLES[layout]
        self._waiting: deque[Left] = deque(maxlen=MOST_WAITING)
        self._paused_until = 0.0

    def sweep_after_write(self, left: Left) -> None:
        """Sweep what a committed write has replaced. What cannot be swept now is swept later."""
        self._waiting.append(left)
        if time.monotonic() < self._paused_until:
            return
        try:
            due, borders = self._due()
            firsts = np.array(borders, dtype=np.int64) >> self._shift
            for one in due:
                ends = np.array(one.ranges, dtype=np.int64).reshape(-1, 2) >> self._shift
                some = [p.shard for p in pieces_of_ranges(firsts, ends[:, 0], ends[:, 1])]
                self._shards.each(partial(self._delete, one), some)
                self._waiting.remove(one)
        except DatabaseError:  # a shard is away, or busy
            self._paused_until = time.monotonic() + PAUSE_S

    def _due(self) -> tuple[list[Left], list[int]]:
        """Versions to sweep now, and the borders."""
        asked = [left.object_id for left in self._waiting], [left.version for left in self._waiting]
        ((oldest, borders, live),) = self._connection.rows(NOW, asked)
        for left in [left for left in self._waiting if left.version in live]:
            self._waiting.remove(left)  # of a write that was not committed
        due = [left for left in self._waiting if oldest is None or left.died <= oldest]
        return due[:AT_ONCE], borders

    def sweep(self) -> SweptVersions:
        """Sweep all shards. Waits for the write that is under way; then writers go on.

        Raises
        ------
        ShardAwayError
            When a shard cannot be reached; the others are swept all the same.
        """
        errors: list[BaseException] = []
        # before the lock: of the rows listed here none will become live after it was taken
        listed = self._outcomes(lambda _, shard: shard.rows(WRITTEN), None, errors)
        live: dict[int, tuple[int, int]] = {}
        oldest = 0

        def look() -> None:
            nonlocal oldest
            ((revision,),) = self._connection.execute(LOCK).fetchall()
            ((held,),) = self._connection.execute(HELD).fetchall()
            oldest = revision if held is None else min(held, revision)
            live.clear()
            live.update({i: (v, r) for i, v, r in self._connection.execute(LIVE).fetchall()})

        self._connection.write(look)
        found = {
            at: [left for row in rows if (left := _dead(row, live))] for at, rows in listed.items()
        }
        chosen = {at: [left for left in some if left.died <= oldest] for at, some in found.items()}

        def delete(at: int, shard: ShardConnection) -> None:
            for left in chosen[at]:
                self._delete(left, at, shard)

        self._outcomes(delete, [at for at, lefts in chosen.items() if lefts], errors)
        if errors:
            raise errors[0]
        swept = {left[:2] for lefts in chosen.values() for left in lefts}
        kept = {left[:2] for lefts in found.values() for left in lefts} - swept
        return SweptVersions(len(swept), len(kept))

    def _outcomes(
        self,
        work: Callable[[int, ShardConnection], Result],
        some: Sequence[int] | None,
        errors: list[BaseException],
    ) -> dict[int, Result]:
        """Results of `work` by shard; errors of the others are added to `errors`."""
        chosen = list(range(len(self._shards)) if some is None else some)
        if not chosen:
            return {}
        results: dict[int, Result] = {}
        for at, done in zip(chosen, self._shards.outcomes(work, chosen), strict=True):
            if (error := done.exception()) is None:
                results[at] = done.result()
            else:
                errors.append(error)
        return results

    def _delete(self, left: Left, _: int, shard: ShardConnection) -> None:
        """Delete the rows of one version from one shard."""
        if shard.driver.closed:
            shard.connect(CONNECT_S)  # once: a writer does not wait for a shard that is away
        with failures.named_errors(shard.shown):
            # committed before: the deletes may take long, and writers wait for the row of `mark`
            shard.execute(MARK, (left.died, left.died))
        ends = np.array(left.ranges, dtype=np.int64).reshape(-1, 2) >> self._shift
        which = wire.int8(left.object_id), wire.int8(left.version)

        def work() -> None:
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

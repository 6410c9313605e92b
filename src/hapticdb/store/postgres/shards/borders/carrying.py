"""One batch of rows, copied from one shard to another; its border moves afterwards.

The shard that gets the rows may hold older copies of them, which an earlier, interrupted batch has
left. They are deleted in the same transaction.
"""

import contextlib
from collections.abc import Generator
from typing import NamedTuple

from hapticdb.errors import BusyError
from hapticdb.store.base import Layout, Table
from hapticdb.store.postgres.connecting import failures
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.shards.borders.moves import Move
from hapticdb.store.postgres.shards.connecting.links import ShardConnection
from hapticdb.store.postgres.shards.schemas import COLUMNS, KEY
from hapticdb.store.postgres.tables.loading import TABLES

BATCH_ROWS: dict[Table, int] = {"voxel": 1 << 17, "brick": 1 << 15, "band": 1 << 13}
"""Rows of each table that move at once, a few megabytes; writers wait so long. A larger value is
quicker as a whole."""
# a rebalance that others have overtaken changes nothing any more (`rebalancing`)
TAKE_MARK = """
UPDATE mark SET writes = writes + 1, rebalance = %s
 WHERE rebalance <= %s RETURNING writes"""
NOTE_MOVED = "UPDATE mark SET moved = greatest(moved, %s)"
IN_RANGE = "z_val >= %s AND z_val < %s"
KNOWN = "SELECT id, version FROM written JOIN unnest(%s::bigint[], %s::bigint[]) AS w(id, version)"
KNOWN += " USING (id, version)"
LISTED = KNOWN.replace("version FROM", "version, ranges FROM")
LIST = "INSERT INTO written VALUES (%s, %s, %s) ON CONFLICT DO NOTHING"
Range = tuple[int, int]


class Carried(NamedTuple):
    """What a batch has copied.

    writes : of the shard that got the rows; rows : of the index table, in all versions; bytes : of
    all tables, as COPY sends them.
    """

    writes: int
    rows: int
    bytes: int


class Carrier:
    """Copies rows between shards of one environment.

    number : of the rebalance that it works for; row_shift : bits of a voxel's key below a row's.
    """

    def __init__(self, layout: Layout, row_shift: int, number: int) -> None:
        self._tables = TABLES[layout]
        self._shift = row_shift
        self._number = number

    def rows_of(self, move: Move) -> Range:
        """First row key of a move, and the first one behind it."""
        return move.low >> self._shift, move.high >> self._shift

    def end_of_batch(self, source: ServerConnection, move: Move) -> int | None:
        """Voxel key where a batch of that move ends; None if the rest of the move is one batch."""
        ends = []
        order = "DESC" if move.is_from_top else "ASC"
        for table in self._tables:
            found = source.rows(
                f"SELECT z_val FROM {table} WHERE {IN_RANGE}"
                f" ORDER BY z_val {order} OFFSET %s LIMIT 1",
                (*self.rows_of(move), BATCH_ROWS[table]),
            )
            ends += [int(row[0]) << self._shift for row in found]
        if not ends:
            return None
        return max(ends) if move.is_from_top else min(ends)

    def carry(
        self, source: ShardConnection, target: ShardConnection, move: Move, epoch: int
    ) -> Carried:
        """Copy all rows of a move in one transaction of the shard that gets them.

        epoch : the present one, in which the other shard still owns the rows.

        Raises
        ------
        BusyError
            When a later rebalance has begun.
        """
        rows = self.rows_of(move)

        def work() -> Carried:
            found = target.execute(TAKE_MARK, (self._number, self._number)).fetchall()
            if not found:
                raise overtaken(target.shown)
            texts = [f"DELETE FROM {table} WHERE {IN_RANGE}" for table in self._tables]
            if sum(target.execute(text, rows).rowcount for text in texts):
                # a snapshot of the time when they were this shard's may still want them
                target.execute(NOTE_MOVED, (epoch,))
            with source.without_limit(), source.snapshot():
                self._list(source, target, rows)
                copied = [_copied(source, target, table, rows) for table in self._tables]
            return Carried(int(found[0][0]), copied[0][0], sum(one[1] for one in copied))

        # done twice, it finds the rows of the first time and exchanges them
        return target.write(work)

    def _list(self, source: ServerConnection, target: ServerConnection, rows: Range) -> None:
        """List the versions of the rows at their new shard, too, so that they are swept there."""
        texts = [f"SELECT id, version FROM {table} WHERE {IN_RANGE}" for table in self._tables]
        there = source.rows(" UNION ".join(texts), rows * len(texts))
        known = set(target.execute(KNOWN, _columns(there)).fetchall())
        missing = [one for one in there if one not in known]
        for listed in source.rows(LISTED, _columns(missing)) if missing else []:
            target.execute(LIST, listed)


def _columns(pairs: list[tuple[int, ...]]) -> tuple[list[int], list[int]]:
    return [pair[0] for pair in pairs], [pair[1] for pair in pairs]


def _copied(
    source: ServerConnection, target: ServerConnection, table: Table, rows: Range
) -> tuple[int, int]:
    """Copy the rows of one table; returns how many, and how many bytes."""
    n_bytes = 0
    columns = COLUMNS[table]
    cursor = target.driver.cursor()
    sent = contextlib.closing(_sent(source, table, rows))
    with sent as pieces, cursor.copy(f"COPY {table} ({columns}) FROM STDIN (FORMAT binary)") as to:
        for piece in pieces:
            to.write(piece)
            n_bytes += len(piece)
    return cursor.rowcount, n_bytes


def _sent(source: ServerConnection, table: Table, rows: Range) -> Generator[bytes, None, None]:
    """Rows of a table in the form of COPY, in pieces; errors name the server that sends them."""
    chosen = f"SELECT {COLUMNS[table]} FROM {table} WHERE {IN_RANGE} ORDER BY {KEY}"
    text = f"COPY ({chosen}) TO STDOUT (FORMAT binary)"
    with failures.named_errors(source.shown), source.driver.cursor().copy(text, rows) as sending:
        for piece in sending:
            yield bytes(piece)


def overtaken(shown: str) -> BusyError:
    """Build the error of a rebalance after which another one has begun."""
    return BusyError(f"{shown}: another rebalance has begun meanwhile, and goes on from here")

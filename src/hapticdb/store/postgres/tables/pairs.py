"""The table `pair` on a server."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from hapticdb.store import parsing
from hapticdb.store.pairs import ALL, MARK, PUT, Ids, KeptPairs, Mark, MaybeMark, PairRow
from hapticdb.store.postgres.connecting.connection import Result, ServerConnection
from hapticdb.store.postgres.tables.reading import PostgresReader
from hapticdb.store.refusals import older_format

TYPES = (
    "bigint[]", "bigint[]", "text[]", *["double precision[]"] * 8, "text[]", "bigint[]", "text[]",
)  # fmt: skip
PUT_ALL = PUT.format(values=f"SELECT * FROM unnest({', '.join(f'%s::{kind}' for kind in TYPES)})")
HELD = "SELECT setting, revision FROM pair WHERE (a, b) = (%s, %s)"
DELETE = """
DELETE FROM pair USING unnest(%s::bigint[], %s::bigint[]) AS gone (a, b)
 WHERE (pair.a, pair.b) = (gone.a, gone.b)"""


class PostgresPairs:
    """Pairs of one environment."""

    def __init__(self, connection: ServerConnection, reader: PostgresReader) -> None:
        self._connection, self._reader = connection, reader

    def pairs(self) -> KeptPairs:
        """All rows, and the mark, in one statement."""
        found: list[tuple[Any, ...]] = []
        if self._reader.has_table(parsing.PAIR):
            found = self._connection.rows(ALL, binary=True)
        return KeptPairs(found, partial(parsing.pair_of, self._connection.shown))

    def put_pairs(
        self, rows: Sequence[PairRow], gone: Ids = (), was: MaybeMark = None, now: MaybeMark = None
    ) -> MaybeMark:
        """Delete rows, write others unless a later revision's are there, and set the mark."""
        deleted = [list(column) for column in zip(*gone, MARK, strict=True)]

        def work() -> MaybeMark:
            # one writer at a time, so that no two wait for one another's rows
            self._connection.execute("SELECT 1 FROM environment WHERE id = 1 FOR UPDATE")
            held = self._connection.execute(HELD, MARK).fetchall()
            mark, row = Mark.after(held, was, now)
            put = [list(column) for column in zip(*(x.columns for x in (*rows, row)), strict=True)]
            self._connection.execute(DELETE, deleted)
            self._connection.execute(PUT_ALL, put)
            return mark

        return self._write(work)

    def accept_pair(self, a: int, b: int, because: str | None, shapes: str | None) -> None:
        """Note why a pair is accepted, and the shapes of both."""
        self._write(
            lambda: self._connection.execute(
                "UPDATE pair SET because = %s, shapes = %s WHERE (a, b) = (%s, %s)",
                (because, shapes, a, b),
            )
        )

    def _write(self, work: Callable[[], Result]) -> Result:
        if not self._reader.has_table(parsing.PAIR):
            raise older_format(self._connection.shown)
        return self._connection.write(work)

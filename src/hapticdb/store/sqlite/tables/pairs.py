"""The table `pair` in a file."""

from collections.abc import Sequence
from functools import partial

from hapticdb.store import parsing
from hapticdb.store.pairs import ALL, MARK, PUT, Ids, KeptPairs, Mark, MaybeMark, PairRow
from hapticdb.store.sqlite.connection import FileConnection
from hapticdb.store.sqlite.tables.reading import SQLiteReader

PUT_EACH = PUT.format(values=f"VALUES ({', '.join('?' * 14)})")
HELD = "SELECT setting, revision FROM pair WHERE (a, b) = (?, ?)"
DELETE = "DELETE FROM pair WHERE (a, b) = (?, ?)"


class SQLitePairs:
    """Pairs of one environment."""

    def __init__(self, connection: FileConnection, reader: SQLiteReader) -> None:
        self._connection, self._reader = connection, reader

    def pairs(self) -> KeptPairs:
        """All rows, and the mark, in one statement."""
        found = []
        if self._reader.has_table(parsing.PAIR):
            found = self._connection.fetch(ALL)
        return KeptPairs(found, partial(parsing.pair_of, self._connection.url))

    def put_pairs(
        self, rows: Sequence[PairRow], gone: Ids = (), was: MaybeMark = None, now: MaybeMark = None
    ) -> MaybeMark:
        """Delete rows, write others unless a later revision's are there, and set the mark."""
        with self._connection.writing():
            held = self._connection.fetch(HELD, MARK)
            mark, row = Mark.after(held, was, now)
            self._connection.driver.executemany(DELETE, [*gone, MARK])
            self._connection.driver.executemany(PUT_EACH, [one.columns for one in (*rows, row)])
        return mark

    def accept_pair(self, a: int, b: int, because: str | None, shapes: str | None) -> None:
        """Note why a pair is accepted, and the shapes of both."""
        with self._connection.writing():
            self._connection.execute(
                "UPDATE pair SET because = ?, shapes = ? WHERE (a, b) = (?, ?)",
                (because, shapes, a, b),
            )

"""The table `pair` in a file."""

from collections.abc import Sequence

from hapticdb.store import parsing
from hapticdb.store.pairs import COLUMNS, UNLESS_LATER, PairRow
from hapticdb.store.sqlite.connection import FileConnection
from hapticdb.store.sqlite.tables.reading import SQLiteReader

PUT = f"""
INSERT INTO pair ({COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)
{UNLESS_LATER}"""


class SQLitePairs:
    """Pairs of one environment."""

    def __init__(self, connection: FileConnection, reader: SQLiteReader) -> None:
        self._connection, self._reader = connection, reader

    def pairs(self) -> list[PairRow]:
        """All rows, ordered by a and b."""
        if not self._reader.has_table(parsing.PAIR):
            return []
        found = self._connection.fetch(f"SELECT {COLUMNS}, because, shapes FROM pair ORDER BY a, b")
        return [parsing.pair_of(self._connection.url, row) for row in found]

    def put_pairs(self, rows: Sequence[PairRow], gone: Sequence[tuple[int, int]] = ()) -> None:
        """Write rows, unless a later revision's are there, and delete others."""
        with self._connection.writing():
            self._connection.driver.executemany(PUT, [row.columns for row in rows])
            self._connection.driver.executemany("DELETE FROM pair WHERE (a, b) = (?, ?)", gone)

    def accept_pair(self, a: int, b: int, because: str | None, shapes: str | None) -> None:
        """Note why a pair is accepted, and the shapes of both."""
        with self._connection.writing():
            self._connection.execute(
                "UPDATE pair SET because = ?, shapes = ? WHERE (a, b) = (?, ?)",
                (because, shapes, a, b),
            )

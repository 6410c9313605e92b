"""The table `pair` on a server."""

from collections.abc import Callable, Sequence

from hapticdb.store import parsing
from hapticdb.store.pairs import COLUMNS, UNLESS_LATER, PairRow
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.tables.reading import PostgresReader
from hapticdb.store.refusals import older_format

TYPES = (
    "bigint[]", "bigint[]", "text[]", *["double precision[]"] * 8, "text[]", "bigint[]", "text[]",
)  # fmt: skip
PUT = f"""
INSERT INTO pair ({COLUMNS})
SELECT * FROM unnest({", ".join(f"%s::{kind}" for kind in TYPES)})
{UNLESS_LATER}"""
DELETE = """
DELETE FROM pair USING unnest(%s::bigint[], %s::bigint[]) AS gone (a, b)
 WHERE (pair.a, pair.b) = (gone.a, gone.b)"""


class PostgresPairs:
    """Pairs of one environment."""

    def __init__(self, connection: ServerConnection, reader: PostgresReader) -> None:
        self._connection, self._reader = connection, reader

    def pairs(self) -> list[PairRow]:
        """All rows, ordered by a and b."""
        if not self._reader.has_table(parsing.PAIR):
            return []
        found = self._connection.rows(f"SELECT {COLUMNS}, because, shapes FROM pair ORDER BY a, b")
        return [parsing.pair_of(self._connection.shown, row) for row in found]

    def put_pairs(self, rows: Sequence[PairRow], gone: Sequence[tuple[int, int]] = ()) -> None:
        """Write rows, unless a later revision's are there, and delete others."""
        put = [list(column) for column in zip(*(row.columns for row in sorted(rows)), strict=True)]
        deleted = [list(column) for column in zip(*sorted(gone), strict=True)]

        def work() -> None:
            # one writer at a time, so that no two wait for one another's rows
            self._connection.execute("SELECT 1 FROM environment WHERE id = 1 FOR UPDATE")
            if put:
                self._connection.execute(PUT, put)
            if deleted:
                self._connection.execute(DELETE, deleted)

        self._write(work)

    def accept_pair(self, a: int, b: int, because: str | None, shapes: str | None) -> None:
        """Note why a pair is accepted, and the shapes of both."""
        self._write(
            lambda: self._connection.execute(
                "UPDATE pair SET because = %s, shapes = %s WHERE (a, b) = (%s, %s)",
                (because, shapes, a, b),
            )
        )

    def _write(self, work: Callable[[], object]) -> None:
        if not self._reader.has_table(parsing.PAIR):
            raise older_format(self._connection.shown)
        self._connection.write(work)

"""How the statements of `hapticdb.store.tables` run on a server."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from numpy.typing import NDArray
from psycopg import errors

from hapticdb.store.postgres import schema_of
from hapticdb.store.postgres.connecting import failures
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.tables import Tables

Result = TypeVar("Result")

WRITE_LOCK = "SELECT 1 FROM environment WHERE id = 1 FOR UPDATE"
# writers take revisions one after the other, and no reader waits for this lock
NEXT_REVISION = "UPDATE environment SET revision = revision + 1 WHERE id = 1 RETURNING revision"


class ServerTables(Tables):
    """The tables on a server. They remember the revision that the last read has seen."""

    HAS_TABLE = "SELECT 1 WHERE to_regclass(%s) IS NOT NULL"
    AMONG = "id = ANY (ARRAY(SELECT json_array_elements_text(%s::json)::bigint))"
    AS_TEXT = "::text"
    TAKEN = errors.UniqueViolation
    _connection: ServerConnection

    def __init__(self, connection: ServerConnection) -> None:
        super().__init__(connection)
        self.url = connection.shown
        made = schema_of.read_environment(connection)
        self.grid, self.layout, self.wants_distances, self.identity, self._is_spread = made
        self._seen = -1

    def _rows(
        self, text: str, parameters: Sequence[Any] = (), *, binary: bool = False
    ) -> list[Any]:
        return self._connection.rows(text, parameters, binary=binary)

    def _do(self, text: str, parameters: Sequence[Any] = ()) -> list[Any]:
        cursor = self._connection.execute(text, parameters)
        return cursor.fetchall() if cursor.description else []

    def _save(self, text: str, parameters: Sequence[Any] = ()) -> None:
        self._connection.write(lambda: self._do(text, parameters))

    def _alone(self, work: Callable[[], Result]) -> Result:
        def locked() -> Result:
            self._do(WRITE_LOCK)
            return work()

        return self._connection.write(locked)

    def _next_revision(self) -> int:
        return int(self._do(NEXT_REVISION)[0][0])

    def _packed(self, values: NDArray[Any]) -> list[Any]:
        return values.reshape(-1).tolist()

    def version(self) -> int:
        """The revision that the last read has seen."""
        return self._seen

    def revision(self) -> int:
        """Number of the last committed write; 0 for an empty environment."""
        text = "SELECT revision, tableoid::bigint FROM environment WHERE id = 1"
        ((self._seen, identity),) = self._rows(text)
        if identity != self.identity:
            raise failures.remade(self.url)
        return self._seen

"""How the statements of `hapticdb.store.tables` run on a file."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import apsw
import numpy as np
from numpy.typing import NDArray

from hapticdb.grid import Grid
from hapticdb.store import parsing
from hapticdb.store.base import Layout
from hapticdb.store.sqlite.connection import FileConnection
from hapticdb.store.sqlite.tables import rows as sqlite_rows
from hapticdb.store.tables import LAST_REVISION, Tables

Result = TypeVar("Result")


def read_environment(connection: FileConnection) -> tuple[Grid, Layout, bool]:
    """Grid and layout of an environment, and whether it wants distances, all checked."""
    kinds = dict(connection.fetch(sqlite_rows.KINDS))
    parsing.check_tables(connection.url, kinds)
    # a reader may have opened a file of an older format
    wish = "wants_distances" if parsing.BAND in kinds else "0"
    rows = connection.fetch(
        "SELECT voxel_size, origin_x, origin_y, origin_z, bits, curve, layout, "
        f"{wish} FROM environment"
    )
    grid, layout = parsing.grid_of(connection.url, rows)
    return grid, layout, parsing.wish_of(connection.url, rows[0][7])


class FileTables(Tables):
    """The tables in a file."""

    HAS_TABLE = "SELECT 1 FROM sqlite_master WHERE name = %s AND type = 'table'"
    AMONG = "id IN (SELECT value FROM json_each(%s))"
    AS_TEXT = ""
    TAKEN = apsw.ConstraintError
    _connection: FileConnection

    def __init__(self, connection: FileConnection) -> None:
        super().__init__(connection)
        self.url = connection.url
        self.grid, self.layout, self.wants_distances = read_environment(connection)

    def _rows(
        self,
        text: str,
        parameters: Sequence[Any] = (),
        *,
        binary: bool = False,  # noqa: ARG002 - a file gives values in one way
    ) -> list[Any]:
        self._connection.file.check()
        return self._connection.fetch(text.replace("%s", "?"), parameters)

    def _do(self, text: str, parameters: Sequence[Any] = ()) -> list[Any]:
        return self._connection.driver.execute(text.replace("%s", "?"), parameters).fetchall()

    def _save(self, text: str, parameters: Sequence[Any] = ()) -> None:
        self._commit(lambda: self._do(text, parameters))

    def _commit(self, work: Callable[[], Result]) -> Result:
        with self._connection.writing():
            return work()

    _alone = _commit

    def _next_revision(self) -> int:
        return self.revision() + 1

    def _new_id(self, revision: int) -> None:
        """None: the table gives one that no object ever had."""

    def _packed(self, values: NDArray[Any]) -> bytes:
        return np.ascontiguousarray(values, values.dtype.newbyteorder("<")).tobytes()

    def _note(self, change: tuple[Any, ...]) -> None:
        self._do("INSERT INTO change VALUES (?, ?, ?, ?)", change)

    def revision(self) -> int:
        """Number of the last committed write; 0 for an empty environment."""
        return parsing.number_of(
            self.url, self._rows(f"SELECT {LAST_REVISION}")[0][0], "the revision"
        )

"""Which shards were away while cells were fetched, and for how long: counted on a table's desk."""

from typing import NamedTuple

import numpy as np

from hapticdb.kernels.records import MOST_SHARDS_AWAY, SHARD_NAME_BYTES
from hapticdb.resident.table import CellTable


class ShardOutage(NamedTuple):
    """A shard that was away while cells were fetched.

    name : as "shard 2 (server2)"; seconds : that it was away so far; times : how often it went
    away; is_away : whether it is away now.
    """

    name: str
    seconds: float
    times: int
    is_away: bool


def outages_of(table: CellTable) -> tuple[ShardOutage, ...]:
    """Shards that were away, in the order in which they first went."""
    return tuple(
        ShardOutage(
            bytes(row["name"]).decode("utf-8", "ignore"),
            float(row["seconds"]),
            int(row["times"]),
            bool(row["is_away"]),
        )
        for row in table.desk.figures["shards"]
        if row["times"]
    )


class OutageCounter:
    """Counts on the desk of a table how long which shards are away; the only writer of that.

    A process that fills the table after another one continues the counts.

    Parameters
    ----------
    table : CellTable
        The table whose desk tells of it.

    Attributes
    ----------
    names : tuple of str
        The shards that are away now.
    """

    def __init__(self, table: CellTable) -> None:
        self._shards = table.desk.figures["shards"]
        self._shards["is_away"] = False
        self.names: tuple[str, ...] = ()

    def count(self, names: tuple[str, ...], elapsed: float) -> bool:
        """Count the seconds since the last call; returns whether other shards are away than then.

        names : of the shards that are away now.
        """
        if names == self.names == ():
            return False
        self._shards["seconds"] += np.where(self._shards["is_away"], elapsed, 0.0)
        if names == self.names:
            return False
        for name in names:
            if name not in self.names:
                self._begin(name)
        packed = np.array([_packed(name) for name in names], dtype=self._shards["name"].dtype)
        self._shards["is_away"] = np.isin(self._shards["name"], packed)
        self.names = names
        return True

    def stop(self) -> None:
        """Count no shard as away: the connection that knew of them is lost."""
        self._shards["is_away"] = False
        self.names = ()

    def _begin(self, name: str) -> None:
        """Count that a shard went away, in its row or a new one; does nothing without a row."""
        packed = _packed(name)
        for row in range(MOST_SHARDS_AWAY):
            if not self._shards["times"][row]:
                self._shards["name"][row] = packed
            if self._shards["name"][row] == packed:
                self._shards["times"][row] += 1
                return


def _packed(name: str) -> bytes:
    return name.encode()[:SHARD_NAME_BYTES]

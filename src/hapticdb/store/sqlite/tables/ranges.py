"""Key ranges as parameters of SQLite: one prepared statement for any number of ranges.

One integer packs the lower end and the width of a range if it has room, as in every frame on a grid
of 11 bits. Otherwise the SQL function `nth` returns the upper ends (docs/decisions/0004).
"""

from typing import Any, cast

import apsw
import numpy as np

from hapticdb.store.base import Columns, Keys, Layout, row_shift
from hapticdb.store.tables import HELD, TABLES

KEY_BITS = 63
"""Value bits of a non-negative int64."""

LISTS: dict[Columns, str] = {
    "voxel": "z_val, id",
    "brick": "z_val, id, occupancy",
    "distances": "z_val, id, occupancy, distances",
}
# SQLite never reorders a CROSS JOIN, so the rows are in the order of the given keys
NARROW: dict[Columns, str] = {
    columns: f"""
  FROM carray(?1) AS range CROSS JOIN {table}
 WHERE z_val BETWEEN range.value >> ?2 AND (range.value >> ?2) + (range.value & ?3)"""
    for columns, table in TABLES.items()
}
WIDE: dict[Columns, str] = {
    columns: f"""
  FROM carray(?1) AS low CROSS JOIN {table}
 WHERE z_val BETWEEN low.value AND nth(?2, low.rowid, ?3)"""
    for columns, table in TABLES.items()
}


class RangeStatements:
    """Statements of ranges on one environment, with the values of their first three parameters."""

    def __init__(self, connection: apsw.Connection, layout: Layout, bits: int) -> None:
        # the bits free in a row key contain the width of a range
        self._width_bits = KEY_BITS - max(3 * bits - row_shift(layout), 1)
        self._mask = (1 << self._width_bits) - 1
        self._key_end = 1 << (KEY_BITS - self._width_bits)
        self._layout = layout
        connection.create_scalar_function("nth", cast("Any", _nth), 3, deterministic=True)

    def scan(self, columns: Columns, lows: Keys, highs: Keys) -> tuple[str, tuple[Any, ...]]:
        """Rows with a key in closed ranges, ascending and disjoint, at least one."""
        source, bindings = self._source(columns, lows, highs)
        return f"SELECT {LISTS[columns]}{source} AND {HELD[columns]}", bindings

    def count(self, lows: Keys, highs: Keys) -> tuple[str, tuple[Any, ...]]:
        """Count the rows of the index table in the ranges."""
        source, bindings = self._source(self._layout, lows, highs)
        return f"SELECT count(*){source}", bindings

    def _source(self, columns: Columns, lows: Keys, highs: Keys) -> tuple[str, tuple[Any, ...]]:
        widths = highs - lows
        # ascending, so the first and the last bound all; keys outside the grid have no room
        is_narrow = (
            int(widths.max()) <= self._mask and int(lows[-1]) < self._key_end and int(lows[0]) >= 0
        )
        if is_narrow:
            # one carray for both ends: otherwise `nth` is called for each range
            packed = apsw.carray((lows << self._width_bits) | widths)
            return NARROW[columns], (packed, self._width_bits, self._mask)
        ends = apsw.pyobject(highs.tolist())
        return WIDE[columns], (apsw.carray(np.ascontiguousarray(lows)), ends, 0)


def _nth(values: list[Any], ordinal: int, _: int) -> Any:  # noqa: ANN401 - any SQLite value
    """Value of a bound list by ordinal, from 1: the upper end of a range, or a row's bytes."""
    return values[ordinal - 1]

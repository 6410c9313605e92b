"""How ranges of keys reach SQLite: one prepared statement for any number of ranges.

One integer carries the lower end and the width of a range if it has room, as in every frame on a
grid of 11 bits. Otherwise the SQL function `nth` returns the upper ends (docs/decisions/0004).
"""

from typing import Any, cast

import apsw
import numpy as np

from hapticdb.store.base import Keys, Layout, Table, row_shift

KEY_BITS = 63
"""Value bits of a non-negative int64."""

COLUMNS: dict[Table, str] = {
    "voxel": "z_val, id",
    "brick": "z_val, id, occupancy",
    "band": "band.z_val, band.id, occupancy, distances",
}
TABLES: dict[Table, str] = {
    "voxel": "voxel",
    "brick": "brick",
    # the occupancy is NULL if the brick holds no voxel: a coalesce to zeros takes 1 us a row
    "band": "band LEFT JOIN brick ON brick.z_val = band.z_val AND brick.id = band.id",
}
# SQLite never reorders a CROSS JOIN, so the rows keep the order of the keys asked for
NARROW: dict[Table, str] = {
    table: f"""
SELECT {columns}
  FROM carray(?1) AS range CROSS JOIN {TABLES[table]}
 WHERE {table}.z_val BETWEEN range.value >> ?2 AND (range.value >> ?2) + (range.value & ?3)"""
    for table, columns in COLUMNS.items()
}
WIDE: dict[Table, str] = {
    table: f"""
SELECT {columns}
  FROM carray(?1) AS low CROSS JOIN {TABLES[table]}
 WHERE {table}.z_val BETWEEN low.value AND nth(?2, low.rowid, ?3)"""
    for table, columns in COLUMNS.items()
}


class RangeStatements:
    """Statements of ranges on one environment, with the values of their first three parameters."""

    def __init__(self, connection: apsw.Connection, layout: Layout, bits: int) -> None:
        # the bits that a row key leaves free hold the width of a range
        self._width_bits = KEY_BITS - max(3 * bits - row_shift(layout), 1)
        self._mask = (1 << self._width_bits) - 1
        self._key_end = 1 << (KEY_BITS - self._width_bits)
        self._layout = layout
        connection.create_scalar_function("nth", cast("Any", _nth), 3, deterministic=True)

    def scan(self, table: Table, lows: Keys, highs: Keys) -> tuple[str, tuple[Any, ...]]:
        """Rows of a table with a key in closed ranges, ascending and disjoint, at least one."""
        widths = highs - lows
        is_narrow = (
            int(widths.max()) <= self._mask and int(lows[-1]) < self._key_end and int(lows[0]) >= 0
        )
        if is_narrow:
            packed = apsw.carray((lows << self._width_bits) | widths)
            return NARROW[table], (packed, self._width_bits, self._mask)
        return WIDE[table], (apsw.carray(np.ascontiguousarray(lows)), _ends(highs), 0)

    def count(self, lows: Keys, highs: Keys) -> tuple[str, tuple[Any, ...]]:
        """Count the rows of the index table in the ranges."""
        sql, bindings = self.scan(self._layout, lows, highs)
        return f"SELECT count(*) FROM ({sql})", bindings


def _ends(highs: Keys) -> object:
    return apsw.pyobject(highs.tolist())


def _nth(values: list[int], ordinal: int, _: int) -> int:
    """Value of a bound list by ordinal, from 1: the other end of a range."""
    return values[ordinal - 1]

"""Rows and objects converted from and to the values that apsw returns and takes."""

from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticdb.store import parsing
from hapticdb.store.base import (
    BRICK_BYTES,
    NO_OCCUPANCY,
    Band,
    Rows,
    Table,
    no_rows,
)

KINDS = """
SELECT name, CASE WHEN sql LIKE 'CREATE VIRTUAL%' THEN 'virtual table' ELSE type END
  FROM sqlite_master"""
NO_VOXEL = bytes(BRICK_BYTES)
"""Occupancy of a brick that holds no voxel of the object."""


def rows_of(url: str, found: list[Any], table: Table) -> Rows:
    """Rows from the tuples of a statement: the columns `ranges.COLUMNS` of a table."""
    if not found:
        return no_rows(distances=table == "band")
    keys, ids, *more = zip(*found, strict=True)
    count = len(keys)
    bits, distances = b"", None
    try:
        # by Python's own functions: a frame has few rows, and each call of NumPy takes 2 us
        if table == "band":
            lengths = list(map(len, more[1]))
            ends = np.fromiter(accumulate(lengths), np.int64, count)
            distances = Band(np.frombuffer(b"".join(more[1]), np.uint8), ends)
            parsing.check_lengths(url, min(lengths), max(lengths))
            bits = b"".join([NO_VOXEL if brick is None else brick for brick in more[0]])
        elif table == "brick":
            bits = b"".join(more[0])
        occupancy = np.frombuffer(bits, np.uint8) if more else NO_OCCUPANCY
        rows = Rows(
            np.fromiter(keys, np.int64, count), np.fromiter(ids, np.int64, count), occupancy,
            distances,
        )  # fmt: skip
    except (TypeError, ValueError, OverflowError) as error:
        raise parsing.damaged(url, f"a row of another kind: {error}") from error
    if more and len(bits) != BRICK_BYTES * count:
        raise parsing.damaged(url, "a brick of the wrong length")
    return rows


def pairs_of(url: str, found: list[Any]) -> NDArray[np.int64]:
    """Pairs (n, 2) of whole numbers that a statement returned."""
    try:
        return np.array(found, dtype=np.int64).reshape(-1, 2)
    except (TypeError, ValueError, OverflowError) as error:
        raise parsing.damaged(url, f"a row of another kind: {error}") from error

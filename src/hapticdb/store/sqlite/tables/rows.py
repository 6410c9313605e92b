"""Rows and objects converted from and to the values that apsw returns and takes."""

from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticdb.store import parsing
from hapticdb.store.base import (
    BRICK_BYTES,
    NO_DISTANCES,
    NO_OCCUPANCY,
    NO_ROWS,
    Band,
    Rows,
)

KINDS = """
SELECT name, CASE WHEN sql LIKE 'CREATE VIRTUAL%' THEN 'virtual table' ELSE type END
  FROM sqlite_master"""
NO_VOXEL = bytes(BRICK_BYTES)
"""Occupancy of a brick that holds no voxel of the object."""


def rows_of(url: str, found: list[Any], *, has_bricks: bool) -> Rows:
    """Rows from the tuples of a statement: (key, id), or (key, id, occupancy)."""
    if not found:
        return NO_ROWS
    if not has_bricks:
        pairs = pairs_of(url, found)
        return Rows(pairs[:, 0].copy(), pairs[:, 1].copy(), NO_OCCUPANCY)
    keys, ids, bricks = zip(*found, strict=True)
    return _bricks(url, keys, ids, bricks)


def _bricks(
    url: str,
    keys: Sequence[Any],
    ids: Sequence[Any],
    bricks: Sequence[Any],
    distances: Band | None = None,
) -> Rows:
    """Rows from their columns."""
    count = len(keys)
    try:
        joined = b"".join(bricks)
        rows = Rows(
            np.fromiter(keys, np.int64, count),
            np.fromiter(ids, np.int64, count),
            np.frombuffer(joined, np.uint8),
            distances,
        )
    except (TypeError, ValueError, OverflowError) as error:
        raise parsing.damaged(url, f"a row of another kind: {error}") from error
    if len(joined) != BRICK_BYTES * count:
        raise parsing.damaged(url, "a brick of the wrong length")
    return rows


def rows_with_distances(url: str, found: list[Any]) -> Rows:
    """Rows from the tuples (key, id, occupancy or None, distances) of a statement."""
    if not found:
        return NO_DISTANCES
    keys, ids, bricks, packed = zip(*found, strict=True)
    try:
        joined = b"".join(packed)
    except TypeError as error:
        raise parsing.damaged(url, f"distances of another kind: {error}") from error
    # by Python's own functions: a frame has few rows, and each call of NumPy takes 2 us
    lengths = list(map(len, packed))
    parsing.check_lengths(url, min(lengths), max(lengths))
    ends = np.fromiter(accumulate(lengths), np.int64, len(lengths))
    bits = [NO_VOXEL if brick is None else brick for brick in bricks]
    return _bricks(url, keys, ids, bits, Band(np.frombuffer(joined, np.uint8), ends))


def pairs_of(url: str, found: list[Any]) -> NDArray[np.int64]:
    """Pairs (n, 2) of whole numbers that a statement returned."""
    try:
        return np.array(found, dtype=np.int64).reshape(-1, 2)
    except (TypeError, ValueError, OverflowError) as error:
        raise parsing.damaged(url, f"a row of another kind: {error}") from error

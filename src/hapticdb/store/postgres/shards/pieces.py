"""Which shard holds a key: ranges of keys with a border between neighbours.

A shard holds all row keys from its first one up to the first one of the next shard. A shard whose
first key is that of the next holds none.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from hapticdb.grid import Grid
from hapticdb.store.base import CELL_SHIFT, Keys


class Piece(NamedTuple):
    """The part of a question that one shard answers.

    shard : its place among the shards, from 0; lows, highs (n,) int64: closed ranges of row keys,
    ascending and disjoint.
    """

    shard: int
    lows: Keys
    highs: Keys


def pieces_of_ranges(firsts: Keys, lows: Keys, highs: Keys) -> Iterator[Piece]:
    """Cut closed ranges (n,), ascending and disjoint, at the borders; one piece a shard, in order.

    firsts (S,) int64: first row key of each shard, ascending; the first is 0.
    """
    if not len(lows):
        return
    ends = np.append(firsts[1:], np.iinfo(np.int64).max)
    begins = np.searchsorted(highs, firsts, "left")
    stops = np.searchsorted(lows, ends, "left")
    for shard in np.flatnonzero((begins < stops) & (firsts < ends)).tolist():
        some = slice(begins[shard], stops[shard])
        first, last = firsts[shard], ends[shard] - 1
        if lows[some.start] >= first and highs[some.stop - 1] <= last:
            yield Piece(shard, lows[some], highs[some])
        else:
            yield Piece(shard, np.maximum(lows[some], first), np.minimum(highs[some], last))


def pieces_of_keys(firsts: Keys, keys: Keys) -> Iterator[tuple[int, slice]]:
    """Places of ascending keys (n,) that each shard holds: its place from 0, and the slice."""
    stops = np.searchsorted(keys, firsts[1:], "left").tolist()
    at = 0
    for shard, stop in enumerate([*stops, len(keys)]):
        if stop > at:
            yield shard, slice(at, stop)
            at = stop


def even_borders(grid: Grid, count: int) -> Keys:
    """First voxel key (S,) of each of `count` shards that hold equal ranges of the whole grid."""
    cells = 1 << max(3 * grid.bits - CELL_SHIFT, 0)
    return np.array([cells * n // count << CELL_SHIFT for n in range(count)], dtype=np.int64)


def borders_by_rows(bounds: Keys, row_shift: int, count: int) -> Keys:
    """First voxel key (S,) of each of `count` shards that hold equally many rows.

    Parameters
    ----------
    bounds : (R + 1,) int64
        Equi-count histogram of the row keys: the quantile vector of the paper, section 5.
    row_shift : int
        Bits of a voxel's key below a row's.
    count : int
        S, number of shards.

    Notes
    -----
    Borders lie between cells, so a cell is never on two shards. A shard can be empty where one cell
    holds more rows than a shard's share.
    """
    ranks = (len(bounds) - 1) * np.arange(1, count) / count
    cells = bounds[np.round(ranks).astype(np.int64)] << row_shift >> CELL_SHIFT
    return np.concatenate([np.zeros(1, np.int64), cells << CELL_SHIFT])

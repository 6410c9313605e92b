"""Which rows go from which shard to which, so that the borders become the wanted ones.

Borders are first voxel keys (S,) int64 of shards, ascending; the first is 0. Each row goes straight
to the shard that keeps it, whatever shards lie between, and no row goes twice:

1. Borders that move down, the last one first. The shard below gives its highest rows away.
2. Borders that move up, the first one first. The shard above gives its lowest rows away.
"""

from typing import NamedTuple

import numpy as np

from hapticdb.store.base import CELL_SHIFT, Keys

LAST = int(np.iinfo(np.int64).max)


class Move(NamedTuple):
    """A range of voxel keys that goes from one shard to another.

    source, target : places of the shards, from 0; low, high : the range from `low` up to, but
    without, `high`, whole cells; is_from_top : whether the shard gives its highest keys first.
    """

    source: int
    target: int
    low: int
    high: int
    is_from_top: bool


def next_move(borders: Keys, wanted: Keys) -> Move | None:
    """Move that comes next on the way to the wanted borders (S,); None if they are reached.

    Part of it may be done (`borders_after`): the next move is then the rest.
    """
    for n in range(len(borders) - 1, 0, -1):
        if wanted[n] < borders[n]:
            source = int(np.searchsorted(borders, borders[n], "left")) - 1
            low = max(wanted[n], borders[source])
            return Move(source, n, int(low), int(borders[n]), is_from_top=True)
    ends = np.append(borders[1:], LAST)
    for n in range(1, len(borders)):
        if wanted[n] > borders[n]:
            source = int(np.searchsorted(borders, borders[n], "right")) - 1
            high = min(wanted[n], ends[source])
            return Move(source, n - 1, int(borders[n]), int(high), is_from_top=False)
    return None


def part_of(move: Move, key: int | None) -> Move:
    """The part of a move up to the cell that holds a voxel key, with that cell; all if None."""
    if key is None:
        return move
    cell = key >> CELL_SHIFT
    if move.is_from_top:
        return move._replace(low=max(move.low, cell << CELL_SHIFT))
    return move._replace(high=min(move.high, (cell + 1) << CELL_SHIFT))


def borders_after(borders: Keys, move: Move) -> Keys:
    """Borders (S,) when a move, or a part of it that begins at its border, is done."""
    after = borders.copy()
    if move.is_from_top:
        after[move.source + 1 : move.target + 1] = move.low
    else:
        after[move.target + 1 : move.source + 1] = move.high
    return after


def all_moves(borders: Keys, wanted: Keys) -> list[Move]:
    """All moves that lead to the wanted borders (S,), in order."""
    found = []
    while (move := next_move(borders, wanted)) is not None:
        found.append(move)
        borders = borders_after(borders, move)
    return found

"""Rows of stored objects, read by statements of bounded size."""

from collections.abc import Iterator

from hapticdb.ingest.layout import Bricks, bricks_of_rows, merged
from hapticdb.query.grouping import Ranges, object_ranges
from hapticdb.query.quantiles import QuantileVector
from hapticdb.store.base import Object, Rows, Store, joined

MOST_ROWS = 1 << 19
"""Rows of the index that one statement may read, whatever objects they belong to. It takes far less
than a second. A larger value needs fewer statements and more memory."""


def rows_of_object(
    store: Store, obj: Object, quantiles: QuantileVector, *, distances: bool = False
) -> Iterator[Rows]:
    """All rows of an object in batches, ascending by key; one statement reads one batch."""
    ranges = object_ranges(store.grid, store.layout, obj)
    return _batches(store, obj, ranges, quantiles, distances=distances)


def bricks_of_object(
    store: Store, obj: Object, quantiles: QuantileVector, *, distances: bool = False
) -> Bricks:
    """All bricks of an object, whatever its layout and curve."""
    batches = rows_of_object(store, obj, quantiles, distances=distances)
    return bricks_of_batches(store, list(batches), distances=distances)


def bricks_of_batches(store: Store, batches: list[Rows], *, distances: bool) -> Bricks:
    """Bricks of batches of rows of one object, with distances if these were read."""
    if store.layout == "brick":
        return bricks_of_rows(joined(batches, distances=distances), store.grid, "brick")
    return merged([bricks_of_rows(batch, store.grid, "voxel") for batch in batches])


def _batches(
    store: Store, obj: Object, ranges: Ranges, quantiles: QuantileVector, *, distances: bool
) -> Iterator[Rows]:
    lows, highs = ranges
    is_one_key = len(lows) == 1 and lows[0] == highs[0]
    pairs = zip(lows.tolist(), highs.tolist(), strict=True)
    if is_one_key or sum(quantiles.rows_between(low, high) for low, high in pairs) <= MOST_ROWS:
        yield store.rows_of(obj.id, lows, highs, distances=distances)
        return
    half = len(lows) // 2
    if half:
        halves = (lows[:half], highs[:half]), (lows[half:], highs[half:])
    else:
        middle = (lows + highs) // 2
        halves = (lows, middle), (middle + 1, highs)
    for part in halves:
        yield from _batches(store, obj, Ranges(*part), quantiles, distances=distances)

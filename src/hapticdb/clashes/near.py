"""Pairs of objects whose boxes are near one another: never too few."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.curves import Z_ORDER, encode
from hapticdb.store.base import Object

Ints = NDArray[np.int64]
AT_ONCE = 1 << 20
"""Pairs of boxes that are compared together. Larger: more memory."""
BITS = 10
"""Bits an axis of the curve along which pairs are ordered."""


def near_pairs(
    objects: Sequence[Object],
    within: float,
    is_of: NDArray[np.bool_],
    is_against: NDArray[np.bool_],
) -> Ints:
    """Pairs (P, 2) of indices, lesser first, whose boxes are `within` metres, along a curve.

    is_of, is_against (O,) : one object of each pair is of the first, the other of the second.
    """
    boxes = np.array([obj.bounds for obj in objects]).reshape(-1, 2, 3)
    reach = within * (1.0 + 1e-9)
    sweeps = [_sweep(boxes[:, :, axis], reach) for axis in range(3)]
    order, counts = min(sweeps, key=lambda sweep: int(sweep[1].sum()))
    low, high = boxes[order, 0], boxes[order, 1] + reach
    found = [np.empty((0, 2), dtype=np.int64)]
    start = 0
    ends = np.cumsum(counts)
    while start < len(order):
        before = int(ends[start - 1]) if start else 0
        stop = max(int(np.searchsorted(ends, before + AT_ONCE, side="right")), start + 1)
        first = np.repeat(np.arange(start, stop), counts[start:stop])
        after = np.arange(len(first)) - np.repeat(
            ends[start:stop] - counts[start:stop] - before, counts[start:stop]
        )
        second = first + 1 + after
        is_near = ((low[second] <= high[first]) & (low[first] <= high[second])).all(axis=1)
        found.append(np.stack([order[first[is_near]], order[second[is_near]]], axis=1))
        start = stop
    pairs = np.sort(np.concatenate(found), axis=1)
    a, b = pairs[:, 0], pairs[:, 1]
    pairs = pairs[(is_of[a] & is_against[b]) | (is_of[b] & is_against[a])]
    return pairs[_along_curve(boxes, pairs)]


def _sweep(edges: NDArray[np.float64], reach: float) -> tuple[Ints, Ints]:
    """Order of boxes by their lower ends (O, 2), and how many after each begin before it ends."""
    order = np.argsort(edges[:, 0], kind="stable")
    low, high = edges[order, 0], edges[order, 1] + reach
    return order, np.searchsorted(low, high, side="right") - np.arange(1, len(order) + 1)


def _along_curve(boxes: NDArray[np.float64], pairs: Ints) -> Ints:
    """Order of pairs by the places of their first objects, then of their second ones."""
    if not len(pairs):
        return np.empty(0, dtype=np.int64)
    middles = boxes.mean(axis=1)
    low = middles.min(axis=0)
    extent = float((middles - low).max()) or 1.0
    keys = encode(((middles - low) * ((2**BITS - 1) / extent)).astype(np.int64), BITS, Z_ORDER)
    return np.lexsort((pairs[:, 1], keys[pairs[:, 1]], pairs[:, 0], keys[pairs[:, 0]]))

"""Broad phase: pairs of objects with near boxes, never too few."""

import numpy as np

from hapticdb.array_types import Bools, Floats, Ints
from hapticdb.kernels.curves import Z_ORDER, encode

AT_ONCE = 1 << 20
"""Pairs of boxes of a batch. Larger: more memory."""
BITS = 10
"""Bits an axis of the curve for the order of pairs."""
FEW = 1000
"""Boxes to compare with all others. More: slower than to sort all boxes."""


def near_pairs(boxes: Floats, within: float, is_of: Bools, is_against: Bools) -> Ints:
    """Pairs (P, 2) of boxes (O, 2, 3), lesser first, `within` metres, along a curve.

    is_of, is_against (O,) : one object of each pair is of the first, the other of the second.
    """
    reach = within * (1.0 + 1e-9)
    some = np.arange(len(boxes))
    if is_of.sum() <= FEW:
        is_near, high = np.zeros_like(is_of), boxes[:, 1] + reach
        for n in np.flatnonzero(is_of):
            is_near |= _are_near(boxes[:, 0], high, boxes[n, 0], high[n])
        some = np.flatnonzero(is_near)
    pairs = some[_near_pairs(boxes[some], reach)]
    a, b = pairs[:, 0], pairs[:, 1]
    pairs = pairs[(is_of[a] & is_against[b]) | (is_of[b] & is_against[a])]
    return pairs[_along_curve(boxes, pairs)]


def _near_pairs(boxes: Floats, reach: float) -> Ints:
    """Pairs (P, 2), lesser first, of boxes (O, 2, 3) within `reach` metres."""
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
        is_near = _are_near(low[first], high[first], low[second], high[second])
        found.append(np.stack([order[first[is_near]], order[second[is_near]]], axis=1))
        start = stop
    return np.sort(np.concatenate(found), axis=1)


def _are_near(low: Floats, high: Floats, other_low: Floats, other_high: Floats) -> Bools:
    """Whether boxes (N, 3) meet others, or one other (3,)."""
    return np.asarray(((other_low <= high) & (low <= other_high)).all(axis=1))


def _sweep(edges: Floats, reach: float) -> tuple[Ints, Ints]:
    """Order of boxes by their lower ends (O, 2), and the number after each that overlap it."""
    order = np.argsort(edges[:, 0], kind="stable")
    low, high = edges[order, 0], edges[order, 1] + reach
    return order, np.searchsorted(low, high, side="right") - np.arange(1, len(order) + 1)


def _along_curve(boxes: Floats, pairs: Ints) -> Ints:
    """Order of pairs by the places of their first objects, then of their second ones."""
    if not len(pairs):
        return np.empty(0, dtype=np.int64)
    middles = boxes.mean(axis=1)
    low = middles.min(axis=0)
    extent = float((middles - low).max()) or 1.0
    keys = encode(((middles - low) * ((2**BITS - 1) / extent)).astype(np.int64), BITS, Z_ORDER)
    return np.lexsort((pairs[:, 1], keys[pairs[:, 1]], pairs[:, 0], keys[pairs[:, 0]]))

"""Sorting inside kernels, for the few keys of a frame.

numpy's own sorts cost a kernel two seconds of compile time.
"""

import numpy as np

from hapticdb.kernels._jit import leaf, maker


@maker
def sorting_order(keys):
    """Order (U,) that sorts distinct keys (U,) (Shell 1959, with Knuth's gaps).

    A common frame needs a few dozen bricks, and their keys are almost in order.
    """
    count = keys.shape[0]
    order = np.empty(count, dtype=np.int64)
    gap = 1
    while 3 * gap < count:
        gap = 3 * gap + 1
    for n in range(count):
        order[n] = n
    while gap > 0:
        for m in range(gap, count):
            moved, at = order[m], m
            while at >= gap and keys[order[at - gap]] > keys[moved]:
                order[at] = order[at - gap]
                at -= gap
            order[at] = moved
        gap //= 3
    return order


@leaf
def insert_distinct(values, start, count, value):
    """Insert a value into values[start : start + count], ascending; returns the new count.

    A frame touches few objects, each by many rows, so the search from the largest value is short.
    """
    at = start + count
    while at > start and values[at - 1] > value:
        at -= 1
    if at > start and values[at - 1] == value:
        return count
    for n in range(start + count, at, -1):
        values[n] = values[n - 1]
    values[at] = value
    return count + 1

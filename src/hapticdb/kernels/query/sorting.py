"""Sorting inside kernels, for the few keys of a frame.

numpy's own sorts cost a kernel two seconds of compile time.
"""

import numpy as np

from hapticdb.kernels._jit import leaf, maker

SORTED_RUN = np.int64(64)
"""Keys in a run that is sorted by insertion. Larger: slower runs. Smaller: more merging."""


@maker
def sorting_order(keys):
    """Order (U,) that sorts keys (U,): runs sorted by insertion, then merged two by two.

    A common frame asks for a few dozen bricks: one run.
    """
    count = keys.shape[0]
    order = np.empty(count, dtype=np.int64)
    for start in range(0, count, SORTED_RUN):
        for n in range(start, min(start + SORTED_RUN, count)):
            key = keys[n]
            at = n
            while at > start and keys[order[at - 1]] > key:
                order[at] = order[at - 1]
                at -= 1
            order[at] = n
    if count <= SORTED_RUN:
        return order
    merged = np.empty(count, dtype=np.int64)
    width = SORTED_RUN
    while width < count:
        for start in range(0, count, 2 * width):
            left, right = start, min(start + width, count)
            middle, end = right, min(start + 2 * width, count)
            for n in range(start, end):
                if left < middle and (right == end or keys[order[left]] <= keys[order[right]]):
                    merged[n] = order[left]
                    left += 1
                else:
                    merged[n] = order[right]
                    right += 1
        order, merged = merged, order
        width *= 2
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

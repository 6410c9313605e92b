"""Records of a database's frames and searches: grid, cached bricks, cubes of space."""

import numpy as np

from hapticdb.kernels.records.layout import Layout, record

GRID: Layout = record(
    [
        *((name, "<f8") for name in "xyz"),  # origin, m
        ("voxel", "<f8"),  # edge, m; NumPy has a `size` of its own
        ("side", "<f8"),  # voxels on an axis
        ("bits", "<i8"),  # on an axis
        ("curve", "<i8"),  # its code
        ("shift", "<i8"),  # from a voxel's key to its row's: 0, or 9 for bricks
    ]
)
"""Grid of an environment, for a frame on rows."""

DECODED_BYTES = 64 << 20
"""Most bytes of the decoded bricks of an environment's frames. SQLite's page cache is smaller by as
much; PostgreSQL has none in the client. Larger: more of a scene is read only once."""
ENTRIES_A_ROW = 4
"""Most directory entries for each row: half of them stay free, and many bricks are empty."""
BRICK: Layout = record(
    [
        ("key", "<i8"),
        ("first", "<i4"),  # slot of its first row
        ("end", "<i4"),  # slot behind its last row; 0 if the entry is free
        ("least", "<i4"),  # slot of the least distances of rows not excluded, -1 without any
        ("filter", "<i4"),  # number of the filter for `least`
    ]
)
"""Directory entry of a cached brick (`kernels.query.brick_frames`), in a hash table by key."""


def _decoded(n_values: int) -> Layout:
    """Layout of decoded rows with so many distances each; `DECODED_BYTES` limit the slots."""
    row = [("id", "<i8", ()), ("found", "<i8", ()), ("occupancy", "u1", (64,))]
    row += [("counts", "u1", ()), ("touched", "u1", ()), ("distances", "u1", (n_values,))]
    slots = DECODED_BYTES // (np.dtype(row).itemsize + ENTRIES_A_ROW * BRICK.itemsize)
    return record([(name, kind, (slots, *shape)) for name, kind, shape in row])


OCCUPIED, MEASURED = _decoded(1), _decoded(1000)
"""Cached rows without and with distances; slot 0 stays unused.

id, occupancy, distances : of a row, or the least distances of several rows; counts : False for rows
of excluded objects, True for least distances; `found`, touched : scratch of a frame, touched False
between frames.
"""

NEAR_CUBE: Layout = record(
    [
        ("key", "<i8"),  # of the cube of space, -1 for none
        ("bound", "<f8"),  # least distance of occupied voxels from its centre, lower bound, voxels
        ("nearest", "<i8"),  # voxel at that distance, packed; -1: the search ended there
        ("unused", "<i8"),  # padding: no record crosses a cache line
    ]
)
"""Cached distance of a cube of space, one cache a thread (`kernels.resident.nearest_voxels`)."""

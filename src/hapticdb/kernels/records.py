"""Records: the named state that crosses between Python, kernels and processes.

Each layout is a structured NumPy dtype. A kernel takes an array of it without axes, or one axis of
them, and reads ``record = array[()]`` once; from there a field is an offset that the compiler
knows, so it costs what a number in a vector costs. One record with many fields crosses into a
kernel in 0.4 us, and every further array costs 0.2 us (a NamedTuple costs that for each array in
it), so what belongs together is one record.

In Python, ``array["hits"]`` is a view of a field, and ``array[()].hits`` its value. This module
imports numpy alone, so that whoever needs a layout does not load numba.
"""

from collections.abc import Sequence

import numpy as np

Layout = np.dtype[np.void]

MOST_MISSED = 63
"""Unknown cells that a frame names for the fetching process. More are fetched in fewer rounds when
a tool has come far into unknown cells; each costs a comparison for each unknown cell of a frame."""
MOST_ASKED = 64
"""Voxels that a session has objects named for at a time, and objects that are named for them. More
name small objects sooner, and make the statement longer."""
LINE = 64
"""Bytes of a processor's cache line: processes that write to one line slow one another down."""
SESSION_BYTES = 2560
"""Of a session's row on the desk: whole cache lines, and the table's arrays keep their pages."""


def _record(fields: Sequence[tuple[object, ...]]) -> Layout:
    """Layout of those fields, aligned; in plain Python, too, a record has them as attributes."""
    return np.dtype((np.record, np.dtype(list(fields), align=True)))


def _record_in_lines(groups: Sequence[Sequence[tuple[object, ...]]], size: int) -> Layout:
    """Layout of groups of fields, each beginning on a cache line of its own."""
    names, formats, offsets = [], [], []
    start = 0
    for group in groups:
        part = _record(group)
        assert part.names is not None  # noqa: S101 - it was made of names
        for name in part.names:
            names.append(name)
            formats.append(part[name])
            offsets.append(start + part.fields[name][1])  # type: ignore[index]
        start += -(-part.itemsize // LINE) * LINE
    layout = {"names": names, "formats": formats, "offsets": offsets, "itemsize": size}
    return np.dtype((np.record, np.dtype(layout, align=True)))  # type: ignore[call-overload]


TOLD: Layout = _record(
    [
        ("is_active", "?"),  # a loop runs here
        ("tool", "<f8", 3),  # the shell's centre, m
        ("handle", "<f8", 3),  # where the hand wants that centre, m
        ("velocity", "<f8", 3),  # of the handle, m/s
        ("radius", "<f8"),  # of the point farthest from the centre, m
    ]
)
"""What a loop tells the fetching process about its tool."""

SESSION: Layout = _record_in_lines(
    [
        [  # written by the loop
            ("sequence", "<i8"),  # odd while the loop writes `told` and the missed cells
            ("told", TOLD),
            ("n_missed", "<i8"),
            ("missed", "<i8", MOST_MISSED),  # keys of the unknown cells of the last frame
            ("n_asked", "<i8"),
            ("asked", "<i8", MOST_ASKED),  # keys of voxels whose objects the loop asks for
        ],
        [  # written by the loop in every frame
            ("n_frames", "<i8"),  # done so far
        ],
        [  # written by the fetching process
            ("heard", "<i8"),  # the sequence number that it has read
            ("n_missing", "<i8"),  # cells wanted at that number and not there yet
            ("n_objects", "<i8"),
            ("objects", "<i8", MOST_ASKED),  # ids of the objects in the voxels asked for
        ],
        [  # written by the process that began the session
            ("is_asked_to_end", "?"),
        ],
    ],
    SESSION_BYTES,
)
"""A session's row on the desk (`hapticdb.resident.table.Desk`)."""

FIGURES: Layout = _record(
    [
        ("cells", "<i8"),  # fetched so far
        ("rows", "<i8"),  # read for them
        ("ranges", "<i8"),  # scanned for them
        ("batches", "<i8"),  # statements
        ("evicted", "<i8"),  # cells
        ("median_latency", "<f8"),  # s, of the last 32 batches
        ("worst_latency", "<f8"),  # s, of all batches
        ("resident", "<i8"),  # cells in memory now
        ("empty", "<i8"),  # cells known to be empty now
        ("wanted", "<i8"),  # cells wanted, summed over all looks
        ("granted", "<i8"),  # cells of those that were there
        ("losses", "<i8"),  # how often the database was lost
    ]
)
"""What the fetching process counts."""

"""Records of the table of resident cells and of its request queue."""

from hapticdb.kernels.records.layout import Layout, record, record_in_lines

MOST_MISSED = 63
"""Most unknown cells in a frame's list for the prefetch process. Larger: fewer rounds of fetching
for a tool deep in unknown cells, and more comparisons for each unknown cell of a frame."""
MOST_OBJECT_REQUESTS = 64
"""Most voxels in a session's request for object ids, and most ids in the reply. Larger: ids of
small objects arrive sooner, and the statement is longer."""
BUFFERS = 3
"""Directories of a table, published in turn."""

CONTROL: Layout = record_in_lines(
    [
        [
            ("version", "<i8"),  # of the published directory
            ("revisions", "<i8", BUFFERS),  # of the database, for the directory in each buffer
        ],
        [
            ("heartbeat", "<i8"),  # ns, CLOCK_MONOTONIC: the database's last complete answer
            ("is_lost", "<i8"),  # the database does not answer
            ("is_over", "<i8"),  # all processes must end
        ],
    ]
)
"""Control block of a table. Written by the prefetch process, `is_over` by the owner of the table;
read by every frame."""

READER: Layout = record_in_lines(
    [
        [
            ("version", "<i8"),  # of the directory of the frame in progress, 0 for none
            ("revision", "<i8"),  # of the database, for the cells of its last frame
        ]
    ]
)
"""Read lease of a session: written by its loop, read by the prefetch process."""

MISSED: Layout = record([("n_cells", "<i8"), ("cells", "<i8", MOST_MISSED)])
"""Unknown cells of a frame: their number, and their directory keys."""

PREFETCH_REQUEST: Layout = record(
    [
        ("is_active", "?"),  # a loop runs here
        ("tool", "<f8", 3),  # the shell's centre, m
        ("handle", "<f8", 3),  # target of that centre by the hand, m
        ("velocity", "<f8", 3),  # of the handle, m/s
        ("radius", "<f8"),  # of the point farthest from the centre, m
    ]
)
"""Prefetch request of a loop: position and motion of its tool."""

REQUEST_BYTES = 2560
"""Size of a session's row in the request queue: whole cache lines, with spare bytes for new fields
at an unchanged size of the table."""
REQUEST: Layout = record_in_lines(
    [
        [  # written by the loop
            ("sequence", "<i8"),  # odd while the loop writes the next two fields
            ("prefetch", PREFETCH_REQUEST),
            ("missed", MISSED),  # of the last frame
            ("n_asked", "<i8"),
            ("asked", "<i8", MOST_OBJECT_REQUESTS),  # keys of voxels, for the ids of their objects
        ],
        [  # written by the prefetch process
            ("heard", "<i8"),  # last sequence number read
            ("n_missing", "<i8"),  # unknown cells of that request
            ("n_objects", "<i8"),
            ("objects", "<i8", MOST_OBJECT_REQUESTS),  # ids of the objects in the requested voxels
        ],
    ],
    REQUEST_BYTES,
)
"""Row of a session in the request queue (`hapticdb.resident.table.RequestQueue`), a seqlock."""

FIGURES: Layout = record(
    [
        ("loaded", "<i8"),  # cells, so far
        ("rows", "<i8"),  # read for them
        ("ranges", "<i8"),  # scanned for them
        ("statements", "<i8"),  # one a batch
        ("evicted", "<i8"),  # cells
        ("latency", "<f8"),  # s, median of the last 32 batches
        ("worst", "<f8"),  # s, of all batches
        ("resident", "<i8"),  # cells in memory now
        ("empty", "<i8"),  # cells without voxels, now
        ("wanted", "<i8"),  # cells requested, summed over all checks
        ("granted", "<i8"),  # requested cells already in memory
        ("losses", "<i8"),  # of the database
        ("lag", "<f8"),  # s since the commit replayed last by a standby; NaN: none answers
    ]
)
"""Counts and latencies of the prefetch process, with the names of `CacheFigures`."""

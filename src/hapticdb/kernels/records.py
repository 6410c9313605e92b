"""Records: structured dtypes for state shared by Python, kernels and processes.

A kernel takes an array of records of 0 axes or 1 and reads ``record = array[()]`` once. A field is
then a constant offset, as cheap as an element of a vector. Passing one record to a kernel costs 0.4
us, and every further array 0.2 us (a NamedTuple costs that for each of its arrays), so related
numbers form one record.

In Python, ``array["hits"]`` is a view of a field; a loop at 1 kHz makes its views once, with
`views_of`. This module imports numpy alone, so a layout is available without numba.
"""

from collections import namedtuple
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Layout = np.dtype[np.void]

MOST_MISSED = 63
"""Most unknown cells in a frame's list for the fetching process. Larger: fewer rounds of fetching
for a tool deep in unknown cells, and more comparisons for each unknown cell of a frame."""
MOST_ASKED = 64
"""Most voxels in a session's request for object ids, and most ids in the reply. Larger: ids of
small objects arrive sooner, and the statement is longer."""
LINE = 64
"""Bytes of a cache line: writers of the same line slow each other down (false sharing)."""
SESSION_BYTES = 2560
"""Size of a session's row in the request queue: whole cache lines, with spare bytes for new fields
at an unchanged size of the table."""


def _record(fields: Sequence[tuple[object, ...]]) -> Layout:
    """Aligned layout of those fields; records have them as attributes in plain Python, too."""
    return np.dtype((np.record, np.dtype(list(fields), align=True)))


def _record_in_lines(groups: Sequence[Sequence[tuple[object, ...]]], size: int) -> Layout:
    """Layout of groups of fields, each group from a new cache line on."""
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


def views_of(record: NDArray[np.void]) -> Any:  # noqa: ANN401 - its fields are the layout's
    """Views of the fields of a record () by name, nested for nested records.

    A number is a view (): ``views.hits.item()`` reads it, ``views.hits[()] = 1`` writes it.
    """
    names = record.dtype.names or ()
    views = [record[name] for name in names]
    kind = namedtuple("Views", names)  # type: ignore[misc]  # noqa: PYI024 - fields of a layout
    return kind(*(views_of(view) if view.dtype.names else view for view in views))


def pose_numbers(record: NDArray[np.void]) -> NDArray[np.float64]:
    """View (7,) of position and unit quaternion of a record ()."""
    fields = record.dtype.fields
    assert fields is not None  # noqa: S101 - it is a record
    start = fields["position"][1]
    assert fields["quaternion"][1] == start + 24  # noqa: S101 - side by side in every layout
    return np.ndarray((7,), np.float64, record, start)


GRID: Layout = _record(
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
BRICK: Layout = _record(
    [
        ("key", "<i8"),
        ("first", "<i4"),  # slot of its first row
        ("end", "<i4"),  # slot behind its last row; 0 if the entry is free
        ("least", "<i4"),  # slot of the least distances of rows not excluded, -1 without any
        ("filter", "<i4"),  # number of the filter for `least`
    ]
)
"""Directory entry of a cached brick (`kernels.query.bricks`), in a hash table by key."""


def _decoded(n_values: int) -> Layout:
    """Layout of decoded rows with so many distances each; `DECODED_BYTES` limit the slots."""
    row = [("id", "<i8", ()), ("found", "<i8", ()), ("occupancy", "u1", (64,))]
    row += [("counts", "u1", ()), ("touched", "u1", ()), ("distances", "u1", (n_values,))]
    slots = DECODED_BYTES // (np.dtype(row).itemsize + ENTRIES_A_ROW * BRICK.itemsize)
    return _record([(name, kind, (slots, *shape)) for name, kind, shape in row])


OCCUPIED, MEASURED = _decoded(1), _decoded(1000)
"""Cached rows without and with distances; slot 0 stays unused.

id, occupancy, distances : of a row, or the least distances of several rows; counts : False for rows
of excluded objects, True for least distances; `found`, touched : scratch of a frame, touched False
between frames.
"""

RESULTS = 10
"""Length of a frame's result; its indices are in `kernels.resident.cells`."""

HAND: Layout = _record(
    [
        ("position", "<f8", 3),  # m
        ("quaternion", "<f8", 4),  # unit, scalar first
        ("velocity", "<f8", 6),  # of the origin, m/s, then rad/s
        ("is_stale", "?"),  # all cells count as unknown
        ("is_open", "?"),  # the clutch
    ]
)
"""Handle, the target of the tool: its frame in the scene. NaN: no handle yet."""

HANDLE: Layout = _record(
    [
        ("scale", "<f8"),  # m of the scene for a metre of the device
        ("clutch", "<i8"),  # bit of its button, 0 for none
        ("starts_elsewhere", "?"),  # at `start`, not at the hand
        ("start", "<f8", 7),  # position m, unit quaternion
        ("is_placed", "?"),  # there was a reading
        ("x", "<f8"),  # of its last finite position, m
        # from hand to handle: added to the hand's position, applied before the hand's turn
        ("position", "<f8", 3),
        ("quaternion", "<f8", 4),
    ]
)
"""Transform from a device's readings to a handle (`kernels.hand.handle`)."""

READING: Layout = _record([("pose", "<f8", (4, 4)), ("velocity", "<f8", 6), ("buttons", "<i8")])
"""Reading of a device (`hapticdb.devices.protocol.Reading`)."""

TOOL: Layout = _record(
    [
        ("position", "<f8", 3),  # of the tool's frame, m
        ("quaternion", "<f8", 4),  # unit, scalar first
        ("kept", "<f8", 6),  # last unfaded wrench for the hand: N, N m
        ("held_for", "<f8"),  # s since that wrench
        ("risen", "<f8"),  # share of the wrench sent, 0 to 1
        ("version", "<i8"),  # of the cells for `felt`, 0 for none
        ("felt", "<f8", RESULTS),  # frame at this pose, about the centre of mass
        ("pose", "<f8", (4, 4)),
        ("tried_pose", "<f8", (4, 4)),  # of the present query
    ]
)
"""Simulated tool. Initially all fields but position and quaternion are zero."""

SENT: Layout = _record(
    [
        ("wrench", "<f8", 6),  # for the device, about the handle's origin: N, N m
        ("hits", "<i8"),
        ("contacts", "<i8"),
        ("unknown", "<i8"),  # points, at the tried pose
        ("deepest", "<f8"),  # m
        ("n_steps", "<i8"),
        ("marks", "<i8"),  # bits of `kernels.hand.holding`; `flags` is a name of NumPy's
        ("revision", "<i8"),  # of the database
    ]
)
"""Result of a period of the loop."""

SERVO: Layout = _record([("tool", TOOL), ("hand", HAND), ("sent", SENT)])
"""State of a loop between periods."""

MOST_TRAIL = 64
"""Positions of the hand in the quasi-static coupling's history, for its damping. Larger: the same
time span at higher loop rates."""
FOLLOWER: Layout = _record(
    [
        ("looked_at", "<f8", 7),  # pose of the tool for the near points
        ("travelled", "<f8"),  # path length of the farthest point, upper bound, voxels
        ("astray", "<f8"),  # voxels from the tool's pose to that of the last query
        ("clearance", "<f8"),  # least distance of points, lower bound, at the tool's pose, voxels
        ("tried_clearance", "<f8"),  # the same at the pose of the last query
        # the equations of a step (`kernels.hand.step`)
        ("side", "<i8"),  # 0 or 1: half of the rows for the near points at the tool's pose
        ("n_near", "<i8"),  # near points at the tool's pose
        ("n_active", "<i8"),  # points in the contact set of the last step
        ("n_bends", "<i8"),  # rows of curvature in its equations
        ("is_bent", "?"),  # curvature of hollow surfaces is computed
        ("matrix", "<f8", (6, 6)),  # of the step's equations: N/m, N, N m
        ("right", "<f8", 6),  # their right-hand side: N, N m
        ("step", "<f8", 6),  # of the tool's centre: m, rad
        ("pull", "<f8", 6),  # from tool to hand: m, rad
        ("pulls", "<f8", 2),  # stiffnesses along it, lowered at the caps: N/m, N m/rad of the scene
        ("n_tried", "<i8"),  # near points at the pose of the last query, in the other half
        ("n_unknown", "<i8"),  # points in unknown cells there
        ("n_looks", "<i8"),  # queries in this period
        ("is_walking", "?"),  # the pose of the query may be forbidden
        ("is_loose", "?"),  # the tool is inside an object, without contacts yet
        ("is_braked", "?"),  # the last step was shortened: the next one is braked
        ("last_hand", "<f8", 3),  # the handle's position in the last period, m
        ("trail", "<f8", (MOST_TRAIL, 4)),  # ring buffer: time s and position m of the handle
        ("n_trail", "<i8"),  # positions written since the handle was last lost
        ("clock", "<f8"),  # s
        ("share", "<f8"),  # of the stiffness in use, 0 to 1
        ("wanted_share", "<f8"),  # target of `share`, by the guard
        ("reversals", "<f8"),  # of the force, with exponential decay
        ("extreme", "<f8"),  # N, greatest or least force since the last reversal
        ("is_rising", "?"),  # the force, since then
        # of large tools
        ("is_large", "?"),  # set by the caller: a run's sphere is tested before its points
        ("merges_from", "<i8"),  # set by the caller: number of near points to merge at; 0: never
        ("merged", "<i8"),  # points for each contact; 0 counts as 1
        # of queries on a GPU
        ("looker", "<i8"),  # address of the callback of a query; 0: on the CPU
        ("way", "<f8"),  # motion of the farthest point since the last query, voxels
        ("anew", "<i8"),  # reset before the next query: a code of `near_points`
    ]
)
"""State of the quasi-static coupling, in addition to the tool. Initially all zero."""

POINT: Layout = _record(
    [
        ("due", "<f8"),  # path length (`travelled`), voxels, of the point's next query
        ("run_due", "<f8"),  # of point n: the least `due` of run number n
        ("u", "<f8"),  # distance at the tool's pose, voxels; h for a point not near
        ("bound", "<f8"),  # lower bound of it, likewise
        ("onset", "<f8"),  # distance at which its contact begins, voxels
    ]
)
"""State of the coupling for each point of the tool (`kernels.hand.near_points`)."""

NEAR: Layout = _record(
    [
        ("point", "<i8"),  # its number
        ("is_active", "?"),  # it is in the contact set
        ("is_hollow", "?"),  # the surface bends towards it
        ("u", "<f8"),  # distance, voxels
        ("bound", "<f8"),  # lower bound of it, voxels
        ("along", "<f8", 3),  # gradient of the distance
        ("about", "<f8", 3),  # its moment about the tool's centre, m
    ]
)
"""Point near a surface. A step scans all near points, 80 bytes each. With the bends in the same
record, broad contacts take a tenth longer."""
BENDS: Layout = _record(
    [
        ("curvature", "<f8", 2),  # 1/voxel, 0 for none
        ("along", "<f8", (2, 3)),  # unit directions
        ("about", "<f8", (2, 3)),  # their moments about the tool's centre, m
    ]
)
"""Principal curvatures of a hollow surface towards a near point, at most two."""

LOOK: Layout = _record(
    [
        ("number", "<i8"),
        ("epoch", "<i8"),  # older values of points are invalid
        ("run", "<i8"),  # points of a run
        # as in FOLLOWER, for the tried pose
        ("is_large", "?"),
        ("is_anew", "?"),
        ("is_bent", "?"),
        ("merged", "<i8"),
        ("travelled", "<f8"),
        ("way", "<f8"),
        ("pose", "<f8", (3, 4)),
        # for `put_back` alone
        ("last", "<i8"),  # points beyond it are restored
        ("n_due", "<i8"),  # runs of its second launch
    ]
)
"""Parameters of a query on the GPU (`kernels.gpu.looks`)."""

FRAME: Layout = np.dtype(
    [
        ("time", "<f8"),  # s since the session's start, when the frame began
        ("dt", "<f8"),  # s since the frame before
        ("lateness", "<f4"),  # s behind its deadline
        ("elapsed", "<f4"),  # s of computing
        ("hand", "<f8", (7,)),  # the handle: position m, unit quaternion, scalar first
        ("hand_velocity", "<f8", (6,)),  # m/s, rad/s
        ("tool", "<f8", (7,)),  # the simulated body, likewise
        ("applied", "<f8", (6,)),  # sent to the device, about the handle's origin: N, N m
        ("spring", "<f8", (9,)),  # between hand and tool: `kernels.hand.device_spring`
        ("hits", "<i4"),
        ("contacts", "<i4"),
        ("unknown", "<i4"),  # points in cells not resident
        ("deepest", "<f4"),  # m
        ("revision", "<i8"),  # of the database
        ("buttons", "<i4"),  # bit mask
        ("state", "<i4"),  # bits of `hapticdb.recording.frame.State`
    ]
)
"""One frame of the loop, and a row of a recording: 336 bytes. Inputs: dt, hand, hand_velocity,
spring, and of the state the bits for a stale hand, an open clutch and new cells. Outputs: tool,
applied, hits, contacts, deepest and the other bits of the state."""

TOLD: Layout = _record(
    [
        ("is_active", "?"),  # a loop runs here
        ("tool", "<f8", 3),  # the shell's centre, m
        ("handle", "<f8", 3),  # target of that centre by the hand, m
        ("velocity", "<f8", 3),  # of the handle, m/s
        ("radius", "<f8"),  # of the point farthest from the centre, m
    ]
)
"""Prefetch request of a loop: position and motion of its tool."""

SESSION: Layout = _record_in_lines(
    [
        [  # written by the loop
            ("sequence", "<i8"),  # odd while the loop writes `told` and the missed cells
            ("told", TOLD),
            ("n_missed", "<i8"),
            ("missed", "<i8", MOST_MISSED),  # keys of the unknown cells of the last frame
            ("n_asked", "<i8"),
            ("asked", "<i8", MOST_ASKED),  # keys of voxels, for the ids of their objects
        ],
        [  # written by the fetching process
            ("heard", "<i8"),  # last sequence number read
            ("n_missing", "<i8"),  # unknown cells of that request
            ("n_objects", "<i8"),
            ("objects", "<i8", MOST_ASKED),  # ids of the objects in the requested voxels
        ],
    ],
    SESSION_BYTES,
)
"""Row of a session in the request queue (`hapticdb.resident.table.RequestQueue`), a seqlock."""

FIGURES: Layout = _record(
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
"""Counts and latencies of the fetching process, with the names of `CacheFigures`."""

MOST_SHOWN = 64
"""Most published contacts of a hosted session. Larger: broad contacts are drawn more densely."""
TIME_BINS, TIME_BIN = 20_000, 1e-6
"""Number and width (s) of the bins of a slot's histograms of times, from 0 to 20 ms. Larger bins:
less exact percentiles. The worst time is stored exactly."""

SEAT: Layout = _record(
    [
        # written by the owner of the session
        ("state", "<i8"),  # of `hapticdb.session.shared_table`
        ("id", "<i8"),  # of the session
        ("worker", "<i8"),  # number of the worker process
        ("is_asked_to_end", "<i8"),
        # seqlock, written by the client of a hosted session
        ("hand_sequence", "<i8"),  # odd while the next fields are written
        ("hand_time", "<i8"),  # ns, CLOCK_MONOTONIC
        ("hand_pose", "<f8", 7),  # position m, unit quaternion, scalar first
        ("is_held", "<i8"),  # the tool is dragged
        ("n_moves", "<i8"),
        # written by the process of the servo loop; counts of frames by their results
        ("n_frames", "<i8"),
        ("missed", "<i8"),  # deadlines without a frame
        ("hit_frames", "<i8"),
        ("contact_frames", "<i8"),
        ("unknown_frames", "<i8"),
        ("held_frames", "<i8"),
        ("stale_frames", "<i8"),
        ("nowhere_frames", "<i8"),
        ("loose_frames", "<i8"),
        ("first_loose_frame", "<i8"),
        ("ended_loose", "<i8"),
        ("guard_actions", "<i8"),
        ("peak_force", "<f8"),  # N
        ("peak_torque", "<f8"),  # N m
        ("deepest", "<f8"),  # m
        ("least_share", "<f8"),  # of the stiffness
        ("worst_lateness", "<f8"),  # s
        ("worst_elapsed", "<f8"),  # s
        ("n_objects", "<i8"),
        ("objects", "<i8", MOST_ASKED),  # ids of touched objects
        ("contacts_sequence", "<i8"),  # odd while the contacts are written
        ("n_contacts", "<i8"),
        ("contacts", "<f8", (MOST_SHOWN, 6)),  # point m and force on the tool N, world frame
        ("lateness", "<i8", TIME_BINS + 1),  # histogram
        ("elapsed", "<i8", TIME_BINS + 1),
    ]
)
"""Slot of a session in the shared table (`hapticdb.session.shared_table`)."""

WAY: Layout = _record(
    [
        ("arriving", "<f8", 7),  # pose read from the slot: position m, unit quaternion
        ("start", "<f8", 7),
        ("end", "<f8", 7),
        ("began", "<i8"),  # ns
        ("seconds", "<f8"),  # duration
    ]
)
"""Segment of a hosted hand's interpolated motion, to its newest pose."""

STATION: Layout = _record(
    [
        ("is_running", "<i8"),  # all other fields are complete
        ("seat", "<i8"),  # row of the shared table
        ("reader", "<i8"),  # row of the table of cells
        ("source", "<i8"),  # of the hand: a code of `kernels.period.loop`
        ("is_frame", "<i8"),  # its periods are recorded and counted
        # addresses of the table's arrays and of its row SESSION, and sizes
        *((name, "<i8") for name in ("control", "readers", "keys", "slots", "words", "masks")),
        *((name, "<i8") for name in ("used", "payload", "near", "session")),
        *((name, "<i8") for name in ("n_control", "n_readers", "n_slots", "capacity")),
        ("heartbeat", "<i8"),  # index in the control block: time of the database's last answer
        ("staleness", "<i8"),  # ns without an answer after which all cells count as unknown
        # addresses of the tool's arrays, and their sizes
        *((name, "<i8") for name in ("points", "center", "spheres", "groups", "columns")),
        *((name, "<i8") for name in ("scratch", "kept", "near_points", "bends", "met")),
        # of the tool's pose, the law's frame there, and the unknown cells
        *((name, "<i8") for name in ("pose", "felt", "missed")),
        *((name, "<i8") for name in ("n_points", "n_spheres", "n_groups", "run")),
        ("place", "<f8", 5),  # origin and voxel size m, voxels on an axis
        ("bits", "<i8"),  # of the grid's curve, on an axis
        ("curve", "<i8"),  # its code
        ("coupling", "<i8"),  # row of `springs` for the next period
        ("used_coupling", "<i8"),  # row for this period
        ("springs", "<f8", (2, 9)),  # fields of DeviceSpring
        # of a device's hand
        ("handle", HANDLE),
        ("reading", READING),
        # addresses of the callbacks to read and drive the device; 0: done by the caller
        ("reads", "<i8"),
        ("pushes", "<i8"),
        # of a hosted hand, between arrivals
        ("seen", "<i8"),  # sequence number of the last arrival
        ("arrived", "<i8"),  # ns
        ("gap", "<i8"),  # ns, mean time between arrivals
        ("is_let_go", "<i8"),
        ("way", WAY),
        ("n_touching", "<i8"),  # touching points, in `met`
        # state between periods
        ("servo", SERVO),
        ("follower", FOLLOWER),
        # times, ns
        ("began", "<i8"),  # the session
        ("begun", "<i8"),  # this period
        ("last", "<i8"),  # frame
        ("told_at", "<i8"),
        ("looked_at", "<i8"),
        ("asked_at", "<i8"),  # 0: no request
        ("shown_at", "<i8"),
    ]
)
"""State of a session in its servo loop: addresses of its arrays, and state between periods."""

PACE: Layout = _record(
    [
        ("is_over", "<i8"),
        ("periods", "<i8"),  # done so far
        ("period", "<i8"),  # ns; 0: one period, whose times the caller has written
        ("passed", "<i8"),  # deadlines so far, kept and missed
        ("most", "<i8"),  # deadlines after which the loop ends
        ("due", "<i8"),  # ns, the deadline of the period
        ("begun", "<i8"),  # ns, when it began
        ("dt", "<f8"),  # s since the one before
        ("moment", "<i8", 4),  # scratch of the clock
        # addresses: of the kernels of tool motion and of a frame, and of the law's numbers
        *((name, "<i8") for name in ("mover", "feeler", "law")),
    ]
)
"""Clock and control of the servo loop: its inputs, and its progress."""

NEAR_CUBE: Layout = _record(
    [
        ("key", "<i8"),  # of the cube of space, -1 for none
        ("bound", "<f8"),  # least distance of occupied voxels from its centre, lower bound, voxels
        ("nearest", "<i8"),  # voxel at that distance, packed; -1: the search ended there
        ("unused", "<i8"),  # padding: no record crosses a cache line
    ]
)
"""Cached distance of a cube of space, one cache a thread (`kernels.resident.nearest`)."""

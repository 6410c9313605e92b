"""Records: the named state that crosses between Python, kernels and processes.

Each layout is a structured NumPy dtype. A kernel takes an array of records, without axes or with
one axis, and reads ``record = array[()]`` once. After that a field is an offset that the compiler
knows, so reading a field costs the same as reading a number of a vector. Passing one record with
many fields to a kernel costs 0.4 us, and every further array costs 0.2 us (a NamedTuple costs that
for each array in it), so numbers that belong together form one record.

In Python, ``array["hits"]`` is a view of a field; a loop that runs a thousand times a second makes
its views once, with `views_of`. This module imports numpy alone, so that whoever needs a layout
does not load numba.
"""

from collections import namedtuple
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Layout = np.dtype[np.void]

MOST_MISSED = 63
"""Most unknown cells that a frame lists for the fetching process. Larger: fewer rounds of fetching
when the tool is far in unknown cells, and more comparisons for each unknown cell of a frame."""
MOST_ASKED = 64
"""Most voxels that a session asks the objects of at a time, and most objects in the answer. Larger:
small objects are named sooner, and the statement is longer."""
LINE = 64
"""Bytes of a processor's cache line: processes that write to one line slow one another down."""
SESSION_BYTES = 2560
"""Size of a session's row on the desk: whole cache lines, such that the table's arrays keep their
pages."""


def _record(fields: Sequence[tuple[object, ...]]) -> Layout:
    """Aligned layout of those fields; a record has them as attributes, in plain Python, too."""
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


def views_of(record: NDArray[np.void]) -> Any:  # noqa: ANN401 - its fields are the layout's
    """Views of the fields of a record () by their names; a nested record gives nested views.

    A number is a view () of its own: ``views.hits.item()`` reads it, ``views.hits[()] = 1`` writes.
    """
    names = record.dtype.names or ()
    views = [record[name] for name in names]
    kind = namedtuple("Views", names)  # type: ignore[misc]  # noqa: PYI024 - fields of a layout
    return kind(*(views_of(view) if view.dtype.names else view for view in views))


def pose_numbers(record: NDArray[np.void]) -> NDArray[np.float64]:
    """Position and unit quaternion of a record () as numbers (7,), the same memory."""
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
"""The grid of an environment and its rows, for a frame on rows."""

DECODED_BYTES = 64 << 20
"""Most memory that the decoded bricks of an environment's frames take. SQLite's page cache is
smaller by as much; PostgreSQL has none in the client. Larger: more of a scene is read once."""
ENTRIES_A_ROW = 4
"""Most entries of the directory for each row: half of them stay free, and many bricks are empty."""
BRICK: Layout = _record(
    [
        ("key", "<i8"),
        ("first", "<i4"),  # slot of its first row
        ("end", "<i4"),  # slot behind its last row; 0 where the entry is free
        ("least", "<i4"),  # slot of the least of its rows that count, -1 if none does
        ("filter", "<i4"),  # number of the filter under which that was found
    ]
)
"""A brick in memory, by its key (`kernels.query.bricks`): an entry of the directory."""


def _decoded(n_values: int) -> Layout:
    """Slots of decoded rows with so many distances, as many as fit into `DECODED_BYTES`."""
    row = [("id", "<i8", ()), ("found", "<i8", ()), ("occupancy", "u1", (64,))]
    row += [("counts", "u1", ()), ("touched", "u1", ()), ("distances", "u1", (n_values,))]
    slots = DECODED_BYTES // (np.dtype(row).itemsize + ENTRIES_A_ROW * BRICK.itemsize)
    return _record([(name, kind, (slots, *shape)) for name, kind, shape in row])


OCCUPIED, MEASURED = _decoded(1), _decoded(1000)
"""Rows in memory without and with distances; slot 0 stays unused.

id, occupancy, distances : of a row, or the least distances of some rows; counts : whether its
object is felt, True for a least; found, touched : memory of a frame, which leaves touched False.
"""

RESULTS = 10
"""Numbers of a frame's result; `kernels.resident.cells` names them."""

HAND: Layout = _record(
    [
        ("position", "<f8", 3),  # m
        ("quaternion", "<f8", 4),  # unit, scalar first
        ("velocity", "<f8", 6),  # of the origin, m/s, then rad/s
        ("is_stale", "?"),  # hold, as if all cells were unknown
        ("is_open", "?"),  # the clutch
    ]
)
"""The handle to which the tool is pulled: its frame in the scene. NaN: there is no handle yet."""

HANDLE: Layout = _record(
    [
        ("scale", "<f8"),  # m of the scene for a metre of the device
        ("clutch", "<i8"),  # bit of the button that opens it, 0 for none
        ("starts_elsewhere", "?"),  # than at the hand: at `start`
        ("start", "<f8", 7),  # position m, unit quaternion
        ("is_placed", "?"),  # there was a reading
        ("x", "<f8"),  # of its last known place, m
        # from hand to handle: added to the hand's position, applied before the hand's turn
        ("position", "<f8", 3),
        ("quaternion", "<f8", 4),
    ]
)
"""How a device's readings move a handle (`kernels.hand.handle`)."""

READING: Layout = _record([("pose", "<f8", (4, 4)), ("velocity", "<f8", 6), ("buttons", "<i8")])
"""What a device has read (`hapticdb.devices.protocol.Reading`)."""

TOOL: Layout = _record(
    [
        ("position", "<f8", 3),  # of the tool's frame, m
        ("quaternion", "<f8", 4),  # unit, scalar first
        ("kept", "<f8", 6),  # the last unfaded wrench for the hand: N, N m
        ("held_for", "<f8"),  # s for which that wrench is kept
        ("risen", "<f8"),  # share of the wrench that is sent, 0 to 1
        ("version", "<i8"),  # of the cells that `felt` was computed from, 0 for none
        ("felt", "<f8", RESULTS),  # frame at this pose, about the centre of mass
        ("pose", "<f8", (4, 4)),
        ("tried_pose", "<f8", (4, 4)),  # that is looked at
    ]
)
"""The tool; at the start all fields but position and quaternion are zero."""

SENT: Layout = _record(
    [
        ("wrench", "<f8", 6),  # for the device, about the handle's origin: N, N m
        ("hits", "<i8"),
        ("contacts", "<i8"),
        ("unknown", "<i8"),  # points, at the pose that was tried
        ("deepest", "<f8"),  # m
        ("n_steps", "<i8"),  # made
        ("marks", "<i8"),  # bits named in `kernels.hand.holding`; `flags` is NumPy's own name
        ("revision", "<i8"),  # of the database
    ]
)
"""The result of a period of the loop."""

SERVO: Layout = _record([("tool", TOOL), ("hand", HAND), ("sent", SENT)])
"""All that a loop keeps from one period to the next."""

MOST_TRAIL = 64
"""Places of the hand that the quasi-static coupling remembers for its damping. Larger: the same
time is remembered at higher loop rates."""
FOLLOWER: Layout = _record(
    [
        ("looked_at", "<f8", 7),  # pose of the tool that the near points belong to
        ("travelled", "<f8"),  # voxels that the farthest point may have moved so far
        ("astray", "<f8"),  # voxels from the tool's pose to the one looked at last
        ("clearance", "<f8"),  # voxels: no point is nearer to a surface, at the tool's pose
        ("tried_clearance", "<f8"),  # the same at the pose looked at last
        # the equations of a step (`kernels.hand.step`)
        ("side", "<i8"),  # 0 or 1: which half of the rows has the near points at the tool's pose
        ("n_near", "<i8"),  # near points at the tool's pose
        ("n_active", "<i8"),  # points in the contact set of the last step
        ("n_bends", "<i8"),  # rows of curvature in its equations
        ("is_bent", "?"),  # the surface is hollow: its curvature is computed
        ("matrix", "<f8", (6, 6)),  # of the step's equations: N/m, N, N m
        ("right", "<f8", 6),  # their right-hand side: N, N m
        ("step", "<f8", 6),  # of the tool's centre: m, rad
        ("pull", "<f8", 6),  # from tool to hand: m, rad
        ("pulls", "<f8", 2),  # stiffnesses along it, lowered at the caps: N/m, N m/rad of the scene
        ("n_tried", "<i8"),  # near points at the pose looked at last, in the other half
        ("n_unknown", "<i8"),  # points in unknown cells there
        ("n_looks", "<i8"),  # poses looked at in this period
        ("is_walking", "?"),  # whether the pose that is looked at may be forbidden
        ("is_loose", "?"),  # the tool lies in something and feels nothing yet
        ("is_braked", "?"),  # the last step was cut short: the next one is held back
        ("last_hand", "<f8", 3),  # the handle's place in the last period, m
        ("trail", "<f8", (MOST_TRAIL, 4)),  # time s and place m of the handle, in turns
        ("n_trail", "<i8"),  # places written since the handle was last lost
        ("clock", "<f8"),  # s
        ("share", "<f8"),  # of the stiffness that is used, 0 to 1
        ("wanted_share", "<f8"),  # the share that the guard moves it to
        ("reversals", "<f8"),  # of the force, forgotten as time passes
        ("extreme", "<f8"),  # N, greatest or least force since the last reversal
        ("is_rising", "?"),  # the force, since then
        # of large tools
        ("is_large", "?"),  # set by the caller: a run's sphere is tested before its points
        ("merges_from", "<i8"),  # set by the caller: near points that are merged; 0: none
        ("merged", "<i8"),  # points for which one contact stands; 0 counts as 1
        # where a GPU looks
        ("looker", "<i8"),  # address of what is called for a look; 0: the period's kernel looks
        ("way", "<f8"),  # voxels that the farthest point has moved since the last look
        ("anew", "<i8"),  # what the next look forgets first, named in `near_points`
    ]
)
"""What the quasi-static coupling keeps beside the tool. It makes its own start: all zero."""

POINT: Layout = _record(
    [
        ("due", "<f8"),  # way of the farthest point, voxels, at which the point is looked at next
        ("run_due", "<f8"),  # of point n: the least `due` of run number n
        ("u", "<f8"),  # distance at the tool's pose, voxels; h where the point is not near
        ("bound", "<f8"),  # lower bound of it, likewise
        ("onset", "<f8"),  # distance at which its contact begins, voxels
    ]
)
"""What the coupling keeps of each point of the tool (`kernels.hand.near_points`)."""

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
"""A point near a surface. A step reads all near points in turn: 80 bytes each, and no others. With
the bends in the same record, broad contacts take a tenth longer."""
BENDS: Layout = _record(
    [
        ("curvature", "<f8", 2),  # 1/voxel, 0 for none
        ("along", "<f8", (2, 3)),  # unit directions
        ("about", "<f8", (2, 3)),  # their moments about the tool's centre, m
    ]
)
"""The two ways in which a hollow surface bends towards a near point."""

LOOK: Layout = _record(
    [
        ("number", "<i8"),
        ("epoch", "<i8"),  # numbers of points that are older are forgotten
        ("run", "<i8"),  # points of a run
        # as FOLLOWER has them, for the pose that is tried
        ("is_large", "?"),
        ("is_anew", "?"),
        ("is_bent", "?"),
        ("merged", "<i8"),
        ("travelled", "<f8"),
        ("way", "<f8"),
        ("pose", "<f8", (3, 4)),
        # for `put_back` alone
        ("last", "<i8"),  # point up to which stays what the look wrote
        ("n_due", "<i8"),  # runs of its second launch
    ]
)
"""What is asked of a look on the GPU (`kernels.gpu.looks`)."""

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
        ("unknown", "<i4"),  # points in cells that were not resident
        ("deepest", "<f4"),  # m
        ("revision", "<i8"),  # of the database
        ("buttons", "<i4"),  # bit mask
        ("state", "<i4"),  # bits of `hapticdb.recording.frame.State`
    ]
)
"""One frame of the loop, and a row of a recording: 336 bytes. Inputs of the frame: dt, hand,
hand_velocity, spring, and of the state that the hand is stale, the clutch, and new cells. Outputs:
tool, applied, hits, contacts, deepest and the rest of the state."""

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
        [  # written by the fetching process
            ("heard", "<i8"),  # the sequence number that it has read
            ("n_missing", "<i8"),  # cells wanted at that number and not there yet
            ("n_objects", "<i8"),
            ("objects", "<i8", MOST_ASKED),  # ids of the objects in the voxels asked for
        ],
    ],
    SESSION_BYTES,
)
"""A session's row on the desk (`hapticdb.resident.table.Desk`)."""

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
        ("empty", "<i8"),  # cells known to be empty now
        ("wanted", "<i8"),  # cells wanted, summed over all looks
        ("granted", "<i8"),  # wanted cells that were in memory
        ("losses", "<i8"),  # how often the database was lost
        ("lag", "<f8"),  # s since the commit that a standby replayed last; NaN: none answers
    ]
)
"""Counts and latencies of the fetching process: a `CacheFigures` has them by these names."""

MOST_SHOWN = 64
"""Most contacts of a hosted session that others see. Larger: broad contacts are drawn more
densely."""
TIME_BINS, TIME_BIN = 20_000, 1e-6
"""Number and width (s) of the bins of a seat's histograms of times, which cover 0 to 20 ms. Larger
bins: less exact percentiles. The worst time is kept exactly."""

SEAT: Layout = _record(
    [
        # written by who began the session
        ("state", "<i8"),  # named in `hapticdb.session.board`
        ("id", "<i8"),  # of the session
        ("worker", "<i8"),  # number of the worker process
        ("is_asked_to_end", "<i8"),
        # written by the process that moves a hosted session's hand
        ("hand_sequence", "<i8"),  # odd while the next fields are written
        ("hand_time", "<i8"),  # ns, CLOCK_MONOTONIC
        ("hand_pose", "<f8", 7),  # position m, unit quaternion, scalar first
        ("is_held", "<i8"),  # somebody holds the tool
        ("n_moves", "<i8"),
        # written by the process that runs the periods; counts of frames and of what they met
        ("n_frames", "<i8"),
        ("missed", "<i8"),  # deadlines at which no frame began
        ("in_time", "<i8"),  # frames that were done within their period
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
        ("objects", "<i8", MOST_ASKED),  # ids of what is touched
        ("contacts_sequence", "<i8"),  # odd while the contacts are written
        ("n_contacts", "<i8"),
        ("contacts", "<f8", (MOST_SHOWN, 6)),  # point m and force on the tool N, world frame
        ("lateness", "<i8", TIME_BINS + 1),  # histogram
        ("elapsed", "<i8", TIME_BINS + 1),
    ]
)
"""A session on the board (`hapticdb.session.board`), which several processes share."""

WAY: Layout = _record(
    [
        ("arriving", "<f8", 7),  # pose on the board: position m, unit quaternion
        ("start", "<f8", 7),
        ("end", "<f8", 7),
        ("began", "<i8"),  # ns
        ("seconds", "<f8"),  # that the way takes
    ]
)
"""The way of a hand to the pose that arrived last."""

STATION: Layout = _record(
    [
        ("is_running", "<i8"),  # all other fields are complete
        ("seat", "<i8"),  # row of the board
        ("reader", "<i8"),  # row of the table of cells
        ("source", "<i8"),  # of the hand: named in `kernels.period.loop`
        ("is_frame", "<i8"),  # its periods are noted and counted
        # addresses of the table's arrays and of its row SESSION, and sizes
        *((name, "<i8") for name in ("control", "readers", "keys", "slots", "words", "masks")),
        *((name, "<i8") for name in ("used", "payload", "near", "session")),
        *((name, "<i8") for name in ("n_control", "n_readers", "n_slots", "capacity")),
        ("heartbeat", "<i8"),  # index in the control block: time of the database's last answer
        ("staleness", "<i8"),  # ns without an answer after which all cells count as unknown
        # addresses of the tool's arrays, and their sizes
        *((name, "<i8") for name in ("points", "center", "spheres", "groups", "columns")),
        *((name, "<i8") for name in ("scratch", "kept", "near_points", "bends", "met")),
        # of the tool's pose, the law's frame there, and the unknown cells that were met
        *((name, "<i8") for name in ("pose", "felt", "missed")),
        *((name, "<i8") for name in ("n_points", "n_spheres", "n_groups", "run")),
        ("place", "<f8", 5),  # origin and voxel size m, voxels on an axis
        ("bits", "<i8"),  # of the grid's curve, on an axis
        ("curve", "<i8"),  # its code
        ("coupling", "<i8"),  # which of the two rows the next period uses
        ("used_coupling", "<i8"),  # which one this period uses
        ("springs", "<f8", (2, 9)),  # fields of DeviceSpring
        # of a device's hand
        ("handle", HANDLE),
        ("reading", READING),
        # addresses of what reads the device and what pushes it; 0: the caller does
        ("reads", "<i8"),
        ("pushes", "<i8"),
        # of a hosted hand, between arrivals
        ("seen", "<i8"),  # sequence number of the last arrival
        ("arrived", "<i8"),  # ns
        ("gap", "<i8"),  # ns, mean time between arrivals
        ("is_let_go", "<i8"),
        ("way", WAY),
        ("n_touching", "<i8"),  # points that touch, in `met`
        # what periods keep
        ("servo", SERVO),
        ("follower", FOLLOWER),
        # times, ns
        ("began", "<i8"),  # the session
        ("begun", "<i8"),  # this period
        ("last", "<i8"),  # frame
        ("told_at", "<i8"),
        ("looked_at", "<i8"),
        ("asked_at", "<i8"),  # 0 where nothing is asked for
        ("shown_at", "<i8"),
    ]
)
"""A session where its periods run: where its memory is, and what it keeps between them."""

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
        # addresses: of the kernels that move a tool and feel a frame, and of the law's numbers
        *((name, "<i8") for name in ("mover", "feeler", "law")),
    ]
)
"""What the loop of periods is told, and what it tells."""

NEAR_CUBE: Layout = _record(
    [
        ("key", "<i8"),  # of the cube of space, -1 for none
        ("bound", "<f8"),  # no occupied voxel is nearer to the cube's middle, voxels
        ("nearest", "<i8"),  # the voxel, packed, that is so far away; -1: the search ended there
        ("unused", "<i8"),  # so that no record lies in two cache lines
    ]
)
"""What a thread remembers of a cube of space (`kernels.resident.nearest`)."""

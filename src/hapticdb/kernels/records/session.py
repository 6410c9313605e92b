"""Records of a loop: the slot of a session, with all of its state, and the loop's clock."""

from hapticdb.kernels.records.cells import MOST_OBJECT_REQUESTS
from hapticdb.kernels.records.hand import FOLLOWER, HANDLE, READING, SERVO
from hapticdb.kernels.records.layout import Layout, record

MOST_SHOWN = 64
"""Most published contacts of a hosted session. Larger: broad contacts are drawn more densely."""
TIME_BINS, TIME_BIN = 20_000, 1e-6
"""Number and width (s) of the bins of a slot's histograms of times, from 0 to 20 ms. Larger bins:
less exact percentiles. The worst time is stored exactly."""


def _integers(names: str) -> list[tuple[str, str]]:
    return [(name, "<i8") for name in names.split()]


SEGMENT: Layout = record(
    [
        ("arriving", "<f8", 7),
        ("start", "<f8", 7),
        ("end", "<f8", 7),
        ("began", "<i8"),
        ("seconds", "<f8"),
    ]
)
"""Segment of a hosted hand's interpolated motion, to its newest pose; see `SLOT`."""

SLOT: Layout = record(
    [
        *_integers("state id is_asked_to_end worker"),
        *_integers("hand_sequence hand_time"),
        ("hand_pose", "<f8", 7),
        *_integers("source is_frame reader request staleness bits curve"),
        ("place", "<f8", 5),
        ("cells", record(_integers("control readers keys slots words masks used payload near"))),
        *_integers("n_readers n_slots capacity"),
        (
            "arrays",
            record(
                _integers(
                    "points center spheres groups columns scratch pose felt missed met kept"
                    " near_points bends"
                )
            ),
        ),
        *_integers("n_points n_spheres n_groups run"),
        *_integers("spring used_spring"),
        ("springs", "<f8", (2, 9)),
        ("handle", HANDLE),
        ("reading", READING),
        *_integers("reads pushes"),
        *_integers("seen arrived gap"),
        ("segment", SEGMENT),
        ("servo", SERVO),
        ("follower", FOLLOWER),
        *_integers("n_touching began begun last requested_at answered_at asked_at shown_at"),
        *_integers("n_frames missed_deadlines hit_frames contact_frames unknown_frames"),
        *_integers("held_frames stale_frames invalid_frames inside_frames first_inside_frame"),
        *_integers("ended_inside guard_actions"),
        *((name, "<f8") for name in ("peak_force", "peak_torque", "deepest", "least_share")),
        *((name, "<f8") for name in ("worst_lateness", "worst_elapsed")),
        ("n_objects", "<i8"),
        ("objects", "<i8", MOST_OBJECT_REQUESTS),
        *_integers("contacts_sequence n_contacts"),
        ("contacts", "<f8", (MOST_SHOWN, 6)),
        ("lateness", "<i8", TIME_BINS + 1),
        ("elapsed", "<i8", TIME_BINS + 1),
    ]
)
"""Slot of a session in the shared table: its whole state, in shared memory.

======================================  ==============================================  ==  =====
field                                   meaning, unit, frame                            by  for
======================================  ==============================================  ==  =====
state, id                               of `session.shared_table`; session's number     O   C W
is_asked_to_end                         end after the present frame                     O   W
worker                                  whose loop runs it, from 1; 0: none             W   O W
hand_sequence                           odd during a write                              C   W C
hand_time                               ns                                              C   W
hand_pose                               m and unit quaternion, scalar first, world      C   W
source, is_frame                        of `period.loop`; periods are recorded          W   W
reader, request                         row of cells; address of its `REQUEST`          W   W
staleness                               ns of silence until all cells are unknown       W   W
place, bits, curve                      grid: origin, voxel m; voxels, bits an axis     W   W
cells, n_readers, n_slots, capacity     addresses of a table's arrays; their sizes      W   W
arrays, n_points, n_spheres, n_groups   addresses of a tool's arrays; their sizes       W   W
run                                     points of a run                                 W   W
springs, spring, used_spring            `DeviceSpring`; row of the next, this period    W   W
handle, reading                         of a device, its own frame and units            W   W
reads, pushes                           addresses of its callbacks; 0: by the caller    W   W
seen, arrived, gap                      last arrival: sequence, ns; ns between two      W   W
segment.arriving, start, end            poses, m and unit quaternion, world             W   W
segment.began, seconds                  ns; s                                           W   W
servo, follower                         tool, handle, wrench; coupling                  W   W
n_touching                              touching points, in `met`                       W   W
began, begun, last                      ns: session, this period, last frame            W   W
requested_at, answered_at               ns: prefetch request; look for ids of objects   W   W
asked_at, shown_at                      ns: request for ids, 0: none; list of contacts  W   W
n_frames                                complete frames                                 W   O C
missed_deadlines ... least_share        counts and extremes of a `Report`: m, N, N m    W   O C
worst_lateness, worst_elapsed           s                                               W   O
lateness, elapsed                       histograms, `TIME_BIN` s                        W   O
n_objects, objects                      ids of touched objects                          W   C
contacts_sequence, n_contacts           odd during a write; number                      W   C
contacts                                m, and N on the tool, world                     W   C
======================================  ==============================================  ==  =====

by, for: writer and readers. O: owner of the session (`session.running`); C: client with a hosted
hand (`session.hosted`); W: worker (`kernels.period`, `session.states`).
"""

LOOP_CLOCK: Layout = record(
    [
        ("worker", "<i8"),  # runs the slots of this worker
        ("is_over", "<i8"),
        ("periods", "<i8"),  # done so far
        ("period", "<i8"),  # ns; 0: one period, whose times the caller has written
        ("passed", "<i8"),  # deadlines so far, kept and missed
        ("most", "<i8"),  # deadlines after which the loop ends
        ("due", "<i8"),  # ns, the deadline of the period
        ("begun", "<i8"),  # ns, when it began
        ("dt", "<f8"),  # s since the one before
        ("moment", "<i8", 4),  # scratch of the system clock
        # addresses: of the kernels of tool motion and of a frame, and of the law's numbers
        *_integers("mover batch_tool law"),
    ]
)
"""Clock and control of the servo loop: its inputs, and its progress."""

"""The loop of a worker: the frames of all its sessions, period by period, without the interpreter.

The loop is one call that ends when the worker ends. It allocates nothing, compiles nothing, holds
no interpreter lock and asks no database. Another thread makes sessions and withdraws them: it sets
`is_running` of a station whose other fields are complete, and may free a station two periods after
it was withdrawn.
"""

import numpy as np

from hapticdb.kernels._jit import FLOAT, FLOATS3, INTS, INTS2, entry, leaf, record_of
from hapticdb.kernels.field.law import DistanceFieldLaw
from hapticdb.kernels.hand import quasistatic
from hapticdb.kernels.hand.device_spring import DeviceSpring
from hapticdb.kernels.hand.holding import IS_FADING, IS_HELD
from hapticdb.kernels.hand.near_points import FIELD_ROWS
from hapticdb.kernels.hand.quasistatic import IS_LOOSE
from hapticdb.kernels.hand.servo import name_voxels, note, tell
from hapticdb.kernels.hosting.clock import now_ns, sleep_ns
from hapticdb.kernels.hosting.following import follow_hand
from hapticdb.kernels.hosting.memory import (
    array_at,
    asleep_of,
    cells_of,
    grid_of,
    tool_of,
)
from hapticdb.kernels.hosting.showing import (
    FELT,
    HOSTED_ROWS,
    TOUCHING,
    count_left_out,
    count_times,
    list_touching,
    show_contacts,
    show_objects,
)
from hapticdb.kernels.large.budget import felt_asleep
from hapticdb.kernels.large.sleeping import LEFT_OUT, LOOKED_AT
from hapticdb.kernels.records import (
    FOLLOWER,
    FRAME,
    PACE,
    RESULTS,
    SEAT,
    SERVO,
    SESSION,
    STATION,
    TOLD,
)
from hapticdb.kernels.resident.cells import (
    FELT_REVISION,
    READER_STRIDE,
    UNKNOWNS,
    begin_frame,
    end_frame,
)
from hapticdb.kernels.resident.fence import fence
from hapticdb.kernels.rigid import moved, pose_of_quaternion, transform_of, turned

STALENESS_NS = 1_000_000_000
"""Nanoseconds without an answer of the database after which frames act as if all cells were
unknown."""
ASK_EVERY_NS, SHOW_EVERY_NS = 10_000_000, 30_000_000
"""Nanoseconds between two requests for the ids of what is touched, and between two lists of the
contacts. Larger: less computing, and what is shown is older."""
HELD, FADING, IN_OBJECT = 1, 2, 8
"""Bits of a frame's state, as `hapticdb.recording.frame.State` names them."""


@leaf
def _spring_of(station):
    """Coupling of a session."""
    n = station.springs[station.coupling]
    return DeviceSpring(n[0], n[1], n[2], n[3], n[4], n[5], n[6], n[7], n[8])


@leaf
def _place_tool(tool, pose):
    """Write the tool's pose (4, 4)."""
    at, w = tool.position, tool.quaternion
    pose_of_quaternion(at[0], at[1], at[2], w[0], w[1], w[2], w[3], pose)


@leaf
def _feel_again(station, cells, shell, place, poses, met, missed, felts, servo):
    """Compute the law's frame at the tool's pose, for a recording; into tool.felt."""
    tool, sent, law = servo.tool, servo.sent, DistanceFieldLaw(station.stiffness)
    asleep = asleep_of(station)
    if asleep.sleepers.boxes.shape[0] > 0:
        asleep.counts[0, LOOKED_AT] = asleep.counts[0, LEFT_OUT] = 0
    which = begin_frame(cells, station.reader)
    felt_asleep(
        cells, which, shell, poses[0], place, law, met[FELT], missed, asleep, np.int64(0), felts[0]
    )
    end_frame(cells, station.reader)
    if asleep.sleepers.boxes.shape[0] > 0:
        sent.left_out = max(sent.left_out, asleep.counts[0, LEFT_OUT])
    for n in range(RESULTS):
        tool.felt[n] = felts[0, n]
    sent.revision = cells.readers[station.reader * READER_STRIDE + FELT_REVISION]
    sent.unknown += np.int64(felts[0, UNKNOWNS])


@leaf
def _report_tool(station, told, servo, shell, pose, radius):
    """Say where tool and hand are, for the fetching process."""
    center, hand = shell.center, servo.hand
    transform = transform_of(pose)
    x, y, z = moved(transform, center[0], center[1], center[2])
    told.is_active = True
    told.tool[0], told.tool[1], told.tool[2] = x, y, z
    told.radius = radius
    if not station.is_let_go:  # else cells around the tool stay wanted
        rx, ry, rz = turned(transform, center[0], center[1], center[2])
        at = hand.position
        x, y, z = at[0] + rx, at[1] + ry, at[2] + rz
    told.handle[0], told.handle[1], told.handle[2] = x, y, z
    for axis in range(3):
        told.velocity[axis] = 0.0 if station.is_let_go else hand.velocity[axis]


@leaf
def _state_of_flags(flags):
    """State of a frame in a recording."""
    state = np.int64(0)
    if flags & IS_HELD:
        state |= HELD
    if flags & IS_FADING:
        state |= FADING
    if flags & IS_LOOSE:
        state |= IN_OBJECT
    return state


@leaf
def step(station, seat, shell, place, dt, field, met, missed, poses, felts, is_shown):
    """Move the tool of a session; returns its radius, m."""
    cells, spring = cells_of(station), _spring_of(station)
    servo_record = array_at(station.servo, (), SERVO)
    follower_record = array_at(station.follower, (), FOLLOWER)
    servo, follower = servo_record[()], follower_record[()]
    quasistatic.advance(
        cells, station.reader, shell, place, spring, servo_record, follower_record, dt, field, met,
        missed,
    )  # fmt: skip
    _place_tool(servo.tool, poses[0])
    if is_shown:
        show_contacts(seat, shell, poses[0], place, spring, follower, field, met)
    if seat.is_recorded and not servo.sent.marks & IS_HELD:
        _feel_again(station, cells, shell, place, poses, met, missed, felts, servo)
    return spring.radius


@leaf
def _ask_objects(station, seat, session_record, shell, place, follower, sent, field, met, pose):
    """Ask for the objects that are touched, and show those that were answered."""
    n_touching = list_touching(follower, field, met, sent.hits, (sent.marks & IS_LOOSE) != 0)
    name_voxels(
        session_record, shell, pose, place, station.bits, station.curve, met[TOUCHING], n_touching
    )
    show_objects(seat, session_record[()])


@leaf
def _run_session(station, seat, ring, missed, poses, felts, due, moment):
    """Run a session's frame, which was due at a time, ns."""
    begun = now_ns(moment)
    servo_record = array_at(station.servo, (), SERVO)
    session_record = array_at(station.session, (), SESSION)
    servo, follower = servo_record[()], array_at(station.follower, (), FOLLOWER)[()]
    told_record = array_at(station.told, (), TOLD)
    shell, place = tool_of(station), grid_of(station)
    met = array_at(station.met, (HOSTED_ROWS, station.n_points), np.int64)
    field = array_at(station.field, (FIELD_ROWS, station.n_points), np.float64)
    control = array_at(station.control, (station.n_control,), np.int64)
    hand, sent = servo.hand, servo.sent
    follow_hand(station, seat, hand, begun)
    hand.is_stale = begun - control[station.heartbeat] > STALENESS_NS
    dt = 1e-9 * (begun - station.last)
    station.last = begun
    is_shown = begun - station.shown_at >= SHOW_EVERY_NS
    if is_shown:
        station.shown_at = begun
    radius = step(station, seat, shell, place, dt, field, met, missed, poses, felts, is_shown)
    _report_tool(station, told_record[()], servo, shell, poses[0], radius)
    tell(session_record, told_record, missed)
    if begun - station.asked_at >= ASK_EVERY_NS:
        station.asked_at = begun
        _ask_objects(
            station, seat, session_record, shell, place, follower, sent, field, met, poses[0]
        )
    lateness, elapsed = 1e-9 * (begun - due), 1e-9 * (now_ns(moment) - begun)
    note(
        ring, seat.n_frames, 1e-9 * (begun - station.began), dt, lateness, elapsed, servo_record,
        np.int64(0), _state_of_flags(sent.marks),
    )  # fmt: skip
    fence()
    seat.n_frames += 1
    count_times(seat, lateness, elapsed)
    seat.unknown_frames += sent.unknown > 0
    seat.held_frames += (sent.marks & IS_HELD) != 0
    seat.stale_frames += hand.is_stale
    count_left_out(seat, sent.left_out)


@entry(
    record_of(STATION, 1), INTS2, FLOAT[:, :, :, ::1], FLOATS3, record_of(SEAT, 1),
    record_of(FRAME, 2), record_of(PACE), INTS,
)  # fmt: skip
def run(stations, misseds, poses, felts, seats, rings, pace_record, moment):
    """Run periods until `pace.is_over`.

    stations (S,) of STATION: the sessions; misseds (S, 1 + MOST_MISSED) int64, poses (S, 1, 4, 4)
    and felts (S, 1, RESULTS): memory of each; seats (B,) and rings (B, R): the board; pace_record
    () of PACE; moment (4,) int64: scratch memory. If the frames of a period take longer than it,
    the deadlines within that time are missed by all sessions alike.
    """
    pace = pace_record[()]
    due = now_ns(moment) + pace.period
    while not pace.is_over:
        left = due - now_ns(moment) - pace.spin
        if left > 0:
            sleep_ns(moment, left)
        while now_ns(moment) < due:
            pass
        for n in range(stations.shape[0]):
            if stations[n].is_running:
                at = stations[n].seat
                _run_session(
                    stations[n], seats[at], rings[at], misseds[n], poses[n], felts[n], due, moment
                )
        done = now_ns(moment)
        due += pace.period
        behind = (done - due) // pace.period + 1 if done > due else np.int64(0)
        for n in range(stations.shape[0]):
            if stations[n].is_running:
                seat = seats[stations[n].seat]
                seat.in_time += behind == 0
                seat.missed += behind
        due += behind * pace.period
        fence()
        pace.periods += 1

"""Servo loop of sessions in one kernel: a single period a call, or all periods until the end.

A period reads the hand, moves the tool, sends the wrench to the hand, publishes its state and
records the frame. One call runs a whole loop: of one session, with its device read and driven by
Python callbacks, or of a host's worker, with many sessions and no device. The kernel makes no
allocation, no compilation and no query of the database, and runs without the interpreter lock. The
kernels of tool motion and of a frame are called by address: they compile in parallel with the loop,
and the loop compiles once for all laws.

Another thread adds and removes sessions: it sets `is_running` of a station after all other fields,
and may free a station two periods after clearing it.
"""

from typing import Any

import numba
import numpy as np
from numba import config, types
from numba.np.numpy_support import as_dtype, from_dtype

from hapticdb.kernels._jit import INT, chosen_by_type, entry, leaf, record_of
from hapticdb.kernels.field.law import DISTANCE_FIELD, DistanceFieldLaw
from hapticdb.kernels.hand.calling import address_of_kernel, call, call_kernel
from hapticdb.kernels.hand.direct import render
from hapticdb.kernels.hand.handle import follow_reading
from hapticdb.kernels.hand.near_points import Grasp
from hapticdb.kernels.hand.quasistatic import IS_ANEW, IS_LOOSE, advance
from hapticdb.kernels.law import TANGENT_PLANE
from hapticdb.kernels.period.clock import now_ns, wait_until
from hapticdb.kernels.period.following import follow_arrivals
from hapticdb.kernels.period.memory import (
    array_at,
    cells_of,
    grid_of,
    memory_of,
    spring_of,
    tool_of,
    voxels_of,
)
from hapticdb.kernels.period.telling import (
    count,
    count_times,
    list_touching,
    name_voxels,
    note,
    show_contacts,
    show_objects,
    tell,
)
from hapticdb.kernels.records import FRAME, PACE, SEAT, SESSION, STATION
from hapticdb.kernels.resident.cells import (
    FELT_REVISION,
    READER_STRIDE,
    begin_frame,
    end_frame,
)
from hapticdb.kernels.resident.feeling import felt
from hapticdb.kernels.resident.fence import fence
from hapticdb.kernels.rigid import is_rigid, numbers_of, pose_of_quaternion

GIVEN, BOARD, DEVICE, NOBODY = 0, 1, 2, 3
"""Sources of a session's hand: the caller; the session's slot in the shared table; the device's
reading in the station; none, and only the times of its periods are counted."""
TELL_EVERY_NS = 900_000
"""Nanoseconds between two prefetch requests. Larger: cells are requested later. Smaller: the loop
computes more."""
ASK_EVERY_NS, SHOW_EVERY_NS = 10_000_000, 30_000_000
"""Nanoseconds between two requests for the ids of touched objects, and between two lists of the
contacts. Larger: less computing, and older ids and contacts."""
WITHDRAWN_NS = 250_000_000
"""Nanoseconds from a request for ids to its withdrawal, which waits for a reply of the database at
least this much later: by then the ids have been published and read."""


MOVER = from_dtype(STATION), from_dtype(SEAT), from_dtype(PACE)
PLANE, DISTANCE = types.CPointer(TANGENT_PLANE), types.CPointer(DISTANCE_FIELD)
"""Argument types of the kernels of tool motion, and of a pointer to a law's numbers."""


@entry(*MOVER, by_address=True)
def move_by_coupling(station, seat, pace):
    """Move the tool of a session to the equilibrium of spring and contacts."""
    shell, place, memory = tool_of(station), grid_of(station), memory_of(station)
    cells, servo, at = cells_of(station), station.servo, station.reader * READER_STRIDE
    tool, sent, follower, spring = servo.tool, servo.sent, station.follower, spring_of(station)
    which = begin_frame(cells, station.reader)
    grasp = Grasp(
        cells, which, shell, place, follower, memory.kept, memory.near, memory.bends, memory.met,
        memory.missed,
    )  # fmt: skip
    is_anew = tool.version != cells.readers[at]
    advance(grasp, cells.readers[at], spring, servo, pace.dt)
    sent.marks |= IS_ANEW if is_anew else 0
    pose_of_quaternion(*numbers_of(tool), memory.pose)
    sent.revision = cells.readers[at + FELT_REVISION]
    end_frame(cells, station.reader)
    if station.begun - station.shown_at >= SHOW_EVERY_NS:
        station.shown_at = station.begun
        show_contacts(seat, grasp, memory.pose, spring)
    station.n_touching = list_touching(grasp, sent.hits)
    return 0


_cells = chosen_by_type(
    lambda law_type: (
        (lambda law, station: cells_of(station))  # noqa: ARG005
        if law_type is DistanceFieldLaw
        else (lambda law, station: voxels_of(station))  # noqa: ARG005
    )
)
"""Cells of a station, with distances for `DistanceFieldLaw`."""


@entry(from_dtype(STATION), INT, PLANE, also={PLANE: DISTANCE}, by_address=True)
def feel(station, which, laws):
    """Compute the law's frame at `station.pose`, into `station.felt` and `station.met`.

    which : index of the directory of cells; laws : pointer to the law.
    """
    law, memory = laws[0], memory_of(station)
    felt(
        law, _cells(law, station), which, tool_of(station), memory.pose, grid_of(station),
        memory.met, memory.missed, memory.felt,
    )  # fmt: skip
    return 0


def feeler_of(numbers: Any) -> tuple[int, int, Any]:  # noqa: ANN401 - a law's NamedTuple
    """Addresses of `feel` for a law and of the law's numbers, and their owner, to be referenced."""
    if config.DISABLE_JIT:
        plain = lambda station, which, _: feel(station, which, [numbers])  # noqa: E731
        return address_of_kernel(plain, ()), 0, plain
    kind = numba.typeof(numbers)
    address = address_of_kernel(feel, (from_dtype(STATION), INT, types.CPointer(kind)))
    kept = np.array(_packed(numbers), _layout_of(kind))
    return address, kept.ctypes.data, (kept, numbers)


def _layout_of(kind: Any) -> Any:  # noqa: ANN401 - of numba
    """Memory layout of a law's value in compiled kernels."""
    if isinstance(kind, types.BaseTuple):
        fields = [(str(n), _layout_of(each)) for n, each in enumerate(kind.types)]
        return np.dtype(fields, align=True)
    if isinstance(kind, types.Array):  # as `_packed` has it
        return np.dtype([(str(n), np.int64) for n in range(5 + 2 * kind.ndim)], align=True)
    return as_dtype(kind)


def _packed(value: Any) -> Any:  # noqa: ANN401 - likewise
    """Value of a law in `_layout_of`; of an array, size, item size, address, shape and strides.

    The two zeros before these are numba's `meminfo` and `parent`: no reference counts.
    """
    if isinstance(value, tuple):
        return tuple(map(_packed, value))
    if isinstance(value, np.ndarray):
        return 0, 0, value.size, value.itemsize, value.ctypes.data, *value.shape, *value.strides
    return value


@entry(*MOVER, by_address=True)
def move_directly(station, seat, pace):  # noqa: ARG001 - as `move_by_coupling`
    """Place the tool of a session at the hand and send the law's wrench there: direct rendering."""
    cells, servo, memory = voxels_of(station), station.servo, memory_of(station)
    sent = servo.sent
    pose_of_quaternion(*numbers_of(servo.hand), memory.pose)
    if is_rigid(memory.pose):
        which = begin_frame(cells, station.reader)
        call_kernel(pace.feeler, station, which, pace.law)
        sent.revision = cells.readers[station.reader * READER_STRIDE + FELT_REVISION]
        end_frame(cells, station.reader)
    render(spring_of(station), tool_of(station).center, servo, memory.felt, pace.dt)
    pose_of_quaternion(*numbers_of(servo.tool), memory.pose)
    station.n_touching = sent.hits
    return 0


@leaf
def _ask_objects(station, seat, session, shell, place, memory, heartbeat):
    """Request the ids of touched objects from the fetching process, and publish those received.

    A request without end would be answered again at each write, for voxels no longer touched. A
    request withdrawn immediately would never be answered by a slow database.
    """
    sent = station.servo.sent
    if sent.hits > 0 or sent.marks & IS_LOOSE:
        name_voxels(
            session, shell, memory.pose, place, station.bits, station.curve, memory.met,
            station.n_touching,
        )  # fmt: skip
        station.asked_at = station.begun
    elif station.asked_at != 0 and heartbeat > station.asked_at + WITHDRAWN_NS:
        session.n_asked = station.asked_at = 0
    show_objects(seat, session)


@leaf
def _run_period(station, seat, ring, pace):
    """Run one period of a session, due at `pace.due` and started at `pace.begun`."""
    servo, begun = station.servo, pace.begun
    lateness = 1e-9 * (begun - pace.due)
    if station.source == NOBODY:
        count_times(seat, lateness, 1e-9 * (now_ns(pace.moment) - begun))
        seat.n_frames += 1
        return
    hand, sent = servo.hand, servo.sent
    shell, place, memory = tool_of(station), grid_of(station), memory_of(station)
    session = array_at(station.session, (), SESSION)[()]
    heartbeat = array_at(station.control, (station.n_control,), np.int64)[station.heartbeat]
    station.begun, reading = begun, station.reading
    station.used_coupling = station.coupling
    if station.source == BOARD:
        follow_arrivals(station, seat, hand, begun)
    elif station.source == DEVICE:
        if station.reads != 0 and call(station.reads) != 0:
            pace.is_over = 1
            return
        follow_reading(station.handle, reading.pose, reading.velocity, reading.buttons, hand)
    hand.is_stale = begun - heartbeat > station.staleness
    call_kernel(pace.mover, station, seat, pace)
    if station.pushes != 0 and call(station.pushes) != 0:
        pace.is_over = 1
    if begun - station.told_at >= TELL_EVERY_NS or sent.unknown > 0 or not station.is_frame:
        station.told_at = begun
        tell(
            session, hand, station.is_let_go, memory.pose, shell.center, spring_of(station).radius,
            memory.missed,
        )  # fmt: skip
    if not station.is_frame:
        return
    if begun - station.looked_at >= ASK_EVERY_NS:
        station.looked_at = begun
        _ask_objects(station, seat, session, shell, place, memory, heartbeat)
    station.last = begun
    elapsed = 1e-9 * (now_ns(pace.moment) - begun)
    time = 1e-9 * (begun - station.began)
    note(ring, seat.n_frames, time, pace.dt, lateness, elapsed, station)
    count(seat, servo, station.follower)
    count_times(seat, lateness, elapsed)
    fence()
    seat.n_frames += 1


@leaf
def _count_missed(stations, seats, pace):
    """Count the deadlines passed during a period, as missed by all sessions; set the next one."""
    done = now_ns(pace.moment)
    pace.due += pace.period
    behind = (done - pace.due) // pace.period + 1 if done > pace.due else np.int64(0)
    for n in range(stations.shape[0]):
        if stations[n].is_running:
            seat = seats[stations[n].seat]
            seat.missed += behind
    pace.due += behind * pace.period
    pace.passed += 1 + behind


@entry(record_of(STATION, 1), record_of(SEAT, 1), record_of(FRAME, 2), record_of(PACE))
def run(stations, seats, rings, pace_record):
    """Run one period of all sessions, or periods until `pace.is_over` or `pace.most` deadlines.

    stations (S,) of STATION: the sessions; seats (B,) and rings (B, R): the shared table;
    pace_record () of PACE, with the kernel of motion for all tools: `move_by_coupling`, or
    `move_directly`. If the frames of a period take longer than it, all sessions miss the deadlines
    within that time.
    """
    pace = pace_record[()]
    is_alone = pace.period > 0
    while True:
        if is_alone:
            wait_until(pace.moment, pace.due)
        for n in range(stations.shape[0]):
            station = stations[n]
            if station.is_running:
                if is_alone:
                    pace.begun = now_ns(pace.moment)
                    pace.dt = 1e-9 * (pace.begun - station.last)
                _run_period(station, seats[station.seat], rings[station.seat], pace)
        if not is_alone:
            return
        _count_missed(stations, seats, pace)
        fence()
        pace.periods += 1
        if pace.is_over or pace.passed >= pace.most:
            return

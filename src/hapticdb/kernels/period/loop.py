"""Servo loop of sessions in one kernel: a single period a call, or all periods until the end.

A period reads the hand, moves the tool, sends the wrench to the hand, publishes its state and
records the frame. One call runs a whole loop: of one session, with its device read and driven by
Python callbacks, or of a host's worker, with many sessions and no device. The kernel makes no
allocation, no compilation and no query of the database, and runs without the interpreter lock. The
kernels of tool motion and of a frame are called by address: they compile in parallel with the loop,
and the loop compiles once for all laws.

Another thread adds sessions: it sets `worker` of a slot after all other fields. The loop clears it
when the session is asked to end, or its cells are closed.
"""

from typing import Any

import numba
import numpy as np
from numba import config, types
from numba.np.numpy_support import as_dtype, from_dtype

from hapticdb.kernels._jit import INT, chosen_by_type, entry, leaf, record_of
from hapticdb.kernels.field.distance_law import DISTANCE_FIELD
from hapticdb.kernels.force_law import TANGENT_PLANE, reads_distances
from hapticdb.kernels.hand.calling import address_of_kernel, call, call_kernel
from hapticdb.kernels.hand.direct import render
from hapticdb.kernels.hand.handle_motion import follow_reading
from hapticdb.kernels.hand.near_points import ProximityQuery
from hapticdb.kernels.hand.quasistatic import IS_ANEW, IS_INSIDE, advance
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
from hapticdb.kernels.records.cells import REQUEST
from hapticdb.kernels.records.hand import FRAME
from hapticdb.kernels.records.session import LOOP_CLOCK, SLOT
from hapticdb.kernels.resident.cell_frames import evaluate_frame
from hapticdb.kernels.resident.cells import (
    begin_frame,
    end_frame,
)
from hapticdb.kernels.resident.fence import fence
from hapticdb.kernels.rigid import is_rigid, numbers_of, pose_of_quaternion

GIVEN, HOSTED, DEVICE, NOBODY = 0, 1, 2, 3
"""Sources of a session's hand: the caller; the client of a hosted hand; the device's reading; none,
and only the times of its periods are counted."""
TELL_EVERY_NS = 900_000
"""Nanoseconds between two prefetch requests. Larger: cells are requested later. Smaller: the loop
computes more."""
ASK_EVERY_NS, SHOW_EVERY_NS = 10_000_000, 30_000_000
"""Nanoseconds between two requests for the ids of touched objects, and between two lists of the
contacts. Larger: less computing, and older ids and contacts."""
WITHDRAWN_NS = 250_000_000
"""Nanoseconds from a request for ids to its withdrawal, which waits for a reply of the database at
least this much later: by then the ids have been published and read."""


MOVER = from_dtype(SLOT), INT, from_dtype(LOOP_CLOCK)
PLANE, DISTANCE = types.CPointer(TANGENT_PLANE), types.CPointer(DISTANCE_FIELD)
"""Argument types of the kernels of tool motion, and of a pointer to a law's numbers."""


@entry(*MOVER, by_address=True)
def move_by_coupling(slot, which, clock):
    """Move the tool of a session to the equilibrium of spring and contacts.

    which : the frame's directory of cells.
    """
    shell, place, memory = tool_of(slot), grid_of(slot), memory_of(slot)
    cells, servo = cells_of(slot), slot.servo
    tool, sent, follower, spring = servo.tool, servo.sent, slot.follower, spring_of(slot)
    # the version of this frame's lease; `control` may have a newer one by now
    version = cells.readers[slot.reader].version
    query = ProximityQuery(
        cells, which, shell, place, follower, memory.kept, memory.near, memory.bends, memory.met,
        memory.missed[0],
    )  # fmt: skip
    is_anew = tool.version != version
    advance(query, version, spring, servo, clock.dt)
    sent.marks |= IS_ANEW if is_anew else 0
    pose_of_quaternion(*numbers_of(tool), memory.pose)
    sent.revision = cells.readers[slot.reader].revision
    if slot.begun - slot.shown_at >= SHOW_EVERY_NS:
        slot.shown_at = slot.begun
        show_contacts(slot, query, memory.pose, spring)
    slot.n_touching = list_touching(query, sent.hits)
    return 0


_cells = chosen_by_type(
    lambda law_type: (
        (lambda law, slot: cells_of(slot))  # noqa: ARG005
        if reads_distances(law_type)
        else (lambda law, slot: voxels_of(slot))  # noqa: ARG005
    )
)
"""Cells of a slot, with distances for a law that reads distances."""


@entry(from_dtype(SLOT), INT, PLANE, also={PLANE: DISTANCE}, by_address=True)
def feel(slot, which, laws):
    """Compute the law's frame at the pose of `memory_of(slot)`, into its `felt` and `met`.

    which : index of the directory of cells; laws : pointer to the law.
    """
    law, memory = laws[0], memory_of(slot)
    evaluate_frame(
        law, _cells(law, slot), which, tool_of(slot), memory.pose, grid_of(slot),
        memory.met, memory.missed[0], memory.felt[0],
    )  # fmt: skip
    return 0


def feeler_of(numbers: Any) -> tuple[int, int, Any]:  # noqa: ANN401 - a law's NamedTuple
    """Addresses of `feel` for a law and of the law's numbers, and their owner, to be referenced."""
    if config.DISABLE_JIT:
        plain = lambda slot, which, _: feel(slot, which, [numbers])  # noqa: E731
        return address_of_kernel(plain, ()), 0, plain
    kind = numba.typeof(numbers)
    address = address_of_kernel(feel, (from_dtype(SLOT), INT, types.CPointer(kind)))
    # the kernel has a bare address: the returned owner must outlive the loop
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
def move_directly(slot, which, clock):
    """Place the tool of a session at the hand and send the law's wrench there: direct rendering."""
    servo, memory = slot.servo, memory_of(slot)
    sent = servo.sent
    pose_of_quaternion(*numbers_of(servo.hand), memory.pose)
    if is_rigid(memory.pose):
        call_kernel(clock.batch_tool, slot, which, clock.law)
        sent.revision = voxels_of(slot).readers[slot.reader].revision
    render(spring_of(slot), tool_of(slot).center, servo, memory.felt[0], clock.dt)
    pose_of_quaternion(*numbers_of(servo.tool), memory.pose)
    slot.n_touching = sent.hits
    return 0


@leaf
def _request_objects(slot, request, shell, place, memory, heartbeat):
    """Request the ids of touched objects from the fetching process, and publish those received.

    A request without end would be answered again at each write, for voxels no longer touched. A
    request withdrawn immediately would never be answered by a slow database.
    """
    sent = slot.servo.sent
    if sent.hits > 0 or sent.marks & IS_INSIDE:
        name_voxels(
            request, shell, memory.pose, place, slot.bits, slot.curve, memory.met,
            slot.n_touching,
        )  # fmt: skip
        slot.asked_at = slot.begun
    elif slot.asked_at != 0 and heartbeat > slot.asked_at + WITHDRAWN_NS:
        request.n_asked = slot.asked_at = 0
    show_objects(slot, request)


@leaf
def _run_period(slot, ring, clock):
    """Run one period of a session, due at `clock.due` and started at `clock.begun`."""
    servo, begun = slot.servo, clock.begun
    lateness = 1e-9 * (begun - clock.due)
    if slot.source == NOBODY:
        count_times(slot, lateness, 1e-9 * (now_ns(clock.moment) - begun))
        slot.n_frames += 1
        return
    hand, sent = servo.hand, servo.sent
    shell, place, memory = tool_of(slot), grid_of(slot), memory_of(slot)
    request = array_at(slot.request, (), REQUEST)[()]
    cells = voxels_of(slot)
    heartbeat = cells.control[()].heartbeat
    slot.begun, reading = begun, slot.reading
    # double buffer: parameters set during the period count from the next one
    slot.used_spring = slot.spring
    if slot.source == HOSTED:
        follow_arrivals(slot, hand, begun)
    elif slot.source == DEVICE:
        if slot.reads != 0 and call(slot.reads) != 0:
            clock.is_over = 1
            return
        follow_reading(slot.handle, reading.pose, reading.velocity, reading.buttons, hand)
    # too long without a complete answer of the database: cells may be out of date
    hand.is_stale = begun - heartbeat > slot.staleness
    call_kernel(clock.mover, slot, begin_frame(cells, slot.reader), clock)
    # the lease covers the motion alone, so the writer may reuse directories between periods
    end_frame(cells, slot.reader)
    if slot.pushes != 0 and call(slot.pushes) != 0:
        clock.is_over = 1
    if begun - slot.requested_at >= TELL_EVERY_NS or sent.unknown > 0 or not slot.is_frame:
        slot.requested_at = begun
        tell(
            request, hand, memory.pose, shell.center, spring_of(slot).radius,
            memory.missed[0],
        )  # fmt: skip
    if not slot.is_frame:
        return
    if begun - slot.answered_at >= ASK_EVERY_NS:
        slot.answered_at = begun
        _request_objects(slot, request, shell, place, memory, heartbeat)
    slot.last = begun
    elapsed = 1e-9 * (now_ns(clock.moment) - begun)
    time = 1e-9 * (begun - slot.began)
    note(ring, slot, time, clock.dt, lateness, elapsed)
    count(slot)
    count_times(slot, lateness, elapsed)
    # a reader that sees the new count sees the whole row of the ring, too
    fence()
    slot.n_frames += 1
    if slot.is_asked_to_end or cells.control[()].is_over:
        slot.worker = 0
        if slot.source == DEVICE:
            clock.is_over = 1


@leaf
def _count_missed(slots, clock):
    """Count the deadlines passed during a period, as missed by all sessions; set the next one."""
    done = now_ns(clock.moment)
    # whole periods: after a late one the deadlines keep their phase, and none is made up for
    clock.due += clock.period
    behind = (done - clock.due) // clock.period + 1 if done > clock.due else np.int64(0)
    for n in range(slots.shape[0]):
        if slots[n].worker == clock.worker:
            slots[n].missed_deadlines += behind
    clock.due += behind * clock.period
    clock.passed += 1 + behind


@entry(record_of(SLOT, 1), record_of(FRAME, 2), record_of(LOOP_CLOCK))
def run(slots, rings, clock_record):
    """Run a period of a worker's sessions, or periods until `clock.is_over` or `clock.most`.

    slots (S,) and rings (S, R): the shared table; clock_record () of LOOP_CLOCK, with the kernel of
    motion for all tools: `move_by_coupling`, or `move_directly`. If the frames of a period take
    longer than it, all sessions miss the deadlines within that time.
    """
    clock = clock_record[()]
    is_alone = clock.period > 0
    while True:
        if is_alone:
            wait_until(clock.moment, clock.due)
        for n in range(slots.shape[0]):
            slot = slots[n]
            # read once a period, since another thread adds sessions meanwhile
            if slot.worker == clock.worker:
                if is_alone:
                    clock.begun = now_ns(clock.moment)
                    clock.dt = 1e-9 * (clock.begun - slot.last)
                _run_period(slot, rings[n], clock)
        if not is_alone:
            return
        _count_missed(slots, clock)
        fence()
        clock.periods += 1
        if clock.is_over or clock.passed >= clock.most:
            return

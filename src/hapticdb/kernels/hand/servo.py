"""One period of the servo loop around the coupling: its report to other processes, its record."""

import numpy as np

from hapticdb.kernels._jit import FLOAT, FLOATS2, INT, INTS, entry, record_of
from hapticdb.kernels.curves import key_of
from hapticdb.kernels.records import FRAME, MOST_ASKED, SERVO, SESSION, TOLD
from hapticdb.kernels.resident.cells import (
    CLUSTERS,
    CONTACTS,
    DEEPEST,
    HITS,
    LISTED,
    PLACE,
    WRENCH,
)
from hapticdb.kernels.resident.fence import fence
from hapticdb.kernels.rigid import turn


@entry(record_of(SESSION), record_of(TOLD), INTS)
def tell(session_row, told_row, missed):
    """Write a loop's report and the unknown cells of its last frame into its row of the desk.

    missed (1 + MOST_MISSED,) int64, as `felt` fills it. The row's sequence number is odd while the
    row is written.
    """
    session, told = session_row[()], told_row[()]
    session.sequence += 1
    fence()
    session.told.is_active = told.is_active
    for axis in range(3):
        session.told.tool[axis] = told.tool[axis]
        session.told.handle[axis] = told.handle[axis]
        session.told.velocity[axis] = told.velocity[axis]
    session.told.radius = told.radius
    session.n_missed = missed[LISTED]
    for n in range(missed[LISTED]):
        session.missed[n] = missed[LISTED + 1 + n]
    fence()
    session.sequence += 1


@entry(record_of(SESSION), CLUSTERS, FLOATS2, PLACE, INT, INT, INTS, INT)
def name_voxels(session_row, shell, pose, place, bits, curve, met, n_hits):
    """Ask for the objects in the voxels that a placed shell hits: write these voxels' keys.

    met (n_hits,): indices of the hits. If there are more than MOST_ASKED, every second, third, ...
    hit is taken.
    """
    session = session_row[()]
    step = max((n_hits + MOST_ASKED - 1) // MOST_ASKED, 1)
    count = 0
    for hit in range(0, n_hits, step):
        n = met[hit]
        x, y, z = shell.points[n, 0], shell.points[n, 1], shell.points[n, 2]
        i = np.int64(
            (turn(pose[0, 0], pose[0, 1], pose[0, 2], x, y, z) + pose[0, 3] - place.x) / place.size
        )
        j = np.int64(
            (turn(pose[1, 0], pose[1, 1], pose[1, 2], x, y, z) + pose[1, 3] - place.y) / place.size
        )
        k = np.int64(
            (turn(pose[2, 0], pose[2, 1], pose[2, 2], x, y, z) + pose[2, 3] - place.z) / place.size
        )
        session.asked[count] = key_of(i, j, k, bits, curve)
        count += 1
    session.n_asked = count


@entry(record_of(FRAME, 1), INT, FLOAT, FLOAT, FLOAT, FLOAT, record_of(SERVO), INT, INT)
def note(ring, at, time, dt, lateness, elapsed, servo_record, buttons, state):
    """Record frame number `at` in its row of the ring buffer (capacity,) of FRAME."""
    servo = servo_record[()]
    tool, hand, sent = servo.tool, servo.hand, servo.sent
    row = ring[at % ring.shape[0]]
    row.time = time
    row.dt = dt
    row.lateness = lateness
    row.elapsed = elapsed
    for n in range(3):
        row.hand[n] = hand.position[n]
        row.tool[n] = tool.position[n]
    for n in range(4):
        row.hand[3 + n] = hand.quaternion[n]
        row.tool[3 + n] = tool.quaternion[n]
    for n in range(6):
        row.hand_velocity[n] = hand.velocity[n]
        row.wrench[n] = tool.felt[WRENCH + n]
        row.applied[n] = sent.wrench[n]
    row.hits = np.int64(tool.felt[HITS])
    row.contacts = np.int64(tool.felt[CONTACTS])
    row.unknown = sent.unknown  # at the pose that was tried; the frame at `tool` has none
    row.deepest = tool.felt[DEEPEST]
    row.revision = sent.revision
    row.buttons = buttons
    row.state = state

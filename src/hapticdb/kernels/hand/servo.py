"""One period of the servo loop around the coupling: what is told, and what is recorded."""

import numpy as np

from hapticdb.kernels._jit import FLOAT, FLOATS, FLOATS2, INT, INTS, entry, record_of
from hapticdb.kernels.curves import key_of
from hapticdb.kernels.query.contact import turn
from hapticdb.kernels.records import MOST_ASKED, SESSION, TOLD
from hapticdb.kernels.resident.cells import (
    CLUSTERS,
    CONTACTS,
    DEEPEST,
    HITS,
    LISTED,
    PLACE,
    UNKNOWNS,
)
from hapticdb.kernels.resident.fence import fence

WIDTH = 43
"""Numbers of a recorded frame, in the order of the fields of `realtime.recorded.FRAME`."""


@entry(record_of(SESSION), record_of(TOLD), INTS)
def tell(session_row, told_row, missed):
    """Write what a loop tells, and the unknown cells of its last frame, into its row of the desk.

    missed (1 + MOST_MISSED,) int64, as `felt` fills it. The row's sequence number is odd meanwhile.
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
    """Ask for the objects in voxels that a placed shell hits: write the voxels' keys.

    met (n_hits,): indices of the points that hit. Of more than MOST_ASKED hits, evenly spread ones
    are taken.
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


@entry(FLOATS2, INT, FLOAT, FLOAT, FLOAT, FLOAT, FLOATS, FLOATS, FLOATS, FLOATS, FLOAT, INT, INT)
def note(
    ring, at, time, dt, lateness, elapsed, hand, tool, frame, applied, revision, buttons, state
):
    """Record a frame in row `at` of ring (capacity, WIDTH)."""
    row = at % ring.shape[0]
    ring[row, 0] = time
    ring[row, 1] = dt
    ring[row, 2] = lateness
    ring[row, 3] = elapsed
    for n in range(13):
        ring[row, 4 + n] = hand[n]
    for n in range(7):
        ring[row, 17 + n] = tool[n]
    for n in range(6):
        ring[row, 24 + n] = frame[n]
        ring[row, 30 + n] = applied[n]
    ring[row, 36] = frame[HITS]
    ring[row, 37] = frame[CONTACTS]
    ring[row, 38] = applied[UNKNOWNS]  # of the pose that was tried; the frame's has none
    ring[row, 39] = frame[DEEPEST]
    ring[row, 40] = revision
    ring[row, 41] = buttons
    ring[row, 42] = state

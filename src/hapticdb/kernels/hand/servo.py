"""One period of the servo loop around the coupling: what is told, and what is recorded."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import FLOAT, FLOATS, FLOATS2, INT, INTS, entry, fields_of
from hapticdb.kernels.curves import key_of
from hapticdb.kernels.query.contact import turn
from hapticdb.kernels.resident.cells import CLUSTERS, CONTACTS, DEEPEST, HITS, PLACE, UNKNOWNS
from hapticdb.kernels.resident.fence import fence

WIDTH = 43
"""Numbers of a recorded frame, in the order of the fields of `realtime.recorded.FRAME`."""
TOLD = 11
"""Words of a session's state that the loop writes; `realtime.prefetch` names them."""


class Signal(NamedTuple):
    """A session's row of the desk.

    sequence (1,) int64; state (32,) float64; missed, voxels (64 or 65,) int64, their number first.
    """

    sequence: NDArray[np.int64]
    state: NDArray[np.float64]
    missed: NDArray[np.int64]
    voxels: NDArray[np.int64]


SIGNAL = fields_of(Signal, INTS, FLOATS, INTS, INTS)


@entry(SIGNAL, FLOATS, INTS)
def tell(signal, told, missed):
    """Write what a session tells: `told` (TOLD,) and the unknown cells of its last frame."""
    signal.sequence[0] += 1
    fence()
    for n in range(TOLD):
        signal.state[n] = told[n]
    for n in range(missed[0] + 1):
        signal.missed[n] = missed[n]
    fence()
    signal.sequence[0] += 1


@entry(SIGNAL, CLUSTERS, FLOATS2, PLACE, INT, INT, INTS, INT)
def name_voxels(signal, shell, pose, place, bits, curve, met, n_hits):
    """Write the keys of some of the voxels that hits (n_hits,) of a placed shell are in."""
    most = signal.voxels.shape[0] - 1
    step = max((n_hits + most - 1) // most, 1)
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
        count += 1
        signal.voxels[count] = key_of(i, j, k, bits, curve)
    signal.voxels[0] = count


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

"""How a hand moves the handle: by a scale, and an offset that remains after the clutch was open."""

from hapticdb.kernels._jit import FLOAT, FLOATS, FLOATS2, entry, record_of
from hapticdb.kernels.records import HAND, OFFSET
from hapticdb.kernels.rigid import product, quaternion_in

FARTHEST = 1e6
"""Largest credible number in a hand's pose or velocity, in m, m/s or rad/s. A larger one means that
the device is wrong, and the hand is refused."""


@entry(FLOATS2, FLOATS)
def is_somewhere(pose, velocity):
    """Whether a pose (4, 4) and a velocity (6,) are finite, and no number is beyond FARTHEST."""
    for row in range(3):
        for column in range(4):
            if not abs(pose[row, column]) <= FARTHEST:  # NaN fails, too
                return False
    for axis in range(6):
        if not abs(velocity[axis]) <= FARTHEST:
            return False
    return True


@entry(FLOATS2, FLOAT, record_of(OFFSET), record_of(HAND))
def grip(pose, scale, offset_record, hand_record):
    """Set the offset such that the handle stays in place for a hand at pose (4, 4)."""
    offset, hand = offset_record[()], hand_record[()]
    position, turn = hand.position, hand.quaternion
    w, x, y, z = quaternion_in(pose)
    # the offset is the right factor: the handle then turns about the same axes as the hand
    w, x, y, z = product(w, -x, -y, -z, turn[0], turn[1], turn[2], turn[3])
    for axis in range(3):
        offset.position[axis] = position[axis] - scale * pose[axis, 3]
    turn = offset.quaternion
    turn[0], turn[1], turn[2], turn[3] = w, x, y, z


@entry(FLOATS2, FLOATS, FLOAT, record_of(OFFSET), record_of(HAND))
def carry(pose, velocity, scale, offset_record, hand_record):
    """Write the handle's position, turn and velocity for a hand at pose (4, 4), velocity (6,).

    They go into `hand_record`. Without an offset and at scale 1 the handle is exactly at the hand.
    """
    offset, hand = offset_record[()], hand_record[()]
    turn = offset.quaternion
    w, x, y, z = quaternion_in(pose)
    w, x, y, z = product(w, x, y, z, turn[0], turn[1], turn[2], turn[3])
    length = (w * w + x * x + y * y + z * z) ** 0.5
    turn = hand.quaternion
    turn[0], turn[1], turn[2], turn[3] = w / length, x / length, y / length, z / length
    for axis in range(3):
        hand.position[axis] = scale * pose[axis, 3] + offset.position[axis]
        hand.velocity[axis] = scale * velocity[axis]
        hand.velocity[3 + axis] = velocity[3 + axis]

"""How a hand carries the handle: scale, and the offset that a clutch leaves between them."""

from hapticdb.kernels._jit import FLOAT, FLOATS, FLOATS2, entry, record_of
from hapticdb.kernels.records import HAND, OFFSET
from hapticdb.kernels.rigid import product, quaternion_in

FARTHEST = 1e6
"""Metres, m/s or rad/s: no hand is farther or faster, it is its device's numbers that are wrong."""


@entry(FLOATS2, FLOATS)
def is_somewhere(pose, velocity):
    """Whether a pose (4, 4) and a velocity (6,) are all numbers, none beyond FARTHEST."""
    for row in range(3):
        for column in range(4):
            if not abs(pose[row, column]) <= FARTHEST:  # nor is what is not a number
                return False
    for axis in range(6):
        if not abs(velocity[axis]) <= FARTHEST:
            return False
    return True


@entry(FLOATS2, FLOAT, record_of(OFFSET), record_of(HAND))
def grip(pose, scale, offset_record, hand_record):
    """Set the offset for a hand at pose (4, 4), so that the handle stays where it is."""
    offset, hand = offset_record[()], hand_record[()]
    position, turn = hand.position, hand.quaternion
    w, x, y, z = quaternion_in(pose)
    # behind the hand's turn, so that the handle turns about the axes that the hand turns about
    w, x, y, z = product(w, -x, -y, -z, turn[0], turn[1], turn[2], turn[3])
    for axis in range(3):
        offset.position[axis] = position[axis] - scale * pose[axis, 3]
    turn = offset.quaternion
    turn[0], turn[1], turn[2], turn[3] = w, x, y, z


@entry(FLOATS2, FLOATS, FLOAT, record_of(OFFSET), record_of(HAND))
def carry(pose, velocity, scale, offset_record, hand_record):
    """Where the handle is, and how fast, for a hand at pose (4, 4) with velocity (6,).

    Into `hand_record`; without an offset, at scale 1, it is where the hand is, exactly.
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

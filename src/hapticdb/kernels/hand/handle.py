"""How a hand carries the handle: scale, and the offset that a clutch leaves between them."""

from hapticdb.kernels._jit import FLOAT, FLOATS, FLOATS2, entry
from hapticdb.kernels.motion import product, quaternion_in

POSITION, QUATERNION, VELOCITY = 0, 3, 7
"""Where a hand (15,) has what; an offset (7,) has the first two."""
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


@entry(FLOATS2, FLOAT, FLOATS, FLOATS)
def grip(pose, scale, offset, hand):
    """Set the offset (7,) so that a hand at pose (4, 4) carries the handle where `hand` has it."""
    w, x, y, z = quaternion_in(pose)
    # behind the hand's turn, so that the handle turns about the axes that the hand turns about
    w, x, y, z = product(w, -x, -y, -z, hand[3], hand[4], hand[5], hand[6])
    for axis in range(3):
        offset[axis] = hand[axis] - scale * pose[axis, 3]
    offset[3] = w
    offset[4] = x
    offset[5] = y
    offset[6] = z


@entry(FLOATS2, FLOATS, FLOAT, FLOATS, FLOATS)
def carry(pose, velocity, scale, offset, hand):
    """Where the handle is, and how fast, for a hand at pose (4, 4) with velocity (6,).

    Into hand (15,); without an offset, at scale 1, it is where the hand is, exactly.
    """
    w, x, y, z = quaternion_in(pose)
    w, x, y, z = product(w, x, y, z, offset[3], offset[4], offset[5], offset[6])
    length = (w * w + x * x + y * y + z * z) ** 0.5
    hand[3] = w / length
    hand[4] = x / length
    hand[5] = y / length
    hand[6] = z / length
    for axis in range(3):
        hand[axis] = scale * pose[axis, 3] + offset[axis]
        hand[7 + axis] = scale * velocity[axis]
        hand[10 + axis] = velocity[3 + axis]

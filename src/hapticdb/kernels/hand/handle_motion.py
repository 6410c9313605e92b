"""Motion of the handle by the hand: scaled, with an offset adjusted by the clutch."""

import math

from hapticdb.kernels._jit import FLOATS, FLOATS2, INT, entry, leaf, record_of
from hapticdb.kernels.records.hand import HAND, HANDLE
from hapticdb.kernels.rigid import product, quaternion_in, set_numbers

FARTHEST = 1e9
"""Largest credible number in a hand's pose or velocity, m, m/s or rad/s. Survey coordinates have
seven digits; a larger number is a fault of the device, and the reading is refused."""


@leaf
def _is_credible(pose, velocity):
    for row in range(3):
        for column in range(4):
            if not abs(pose[row, column]) <= FARTHEST:  # NaN fails, too
                return False
    for axis in range(6):
        if not abs(velocity[axis]) <= FARTHEST:
            return False
    return True


@entry(FLOATS2, FLOATS)
def is_valid_pose(pose, velocity):
    """Whether a pose (4, 4) and a velocity (6,) are finite and within FARTHEST."""
    return _is_credible(pose, velocity)


@leaf
def _grip(handle, pose, hand):
    """Compute the offset from a hand at pose (4, 4) to the present handle."""
    position, turn = hand.position, hand.quaternion
    w, x, y, z = quaternion_in(pose)
    # the offset is the right factor: the handle then turns about the same axes as the hand
    w, x, y, z = product(w, -x, -y, -z, turn[0], turn[1], turn[2], turn[3])
    for axis in range(3):
        handle.position[axis] = position[axis] - handle.scale * pose[axis, 3]
    turn = handle.quaternion
    turn[0], turn[1], turn[2], turn[3] = w, x, y, z


@leaf
def _carry(handle, pose, velocity, hand):
    """Write the handle's position, quaternion and velocity for a hand's pose (4, 4), velocity (6,).

    At scale 1 and without an offset, the handle equals the hand exactly.
    """
    scale, turn = handle.scale, handle.quaternion
    w, x, y, z = quaternion_in(pose)
    w, x, y, z = product(w, x, y, z, turn[0], turn[1], turn[2], turn[3])
    length = (w * w + x * x + y * y + z * z) ** 0.5
    turn = hand.quaternion
    turn[0], turn[1], turn[2], turn[3] = w / length, x / length, y / length, z / length
    for axis in range(3):
        hand.position[axis] = scale * pose[axis, 3] + handle.position[axis]
        hand.velocity[axis] = scale * velocity[axis]
        hand.velocity[3 + axis] = velocity[3 + axis]


@leaf
def _place(handle, pose, velocity, hand):
    """Initialise the handle at the first credible reading: at `handle.start`, or at the hand."""
    offset = handle.quaternion
    if handle.starts_elsewhere:
        set_numbers(hand, handle.start)
        _grip(handle, pose, hand)
    else:
        for axis in range(3):
            handle.position[axis] = offset[1 + axis] = 0.0
        offset[0] = 1.0
    _carry(handle, pose, velocity, hand)


@leaf
def follow_reading(handle, pose, velocity, buttons, hand):
    """Move the handle by one reading of the device; output in `hand`.

    handle : record of HANDLE; pose (4, 4), velocity (6,), buttons : the reading. A reading without
    credible numbers saves the handle's x in `handle.x` and sets it to NaN.
    """
    position = hand.position
    if not _is_credible(pose, velocity):
        if not math.isnan(position[0]):
            handle.x = position[0]  # NaN marks the handle as lost, x alone is overwritten
            position[0] = math.nan
        return
    if not handle.is_placed:
        handle.is_placed = True
        _place(handle, pose, velocity, hand)
    elif math.isnan(position[0]):
        position[0] = handle.x
    if buttons & handle.clutch:
        hand.is_open = True
        for axis in range(6):
            hand.velocity[axis] = 0.0
        return
    # clutch closed: a new offset at the present handle, so the handle does not jump
    if hand.is_open:
        hand.is_open = False
        _grip(handle, pose, hand)
    _carry(handle, pose, velocity, hand)


@entry(record_of(HANDLE), FLOATS2, FLOATS, INT, record_of(HAND))
def follow(handle_record, pose, velocity, buttons, hand_record):
    """`follow_reading` for records ()."""
    follow_reading(handle_record[()], pose, velocity, buttons, hand_record[()])

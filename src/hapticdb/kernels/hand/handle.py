"""How a hand moves the handle: by a scale, and an offset that remains after the clutch was open."""

import math

from hapticdb.kernels._jit import FLOATS, FLOATS2, INT, entry, leaf, record_of
from hapticdb.kernels.records import HAND, HANDLE
from hapticdb.kernels.rigid import product, quaternion_in, set_numbers

FARTHEST = 1e9
"""Largest credible number in a hand's pose or velocity, in m, m/s or rad/s: places of surveys have
seven digits. A larger one means that the device is wrong, and the hand is refused."""


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
def is_somewhere(pose, velocity):
    """Whether a pose (4, 4) and a velocity (6,) are finite, and no number is beyond FARTHEST."""
    return _is_credible(pose, velocity)


@leaf
def _grip(handle, pose, hand):
    """Set the offset such that the handle stays in place for a hand at pose (4, 4)."""
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
    """Write the handle's position, turn and velocity for a hand at pose (4, 4), velocity (6,).

    Without an offset and at scale 1 the handle is exactly at the hand.
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
    """Put the handle where it starts, for the first reading that has a place."""
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
    """Move the handle, a record of HANDLE, as far as a device's reading says; writes `hand`.

    Without a place of the hand the handle has none: its x is NaN.
    """
    position = hand.position
    if not _is_credible(pose, velocity):
        if not math.isnan(position[0]):
            handle.x = position[0]
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
    if hand.is_open:
        hand.is_open = False
        _grip(handle, pose, hand)
    _carry(handle, pose, velocity, hand)


@entry(record_of(HANDLE), FLOATS2, FLOATS, INT, record_of(HAND))
def follow(handle_record, pose, velocity, buttons, hand_record):
    """`follow_reading` for records ()."""
    follow_reading(handle_record[()], pose, velocity, buttons, hand_record[()])

"""The tool as a body: its mass, its spring and damper, and whether its state is finite."""

import math
from typing import NamedTuple

from hapticdb.kernels._jit import FLOAT, INT, fields_of, inlined, leaf
from hapticdb.kernels.records import RESULTS


class Body(NamedTuple):
    """The tool as a body, and its coupling.

    mass in kg, inertia in kg m^2; spring and turn_spring in N/m and N m/rad, damping and
    turn_damping in N s/m and N m s/rad; radius, m: distance of the farthest point from the centre;
    stiffness of a contact, N/m; hold and fade, s: how long the wrench is kept when cells are
    unknown, and how long it then falls to zero; most_substeps: largest number of steps in a period.
    """

    mass: float
    inertia: float
    spring: float
    damping: float
    turn_spring: float
    turn_damping: float
    radius: float
    stiffness: float
    hold: float
    fade: float
    most_substeps: int


BODY = fields_of(Body, *(FLOAT,) * 10, INT)


@inlined
def is_finite(numbers):
    """Whether all numbers (n,) are finite."""
    count = 0
    for n in range(numbers.shape[0]):
        count += math.isfinite(numbers[n])
    return count == numbers.shape[0]


@leaf
def is_somewhere(frame):
    """Whether position, turn and velocity of a tool or a hand are finite."""
    return is_finite(frame.position) and is_finite(frame.quaternion) and is_finite(frame.velocity)


@leaf
def begin_anew(tool):
    """Set a tool's state to zero, except its position and quaternion."""
    for n in range(6):
        tool.velocity[n] = tool.kept[n] = tool.loose[n] = 0.0
    for n in range(RESULTS):
        tool.felt[n] = tool.tried_felt[n] = 0.0
    for row in range(4):
        for column in range(4):
            tool.pose[row, column] = tool.tried_pose[row, column] = 0.0
    tool.held_for = tool.risen = 0.0
    tool.version = 0


@leaf
def place_lost(tool, hand, is_hand):
    """Begin anew, at the hand if there is one, with a tool that is not finite."""
    if is_somewhere(tool) and is_finite(tool.kept) and math.isfinite(tool.held_for):
        return
    begin_anew(tool)
    if is_hand:
        for n in range(3):
            tool.position[n] = hand.position[n]
        for n in range(4):
            tool.quaternion[n] = hand.quaternion[n]

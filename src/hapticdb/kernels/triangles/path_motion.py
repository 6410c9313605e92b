"""The motion of a tool along a path: straight, with even turns about its centre.

On a part of the path the tool shifts by v and turns by the rotation vector w, both half before the
middle of the part and half after it. A place at r from the centre in the middle is at most

    |n . (v + w x r) / 2| + (t / 2 + t^2 / 6) |w x r| / 2,    t = |w| / 2,

away from there along a unit direction n: the first term is the motion to first order; the sine and
cosine of an angle up to t differ from t and 1 by t^3 / 6 and t^2 / 2 at most.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import FLOATS, FLOATS2, FLOATS3, INTS, entry, fields_of, leaf
from hapticdb.kernels.rigid import moment

Floats = NDArray[np.float64]


class PathMotion(NamedTuple):
    """M given poses, two at least, and the motion between them; world frame.

    From one pose to the next, the centre goes straight and the tool turns about it evenly, and no
    place of the tool moves more than the difference of `parameters`.
    """

    parameters: Floats  # (M,) metres, ascending
    centers: Floats  # (M, 3) of the turns
    rotations: Floats  # (M, 3, 3)
    turns: Floats  # (M - 1, 3) rotation vectors to the next pose
    center: Floats  # (3,) tool frame


MOTION = fields_of(PathMotion, FLOATS, FLOATS2, FLOATS3, FLOATS2, FLOATS)


class Moved(NamedTuple):
    """Pose of the tool in the middle of a part of the path, and its motion from there."""

    pose: Floats  # (4, 4)
    center: Floats  # (3,) of the turns
    shift: Floats  # (3,) from the middle to the end
    turn: Floats  # (3,) likewise
    angle: Floats  # (1,) of that turn


@leaf
def move(motion, segment, low, high, moved):
    """Write pose and motion of the tool on a segment between two path parameters."""
    length = motion.parameters[segment + 1] - motion.parameters[segment]
    share, half = 0.0, 0.0
    if length > 0.0:
        share = (0.5 * (low + high) - motion.parameters[segment]) / length
        # the expansion about the middle halves the angle, and quarters its second-order rest
        share, half = min(max(share, 0.0), 1.0), 0.5 * (high - low) / length
    square = 0.0
    for axis in range(3):
        step = motion.centers[segment + 1, axis] - motion.centers[segment, axis]
        moved.center[axis] = motion.centers[segment, axis] + share * step
        moved.shift[axis] = half * step
        moved.turn[axis] = half * motion.turns[segment, axis]
        square += motion.turns[segment, axis] ** 2
    angle = math.sqrt(square)
    moved.angle[0] = half * angle
    _turn(motion.rotations[segment], motion.turns[segment], angle, share, moved.pose)
    for axis in range(3):
        moved.pose[axis, 3] = moved.center[axis]
        for k in range(3):
            # translation that leaves the turning centre in its place
            moved.pose[axis, 3] -= moved.pose[axis, k] * motion.center[k]


@leaf
def _turn(rotation, turn, angle, share, pose):
    """Write a rotation (3, 3) after a share of a turn (3,) into a pose (Rodrigues' formula)."""
    if angle > 0.0:
        x, y, z = turn[0] / angle, turn[1] / angle, turn[2] / angle
    else:
        x, y, z = 0.0, 0.0, 0.0
    sine, half = math.sin(share * angle), math.sin(0.5 * share * angle)
    rest = 2.0 * half * half  # 1 - cos
    for k in range(3):
        px, py, pz = rotation[0, k], rotation[1, k], rotation[2, k]
        qx, qy, qz = moment(x, y, z, px, py, pz)
        pose[0, k] = px + sine * qx + rest * (y * qz - z * qy)
        pose[1, k] = py + sine * qy + rest * (z * qx - x * qz)
        pose[2, k] = pz + sine * qz + rest * (x * qy - y * qx)


@leaf
def velocity(moved, x, y, z):
    """Motion of a place from the middle to the end of the part, to first order.

    Returns the shift along each axis, and the metres of the turn.
    """
    x, y, z = x - moved.center[0], y - moved.center[1], z - moved.center[2]
    ux, uy, uz = moment(moved.turn[0], moved.turn[1], moved.turn[2], x, y, z)
    turned = math.sqrt(ux * ux + uy * uy + uz * uz)
    return moved.shift[0] + ux, moved.shift[1] + uy, moved.shift[2] + uz, turned


@leaf
def bend(moved):
    """Bound of the deviation from the motion to first order, as a share of a place's turn."""
    return moved.angle[0] * (0.5 + moved.angle[0] / 6.0)


@entry(MOTION, INTS, FLOATS, FLOATS3)
def poses_kernel(motion, segments, parameters, poses):
    """Write the poses (N, 4, 4) at path parameters (N,) on segments (N,), over identities."""
    center, shift, turn, angle = np.empty(3), np.empty(3), np.empty(3), np.empty(1)
    for n in range(parameters.shape[0]):
        move(
            motion,
            segments[n],
            parameters[n],
            parameters[n],
            Moved(poses[n], center, shift, turn, angle),
        )

"""Motion of simulated hands: timed poses, smooth random motion, and a mass on a damped spring.

Velocities (6,) are m/s of the origin, then rad/s, both in the frame of the poses.
"""

import math

import numpy as np
from numba import types

from hapticdb.kernels._jit import FLOAT, FLOATS, FLOATS2, FLOATS3, INT, entry, leaf
from hapticdb.kernels.rigid import (
    moment,
    product,
    quaternion_by,
    quaternion_in,
    turn_of,
    write_pose,
)

PAIR = types.UniTuple(FLOAT, 2)


@entry(FLOAT, FLOATS2, FLOATS2, FLOATS)
def play(time, knots, pose, velocity):
    """Pose and velocity at a time: linear between knots, turning about one axis (slerp).

    knots (M, 8) in order of time, M > 1: s, m, unit quaternion. The hand rests before the first
    knot and from the last knot on. Writes pose (4, 4) and velocity (6,).
    """
    left, right = 0, len(knots) - 1
    rests = time < knots[0, 0] or time >= knots[right, 0]
    time = min(max(time, knots[0, 0]), knots[right, 0])
    while right - left > 1:
        middle = (left + right) // 2
        if knots[middle, 0] <= time:
            left = middle
        else:
            right = middle
    span = knots[right, 0] - knots[left, 0]
    share = (time - knots[left, 0]) / span
    w, x, y, z = knots[left, 4], knots[left, 5], knots[left, 6], knots[left, 7]
    turn_x, turn_y, turn_z = turn_of(
        *product(knots[right, 4], knots[right, 5], knots[right, 6], knots[right, 7], w, -x, -y, -z)
    )
    w, x, y, z = product(*quaternion_by(share * turn_x, share * turn_y, share * turn_z), w, x, y, z)
    px = knots[left, 1] + share * (knots[right, 1] - knots[left, 1])
    py = knots[left, 2] + share * (knots[right, 2] - knots[left, 2])
    pz = knots[left, 3] + share * (knots[right, 3] - knots[left, 3])
    write_pose(px, py, pz, w, x, y, z, pose)
    rate = 0.0 if rests else 1.0 / span
    for axis in range(3):
        velocity[axis] = rate * (knots[right, 1 + axis] - knots[left, 1 + axis])
    velocity[3] = rate * turn_x
    velocity[4] = rate * turn_y
    velocity[5] = rate * turn_z


@leaf
def _wave(time, waves, axis):
    """Value and rate of change of one axis's sum of sines, zero at time zero."""
    value = 0.0
    rate = 0.0
    for n in range(waves.shape[1]):
        amplitude, speed, phase = waves[axis, n, 0], waves[axis, n, 1], waves[axis, n, 2]
        angle = speed * time + phase
        value += amplitude * (math.sin(angle) - waves[axis, n, 3])
        rate += amplitude * speed * math.cos(angle)
    return value, rate


@leaf
def _angular_velocity(x, y, z, dx, dy, dz):
    """Angular velocity of the rotation exp(turn) as the turn changes by (dx, dy, dz) a second.

    The left Jacobian of the rotation group: w = d + a (t x d) + b t x (t x d) with
    a = (1 - cos r) / r^2, b = (r - sin r) / r^3, r the turn's angle.
    """
    square = x * x + y * y + z * z
    if square < 1e-6:  # differences lose digits here: series, whose next terms are below 1e-14
        a = 0.5 - square / 24.0
        b = 1.0 / 6.0 - square / 120.0
    else:
        r = math.sqrt(square)
        a = (1.0 - math.cos(r)) / square
        b = (r - math.sin(r)) / (square * r)
    cx, cy, cz = moment(x, y, z, dx, dy, dz)
    ex, ey, ez = moment(x, y, z, cx, cy, cz)
    return dx + a * cx + b * ex, dy + a * cy + b * ey, dz + a * cz + b * ez


@leaf
def _swaying(time, waves):
    """Position, rotation vector, velocity and angular velocity at a time."""
    px, vx = _wave(time, waves, np.int64(0))
    py, vy = _wave(time, waves, np.int64(1))
    pz, vz = _wave(time, waves, np.int64(2))
    x, dx = _wave(time, waves, np.int64(3))
    y, dy = _wave(time, waves, np.int64(4))
    z, dz = _wave(time, waves, np.int64(5))
    return (px, py, pz), (x, y, z), (vx, vy, vz), _angular_velocity(x, y, z, dx, dy, dz)


@entry(FLOAT, FLOATS3, FLOATS2, FLOATS2, FLOATS)
def sway(time, waves, center, pose, velocity):
    """Pose and velocity at a time of a hand swaying about a pose by sums of sines.

    waves (6, K, 4): amplitude (m; rad for the last three axes, a rotation vector), rad/s, phase,
    the phase's sine. center (4, 4): the pose. Writes pose (4, 4) and velocity (6,), the exact
    derivatives.
    """
    (px, py, pz), (x, y, z), moving, turning = _swaying(time, waves)
    velocity[0], velocity[1], velocity[2] = moving
    velocity[3], velocity[4], velocity[5] = turning
    w, x, y, z = product(*quaternion_by(x, y, z), *quaternion_in(center))
    write_pose(px + center[0, 3], py + center[1, 3], pz + center[2, 3], w, x, y, z, pose)


@entry(FLOATS3, FLOAT, INT)
def survey(waves, cycle, n_samples):
    """Farthest distance, fastest speed and fastest turning over a cycle -> m, m/s, rad/s.

    waves as in `sway`; cycle in seconds, sampled at n_samples times.
    """
    reach = 0.0
    speed = 0.0
    turning = 0.0
    for n in range(n_samples):
        time = n * cycle / n_samples
        (px, py, pz), _, (vx, vy, vz), (wx, wy, wz) = _swaying(time, waves)
        reach = max(reach, px * px + py * py + pz * pz)
        speed = max(speed, vx * vx + vy * vy + vz * vz)
        turning = max(turning, wx * wx + wy * wy + wz * wz)
    return math.sqrt(reach), math.sqrt(speed), math.sqrt(turning)


@entry(INT, FLOAT, FLOAT, FLOAT, FLOATS2, FLOATS, FLOATS, PAIR, PAIR, FLOATS, FLOATS2, FLOATS)
def pull(
    n_steps, step, ahead, rest, hand, hand_velocity, wrench, inertias, grips, body, pose, velocity
):
    """Simulate a body pulled by a hand through a critically damped spring, against a wrench.

    n_steps semi-implicit Euler steps of step seconds. ahead: seconds from the first step's start to
    the time of hand (4, 4) and hand_velocity (6,), a velocity constant until then. inertias
    (kg, kg m^2) and grips (N/m, N m/rad) are pairs. body (13,): position, unit quaternion,
    velocity; changed in place. Writes pose (4, 4), extrapolated by `rest` seconds, and
    velocity (6,).
    """
    mass, inertia = inertias
    grip, turn_grip = grips
    damping = 2.0 * math.sqrt(grip * mass)
    turn_damping = 2.0 * math.sqrt(turn_grip * inertia)
    hw, hx, hy, hz = quaternion_in(hand)
    w, x, y, z = body[3], body[4], body[5], body[6]
    for n in range(n_steps):
        late = n * step - ahead
        for axis in range(3):
            target = hand[axis, 3] + late * hand_velocity[axis]
            force = grip * (target - body[axis]) + wrench[axis]
            force += damping * (hand_velocity[axis] - body[7 + axis])
            body[7 + axis] += step * force / mass
            body[axis] += step * body[7 + axis]
        tw, tx, ty, tz = quaternion_by(
            late * hand_velocity[3], late * hand_velocity[4], late * hand_velocity[5]
        )
        tw, tx, ty, tz = product(tw, tx, ty, tz, hw, hx, hy, hz)
        turns = turn_of(*product(tw, tx, ty, tz, w, -x, -y, -z))
        for axis in range(3):
            torque = turn_grip * turns[axis] + wrench[3 + axis]
            torque += turn_damping * (hand_velocity[3 + axis] - body[10 + axis])
            body[10 + axis] += step * torque / inertia
        w, x, y, z = product(
            *quaternion_by(step * body[10], step * body[11], step * body[12]), w, x, y, z
        )
        scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
        w, x, y, z = w * scale, x * scale, y * scale, z * scale
    body[3], body[4], body[5], body[6] = w, x, y, z
    w, x, y, z = product(
        *quaternion_by(rest * body[10], rest * body[11], rest * body[12]), w, x, y, z
    )
    px, py, pz = body[0] + rest * body[7], body[1] + rest * body[8], body[2] + rest * body[9]
    write_pose(px, py, pz, w, x, y, z, pose)
    for axis in range(6):
        velocity[axis] = body[7 + axis]

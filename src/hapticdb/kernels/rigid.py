"""Rigid motion in kernels: rotations, poses and quaternions.

A pose is a (4, 4) matrix. A quaternion has the scalar first and unit length. A turn is a rotation
vector: axis times angle in radians.
"""

import math

from hapticdb.kernels._jit import FLOATS3, entry, inlined, leaf


@leaf
def is_rigid(pose):
    """Whether a (4, 4) matrix is finite, a rotation to 1e-6, and has the last row 0 0 0 1."""
    for a in range(4):
        for b in range(4):
            if not math.isfinite(pose[a, b]):
                return False
    for b in range(3):
        if pose[3, b] != 0.0:
            return False
    if pose[3, 3] != 1.0:
        return False
    for a in range(3):
        for b in range(a, 3):
            dot = pose[0, a] * pose[0, b] + pose[1, a] * pose[1, b] + pose[2, a] * pose[2, b]
            if abs(dot - (1.0 if a == b else 0.0)) > 1e-6:
                return False
    det = (
        pose[0, 0] * (pose[1, 1] * pose[2, 2] - pose[1, 2] * pose[2, 1])
        - pose[0, 1] * (pose[1, 0] * pose[2, 2] - pose[1, 2] * pose[2, 0])
        + pose[0, 2] * (pose[1, 0] * pose[2, 1] - pose[1, 1] * pose[2, 0])
    )
    return det > 0.0


@entry(FLOATS3)
def first_not_rigid(poses):
    """Index of the first of poses (B, 4, 4) that is not rigid; B if all are."""
    for n in range(poses.shape[0]):
        if not is_rigid(poses[n]):
            return n
    return poses.shape[0]


@inlined
def transform_of(pose):
    """Upper three rows of a pose as twelve numbers, row by row, for registers instead of memory."""
    return (
        pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3],
        pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3],
        pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3],
    )  # fmt: skip


@leaf
def turn(a, b, c, x, y, z):
    """One coordinate of a turned vector: a row (a, b, c) of the rotation times (x, y, z)."""
    return a * x + b * y + c * z


@leaf
def turned(transform, x, y, z):
    """Vector (x, y, z) turned by a pose's rotation; see `transform_of`."""
    a, b, c, _, d, e, f, _, g, h, m, _ = transform
    return turn(a, b, c, x, y, z), turn(d, e, f, x, y, z), turn(g, h, m, x, y, z)


@leaf
def moved(transform, x, y, z):
    """Point (x, y, z) placed by a pose; see `transform_of`."""
    a, b, c, u, d, e, f, v, g, h, m, w = transform
    return turn(a, b, c, x, y, z) + u, turn(d, e, f, x, y, z) + v, turn(g, h, m, x, y, z) + w


@leaf
def moment(rx, ry, rz, fx, fy, fz):
    """Torque of a force at a lever: r x F."""
    return ry * fz - rz * fy, rz * fx - rx * fz, rx * fy - ry * fx


@leaf
def gap(x, low, high):
    """Distance of x from the interval low .. high, 0 inside."""
    return max(low - x, x - high, 0.0)


@leaf
def length_at(numbers, start):
    """Length of the vector in three numbers from `start` on."""
    x, y, z = numbers[start], numbers[start + 1], numbers[start + 2]
    return math.sqrt(x * x + y * y + z * z)


@leaf
def product(aw, ax, ay, az, bw, bx, by, bz):
    """Quaternion product a b: rotation by b, then by a."""
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


@leaf
def turned_by(w, x, y, z, a, b, c):
    """Vector v = (a, b, c) turned by a unit quaternion: v + 2 q x (q x v + w v)."""
    ux, uy, uz = y * c - z * b + w * a, z * a - x * c + w * b, x * b - y * a + w * c
    return a + 2.0 * (y * uz - z * uy), b + 2.0 * (z * ux - x * uz), c + 2.0 * (x * uy - y * ux)


@leaf
def turn_of(w, x, y, z):
    """Turn of a unit quaternion, by at most half a revolution."""
    sine = math.sqrt(x * x + y * y + z * z)
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    # the quotient's limit: w is 1 there
    scale = 2.0 if sine < 1e-12 else 2.0 * math.atan2(sine, w) / sine
    return scale * x, scale * y, scale * z


@leaf
def quaternion_by(x, y, z):
    """Unit quaternion of a turn."""
    angle = math.sqrt(x * x + y * y + z * z)
    scale = 0.5 if angle < 1e-12 else math.sin(0.5 * angle) / angle
    return math.cos(0.5 * angle), scale * x, scale * y, scale * z


@leaf
def quaternion_in(pose):
    """Unit quaternion of a pose's rotation, from its longest component (Shepperd 1978)."""
    xx, yy, zz = pose[0, 0], pose[1, 1], pose[2, 2]
    w, x, y, z = 1.0 + xx + yy + zz, 1.0 + xx - yy - zz, 1.0 - xx + yy - zz, 1.0 - xx - yy + zz
    longest = max(w, x, y, z)
    if longest == w:
        x, y, z = pose[2, 1] - pose[1, 2], pose[0, 2] - pose[2, 0], pose[1, 0] - pose[0, 1]
    elif longest == x:
        w, y, z = pose[2, 1] - pose[1, 2], pose[0, 1] + pose[1, 0], pose[0, 2] + pose[2, 0]
    elif longest == y:
        w, x, z = pose[0, 2] - pose[2, 0], pose[0, 1] + pose[1, 0], pose[1, 2] + pose[2, 1]
    else:
        w, x, y = pose[1, 0] - pose[0, 1], pose[0, 2] + pose[2, 0], pose[1, 2] + pose[2, 1]
    scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    return w * scale, x * scale, y * scale, z * scale


@leaf
def write_pose(px, py, pz, w, x, y, z, pose):
    """Write position and unit quaternion into pose (4, 4), except its last row."""
    pose[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    pose[0, 1] = 2.0 * (x * y - w * z)
    pose[0, 2] = 2.0 * (x * z + w * y)
    pose[0, 3] = px
    pose[1, 0] = 2.0 * (x * y + w * z)
    pose[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    pose[1, 2] = 2.0 * (y * z - w * x)
    pose[1, 3] = py
    pose[2, 0] = 2.0 * (x * z - w * y)
    pose[2, 1] = 2.0 * (y * z + w * x)
    pose[2, 2] = 1.0 - 2.0 * (x * x + y * y)
    pose[2, 3] = pz


@leaf
def pose_of_quaternion(px, py, pz, w, x, y, z, out):
    """Write the matrix, out (4, 4), of a position and a unit quaternion, without normalising it.

    Shared by a session and its replay, for the same bits.
    """
    write_pose(px, py, pz, w, x, y, z, out)
    out[3, 0] = out[3, 1] = out[3, 2] = 0.0
    out[3, 3] = 1.0


@leaf
def numbers_of(body):
    """Fields `position` and `quaternion` of a record, as seven numbers."""
    at, turned = body.position, body.quaternion
    return at[0], at[1], at[2], turned[0], turned[1], turned[2], turned[3]


@leaf
def set_numbers(body, numbers):
    """Write seven numbers into the fields `position` and `quaternion` of a record."""
    for n in range(3):
        body.position[n] = numbers[n]
    for n in range(4):
        body.quaternion[n] = numbers[3 + n]

"""The way of a step: in strides so short that no point can pass a surface unseen.

Every stride is shorter than the lower bound of the distance of every point to every surface
(`near_points`), along the exact screw motion of the step. So a point never gets from one side of a
sheet to the other, however thin the sheet is and however fast the hand moves.
"""

import math

import numpy as np

from hapticdb.kernels._jit import leaf
from hapticdb.kernels.hand.near_points import NOT_KNOWN, OPEN, SHUT, look, settle
from hapticdb.kernels.rigid import length_at, pose_of_quaternion, product, quaternion_by, turn

STRIDE = 0.98
"""Length of a stride, in lower bounds of the least distance. Larger: fewer looks; below 1, or the
proof is lost."""
LEAST_STRIDE = 0.02
"""Voxels: the clearance that a stride counts with at least. Only points that lie in a surface have
less."""
SHORTEST = 0.02
"""Share of a stride below which it is not halved any more. Smaller: more looks at an obstacle."""
MOST_LOOKS = 96
"""Most poses that a period looks at. Larger: a faster hand is followed in one period, and the worst
period takes longer."""


@leaf
def _place_next(turned, center, pose, next_pose, step, vx, vy, vz, wx, wy, wz):
    """Pose after a step at constant velocities, into next_pose (4, 4) -> position, quaternion.

    turned (4,): unit quaternion of pose (4, 4); step in s, velocities of the centre, m/s and rad/s.
    """
    w, x, y, z = product(
        *quaternion_by(step * wx, step * wy, step * wz), turned[0], turned[1], turned[2], turned[3]
    )
    scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = scale * w, scale * x, scale * y, scale * z
    pose_of_quaternion(0.0, 0.0, 0.0, w, x, y, z, next_pose)
    cx, cy, cz = center[0], center[1], center[2]
    # position: the moved centre, minus the centre's lever in the turned frame
    px = turn(pose[0, 0], pose[0, 1], pose[0, 2], cx, cy, cz) + pose[0, 3] + step * vx
    py = turn(pose[1, 0], pose[1, 1], pose[1, 2], cx, cy, cz) + pose[1, 3] + step * vy
    pz = turn(pose[2, 0], pose[2, 1], pose[2, 2], cx, cy, cz) + pose[2, 3] + step * vz
    px -= turn(next_pose[0, 0], next_pose[0, 1], next_pose[0, 2], cx, cy, cz)
    py -= turn(next_pose[1, 0], next_pose[1, 1], next_pose[1, 2], cx, cy, cz)
    pz -= turn(next_pose[2, 0], next_pose[2, 1], next_pose[2, 2], cx, cy, cz)
    pose_of_quaternion(px, py, pz, w, x, y, z, next_pose)
    return px, py, pz, w, x, y, z


@leaf
def place_on_way(tool, center, follower, done):
    """Tool's pose at a share of the step, into tool.tried_pose -> position and quaternion."""
    step = follower.step
    return _place_next(
        tool.quaternion, center, tool.pose, tool.tried_pose, done,
        step[0], step[1], step[2], step[3], step[4], step[5],
    )  # fmt: skip


@leaf
def way_of_step(follower, radius, size):
    """Way that no point exceeds in the whole step, voxels."""
    return (length_at(follower.step, 0) + radius * length_at(follower.step, 3)) / size


@leaf
def _stride_on(cells, which, shell, place, way, done, tool, follower, field, met, missed):
    """Make one stride from share `done` of the step -> where the tool is then, and what was found.

    SHUT: not even a short stride is allowed, or the period has no looks left.
    """
    stride = min(1.0 - done, STRIDE * max(follower.clearance, LEAST_STRIDE) / max(way, 1e-300))
    part = stride
    while part >= SHORTEST * stride and follower.n_looks < MOST_LOOKS:
        end = 1.0 if part >= 1.0 - done else done + part
        place_on_way(tool, shell.center, follower, end)
        moved = way * (end - done)
        found = look(
            cells, which, shell, tool.tried_pose, place, follower.astray + moved, np.bool_(True),
            follower, field, met, missed,
        )  # fmt: skip
        follower.astray = moved
        if found == OPEN:
            settle(follower, field, met)
            return end, found
        if found == NOT_KNOWN:
            return done, found
        part *= 0.5
    return done, SHUT


@leaf
def keep_pose(tool, follower, px, py, pz, w, x, y, z):
    """Make a pose the tool's, which the near points belong to."""
    pose_of_quaternion(px, py, pz, w, x, y, z, tool.pose)
    position, turned, looked_at = tool.position, tool.quaternion, follower.looked_at
    position[0], position[1], position[2] = px, py, pz
    turned[0], turned[1], turned[2], turned[3] = w, x, y, z
    looked_at[0], looked_at[1], looked_at[2] = px, py, pz
    looked_at[3], looked_at[4], looked_at[5], looked_at[6] = w, x, y, z


@leaf
def walk(cells, which, shell, place, radius, tool, follower, field, met, missed):
    """Walk the step as far as the tool may go -> share of the step, and what the last look found.

    radius, m: distance of the farthest point from the tool's centre.
    """
    way = way_of_step(follower, radius, place.size)
    done, found = 0.0, OPEN
    while done < 1.0 and found == OPEN:
        done, found = _stride_on(
            cells, which, shell, place, way, done, tool, follower, field, met, missed
        )
    if done > 0.0:
        px, py, pz, w, x, y, z = place_on_way(tool, shell.center, follower, done)
        keep_pose(tool, follower, px, py, pz, w, x, y, z)
    return done, found

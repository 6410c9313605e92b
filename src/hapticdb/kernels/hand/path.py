"""The way of a step: in strides so short that no point can pass a surface unseen.

Every stride is shorter than the lower bound of the distance of every point to every surface
(`near_points`), along the exact screw motion of the step. So a point never gets from one side of a
sheet to the other, however thin the sheet is and however fast the hand moves.
"""

import math

import numpy as np

from hapticdb.kernels._jit import leaf
from hapticdb.kernels.hand.near_points import NOT_KNOWN, OPEN, SHUT, look, settle
from hapticdb.kernels.rigid import (
    length_at,
    moved,
    pose_of_quaternion,
    product,
    quaternion_by,
    set_numbers,
    transform_of,
    turned,
)

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
def turned_on(step, share, before):
    """Quaternion after a share of the step's turn, not normalised, and its length."""
    w, x, y, z = product(
        *quaternion_by(share * step[3], share * step[4], share * step[5]),
        before[0], before[1], before[2], before[3],
    )  # fmt: skip
    return w, x, y, z, math.sqrt(w * w + x * x + y * y + z * z)


@leaf
def place_on_way(tool, center, follower, done):
    """Tool's pose at a share of the step, into tool.tried_pose -> position and quaternion."""
    step, pose = follower.step, tool.tried_pose
    w, x, y, z, length = turned_on(step, done, tool.quaternion)
    scale = 1.0 / length
    w, x, y, z = scale * w, scale * x, scale * y, scale * z
    pose_of_quaternion(0.0, 0.0, 0.0, w, x, y, z, pose)
    # position: the moved centre, minus the centre's lever in the turned frame
    px, py, pz = moved(transform_of(tool.pose), center[0], center[1], center[2])
    rx, ry, rz = turned(transform_of(pose), center[0], center[1], center[2])
    px, py, pz = px + done * step[0] - rx, py + done * step[1] - ry, pz + done * step[2] - rz
    pose_of_quaternion(px, py, pz, w, x, y, z, pose)
    return px, py, pz, w, x, y, z


@leaf
def way_of_step(follower, radius, size):
    """Way that no point exceeds in the whole step, voxels."""
    return (length_at(follower.step, 0) + radius * length_at(follower.step, 3)) / size


@leaf
def _stride_on(grasp, way, done, tool):
    """Make one stride from share `done` of the step -> where the tool is then, and what was found.

    SHUT: not even a short stride is allowed, or the period has no looks left.
    """
    follower = grasp.follower
    stride = min(1.0 - done, STRIDE * max(follower.clearance, LEAST_STRIDE) / max(way, 1e-300))
    part = stride
    while part >= SHORTEST * stride and follower.n_looks < MOST_LOOKS:
        end = 1.0 if part >= 1.0 - done else done + part
        place_on_way(tool, grasp.shell.center, follower, end)
        passed = way * (end - done)
        found = look(grasp, tool.tried_pose, follower.astray + passed, np.bool_(True))
        follower.astray = passed
        if found == OPEN:
            settle(grasp)
            return end, found
        if found == NOT_KNOWN:
            return done, found
        part *= 0.5
    return done, SHUT


@leaf
def keep_pose(tool, follower, at):
    """Make a pose of seven numbers the tool's, which the near points belong to."""
    pose_of_quaternion(*at, tool.pose)
    set_numbers(tool, at)
    for n in range(7):
        follower.looked_at[n] = at[n]


@leaf
def walk(grasp, radius, tool):
    """Walk the step as far as the tool may go -> share of the step, and what the last look found.

    radius, m: distance of the farthest point from the tool's centre.
    """
    follower = grasp.follower
    way = way_of_step(follower, radius, grasp.place.size)
    done, found = 0.0, OPEN
    while done < 1.0 and found == OPEN:
        done, found = _stride_on(grasp, way, done, tool)
    if done > 0.0:
        keep_pose(tool, follower, place_on_way(tool, grasp.shell.center, follower, done))
    return done, found

"""Conservative advancement along a step: no point crosses a surface.

Every advance is shorter than a lower bound of the distance from any point to any surface
(`near_points`), along the exact screw motion of the step. So no point reaches the other side of a
sheet, however thin the sheet and however fast the hand.
"""

import math

import numpy as np

from hapticdb.kernels._jit import leaf
from hapticdb.kernels.hand.near_points import NOT_KNOWN, OPEN, SHUT, query_proximity, settle
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
"""Length of an advance, in lower bounds of the least distance. Larger: fewer queries; 1 or more
voids the proof."""
LEAST_STRIDE = 0.02
"""Least clearance assumed for an advance, voxels. Only points inside a surface have less."""
SHORTEST = 0.02
"""Least share of an advance after halvings. Smaller: more queries at an obstacle."""
MOST_QUERIES = 96
"""Most poses queried in a period. Larger: a faster hand is followed in one period, and the worst
period takes longer."""


@leaf
def turned_on(step, share, before):
    """Quaternion after a share of the step's rotation, not normalised, and its norm."""
    w, x, y, z = product(
        *quaternion_by(share * step[3], share * step[4], share * step[5]),
        before[0], before[1], before[2], before[3],
    )  # fmt: skip
    return w, x, y, z, math.sqrt(w * w + x * x + y * y + z * z)


@leaf
def place_on_step(tool, center, follower, done):
    """Tool's pose at a share of the step, into tool.tried_pose; return position and quaternion."""
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
def step_bound(follower, radius, size):
    """Upper bound of any point's path length in the whole step, voxels; radius, size : m."""
    # screw motion: |v| + r |w| bounds the arc length at any radius up to r
    return (length_at(follower.step, 0) + radius * length_at(follower.step, 3)) / size


@leaf
def _advance_once(query, path_length, done, tool):
    """Advance once from share `done` of the step; return the new share and the query's result.

    SHUT : even the shortest advance is blocked, or the period has no queries left.
    """
    follower = query.follower
    # conservative advancement: the least clearance bounds the motion of every point
    stride = min(
        1.0 - done, STRIDE * max(follower.clearance, LEAST_STRIDE) / max(path_length, 1e-300)
    )
    part = stride
    # refused below FLOOR or LEAST_BOUND, stricter than the proof: halve towards the obstacle
    while part >= SHORTEST * stride and follower.n_queries < MOST_QUERIES:
        end = 1.0 if part >= 1.0 - done else done + part  # exactly 1: the caller's loop ends
        place_on_step(tool, query.shell.center, follower, end)
        passed = path_length * (end - done)
        # from a refused pose the path leads back to the tool's pose first
        found = query_proximity(query, tool.tried_pose, follower.astray + passed, np.bool_(True))
        follower.astray = passed
        if found == OPEN:
            settle(query)
            return end, found
        if found == NOT_KNOWN:
            return done, found
        part *= 0.5
    return done, SHUT


@leaf
def set_pose(tool, follower, at):
    """Set the pose of the tool and of its near points to `at`: position and quaternion."""
    pose_of_quaternion(*at, tool.pose)
    set_numbers(tool, at)
    for n in range(7):
        follower.queried_at[n] = at[n]


@leaf
def advance_step(query, radius, tool):
    """Advance along the step up to an obstacle; return the share done and the last query's result.

    radius : m, from the tool's centre to its farthest point.
    """
    follower = query.follower
    path_length = step_bound(follower, radius, query.grid.size)
    done, found = 0.0, OPEN
    # shares refer to the pose at the start of the step: it is unchanged until the end
    while done < 1.0 and found == OPEN:
        done, found = _advance_once(query, path_length, done, tool)
    if done > 0.0:
        # again, since `tried_pose` may be a refused pose beyond `done`
        set_pose(tool, follower, place_on_step(tool, query.shell.center, follower, done))
    return done, found

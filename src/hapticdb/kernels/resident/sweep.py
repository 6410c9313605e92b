"""Poses between the given poses of a path, and voxels as one number."""

import numpy as np

from hapticdb.kernels._jit import FLOATS, FLOATS2, FLOATS3, INT, INTS, entry, leaf
from hapticdb.kernels.query.grouping import first_bound
from hapticdb.kernels.rigid import pose_of_quaternion, product, quaternion_by, transform_of, turned

AXIS_BITS = 21
"""Bits of each coordinate of a packed voxel, i uppermost. Three coordinates must fit an int64."""
AXIS_MASK = (1 << AXIS_BITS) - 1
CAUTION = 1e-6
"""Voxels by which a bound is lowered, so that rounding errors cannot make it wrong."""


@entry(FLOATS3, FLOATS2, FLOATS2, FLOATS2, INTS, FLOATS, INT, FLOATS3)
def poses_between(poses, centers, quaternions, turns, starts, center, first, out):
    """Write samples first .. first + B - 1 of a path to out (B, 4, 4).

    Between two poses the tool's centre moves on a line and the tool turns by slerp. A sample at a
    given pose is exactly that pose. poses (M, 4, 4) as given; centers (M, 3): position of the
    tool's point `center` (3,) at each pose, metres; quaternions (M, 4); turns (M - 1, 3): rotation
    vectors from each pose to the next, world frame; starts (M,) int64: the sample at each pose.
    """
    at = first_bound(first + 1, starts, np.int64(0)) - 1
    x, y, z = center[0], center[1], center[2]
    for n in range(out.shape[0]):
        sample = first + n
        while at + 1 < starts.shape[0] and starts[at + 1] <= sample:
            at += 1
        pose = out[n]
        if sample == starts[at]:
            for a in range(4):
                for b in range(4):
                    pose[a, b] = poses[at, a, b]
            continue
        share = (sample - starts[at]) / (starts[at + 1] - starts[at])
        qw, qx = quaternions[at, 0], quaternions[at, 1]
        qy, qz = quaternions[at, 2], quaternions[at, 3]
        qw, qx, qy, qz = product(
            *quaternion_by(share * turns[at, 0], share * turns[at, 1], share * turns[at, 2]),
            qw, qx, qy, qz,
        )  # fmt: skip
        px = centers[at, 0] + share * (centers[at + 1, 0] - centers[at, 0])
        py = centers[at, 1] + share * (centers[at + 1, 1] - centers[at, 1])
        pz = centers[at, 2] + share * (centers[at + 1, 2] - centers[at, 2])
        pose_of_quaternion(px, py, pz, qw, qx, qy, qz, pose)
        tx, ty, tz = turned(transform_of(pose), x, y, z)
        pose[0, 3] -= tx
        pose[1, 3] -= ty
        pose[2, 3] -= tz


@leaf
def packed(i, j, k):
    """Voxel (i, j, k) as one number."""
    return (i << (2 * AXIS_BITS)) | (j << AXIS_BITS) | k


@leaf
def unpacked(voxel):
    """Voxel (i, j, k) of a number; undoes `packed`."""
    return voxel >> (2 * AXIS_BITS), (voxel >> AXIS_BITS) & AXIS_MASK, voxel & AXIS_MASK

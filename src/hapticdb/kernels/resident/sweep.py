"""A path swept through resident cells: poses between the given poses, and hits with their voxels.

The search for hits stops at the first cell that is not resident and returns where it stopped. The
caller fetches that cell and continues the search; no hit is guessed.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import (
    FLOATS,
    FLOATS2,
    FLOATS3,
    INT,
    INTS,
    entry,
    fields_of,
    inlined,
    leaf,
)
from hapticdb.kernels.law import depth_below_plane
from hapticdb.kernels.query.contact import center_of
from hapticdb.kernels.query.grouping import first_bound
from hapticdb.kernels.resident.cells import (
    CELLS,
    CLUSTERS,
    PLACE,
    begin_frame,
    bit_in,
    cell_key,
    column_of,
    end_frame,
    place_in_set,
    slot_of,
)
from hapticdb.kernels.resident.runs import free_runs
from hapticdb.kernels.rigid import (
    moved,
    pose_of_quaternion,
    product,
    quaternion_by,
    transform_of,
    turned,
)

AXIS_BITS = 21
"""Bits of each coordinate of a packed voxel, i uppermost. Three coordinates must fit an int64."""
AXIS_MASK = (1 << AXIS_BITS) - 1
CAUTION = 1e-6
"""Voxels by which a bound is lowered, so that rounding errors cannot make it wrong."""


class Found(NamedTuple):
    """H hits as `find_hits` writes them.

    samples (H,) int64: indices into the poses; points (H,) int64: indices of the shell's points;
    places (H,) int64: index of the hit's voxel in `voxels`; depths (H,): metres, not below 0;
    voxels (capacity,) int64: an open-addressing set of packed voxels, -1 where free; its capacity
    is a power of two.
    """

    samples: NDArray[np.int64]
    points: NDArray[np.int64]
    places: NDArray[np.int64]
    depths: NDArray[np.float64]
    voxels: NDArray[np.int64]


FOUND = fields_of(Found, INTS, INTS, INTS, FLOATS, INTS)


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


def unpack(voxels: NDArray[np.int64]) -> NDArray[np.int64]:
    """Voxels (n, 3) of numbers (n,)."""
    rest = voxels >> AXIS_BITS
    return np.stack([rest >> AXIS_BITS, rest & AXIS_MASK, voxels & AXIS_MASK], axis=1)


@inlined
def entered(voxels, voxel):
    """Index of a packed voxel in the set `voxels`; enters the voxel if it is not there."""
    at = place_in_set(voxels, voxel)
    voxels[at] = voxel
    return at


@inlined
def _hits_of_pose(cells, which, shell, transform, place, sample, count, found):
    """Append hits of one placed shell to `found` -> its number of hits, -1 if a cell is unknown.

    sample: index of the pose, written with each hit.
    """
    _, _, keys, slots, words, masks, used, _, _ = cells
    points, _, spheres, groups, run, _, _ = shell
    ox, oy, oz, size, side = place.x, place.y, place.z, place.size, place.side
    cluster = start = 0
    while start < points.shape[0]:
        n_free = free_runs(
            keys, slots, words, masks, used, which, spheres, groups, cluster, transform, place, 0.0
        )
        if n_free > 0:
            cluster += n_free
            start += n_free * run
            continue
        for n in range(start, min(start + run, points.shape[0])):
            px, py, pz = moved(transform, points[n, 0], points[n, 1], points[n, 2])
            x, y, z = (px - ox) / size, (py - oy) / size, (pz - oz) / size
            if not (0.0 <= x < side and 0.0 <= y < side and 0.0 <= z < side):
                continue
            i, j, k = np.int64(x), np.int64(y), np.int64(z)
            slot = slot_of(keys, slots, which, cell_key(i, j, k))
            if slot < 0:
                return np.int64(-1)
            if not bit_in(words[slot, column_of(i, j)], k):
                continue
            nx, ny, nz = turned(transform, points[n, 3], points[n, 4], points[n, 5])
            cx, cy, cz = center_of(px, ox, size), center_of(py, oy, size), center_of(pz, oz, size)
            found.samples[count] = sample
            found.points[count] = n
            found.places[count] = entered(found.voxels, packed(i, j, k))
            found.depths[count] = max(depth_below_plane(px, py, pz, nx, ny, nz, cx, cy, cz), 0.0)
            count += 1
        cluster += 1
        start += run
    return np.int64(count)


@entry(CELLS, INT, CLUSTERS, FLOATS3, INTS, PLACE, INT, INT, FOUND)
def find_hits(cells, reader, shell, poses, samples, place, first, count, found):
    """Hits at poses[samples[first:]], appended to `found` from its entry `count` on.

    Runs of points whose sphere is free are skipped. Returns the number of samples (S,) done and the
    number of hits now. There are fewer samples than S when a cell was not resident; hits of the
    sample that was not finished are not counted. Depths equal those of `cells.felt` under the
    tangent-plane law, bit for bit.
    """
    which = begin_frame(cells, reader)
    for at in range(first, samples.shape[0]):
        sample = samples[at]
        now = _hits_of_pose(
            cells, which, shell, transform_of(poses[sample]), place, sample, count, found
        )
        if now < 0:
            end_frame(cells, reader)
            return at, count
        count = now
    end_frame(cells, reader)
    return samples.shape[0], count

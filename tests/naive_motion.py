"""The motion between given poses in plain formulas: an oracle for paths and sweeps."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]


def middle_of(points: Floats) -> Floats:
    """Middle (3,) of the bounding box of a shell's points (N, 3)."""
    return np.asarray(0.5 * (points.min(axis=0) + points.max(axis=0)))


def poses_at(poses: Floats, middle: Floats, times: Floats) -> Floats:
    """Poses (n, 4, 4) at times (n,): time m + s is the share s of the way from pose m to the next.

    middle (3,): the tool's middle in its own frame.
    """
    last = len(poses) - 1
    times = np.clip(times, 0.0, last)
    m = np.minimum(times.astype(int), max(last - 1, 0))
    a, b, share = poses[m], poses[np.minimum(m + 1, last)], (times - m)[:, None]
    turns = Rotation.from_matrix(b[:, :3, :3] @ a[:, :3, :3].swapaxes(1, 2)).as_rotvec()
    begin, end = placed(a, middle[None])[:, 0], placed(b, middle[None])[:, 0]
    out = np.tile(np.eye(4), (len(times), 1, 1))
    out[:, :3, :3] = Rotation.from_rotvec(share * turns).as_matrix() @ a[:, :3, :3]
    out[:, :3, 3] = begin + share * (end - begin) - out[:, :3, :3] @ middle
    return out


def placed(poses: Floats, points: Floats) -> Floats:
    """Points (N, 3) of the tool at poses (n, 4, 4): (n, N, 3)."""
    turned = np.einsum("nab,pb->npa", poses[:, :3, :3], points)
    return np.asarray(turned + poses[:, None, :3, 3])

"""The poses that a path is given by."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.errors import UsageError
from hapticdb.poses import as_floats

Floats = NDArray[np.float64]

RIGID = 1e-6
"""Greatest deviation of a rotation's columns from orthonormal ones; the same as for a frame."""


def checked_poses(poses: ArrayLike) -> Floats:
    """Check that poses (M, 4, 4) are rigid transforms, and return them."""
    given = as_floats(poses, "a path")
    if given.ndim != 3 or given.shape[1:] != (4, 4) or not len(given):
        raise UsageError(f"a path of shape {given.shape}: give poses (M, 4, 4), one at least")
    rotations = given[:, :3, :3]
    with np.errstate(invalid="ignore", over="ignore"):
        products = np.swapaxes(rotations, 1, 2) @ rotations
        is_rigid = (
            np.isfinite(given).all(axis=(1, 2))
            & (np.abs(products - np.eye(3)).max(axis=(1, 2)) <= RIGID)
            & (np.linalg.det(np.nan_to_num(rotations)) > 0.0)
            & (given[:, 3] == (0.0, 0.0, 0.0, 1.0)).all(axis=1)
        )
    bad = np.flatnonzero(~is_rigid)
    if len(bad):
        raise UsageError(f"pose {bad[0]} of the path is no rigid transform: give a rotation")
    return given


def turns_between(quaternions: Floats) -> Floats:
    """Rotation vectors (M - 1, 3), world frame: smallest turn from each quaternion to the next."""
    aw, a = quaternions[1:, :1], quaternions[1:, 1:]
    bw, b = quaternions[:-1, :1], -quaternions[:-1, 1:]
    w = aw * bw - (a * b).sum(axis=1, keepdims=True)
    v = aw * b + bw * a + np.cross(a, b)
    v = np.where(w < 0.0, -v, v)
    sine = np.linalg.norm(v, axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, np.abs(w))
    return np.asarray(v * np.where(sine < 1e-12, 2.0, angle / np.maximum(sine, 1e-300)))

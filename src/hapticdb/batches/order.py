"""Order of computation of a batch: along the grid's space-filling curve.

So resident cells serve many poses before their eviction.
"""

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import UsageError
from hapticdb.grid import Grid
from hapticdb.kernels import rigid

AT_ONCE = 1 << 14
"""Poses copied together for the check, 2 MB. Larger: more memory."""


def not_rigid(pose: int) -> UsageError:
    """Error for a pose that is not rigid, with its number."""
    return UsageError(
        f"pose {pose}: a pose that is no rigid transform: give finite numbers and a rotation"
    )


def order_of(
    poses: NDArray[np.float64], center: NDArray[np.float64], grid: Grid
) -> NDArray[np.int64]:
    """Indices (B,) of poses (B, 4, 4) along the grid's curve, by the tool's centre.

    The poses may lie in a mapped file. center (3,), tool frame, metres. `UsageError` names the
    first pose that is not rigid.
    """
    keys = np.empty(len(poses), dtype=np.int64)
    for start in range(0, len(poses), AT_ONCE):
        part = np.array(poses[start : start + AT_ONCE])
        first = rigid.first_not_rigid(part)
        if first < len(part):
            raise not_rigid(start + first)
        places = grid.to_voxel_units(part[:, :3, :3] @ center + part[:, :3, 3])
        voxels = np.clip(places, 0, grid.side - 1).astype(np.int64)
        keys[start : start + AT_ONCE] = grid.encode(voxels)
    return np.argsort(keys, kind="stable")

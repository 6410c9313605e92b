"""The order in which the poses of a batch are computed: neighbours in space follow one another.

So the cells that are in memory serve many poses before others take their place.
"""

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import UsageError
from hapticdb.grid import Grid
from hapticdb.kernels import rigid

AT_ONCE = 1 << 14
"""Poses that are copied at once to be checked, 2 MB. A larger value takes more memory."""


def not_rigid(pose: int) -> UsageError:
    """Build the error for a pose of that number that is not rigid."""
    return UsageError(
        f"pose {pose}: a pose that is no rigid transform: give finite numbers and a rotation"
    )


def order_of(
    poses: NDArray[np.float64], center: NDArray[np.float64], grid: Grid
) -> NDArray[np.int64]:
    """Indices (B,) of poses (B, 4, 4), along the grid's curve, by the place of the tool's centre.

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

"""Changed cells wake the clusters that they concern; all others sleep on.

The rest of a run (`sleeping`) was found in a cube: around the centre where the rest began, half a
side of the run's radius, the law's margin and the rest. Nothing outside the cube has a part in it.
So a cell that changes, or that is forgotten, ends the rests of the runs whose cubes it meets. A
cell that was unknown counted as occupied; when it becomes known it ends no rest.

The writer of the directory enters the changed cells of each version in a ring (`cells.CHANGED`). A
frame reads those between the version of its last frame and its own. If the ring does not have all
of them any more, all clusters wake.
"""

from hapticdb.kernels._jit import inlined, leaf
from hapticdb.kernels.resident.cells import (
    CHANGED,
    CHANGES,
    CHANGES_BEGUN,
    CHANGES_KEPT,
    cell_of_key,
)
from hapticdb.kernels.resident.fence import fence

FOLLOWED, WOKEN, STATE = 0, 1, 2
"""Indices of `Sleepers.state`: the number of changes up to which rests hold, -1 before the first
frame; the number of times that a changed cell has woken a sleeping run; their number."""
AWAKE = -1.0
"""Rest of what is awake."""
SLACK = 1e-3
"""Voxels added to each cube: far more than the rounding errors of a frame."""
CELL_SIDE = 32.0
"""Side of a cell, voxels."""


@leaf
def _changes_since(control, which, followed, changed):
    """Copy the lowest corners of the cells changed since `followed`, voxels, to changed (K, 3).

    which: the directory that the frame reads. Returns the number of changes up to that directory,
    and the number of cells copied, below zero if changes are lost.
    """
    end = control[CHANGES + which]
    count = end - followed
    if followed < 0 or count < 0 or count > CHANGES_KEPT:
        return end, -1
    for n in range(count):
        ci, cj, ck = cell_of_key(control[CHANGED + (followed + n) % CHANGES_KEPT])
        changed[n, 0] = CELL_SIDE * ci
        changed[n, 1] = CELL_SIDE * cj
        changed[n, 2] = CELL_SIDE * ck
    if count > 0:
        fence()  # a writer says what it will overwrite before it does so
        if control[CHANGES_BEGUN] - followed > CHANGES_KEPT:
            return end, -1
    return end, count


@inlined
def _cube_of_rest(rests, spheres, n, margin, size):
    """Half the side of the cube in which run n found its rest, voxels; its centre is in `rests`."""
    return spheres[n, 3] / size + margin + rests[n, 3] + SLACK


@inlined
def is_met(changed, cell, low_x, low_y, low_z, high_x, high_y, high_z):
    """Whether a changed cell meets a closed box, voxels."""
    x, y, z = changed[cell, 0], changed[cell, 1], changed[cell, 2]
    return (
        x <= high_x
        and x + CELL_SIDE >= low_x
        and y <= high_y
        and y + CELL_SIDE >= low_y
        and z <= high_z
        and z + CELL_SIDE >= low_z
    )


@leaf
def _wake_all(rests, block_rests, rest, state):
    """End all rests; counts the runs that slept. rest: column of `block_rests`."""
    for block in range(block_rests.shape[0]):
        block_rests[block, rest] = AWAKE
    for n in range(rests.shape[0]):
        state[WOKEN] += rests[n, 3] >= 0.0
        rests[n, 3] = AWAKE


@leaf
def _wake_runs(rests, spheres, start, end, changed, cell, margin, size):
    """End the rests of runs start .. end - 1 that a changed cell concerns -> their number."""
    woken = 0
    for n in range(start, end):
        if rests[n, 3] < 0.0:
            continue
        half = _cube_of_rest(rests, spheres, n, margin, size)
        x, y, z = rests[n, 0], rests[n, 1], rests[n, 2]
        if is_met(changed, cell, x - half, y - half, z - half, x + half, y + half, z + half):
            rests[n, 3] = AWAKE
            woken += 1
    return woken


@leaf
def wake_changed(
    control, which, spheres, rests, block_rests, rest, block_size, state, changed, margin, size
):
    """End the rests that cells concern which changed since the last frame.

    rests (C, 4), block_rests (B, `rest` + 1), state (STATE,) and changed (K, 3): those of
    `sleeping.Sleepers`; block_size: runs of a block. A changed cell is compared with the box around
    the cubes of a block's sleeping runs first, then with each of these cubes.
    """
    followed = state[FOLLOWED]
    end, count = _changes_since(control, which, followed, changed)
    if end == followed:
        return
    state[FOLLOWED] = end
    if count < 0:
        _wake_all(rests, block_rests, rest, state)
        return
    for block in range(block_rests.shape[0]):
        start = block * block_size
        stop = min(start + block_size, spheres.shape[0])
        low_x = low_y = low_z = 1e30
        high_x = high_y = high_z = -1e30
        for n in range(start, stop):
            if rests[n, 3] >= 0.0:
                half = _cube_of_rest(rests, spheres, n, margin, size)
                x, y, z = rests[n, 0], rests[n, 1], rests[n, 2]
                low_x, low_y, low_z = (
                    min(low_x, x - half),
                    min(low_y, y - half),
                    min(low_z, z - half),
                )
                high_x, high_y = max(high_x, x + half), max(high_y, y + half)
                high_z = max(high_z, z + half)
        for cell in range(count):
            if is_met(changed, cell, low_x, low_y, low_z, high_x, high_y, high_z):
                woken = _wake_runs(rests, spheres, start, stop, changed, cell, margin, size)
                if woken > 0:
                    block_rests[block, rest] = AWAKE
                    state[WOKEN] += woken

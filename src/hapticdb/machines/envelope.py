"""Swept envelopes: closed surfaces around all places of a tool or machine on its path.

No place moves by more than the path's parameter. With samples every two voxels each swept place is
within one voxel of a triangle at a sample, so the voxels of these triangles and their neighbours
contain the swept surface. Nothing leaves a closed surface, so all that they enclose is added.
"""

from collections.abc import Sequence
from math import ceil

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.errors import UsageError
from hapticdb.exact.movers import Mover
from hapticdb.exact.path import ToolPath, checked_poses
from hapticdb.exact.sweep import center_of
from hapticdb.grid import corners_of
from hapticdb.kernels.surfaces.triangle_bvh import normals_of
from hapticdb.kernels.surfaces.voxelize import brick_voxels, voxelize_pieces
from hapticdb.machines.joint_path import DEVIATION, checked_values, joint_path, mover_of
from hapticdb.machines.machine import Machine
from hapticdb.mesh import Part
from hapticdb.pointshell.shell import PointShell
from hapticdb.pointshell.tool_surface import ToolSurface
from hapticdb.units import length_text

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MOST_CELLS, USUAL_CELLS = 1 << 26, 1 << 21
"""Voxels of the path's box: at most, 1 GiB, and unless their size is given."""
MOST_VISITS = 1e9
"""Visits of voxels, a minute of work: a triangle takes the time of 4, a sample that of 100."""
BOX_SAMPLES, TRIANGLES_AT_ONCE, BRICKS_AT_ONCE = 1024, 1 << 18, 1 << 13
"""Samples of a path for its box; triangles and bricks of a batch, 0.1 GiB."""
BORDER = 3
"""Voxels beside the box: touched ones, their neighbours, and one that stays empty."""


def sweep_envelope(
    tool: PointShell | Machine, path: ArrayLike, name: str, *,
    voxel: float | None = None, about: ArrayLike | None = None, at: ArrayLike | None = None,
) -> Part:  # fmt: skip
    """Closed surface around all that a tool or machine sweeps; `Environment.add` stores it.

    Nothing of the motion is outside. On each axis the surface is two voxels from it at most, but
    what the motion encloses is filled.

    Parameters
    ----------
    tool, path, about, at
        A tool and poses (M, 4, 4) as for `sweep`, or a machine and joint values as for
        `sweep_machine`.
    name : str
        Of the part.
    voxel : float or None
        Edge of the voxels, metres; unless given, 2 million fill the path's box.

    Raises
    ------
    UsageError
        As for `sweep`; for voxels too small for the path.
    """
    from scipy.ndimage import label, maximum_filter  # noqa: PLC0415 - a third of a second

    if voxel is not None and not 0.0 < voxel < np.inf:
        raise UsageError(f"an envelope in voxels of {voxel} m: give a length above 0")
    movers = _movers(tool, path, about, at)
    margin = DEVIATION + max(one.tool.chord + one.tool.radius for one in movers)
    low, edges = _box(movers)
    most = MOST_CELLS if voxel else USUAL_CELLS
    size = _least_size(movers, edges, most, max(voxel or 0.0, 4.0 * margin))
    if voxel is not None and size > voxel:
        raise UsageError(
            f"an envelope in voxels of {length_text(voxel)}: they are too many, or smaller than "
            f"errors of the surfaces; {length_text(1.01 * size)} would do"
        )
    origin = low - BORDER * size
    cells = np.zeros(np.ceil(edges / size).astype(np.int64) + 2 * BORDER, np.bool_)
    for mover in movers:
        _mark(cells, mover, origin, size, 2.0 * (size - margin))
    # region 1 has the first voxel, which is outside
    corners, faces = _boundary(label(~maximum_filter(cells, 3))[0] != 1)
    placed = np.eye(4)
    placed[:3, 3] = origin
    return Part(name, size * corners, faces, placed, attributes={"voxel": length_text(size)})


def _movers(
    tool: PointShell | Machine, path: ArrayLike, about: ArrayLike | None, at: ArrayLike | None
) -> list[Mover]:
    if isinstance(tool, Machine):
        base = np.eye(4) if at is None else checked_poses(np.asarray(at)[None])[0]
        links = [(0, link) for link in tool.surfaces]
        joints, steps = joint_path(tool, checked_values(tool, path), links)
        return [mover_of(tool, joints, *link, steps[link], None, base) for link in links]
    body = ToolSurface(tool)
    return [Mover(body, ToolPath.of(path, body.corners, center_of(body, about)).checked())]


def _box(movers: Sequence[Mover]) -> tuple[Floats, Floats]:
    """Lower corner (3,) and edges (3,) of a box of the motion."""
    lows, highs = [], []
    for tool, path, *_ in movers:
        poses = path.at(np.linspace(0.0, path.length, BOX_SAMPLES))
        places = corners_of(tool.box) @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
        lows.append(places.min(axis=(0, 1)) - path.length / BOX_SAMPLES)
        highs.append(places.max(axis=(0, 1)) + path.length / BOX_SAMPLES)
    low = np.min(lows, axis=0)
    return low, np.max(highs, axis=0) - low


def _least_size(movers: Sequence[Mover], edges: Floats, most: int, wanted: float) -> float:
    """Least voxel size within the limits, not below the wanted one; most : voxels of the box."""
    bodies = [(path.length, tool.tree.corners) for tool, path, *_ in movers]
    parts = [(far, 4 * len(one) + 100, normals_of(one)[1].sum()) for far, one in bodies]
    size = max(wanted, float(edges.max()) / most)
    while True:
        visits = sum((far / size + 1.0) * (n + area / size**2) for far, n, area in parts)
        if np.prod(edges / size + 2.0 * BORDER) <= most and visits <= MOST_VISITS:
            return size
        size *= 1.02


def _mark(cells: NDArray[np.bool_], mover: Mover, origin: Floats, size: float, step: float) -> None:
    """Mark the voxels of the triangles at samples of the path, a step apart at most."""
    path, corners = mover.path, mover.tool.tree.corners.reshape(-1, 3)
    samples = np.linspace(0.0, path.length, ceil(path.length / step) + 1)
    at_once = 3 * TRIANGLES_AT_ONCE // len(corners) + 1
    for first in range(0, len(samples), at_once):
        poses = path.at(samples[first : first + at_once])
        # contiguous, and scaled before: a third of the time
        placed = corners @ np.ascontiguousarray(np.swapaxes(poses[:, :3, :3], 1, 2) / size)
        placed += (poses[:, None, :3, 3] - origin) / size
        bits = max(cells.shape).bit_length()
        for _, keys, bricks in voxelize_pieces(placed, bits, BRICKS_AT_ONCE):
            cells[tuple(brick_voxels(keys, bricks).T)] = True


def _boundary(cells: NDArray[np.bool_]) -> tuple[Floats, Ints]:
    """Corners (V, 3), in voxels, and faces (F, 3), outward, of the voxels' boundary."""
    quads = []
    for axis in range(3):
        u, v = np.roll(np.eye(3, dtype=np.int64), -axis, axis=0)[1:]
        change = np.diff(cells.view(np.int8), axis=axis)
        for side in (1, -1):
            at = np.argwhere(change == -side)
            at[:, axis] += 1
            quads.append(at[:, None] + np.stack([0 * u, u, u + v, v])[::side])
    shape, corners = tuple(n + 1 for n in cells.shape), np.concatenate(quads).reshape(-1, 3)
    keys, numbers = np.unique(np.ravel_multi_index(tuple(corners.T), shape), return_inverse=True)
    faces = numbers.reshape(-1, 4)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    return np.stack(np.unravel_index(keys, shape), axis=1).astype(np.float64), faces

"""Exact distances of a tool's surface from those of objects, at many poses."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from hapticdb.batches.result import ClearanceBatch
from hapticdb.ingest.geometry import parts_of
from hapticdb.pointshell.moving import MovingSurface, tree_of
from hapticdb.pointshell.shell import PointShell
from hapticdb.store.base import Object, Store

Floats = NDArray[np.float64]


def exact_clearance(
    store: Store,
    objects: Sequence[Object],
    shell: PointShell,
    poses: Floats,
    reach: float,
    progress: Callable[[int, int], None] | None,
) -> ClearanceBatch:
    """Distances at poses (B, 4, 4), rigid; boxes say which objects may be near, surfaces how near.

    Raises `UsageError` if the shell has no surface, NoSurfaceError if an object has none.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415 - a third of a second

    tool = MovingSurface(shell)
    found = ClearanceBatch(len(poses), reach, 0.0)
    places = np.zeros((len(poses), 3))
    found.revision = store.revision()
    gaps = _box_gaps(objects, tool.corners, poses)
    order = np.argsort(gaps.min(axis=1, initial=np.inf), kind="stable")
    for n, i in enumerate(order.tolist()):
        near = np.flatnonzero(gaps[i] < found.distances)
        if len(near):
            ((_, part),) = parts_of(store, [objects[i]])
            measured = tool.nearest(
                tree_of(part.surface()), poses[near], found.distances[near].copy()
            )
            is_nearer = measured.pairs[:, 0] >= 0
            at = near[is_nearer]
            found.distances[at] = measured.at_least[is_nearer]
            places[at] = measured.on_b[is_nearer]
            found.points[at] = 0
        if progress is not None:
            progress(((n + 1) * len(poses)) // len(objects), len(poses))
    at = np.flatnonzero(found.points == 0)
    local = np.einsum("nji,nj->ni", poses[at, :3, :3], places[at] - poses[at, :3, 3])
    found.points[at] = cKDTree(shell.points).query(local)[1] if len(at) else 0
    return found


def _box_gaps(objects: Sequence[Object], corners: Floats, poses: Floats) -> Floats:
    """Distances (O, B) of objects' boxes from the tool's box at poses, never too large."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    middles = poses[:, :3, :3] @ (0.5 * (low + high)) + poses[:, :3, 3]
    reach = np.abs(poses[:, :3, :3]) @ (0.5 * (high - low))
    out = np.empty((len(objects), len(poses)))
    for row, obj in zip(out, objects, strict=True):
        apart = np.maximum(middles - reach - obj.bounds[1], obj.bounds[0] - middles - reach)
        row[:] = np.linalg.norm(np.maximum(apart, 0.0), axis=1)
    return out

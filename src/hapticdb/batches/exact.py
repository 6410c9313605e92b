"""Exact distances of a tool's surface from surfaces of objects, at many poses."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from hapticdb.batches.result import ClearanceBatch
from hapticdb.ingest.geometry import parts_of
from hapticdb.pointshell.moving import MovingSurface
from hapticdb.pointshell.shape import tree_of
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
    """Distances at rigid poses (B, 4, 4); broad phase by AABBs; UsageError without a surface."""
    from scipy.spatial import cKDTree  # noqa: PLC0415 - a third of a second

    tool = MovingSurface(shell)
    found = ClearanceBatch(len(poses), reach)
    places = np.zeros((len(poses), 3))
    found.revision = store.revision()
    bounds = np.array([obj.bounds for obj in objects]).reshape(-1, 2, 3)
    gaps = tool.box_gaps(bounds, poses)
    order = np.argsort(gaps.min(axis=1, initial=np.inf), kind="stable").tolist()
    parts = parts_of(store, [objects[i] for i in order])
    for n, (i, (_, part)) in enumerate(zip(order, parts, strict=True)):
        near = np.flatnonzero(gaps[i] < found.distances)
        if len(near):
            tree = tree_of(part.surface())
            measured = tool.nearest(tree, poses[near], found.distances[near].copy())
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

"""Exact distances of surfaces: of a tool from objects at many poses, and of two objects."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from hapticdb.array_types import Floats
from hapticdb.batches.batch_results import ClearanceBatch
from hapticdb.batches.order import not_rigid
from hapticdb.errors import UsageError
from hapticdb.ingest.geometry import parts_of
from hapticdb.kernels.rigid import first_not_rigid
from hapticdb.kernels.surfaces.triangle_bvh import TriangleBVH
from hapticdb.kernels.triangles.surface_distance import nearest
from hapticdb.pointshell.shape import bvh_of
from hapticdb.pointshell.shell import PointShell
from hapticdb.pointshell.tool_surface import ToolSurface
from hapticdb.store.base import Object, Store

MET = 1e-9
"""Metres: surfaces that are farther apart do not meet."""


class Distance(NamedTuple):
    """Least distance of the surfaces of two objects, metres.

    a, b : the objects; at_least, at_most : bounds, 0 where the surfaces meet; they differ by
    rounding and by chord errors; on_a, on_b (3,) : the nearest places, world frame.
    """

    a: Object
    b: Object
    at_least: float
    at_most: float
    on_a: Floats
    on_b: Floats


def least_distance(store: Store, ones: Sequence[Object], others: Sequence[Object]) -> Distance:
    """Least distance of any of some objects from any of others; broad phase by AABBs."""
    boxes, more = (np.array([obj.bounds for obj in some]) for some in (ones, others))
    apart = np.maximum(boxes[:, None, 0] - more[None, :, 1], more[None, :, 0] - boxes[:, None, 1])
    gaps = np.linalg.norm(np.maximum(apart, 0.0), axis=2)
    trees: dict[int, tuple[TriangleBVH, float]] = {}

    def tree_and_chord(obj: Object) -> tuple[TriangleBVH, float]:
        if obj.id not in trees:
            ((_, part),) = parts_of(store, [obj])
            trees[obj.id] = bvh_of(part.surface()), part.placed_chord
        return trees[obj.id]

    found, least_of_all, limit = None, np.inf, np.inf
    for n in np.argsort(gaps, axis=None, kind="stable").tolist():
        i, j = divmod(n, len(others))
        if gaps[i, j] >= limit:
            break
        one, other = ones[i], others[j]
        if one.id == other.id:
            continue
        (tree, chord), (second, more_chord) = tree_and_chord(one), tree_and_chord(other)
        error = chord + more_chord
        near = nearest(tree, second, np.eye(4)[None], np.array([limit + error]))
        if near.pairs[0, 0] >= 0:
            least, most = max(float(near.at_least[0]) - error, 0.0), float(near.at_most[0]) + error
            least_of_all = min(least_of_all, least)
            if most < limit:
                found, limit = Distance(one, other, least, most, near.on_a[0], near.on_b[0]), most
    if found is None:
        raise UsageError("distance: give two different objects")
    return found._replace(at_least=least_of_all)


def exact_clearance(
    store: Store,
    objects: Sequence[Object],
    shell: PointShell,
    poses: Floats,
    reach: float,
    progress: Callable[[int, int], None] | None,
) -> ClearanceBatch:
    """Distances at rigid poses (B, 4, 4); broad phase by AABBs; UsageError otherwise."""
    from scipy.spatial import cKDTree  # noqa: PLC0415 - a third of a second

    first = first_not_rigid(poses)
    if first < len(poses):
        raise not_rigid(first)
    tool = ToolSurface(shell)
    found = ClearanceBatch(len(poses), reach)
    places = np.zeros((len(poses), 3))
    found.revision = store.revision()
    bounds = np.array([obj.bounds for obj in objects]).reshape(-1, 2, 3)
    gaps = tool.box_gaps(bounds, poses)
    order = np.argsort(gaps.min(axis=1, initial=np.inf), kind="stable").tolist()
    parts = parts_of(store, [objects[i] for i in order])
    for n, (i, (_, part)) in enumerate(zip(order, parts, strict=True)):
        farthest = np.minimum(found.distances, reach)
        near = np.flatnonzero(gaps[i] < farthest)
        if len(near):
            tree = bvh_of(part.surface())
            measured = tool.nearest(tree, poses[near], farthest[near])
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

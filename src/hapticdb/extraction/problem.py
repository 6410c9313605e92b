"""What is to come out, and what stands around it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.environment import Environment
from hapticdb.errors import UsageError
from hapticdb.pointshell.shell import PointShell
from hapticdb.store.base import Object, scene_bounds
from hapticdb.store.finding import Words

Floats = NDArray[np.float64]

DENSE = 0.5
"""Voxels from point to point of the tool, as for a sweep. Smaller: narrower ways are proved."""
MOST_SEARCHED = 40_000
"""Greatest number of points that the search moves; the proof moves all of them. Larger: fewer
ways that the proof refuses, a slower search."""
GUARD = 1.0
"""Clearance, voxels, that the search wants first: a way with less is seldom proved. Larger: wider
ways, fewer of them."""

CORES = (2.0, 1.5, 1.0)
"""Depths, voxels, to which the surface is drawn inward for its core, one after another where the
part is thinner. Larger: parts that touch may go deeper into one another."""


class Problem(NamedTuple):
    """Parts that are to come out as one rigid body, and the objects that stand.

    parts : the objects that move, at their places; where, exclude : words of what is felt,
    `exclude` with the parts' ids; standing : the objects that are felt; box (2, 3) : corners of
    their bounding box, metres; shell : the parts' surfaces, dense, world frame, so that its poses
    are displacements; center (3,) : middle of the shell's bounding box; radius : greatest distance
    of the surface from it, metres.
    """

    env: Environment
    parts: tuple[Object, ...]
    where: tuple[int | str, ...]
    exclude: tuple[int | str, ...]
    standing: tuple[Object, ...]
    box: Floats
    shell: PointShell
    center: Floats
    radius: float

    @property
    def voxel_size(self) -> float:
        """Metres."""
        return self.env.grid.voxel_size


def problem_of(
    env: Environment, words: Words, where: Words, exclude: Words, *, seed: int
) -> Problem:
    """Read the parts that words choose from their files, and look up what stands.

    Raises
    ------
    ObjectNotFoundError
        If a word chooses nothing.
    UsageError
        If no word is given, a part is a point cloud, or nothing else stands.
    """
    parts = env.find(*words)
    left_out: tuple[int | str, ...] = (*(obj.id for obj in parts), *exclude)
    standing = env.felt(where, left_out)
    if not standing:
        raise UsageError(f"nothing stands in {env.url} beside what is to come out")
    shell = env.shell(
        *(obj.id for obj in parts), spacing=DENSE * env.grid.voxel_size, seed=seed
    ).with_cover()
    low, high = shell.points.min(axis=0), shell.points.max(axis=0)
    center = 0.5 * (low + high)
    radius = float(np.sqrt(((shell.points - center) ** 2).sum(axis=1).max())) + (shell.cover or 0.0)
    return Problem(
        env, tuple(parts), tuple(where), left_out, tuple(standing), _box_of(standing), shell,
        center, radius,
    )  # fmt: skip


def _box_of(standing: Sequence[Object]) -> Floats:
    bounds = scene_bounds(standing)
    assert bounds is not None  # noqa: S101 - there is at least one
    return bounds


def searched_shell(shell: PointShell) -> PointShell:
    """Points that the search moves: every n-th of the dense shell, `MOST_SEARCHED` at most."""
    stride = -(-len(shell) // MOST_SEARCHED)
    return PointShell(
        shell.points[::stride].copy(), shell.normals[::stride].copy(), shell.center.copy(),
        is_closed=shell.is_closed,
    )  # fmt: skip


def guarded_shell(shell: PointShell, voxel_size: float) -> PointShell:
    """Add to the points of a shell the same points, `GUARD` voxels outside the surface."""
    outside = shell.points - GUARD * voxel_size * shell.normals
    pairs = np.stack([shell.points, outside], axis=1).reshape(-1, 3)
    return PointShell(
        pairs, np.repeat(shell.normals, 2, axis=0), shell.center.copy(), is_closed=shell.is_closed
    )


def core_shell(shell: PointShell, voxel_size: float) -> PointShell | None:
    """Points inside a part, two voxels from its surface or less where it is thin.

    None if there are none, as in thin sheets.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415 - a third of a second, for parts in contact

    tree = cKDTree(shell.points)
    points, normals = np.empty((0, 3)), np.empty((0, 3))
    left = np.ones(len(shell), dtype=np.bool_)
    for voxels in CORES:
        depth = voxels * voxel_size
        images = shell.points[left] + depth * shell.normals[left]
        distances, _ = tree.query(images)
        is_inside = distances > 0.9 * depth  # no other wall is nearer than its own
        points = np.concatenate([points, images[is_inside]])
        normals = np.concatenate([normals, shell.normals[left][is_inside]])
        left[np.flatnonzero(left)[is_inside]] = False
    return PointShell(points, normals, shell.center.copy()) if len(points) else None

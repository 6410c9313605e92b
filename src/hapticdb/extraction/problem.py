"""The problem of a search: moving parts, standing objects, and the exit."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.array_types import Floats
from hapticdb.environment import Environment
from hapticdb.errors import UsageError
from hapticdb.exact.path import ToolPath
from hapticdb.grid import corners_of
from hapticdb.pointshell.shell import PointShell
from hapticdb.store.attributes import scene_bounds
from hapticdb.store.base import Object
from hapticdb.store.finding import Words

SPACING = 0.5
"""Spacing of the search's points, voxels. Larger: a faster search, more refuted paths."""
MOST_POINTS = 40_000
"""Number of these points, at most; as for `SPACING`."""
GUARD = 1.0
"""Clearance of the planner's first plans, voxels, since points, voxels and steps are coarser than
surfaces. Larger: fewer paths refuted by the proof, narrow passages missed."""


class Problem(NamedTuple):
    """Parts to be removed as one rigid body, and the standing objects.

    parts : the moving objects at their poses; where, exclude : filter of the objects that collide,
    `exclude` with the parts' ids; contact, overlap : tolerances of the proving sweeps; standing :
    the objects that collide; box (2, 3) : corners of their bounding box, metres; shell : points of
    the parts' surface, world frame, so its poses are displacements; corners (8, 3), center (3,) :
    of the surface's bounding box; radius : greatest distance of the surface from there, metres;
    until : end of the search with its sweeps, `time.monotonic`.
    """

    env: Environment
    parts: tuple[Object, ...]
    where: tuple[int | str, ...]
    exclude: tuple[int | str, ...]
    contact: float
    overlap: float
    standing: tuple[Object, ...]
    box: Floats
    shell: PointShell
    corners: Floats
    center: Floats
    radius: float
    until: float = math.inf

    @property
    def voxel_size(self) -> float:
        """Metres."""
        return self.env.grid.voxel_size

    @property
    def own_axes(self) -> Floats:
        """Axes (6, 3): of the first part's frame, and principal axes of the surface."""
        corners = self.shell.outline
        _, principal = np.linalg.eigh(np.cov(corners.T))
        return np.concatenate([self.parts[0].transform[:3, :3].T, principal.T])

    def shift(self, pose: Floats) -> Floats:
        """Shift (3,) of the part's centre by a displacement (4, 4)."""
        return np.asarray(pose[:3, :3] @ self.center + pose[:3, 3] - self.center)

    def path(self, poses: Floats) -> ToolPath:
        """Motion through displacements (M, 4, 4), as in a sweep, with its bound for each point."""
        return ToolPath.of(poses, self.corners, self.center)


def problem_of(
    env: Environment, words: Words, where: Words, exclude: Words, *, seed: int, contact: float,
    overlap: float,
) -> Problem:  # fmt: skip
    """Problem of the parts and the standing objects chosen by words.

    Raises `ObjectNotFoundError` if a word chooses nothing. Raises `UsageError` if no word is given,
    a part is a point cloud, or nothing else stands.
    """
    parts = env.find(*words)
    # parts move as one body, so none of them blocks another
    excluded: tuple[int | str, ...] = (*(obj.id for obj in parts), *exclude)
    standing = env.select(where, excluded)
    if not standing:
        raise UsageError(f"nothing stands in {env.url} beside what is to come out")
    shell = env.shell(
        *(obj.id for obj in parts), points=MOST_POINTS, spacing=SPACING * env.grid.voxel_size,
        seed=seed, inset=0.0,
    )  # fmt: skip
    bounds = scene_bounds(standing)
    assert bounds is not None  # noqa: S101 - there is at least one
    outline = shell.outline
    box = np.stack([outline.min(axis=0), outline.max(axis=0)])
    center = box.mean(axis=0)
    radius = float(np.linalg.norm(outline - center, axis=1).max())
    return Problem(
        env, tuple(parts), tuple(where), excluded, contact, overlap, tuple(standing),
        bounds, shell, corners_of(box), center, radius,
    )  # fmt: skip


def guarded_shell(shell: PointShell, voxel_size: float) -> PointShell:
    """Shell with a second point `GUARD` voxels outside the surface for each point."""
    outside = shell.points - GUARD * voxel_size * shell.normals
    pairs = np.stack([shell.points, outside], axis=1).reshape(-1, 3)
    return PointShell(
        pairs, np.repeat(shell.normals, 2, axis=0), shell.center.copy(), is_closed=shell.is_closed
    )


class Exit(NamedTuple):
    """Region outside: a part within it is removed.

    low, high (3,) : corners of the box of all standing objects; center (3,) : centre of the part at
    its start; radius : of its bounding sphere with a margin; out : distance from the start at which
    the part is out in any case, or None. Metres.
    """

    low: Floats
    high: Floats
    center: Floats
    radius: float
    out: float | None

    def distances(self, directions: Floats) -> Floats:
        """Metres (D,) along each unit direction (D, 3) until the part is out."""
        # axes across the direction divide by 0: replaced by inf below
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            up = (self.high + self.radius - self.center) / directions
            down = (self.low - self.radius - self.center) / directions
        distances = np.where(directions > 0.0, up, np.where(directions < 0.0, down, np.inf))
        # beyond one side of the box is out, so the nearest side decides
        distances = np.maximum(distances.min(axis=1), 0.0)
        return np.asarray(distances if self.out is None else np.minimum(distances, self.out))

    def is_out(self, shifts: Floats) -> NDArray[np.bool_]:
        """Whether the part is out after shifts (n, 3) of its centre, metres."""
        middles = self.center + shifts
        gaps = np.maximum(np.maximum(self.low - middles, middles - self.high), 0.0)
        # less rounding: a shift by exactly `distances` is out
        is_clear = gaps.max(axis=1) >= (1.0 - 1e-9) * self.radius
        if self.out is None:
            return np.asarray(is_clear)
        return np.asarray(is_clear | (np.linalg.norm(shifts, axis=1) >= (1.0 - 1e-9) * self.out))

    def goals(self, directions: Floats) -> Floats:
        """Shifts (D, 3) until the part is out, along unit directions (D, 3)."""
        return np.asarray(directions * self.distances(directions)[:, None])

"""Whether poses are free, many at once, against resident cells.

A pose is free if no point of the shell lies in an occupied voxel. With the guard, no point a voxel
outside the surface does either. The search believes this; the proof is that of a sweep.

A part that touches something at its start is in no free pose there, because surfaces that touch
share voxels. In contact a pose is allowed if the part is clear of all that it does not touch at its
start, and if its core, its surface drawn inward, is free, or hit little more than at the start.
"""

from contextlib import ExitStack, closing
from typing import Self

import numpy as np
from numpy.typing import NDArray

from hapticdb.extraction.problem import (
    Problem,
    core_shell,
    guarded_shell,
    searched_shell,
)
from hapticdb.query.touches import Touch
from hapticdb.resident.frames import ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import CellTable
from hapticdb.sweeps.path import Extent, SweepPath

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

GROWTH = 1.2
"""A part slides along what it touches at its start while it has at most so many times the hits of
its start. Larger: more motions that the proof refuses."""
CORE_GROWTH = 2.0
"""The same for the core: where it is hit at the start, parts interlock, or are hardly thicker than
voxels, and the number varies. Larger: more motions that cut into what is touched."""
CORE_SHARE = 0.05
"""Share of the core's points that may be hit besides by straight pulls, where it is hit at the
start. Larger: as for `CORE_GROWTH`; smaller: fewer parts that fill one another, as bricks with
studs do, come apart. How deep they get is proved afterwards."""
FRESH = 1.0
"""Voxels from where a part is at its start beyond which it is in a fresh place. Larger: more pulls
against contacts, also through thin walls of what is touched."""
AT_ONCE = 32
"""Poses of a motion that are looked at together. Larger: fewer calls; more poses of motions that
turn out blocked."""
FIRST_AT_ONCE = 4
"""The same for the first ones, which refuse most of the blocked motions; twice as many follow."""


class FreeSpace:
    """Numbers of hits of a problem's parts at any poses. It is also a context manager.

    Attributes
    ----------
    n_poses : int
        Number of poses looked at so far.
    extent : Extent
        That of the searched shell, for paths.
    """

    def __init__(self, problem: Problem, budget_bytes: int) -> None:
        self.voxel_size = problem.voxel_size
        self.shell = searched_shell(problem.shell)
        self.extent = Extent.of(self.shell)
        self.n_poses = 0
        shells = (self.shell, guarded_shell(self.shell, self.voxel_size))
        with ExitStack() as stack:
            table = stack.enter_context(CellTable.create(budget_bytes))
            self.residency = Residency(
                problem.env.store, table, problem.exclude, where=problem.where
            )
            self._frames = [
                stack.enter_context(closing(ResidentFrames(self.residency, shell)))
                for shell in shells
            ]
            self._close = stack.pop_all().close

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def hits(self, poses: Floats, *, is_guarded: bool = False) -> Ints:
        """Numbers of points (n,) in occupied voxels at poses (n, 4, 4)."""
        self.n_poses += len(poses)
        return self._frames[is_guarded].feel(poses).hits

    def are_free(self, poses: Floats, *, is_guarded: bool = False) -> NDArray[np.bool_]:
        """Whether poses (n, 4, 4) have no hits; much sooner than `hits` where they have some."""
        self.n_poses += len(poses)
        return ~self._frames[is_guarded].collides(poses)

    def farthest(self, ends: Floats, *, is_guarded: bool) -> Floats:
        """Last displacement (4, 4) before the first hit between two poses (2, 4, 4).

        The samples are those of a sweep; the first pose is taken for free.
        """
        path = SweepPath.of(ends, self.extent, self.voxel_size)
        last = np.asarray(ends[0])
        for begin in range(1, len(path), AT_ONCE):
            poses = path.sample(begin, min(begin + AT_ONCE, len(path)))
            is_free = self.are_free(poses, is_guarded=is_guarded)
            n_free = len(poses) if is_free.all() else int(np.argmin(is_free))
            last = poses[n_free - 1] if n_free else last
            if n_free < len(poses):
                break
        return last

    def is_motion_free(self, ends: Floats, *, is_guarded: bool) -> bool:
        """Whether all poses between two poses (2, 4, 4) are free, in steps of half a voxel.

        The samples are those of a sweep. The end comes first, then samples far apart: a blocked
        motion is mostly refused by few of them.
        """
        path = SweepPath.of(ends, self.extent, self.voxel_size)
        poses = path.sample(0, len(path))
        for some in _from_coarse_to_fine(len(poses)):
            if not self.are_free(poses[some], is_guarded=is_guarded).all():
                return False
        return True


class ContactSpace:
    """Which poses are allowed while parts leave contact. It is also a context manager.

    Attributes
    ----------
    start : Touch
        What the searched shell touches at the start.
    touched : tuple of int
        Ids of these objects.
    """

    def __init__(self, problem: Problem, space: FreeSpace, budget_bytes: int) -> None:
        self._problem, self._space = problem, space
        self.start = self.touch(np.eye(4))
        self.touched = tuple(obj.id for obj in self.start.objects)
        self._frames: list[ResidentFrames] = []
        self._most: list[float] = []
        self._most_pulled: list[float] = []
        with ExitStack() as stack:
            if self.touched:
                self._feel_beside(stack, budget_bytes)
            self._close = stack.pop_all().close

    def _feel_beside(self, stack: ExitStack, budget_bytes: int) -> None:
        """Set up frames of the part without what it touches, and of its core."""
        problem, shell = self._problem, self._space.shell
        table = stack.enter_context(CellTable.create(budget_bytes))
        others = Residency(
            problem.env.store, table, (*problem.exclude, *self.touched), where=problem.where
        )
        core = core_shell(shell, problem.voxel_size)
        asked = [(others, shell), *([] if core is None else [(self._space.residency, core)])]
        for residency, points in asked:
            frames = stack.enter_context(closing(ResidentFrames(residency, points)))
            start = int(frames.feel(np.eye(4)).hits[0])
            more = start + CORE_SHARE * len(points) if start else 0.0
            self._frames.append(frames)
            self._most.append(CORE_GROWTH * start)
            self._most_pulled.append(max(CORE_GROWTH * start, more))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def touch(self, pose: Floats) -> Touch:
        """Contacts of the searched shell at a pose (4, 4)."""
        problem = self._problem
        return problem.env.touch(
            self._space.shell, pose, where=problem.where, exclude=problem.exclude, law="plane"
        )

    def are_allowed(self, poses: Floats, *, is_pull: bool = False) -> NDArray[np.bool_]:
        """Whether each of the poses (n, 4, 4) is allowed in contact; more of a straight pull."""
        self._space.n_poses += len(poses)
        allowed = np.ones(len(poses), dtype=np.bool_)
        greatest = self._most_pulled if is_pull else self._most
        for frames, most in zip(self._frames, greatest, strict=True):
            allowed &= frames.feel(poses).hits <= most
        return allowed

    def stays(self, poses: Floats) -> bool:
        """Whether a part at poses (n, 4, 4) hits something only where it is at its start.

        No point that hits may be more than `FRESH` voxels outside the part as it stands.
        """
        from scipy.spatial import cKDTree  # noqa: PLC0415 - a third of a second, for the last resort

        shell, farthest = self._space.shell, FRESH * self._problem.voxel_size
        tree = cKDTree(shell.points)
        for pose in poses:
            hits = self.touch(pose).hits
            places = shell.points[hits] @ pose[:3, :3].T + pose[:3, 3]
            distances, nearest = tree.query(places)
            inward = ((places - shell.points[nearest]) * shell.normals[nearest]).sum(axis=1)
            if ((distances > farthest) & (inward < 0.0)).any():
                return False
        return True


def _from_coarse_to_fine(n: int) -> list[Ints]:
    """Indices 0 .. n - 1 in blocks, each once: the last one, then those that are far apart."""
    order: list[int] = [n - 1]
    seen = {n - 1}
    stride = 1 << max(n - 1, 1).bit_length()
    while stride >= 1:
        fresh = [i for i in range(0, n, stride) if i not in seen]
        order += fresh
        seen.update(fresh)
        stride //= 2
    at = np.array(order)
    blocks, begin, length = [at[:1]], 1, FIRST_AT_ONCE
    while begin < n:
        blocks.append(at[begin : begin + length])
        begin, length = begin + length, min(2 * length, AT_ONCE)
    return blocks

"""Collision checks of many poses against resident cells.

A pose is free if no shell point is in an occupied voxel; in the wide space, nor any point one voxel
outside the surface. The search relies on this; proofs are by sweeps.

Touching surfaces share voxels, so a part in contact is not free at its start; there, sweeps check
its motion.
"""

from contextlib import ExitStack, closing

import numpy as np
from numpy.typing import NDArray

from hapticdb.array_types import Floats, Ints
from hapticdb.closing import Closes
from hapticdb.exact.path import SampledPath
from hapticdb.extraction.problem import Problem, guarded_shell
from hapticdb.query.touches import Touch
from hapticdb.resident.frames import ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import CellTable

STEP = 0.5
"""Greatest motion between two poses, voxels. Larger: thin objects are missed."""
AT_ONCE = 32
"""Poses of a motion in one check. Larger: fewer calls, more poses of blocked motions."""
FIRST_AT_ONCE = 4
"""Poses of the first check, which refutes most blocked motions; the number doubles from then on."""


class Room:
    """Free space of one shell.

    n_poses : number of poses checked so far.
    """

    def __init__(self, frames: ResidentFrames, problem: Problem) -> None:
        self.n_poses = 0
        self._frames, self._problem = frames, problem

    def parameters(self, path: SampledPath) -> Floats:
        """Path parameters (n,), at most `STEP` voxels apart."""
        steps = path.length / (STEP * self._problem.voxel_size)
        return np.linspace(0.0, path.length, 1 + max(int(np.ceil(steps)), 1))

    def hits(self, poses: Floats) -> Ints:
        """Numbers (n,) of points in occupied voxels at poses (n, 4, 4)."""
        self.n_poses += len(poses)
        return self._frames.evaluate(poses).hits

    def are_free(self, poses: Floats) -> NDArray[np.bool_]:
        """Whether poses (n, 4, 4) have no hits; ends at the first hit, so faster than `hits`."""
        self.n_poses += len(poses)
        return ~self._frames.collides(poses)

    def _between(self, ends: Floats) -> Floats:
        """Poses (n, 4, 4) between two poses (2, 4, 4), as in `parameters`; a shift is faster."""
        # equal bits, not nearly: a plan of shifts has one rotation, copied to every state
        if not np.array_equal(ends[0, :3, :3], ends[1, :3, :3]):
            path = self._problem.path(ends)
            return path.at(self.parameters(path))
        shift = ends[1, :3, 3] - ends[0, :3, 3]
        steps = float(np.linalg.norm(shift)) / (STEP * self._problem.voxel_size)
        shares = np.linspace(0.0, 1.0, 1 + max(int(np.ceil(steps)), 1))
        poses = np.tile(ends[0], (len(shares), 1, 1))
        poses[:, :3, 3] += shares[:, None] * shift
        return poses

    def farthest(self, ends: Floats) -> Floats:
        """Last displacement (4, 4) before the first hit between two poses (2, 4, 4).

        The first pose is assumed free.
        """
        poses = self._between(ends)
        for begin in range(1, len(poses), AT_ONCE):
            is_free = self.are_free(poses[begin : begin + AT_ONCE])
            if not is_free.all():
                return np.asarray(poses[begin - 1 + int(np.argmin(is_free))])
        return np.asarray(poses[-1])

    def is_motion_free(self, ends: Floats) -> bool:
        """Whether all poses between two poses (2, 4, 4) are free.

        The end comes first, then poses far apart: few checks refute most blocked motions.
        """
        poses = self._between(ends)
        return all(self.are_free(poses[some]).all() for some in _from_coarse_to_fine(len(poses)))


class FreeSpace(Closes):
    """Free space of a problem's parts; a context manager.

    room : without clearance; wide : with `GUARD` voxels of it; start : contacts at the start pose.
    """

    def __init__(self, problem: Problem, budget_bytes: int) -> None:
        self._problem = problem
        self.start = self.touch(np.eye(4))
        # an error before `pop_all` closes what is open so far
        with ExitStack() as stack:
            table = stack.enter_context(CellTable.create(budget_bytes))
            residency = Residency(problem.env.store, table, problem.exclude, where=problem.where)
            self.room, self.wide = (
                Room(stack.enter_context(closing(ResidentFrames(residency, shell))), problem)
                for shell in (problem.shell, guarded_shell(problem.shell, problem.voxel_size))
            )
            self._close = stack.pop_all().close

    def close(self) -> None:
        """Free the cells."""
        self._close()

    @property
    def n_poses(self) -> int:
        """Number of poses checked so far."""
        return self.room.n_poses + self.wide.n_poses

    def touch(self, pose: Floats) -> Touch:
        """Contacts of the parts at a pose (4, 4)."""
        problem = self._problem
        return problem.env.touch(
            problem.shell, pose, where=problem.where, exclude=problem.exclude, law="plane"
        )


def _from_coarse_to_fine(n: int) -> list[Ints]:
    """Indices 0 .. n - 1 in blocks, each once: the last one, then from coarse to fine strides."""
    # the end first: a state in collision refutes every motion to it
    order: list[int] = [n - 1]
    seen = {n - 1}
    # coarse to fine: a wide obstacle is met after few poses
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

"""Searches a path round corners and with turns, by a planner in a process of its own.

The search answers the planner's questions whether a motion is free. It ends the process at its
deadline.
"""

import time
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import HapticDBError
from hapticdb.extraction.directions import AXES
from hapticdb.extraction.free_space import FreeSpace
from hapticdb.extraction.leaving import Exit
from hapticdb.extraction.planner_child import PlanRequest
from hapticdb.extraction.problem import Problem
from hapticdb.extraction.pulls import Pull
from hapticdb.poses import quaternion_of, rotation_of
from hapticdb.realtime.processes import Process

Floats = NDArray[np.float64]

MOST_STARTS = 12
"""Greatest number of pulls at whose ends the planner starts. Larger: more directions are tried
together."""
STRIDE = 0.5
"""Greatest distance of two neighbouring states, in radii of the part. Larger: fewer questions in
the open, more of them refused in narrow places."""
SHARE_OF_SHIFTS = 0.3
"""Share of the questions and of the time that go to shifts without turns, which need far fewer."""
ENDING = 1.0
"""Seconds that a process that has closed its pipe has to end. Larger: its end is told later."""
WORK = "hapticdb.extraction.planner_child:plan"


class Planned(NamedTuple):
    """What the planner has done.

    poses (M, 4, 4) : displacements from the start to where the part is out, or None; motions :
    questions answered.
    """

    poses: Floats | None
    motions: int


class Planner:
    """Plans for one problem.

    Parameters
    ----------
    problem, space, leaving :
        What is to come out, whether poses are free, where it is out.
    pulls : list of Pull
        Pulls tried before: planning starts where they end.
    seed, most_motions, until :
        Seed of the planner; questions that it may ask; time of `time.monotonic` at which it ends.
    """

    def __init__(
        self,
        problem: Problem,
        space: FreeSpace,
        leaving: Exit,
        pulls: list[Pull],
        *,
        seed: int,
        most_motions: int,
        until: float,
    ) -> None:
        self._problem, self._space, self._leaving = problem, space, leaving
        self._pulls = pulls
        self._seed, self._most, self._until = seed, most_motions, until
        self.n_motions = 0

    def search(self) -> Planned:
        """Search with the guard, first by shifts alone; without the guard if nothing is guarded.

        Raises
        ------
        MissingExtraError
            If OMPL is not installed.
        """
        starts, is_guarded = self._starts()
        if not len(starts):
            return Planned(None, 0)
        began, left = time.monotonic(), self._most
        soon = began + SHARE_OF_SHIFTS * (self._until - began)
        for turning, until, share in (
            (0.0, soon, SHARE_OF_SHIFTS),
            (self._problem.radius, self._until, 1.0),
        ):
            most = max(int(share * (left - self.n_motions)), 1)
            rows = self._ask(starts, turning, most, until, is_guarded=is_guarded)
            if rows is not None:
                return Planned(self._path(rows), self.n_motions)
        return Planned(None, self.n_motions)

    def _starts(self) -> tuple[Floats, bool]:
        """Shifts (S, 3) at which the planner starts, and whether they are free with the guard.

        Of each pull that goes anywhere, the farthest place; the longest pulls first.
        """
        for is_guarded in (True, False):
            ends: list[tuple[float, Floats]] = []
            for pull in self._pulls:
                if is_guarded and pull.guarded is not None:
                    ends.append((pull.guarded[1], pull.direction * pull.guarded[1]))
                elif not is_guarded and pull.free > 0.0:
                    ends.append((pull.free, pull.direction * pull.free))
            if ends:
                ends.sort(key=lambda end: -end[0])
                return np.array([shift for _, shift in ends[:MOST_STARTS]]), is_guarded
        return np.empty((0, 3)), False

    def _ask(
        self, starts: Floats, turning: float, most: int, until: float, *, is_guarded: bool
    ) -> Floats | None:
        """Let a process plan; returns states (n, 7) or None."""
        problem, leaving = self._problem, self._leaving
        goals = leaving.goals(AXES)
        room = np.concatenate([goals, starts])
        request = PlanRequest(
            self._rows(starts), self._rows(goals),
            (problem.center + room).min(axis=0) - problem.voxel_size,
            (problem.center + room).max(axis=0) + problem.voxel_size,
            turning, STRIDE * problem.radius, self._seed, most,
        )  # fmt: skip
        with Process(WORK, request, ()) as process:
            while True:
                message = process.receive(until - time.monotonic())
                if message is None:
                    if time.monotonic() >= until:
                        return None  # leaving ends the process
                    if process.wait(ENDING):
                        raise HapticDBError("the planner's process has ended: search again")
                    continue
                if message.word == "path":
                    return None if message.content is None else np.asarray(message.content)
                self.n_motions += 1
                ends = self._poses(np.asarray(message.content))
                process.send(self._space.is_motion_free(ends, is_guarded=is_guarded))

    def _rows(self, shifts: Floats) -> Floats:
        """States (n, 7) of shifts (n, 3): the place of the part's middle, and no turn."""
        turns = np.tile([1.0, 0.0, 0.0, 0.0], (len(shifts), 1))
        return np.hstack([self._problem.center + shifts, turns])

    def _poses(self, rows: Floats) -> Floats:
        """Displacements (n, 4, 4) of states (n, 7)."""
        poses = np.tile(np.eye(4), (len(rows), 1, 1))
        poses[:, :3, :3] = rotation_of(rows[:, 3:] / np.linalg.norm(rows[:, 3:], axis=1)[:, None])
        poses[:, :3, 3] = rows[:, :3] - poses[:, :3, :3] @ self._problem.center
        return poses

    def _path(self, rows: Floats) -> Floats:
        """Whole path of displacements (M, 4, 4): straight to where the planner began, then on."""
        poses = self._poses(rows)
        poses[:, :3, :3] = rotation_of(quaternion_of(poses[:, :3, :3]))
        return np.concatenate([np.eye(4)[None], poses])

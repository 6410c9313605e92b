"""Searches a path round corners and with turns, by a planner in a process of its own.

The search answers the planner's questions whether a motion is free. It ends the process at its
deadline.
"""

import time

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import HapticDBError
from hapticdb.extraction.free_space import ContactSpace, FreeSpace
from hapticdb.extraction.goals import GoalSampler
from hapticdb.extraction.leaving import Exit
from hapticdb.extraction.legs import Legs
from hapticdb.extraction.loosening import Loosened, Loosening
from hapticdb.extraction.planner_child import PlanRequest
from hapticdb.extraction.problem import Problem
from hapticdb.extraction.pulls import Pulls, shifted
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
SHARE_OF_LEGS = 0.3
"""Greatest share of the time that goes to straight legs along the axes. Their motions are no
questions of the planner, and not counted as such."""
SHARE_OF_LOOSENING = 0.2
"""Share of the questions and of the time that go to motions out of contact, where no pull is free.
Larger: longer ways out of contact are found, less is left for what follows."""
MOST_TURNS = 8
"""Greatest number of turns at which goals are sought. Larger: more places to reach, each one looked
at before the planner begins."""
QUARTERS = np.array(
    [[[1, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
     [[0, -1, 0], [1, 0, 0], [0, 0, 1]]], dtype=np.float64,
)  # fmt: skip
"""Quarter turns about the axes: the planner seeks places outside also with these."""
SAME = 1e-9
"""Greatest difference of two states that are one: positions in metres, quaternions."""
ENDING = 1.0
"""Seconds that a process that has closed its pipe has to end. Larger: its end is told later."""
WORK = "hapticdb.extraction.planner_child:plan"


class Planner:
    """Plans for one problem.

    Parameters
    ----------
    problem, space, contact, leaving :
        What is to come out, whether poses are free or allowed in contact, where it is out.
    pulls : Pulls
        Pulls tried before: planning starts where they end.
    seed, most_motions, until :
        Seed of the planner; questions that it may ask; time of `time.monotonic` at which it ends.
    """

    def __init__(
        self,
        problem: Problem,
        space: FreeSpace,
        contact: ContactSpace,
        leaving: Exit,
        pulls: Pulls,
        *,
        seed: int,
        most_motions: int,
        until: float,
    ) -> None:
        self._problem, self._space, self._leaving = problem, space, leaving
        self._contact, self._pulls = contact, pulls
        self._seed, self._most, self._until = seed, most_motions, until
        self._starts: list[Loosened] | None = None
        self._used: Loosened | None = None
        self._goals = GoalSampler(problem, space, leaving, pulls, seed)
        self.n_motions = 0

    @property
    def can_refuse(self) -> bool:
        """Whether another start is left beside that of the last path, with questions and time."""
        is_left = self._starts is not None and len(self._starts) > 1
        return is_left and self.n_motions < self._most and time.monotonic() < self._until

    def refuse(self) -> None:
        """Do not start again where the last path did, because its way there is refuted."""
        self._starts = [one for one in self._starts or [] if one is not self._used]

    def search(self) -> Floats | None:
        """Path (M, 4, 4) of displacements from the start to where the part is out, or None.

        Searched with the guard, first by shifts alone; without the guard if nothing is guarded.

        Raises
        ------
        MissingExtraError
            If OMPL is not installed.
        """
        if self._starts is None:
            self._starts = self._found_starts()
        is_guarded = any(one.is_guarded for one in self._starts)
        starts = [one for one in self._starts if one.is_guarded == is_guarded]
        if not starts:
            return None
        path = self._by_legs(starts, is_guarded=is_guarded)
        if path is not None:
            return path
        del starts[MOST_STARTS:]
        began, left = time.monotonic(), max(self._most - self.n_motions, 0)
        soon = began + SHARE_OF_SHIFTS * (self._until - began)
        asked = self.n_motions
        for turning, until, share in (
            (0.0, soon, SHARE_OF_SHIFTS),
            (self._problem.radius, self._until, 1.0),
        ):
            most = max(int(share * (left - (self.n_motions - asked))), 1)
            path = self._ask(starts, turning, most, until, is_guarded=is_guarded)
            if path is not None:
                return path
        return None

    def _found_starts(self) -> list[Loosened]:
        """Ways to where the planner starts: pulls; where none is free with the guard, others, too.

        Of each pull that goes anywhere, the farthest place; the longest pulls first.
        """
        found: list[tuple[float, Loosened]] = []
        for pull in self._pulls.done:
            way = pull.guarded[1] if pull.guarded is not None else pull.free
            if way > 0.0:
                poses = np.stack([np.eye(4), shifted(pull.direction * way)])
                found.append((way, Loosened(poses, pull.guarded is not None)))
        starts = [one for _, one in sorted(found, key=lambda one: -one[0])]
        if not any(one.is_guarded for one in starts):
            starts += self._loosened()
        return starts

    def _loosened(self) -> list[Loosened]:
        """Ways out of contact by other motions than pulls."""
        most = max(int(SHARE_OF_LOOSENING * self._most), 1)
        now = time.monotonic()
        until = now + SHARE_OF_LOOSENING * (self._until - now)
        if not self._contact.touched:
            return []
        loosening = Loosening(self._problem, self._space, self._contact, self._seed)
        found = loosening.search(most, until)
        self.n_motions += loosening.n_motions
        return found

    def _by_legs(self, starts: list[Loosened], *, is_guarded: bool) -> Floats | None:
        """Path (M, 4, 4) out by straight legs along axes, or None."""
        now = time.monotonic()
        until = now + SHARE_OF_LEGS * (self._until - now)
        found = Legs(self._problem, self._space, self._leaving, is_guarded, until).search(starts)
        if found is None:
            return None
        self._used, path = found
        return path

    def _ask(
        self, starts: list[Loosened], turning: float, most: int, until: float, *, is_guarded: bool
    ) -> Floats | None:
        """Let a process plan; returns displacements (M, 4, 4) from the start, or None.

        Without turns, those starts take part that are turned as the first one is.
        """
        turn = starts[0].poses[-1][:3, :3] if turning == 0.0 else None
        if turn is not None:
            starts = [one for one in starts if np.allclose(one.poses[-1][:3, :3], turn, atol=SAME)]
        turns = np.stack([one.poses[-1][:3, :3] for one in starts])
        if turn is None:
            turns = np.concatenate([turns, *(turns @ quarter for quarter in QUARTERS)])
        turns = _distinct_turns(turns)[:MOST_TURNS]
        goals = self._goals.poses(turns, is_guarded=is_guarded)
        first, last = self._rows(np.stack([one.poses[-1] for one in starts])), self._rows(goals)
        room = np.concatenate([first, last])[:, :3]
        request = PlanRequest(
            first, last, room.min(axis=0) - self._problem.voxel_size,
            room.max(axis=0) + self._problem.voxel_size, turning, STRIDE * self._problem.radius,
            self._seed, most,
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
                rows = None if message.content is None else np.asarray(message.content)
                if message.word == "path":
                    return None if rows is None else self._path(rows, turn, starts, first)
                assert rows is not None  # noqa: S101 - a motion has two states
                self.n_motions += 1
                ends = self._poses(rows, turn)
                process.send(self._space.is_motion_free(ends, is_guarded=is_guarded))

    def _rows(self, poses: Floats) -> Floats:
        """States (n, 7) of displacements (n, 4, 4): place of the part's middle, and its turn."""
        places = poses[:, :3, :3] @ self._problem.center + poses[:, :3, 3]
        return np.hstack([places, quaternion_of(poses[:, :3, :3])])

    def _poses(self, rows: Floats, turn: Floats | None) -> Floats:
        """Displacements (n, 4, 4) of states (n, 7), turned as `turn` (3, 3) says if it is given."""
        poses = np.tile(np.eye(4), (len(rows), 1, 1))
        if turn is None:
            turns = rows[:, 3:] / np.linalg.norm(rows[:, 3:], axis=1)[:, None]
            poses[:, :3, :3] = rotation_of(turns)
        else:
            poses[:, :3, :3] = turn
        poses[:, :3, 3] = rows[:, :3] - poses[:, :3, :3] @ self._problem.center
        return poses

    def _path(
        self, rows: Floats, turn: Floats | None, starts: list[Loosened], first: Floats
    ) -> Floats:
        """Whole path of displacements (M, 4, 4): to where the planner began, on, and out."""
        off = np.abs(first[:, :3] - rows[0, :3]).max(axis=1)
        if turn is None:
            signs = np.sign((first[:, 3:] * rows[0, 3:]).sum(axis=1))[:, None]
            off += np.abs(signs * first[:, 3:] - rows[0, 3:]).max(axis=1)
        self._used = starts[int(np.argmin(off))]
        poses = self._poses(rows, turn)
        path = np.concatenate([self._used.poses, poses[1:]])
        end = self._goals.exit_of(path[-1])
        if end is not None:
            path = np.concatenate([path, end[None]])
        path[:, :3, :3] = rotation_of(quaternion_of(path[:, :3, :3]))
        return path


def _distinct_turns(turns: Floats) -> Floats:
    """Rotations (k, 3, 3) of rotations (n, 3, 3), each once, the first ones first."""
    kept: list[Floats] = []
    for turn in turns:
        if not any(np.allclose(turn, other, atol=SAME) for other in kept):
            kept.append(turn)
    return np.array(kept)

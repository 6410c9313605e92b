"""Planned paths round corners and with turns; the planner runs in a process of its own.

The search answers the planner's motion queries, and ends the process at its deadline.
"""

import time
from typing import NamedTuple

import numpy as np

from hapticdb.array_types import Floats
from hapticdb.errors import HapticDBError
from hapticdb.extraction.contact_escape import ContactEscape, EscapePath
from hapticdb.extraction.free_space import FreeSpace, Room
from hapticdb.extraction.goals import SAME, Goals
from hapticdb.extraction.legs import Legs
from hapticdb.extraction.planner_child import PlanRequest
from hapticdb.extraction.problem import Exit, Problem
from hapticdb.extraction.proof import BACK
from hapticdb.extraction.pulls import Pulls, first_run
from hapticdb.poses import quaternion_of, rotation_of
from hapticdb.session.processes.process import Process

MOST_STARTS = 12
"""Starts of the planner, at most. Larger: more directions in one plan."""
LEAVING = 2.0
"""Longest contact, voxels, of a pull trusted without a sweep. Larger: more starts behind thin
walls."""
STRIDE = 0.5
"""Greatest distance of neighbouring states, radii of the part. Larger: fewer queries in open space,
more of them refused in narrow passages."""
SHARE_OF_WIDE = 0.6
"""Share of queries and time for paths with clearance; sweeps refute more of the narrower ones."""
SHARE_OF_SHIFTS = 0.3
"""Share of queries and time for plans without turns, which need far fewer queries."""
SHARE_OF_LEGS = 0.3
"""Greatest share of the time for straight legs along the axes; these are no queries of the
planner."""
SHARE_OF_ESCAPES = 0.2
"""Share of queries and time for motions out of contact, if no pull is free. Larger: longer paths
out of contact, less for the planner."""
MOST_TURNS = 8
"""Rotations of the goals, at most. Larger: more goals, and more checks before the planner
begins."""
QUARTERS = np.array(
    [[[1, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
     [[0, -1, 0], [1, 0, 0], [0, 0, 1]]], dtype=np.float64,
)  # fmt: skip
"""Quarter turns about the axes, for further rotations of goals outside."""
ENDING = 1.0
"""Seconds for the exit of a process after it closed its pipe. Larger: its end is reported later."""
WORK = "hapticdb.extraction.planner_child:plan"


class _Share(NamedTuple):
    """Budget of a part of the search: motion queries, and its end (`time.monotonic`)."""

    motions: int
    until: float


class Planner:
    """Plans for one problem.

    problem, space : the parts and their free space. pulls : done before; plans start at their ends.
    goals : to reach. leaving : the exit; None for a goal pose. seed : of the planner;
    most_motions : motion queries, at most; until : end, `time.monotonic`.
    """

    def __init__(
        self,
        problem: Problem,
        space: FreeSpace,
        pulls: Pulls,
        goals: Goals,
        *,
        leaving: Exit | None,
        seed: int,
        most_motions: int,
        until: float,
    ) -> None:
        self._problem, self._space = problem, space
        self._pulls, self._goals, self._leaving = pulls, goals, leaving
        self._seed, self._most, self._until = seed, most_motions, until
        self._starts: list[EscapePath] | None = None
        self._used: EscapePath | None = None
        self.n_motions = 0

    @property
    def can_reject(self) -> bool:
        """Whether another start remains after that of the last path, with queries and time."""
        is_left = self._starts is not None and len(self._starts) > 1
        return is_left and self.n_motions < self._most and time.monotonic() < self._until

    def reject_start(self) -> None:
        """Drop the start of the last path, because its first part is refuted."""
        # by identity: two starts may have equal poses and other motions before
        self._starts = [one for one in self._starts or [] if one is not self._used]

    def search(self) -> Floats | None:
        """Path (M, 4, 4) of displacements from the start to the goal, or None.

        The wide space is searched first, and in each space shifts alone before turns.

        Raises `MissingExtraError` if OMPL is not installed.
        """
        if self._starts is None:
            self._starts = self._found_starts()
        wide = [one for one in self._starts if one.is_wide]
        # straight legs first: they cost no query of the planner
        if self._leaving is not None and self._starts:
            path = self._by_legs(self._leaving, wide)
            if path is not None:
                return path
        for room, starts, share in (
            (self._space.wide, wide, SHARE_OF_WIDE),
            (self._space.room, self._starts, 1.0),
        ):
            path = self._in_room(room, starts, self._part(share)) if starts else None
            if path is not None:
                return path
        return None

    def _by_legs(self, leaving: Exit, wide: list[EscapePath]) -> Floats | None:
        """Path (M, 4, 4) out by straight legs along axes, from starts in the wide space if any."""
        room = self._space.wide if wide else self._space.room
        until = self._part(SHARE_OF_LEGS).until
        found = Legs(self._problem, room, leaving, until).search(wide or self._starts or [])
        if found is None:
            return None
        self._used, path = found
        return path

    def _part(self, share: float) -> _Share:
        """A share of the remaining queries and time."""
        now, left = time.monotonic(), max(self._most - self.n_motions, 0)
        return _Share(max(int(share * left), 1), now + share * (self._until - now))

    def _in_room(self, room: Room, starts: list[EscapePath], part: _Share) -> Floats | None:
        """Path from one of the starts, in one space: by shifts alone, then with turns."""
        now, before = time.monotonic(), self.n_motions
        # shifts alone first: R^3 instead of SE(3) needs far fewer queries
        soon = _Share(
            max(int(SHARE_OF_SHIFTS * part.motions), 1), now + SHARE_OF_SHIFTS * (part.until - now)
        )
        path = self._plan(room, starts[:MOST_STARTS], 0.0, soon)
        if path is not None:
            return path
        # what the shifts left over goes to the search with turns
        left = part._replace(motions=max(part.motions - (self.n_motions - before), 1))
        return self._plan(room, starts[:MOST_STARTS], self._problem.radius, left)

    def _found_starts(self) -> list[EscapePath]:
        """Paths to the planner's starts: pulls; if none ends in the wide space, others, too.

        The start of a pull is the end of its first free run; the longest pulls come first. The
        others are motions out of contact. For a goal pose, the parts' own pose is the only start if
        it is free in the wide space.
        """
        here = np.eye(4)[None]
        if self._leaving is None and self._space.wide.are_free(here)[0]:
            return [EscapePath(here, is_wide=True)]
        found: list[tuple[float, EscapePath]] = []
        for pull in self._pulls.done:
            # a little before the hit: there the part is in contact again
            farthest = pull.free - BACK * self._problem.voxel_size
            is_told = pull.is_swept or pull.contact_length <= LEAVING * self._problem.voxel_size
            # a pull without a sweep may have passed a thin wall between two samples
            if farthest <= 0.0 or not is_told:
                continue
            path = self._problem.path(pull.poses(np.array([0.0, farthest])))
            parameters = self._space.room.parameters(path)
            poses = path.at(parameters)
            # the wide space has a margin: states there are refuted less by the sweep
            for room in (self._space.wide, self._space.room):
                first, last = first_run(room.are_free(poses))
                if first < last:
                    # the end of the first free run: beyond it the pull is in contact again
                    escape = np.stack([np.eye(4), poses[last - 1]])
                    is_wide = room is self._space.wide
                    found.append((float(parameters[last - 1]), EscapePath(escape, is_wide)))
                    break
        starts = [one for _, one in sorted(found, key=lambda one: -one[0])]
        if self._space.start.objects and not any(one.is_wide for one in starts):
            part = self._part(SHARE_OF_ESCAPES)
            loosening = ContactEscape(self._problem, self._space, self._seed)
            starts += loosening.search(part.motions, part.until)
            self.n_motions += loosening.n_motions
        return starts

    def _plan(
        self, room: Room, starts: list[EscapePath], turning: float, part: _Share
    ) -> Floats | None:
        """Plan in a process; returns displacements (M, 4, 4) from the start, or None.

        turning : weight of a turn, metres a radian; 0 for shifts alone, from those starts with the
        rotation of the first one.
        """
        # one rotation for a plan of shifts: the state space has no other
        turn = starts[0].poses[-1][:3, :3] if turning == 0.0 else None
        if turn is not None:
            starts = [one for one in starts if np.allclose(one.poses[-1][:3, :3], turn, atol=SAME)]
        turns = np.stack([one.poses[-1][:3, :3] for one in starts])
        if turn is None:
            turns = np.concatenate([turns, *(turns @ quarter for quarter in QUARTERS)])
        turns = _distinct_turns(turns)[:MOST_TURNS]
        goals = self._goals.poses(room, turns, is_turning=turn is None)
        if not len(goals):
            return None
        first, last = self._rows(np.stack([one.poses[-1] for one in starts])), self._rows(goals)
        # OMPL samples in a box: it must hold all starts and goals
        ends = np.concatenate([first[:, :3], last[:, :3], self._goals.corners])
        margin = self._problem.voxel_size
        request = PlanRequest(
            first, last, ends.min(axis=0) - margin, ends.max(axis=0) + margin, turning,
            STRIDE * self._problem.radius, self._seed, part.motions,
        )  # fmt: skip
        rows = self._answer(room, request, turn, part.until)
        return None if rows is None else self._path(rows, turn, starts, first)

    def _answer(
        self, room: Room, request: PlanRequest, turn: Floats | None, until: float
    ) -> Floats | None:
        """Answer the planner's queries until its path: states (n, 7), or None."""
        with Process(WORK, request, ()) as process:
            while True:
                message = process.receive(until - time.monotonic())
                if message is None:
                    if time.monotonic() >= until:
                        return None  # leaving ends the process
                    # the pipe closes before the process is gone: silence alone is no end
                    if process.wait(ENDING):
                        raise HapticDBError("the planner's process has ended: search again")
                    continue
                rows = None if message.content is None else np.asarray(message.content)
                if message.word == "path":
                    return rows
                assert rows is not None  # noqa: S101 - a motion has two states
                self.n_motions += 1
                process.send(room.is_motion_free(self._poses(rows, turn)))

    def _rows(self, poses: Floats) -> Floats:
        """States (n, 7) of displacements (n, 4, 4): position of the part's centre, quaternion."""
        places = poses[:, :3, :3] @ self._problem.center + poses[:, :3, 3]
        return np.hstack([places, quaternion_of(poses[:, :3, :3])])

    def _poses(self, rows: Floats, turn: Floats | None) -> Floats:
        """Displacements (n, 4, 4) of states (n, 7); `turn` (3, 3) replaces their rotations."""
        poses = np.tile(np.eye(4), (len(rows), 1, 1))
        if turn is None:
            turns = rows[:, 3:] / np.linalg.norm(rows[:, 3:], axis=1)[:, None]
            poses[:, :3, :3] = rotation_of(turns)
        else:
            poses[:, :3, :3] = turn
        poses[:, :3, 3] = rows[:, :3] - poses[:, :3, :3] @ self._problem.center
        return poses

    def _path(
        self, rows: Floats, turn: Floats | None, starts: list[EscapePath], first: Floats
    ) -> Floats:
        """Whole path of displacements (M, 4, 4): to the planner's start, along its states, on."""
        # the planner does not say which start it used: the nearest one
        off = np.abs(first[:, :3] - rows[0, :3]).max(axis=1)
        if turn is None:
            # q and -q are one rotation: compare on the same half of the sphere
            signs = np.sign((first[:, 3:] * rows[0, 3:]).sum(axis=1))[:, None]
            off += np.abs(signs * first[:, 3:] - rows[0, 3:]).max(axis=1)
        self._used = starts[int(np.argmin(off))]
        poses = self._poses(rows, turn)
        path = np.concatenate([self._used.poses, poses[1:]])
        path = np.concatenate([path, self._goals.beyond(path[-1])])
        # rounding adds up in products: rotations are made orthonormal for the sweep
        path[:, :3, :3] = rotation_of(quaternion_of(path[:, :3, :3]))
        return path


def _distinct_turns(turns: Floats) -> Floats:
    """Distinct rotations (k, 3, 3) of rotations (n, 3, 3), in their order."""
    kept: list[Floats] = []
    for turn in turns:
        if not any(np.allclose(turn, other, atol=SAME) for other in kept):
            kept.append(turn)
    return np.array(kept)

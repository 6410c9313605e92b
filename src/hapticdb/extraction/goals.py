"""Places that the planner tries to reach: those from which a straight way leads out, or to a pose.

Beyond the convex hull of what stops the straight pulls nothing of it is in the way. A place there
counts if the straight way from it out is free. The part is then pushed back in from there, as far
as it goes: the end is the goal. Other turns of the part reach places that no pull shows.
"""

import time
from collections import Counter
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hapticdb.extraction.directions import AXES, likely_directions
from hapticdb.extraction.free_space import FreeSpace, Room
from hapticdb.extraction.judge import passed
from hapticdb.extraction.problem import Exit, Problem
from hapticdb.extraction.pulls import Pulls, first_run, shifted
from hapticdb.grid import corners_of

Floats = NDArray[np.float64]

MOST_GOALS = 6
"""Greatest number of places for each turn of the part. Larger: more ways are tried
together, more poses before the planner begins."""
MOST_BLOCKERS = 8
"""Number of objects in the hull, those that stop most pulls."""
AROUND = 4.0
"""Half of the edge of the cube around the part in which the hull is taken, radii of the part.
Larger: the hull of large objects reaches farther than what the part meets."""
FEW = 4
"""Number of places outside the hull below which the planner also seeks those that are out of all.
Larger: the planner's room is larger."""
N_RANDOM = 18
"""Random directions beside the axes. Larger: more places are looked at."""
ROOM = 2.0
"""Distance from the hull, voxels."""
RETREAT = 4.0
"""Length of the ways back from a pose that is not free, radii of the part. Larger: longer bores."""
ASIDE = 2.0
"""Radii of the part around all that stands in which the planner seeks a way to a pose."""
SAME = 1e-9
"""Greatest difference of numbers in two poses that are one."""


class Goals(Protocol):
    """Places that the planner tries to reach.

    corners (n, 3) : the planner's room holds them, beside starts and goals.
    """

    corners: Floats

    def poses(self, room: Room, turns: Floats, *, is_turning: bool) -> Floats:
        """Displacements (G, 4, 4) that are free; turns (k, 3, 3) : those of the starts first."""

    def beyond(self, pose: Floats) -> Floats:
        """Displacements (n, 4, 4) that lead on from one of these places; there may be none."""


class GoalsOutside:
    """Goals from which the parts come out, the same for the same seed."""

    def __init__(self, problem: Problem, leaving: Exit, pulls: Pulls, seed: int) -> None:
        self._problem, self._leaving, self._pulls, self._seed = problem, leaving, pulls, seed
        self._exits: list[tuple[Floats, Floats]] = []
        self.corners = np.empty((0, 3))

    def poses(self, room: Room, turns: Floats, *, is_turning: bool) -> Floats:  # noqa: ARG002
        """Displacements (G, 4, 4), turned by each of (k, 3, 3): outside the hull, and out."""
        corners = self._hull()
        rng = np.random.default_rng(self._seed)
        random = rng.normal(size=(N_RANDOM, 3))
        directions = np.concatenate([AXES, random / np.linalg.norm(random, axis=1)[:, None]])
        aside = rng.uniform(-1.0, 1.0, size=(len(directions), 3)) * self._problem.radius
        aside[: len(AXES)] = 0.0
        found: list[Floats] = []
        for turn in turns:
            found += self._around(room, corners, directions, aside, turn)
        if len(found) < FEW:
            found += [self._placed(turns[0], shift) for shift in self._leaving.goals(AXES)]
        return np.array(found)

    def beyond(self, pose: Floats) -> Floats:
        """Displacements (n, 4, 4) straight on from a goal outside the hull; none if it is out."""
        return _led_on(pose, self._exits)

    def _around(
        self, room: Room, corners: Floats, directions: Floats, aside: Floats, turn: Floats
    ) -> list[Floats]:
        """Places outside the hull with a free way out, (4, 4) each; remembers where these end."""
        found: list[Floats] = []
        lengths = self._leaving.distances(directions)
        for direction, length, shift in zip(directions, lengths, aside, strict=True):
            if len(found) == MOST_GOALS:
                break
            across = shift - (shift @ direction) * direction
            place = self._outside(corners, direction, across, turn)
            center = turn @ self._problem.center + place[:3, 3]
            way = float((center - self._problem.center) @ direction)
            out = self._placed(turn, center - self._problem.center + (length - way) * direction)
            if way >= length or not self._leaving.is_out(self._problem.shift(out)[None])[0]:
                continue  # the hull reaches as far as everything else
            if room.is_motion_free(np.stack([place, out])):
                deepest = place.copy()
                deepest[:3, 3] -= way * direction
                goal = room.farthest(np.stack([place, deepest]))
                found.append(goal)
                self._exits.append((goal, out[None]))
        return found

    def _outside(self, corners: Floats, direction: Floats, across: Floats, turn: Floats) -> Floats:
        """Displacement (4, 4) to where the part lies beyond the hull in a direction."""
        problem = self._problem
        placed = (problem.shell.points - problem.center) @ (turn.T @ direction)
        reach = float((corners @ direction).max()) + ROOM * problem.voxel_size - float(placed.min())
        way = max(reach - float(problem.center @ direction), 0.0)
        return self._placed(turn, across + way * direction)

    def _placed(self, turn: Floats, shift: Floats) -> Floats:
        """Displacement (4, 4) that turns the part about its middle, and then shifts it."""
        pose = shifted(shift + self._problem.center - turn @ self._problem.center)
        pose[:3, :3] = turn
        return pose

    def _hull(self) -> Floats:
        """Points (n, 3) whose convex hull holds what blocks near the part: corners of its boxes."""
        problem = self._problem
        counts = Counter(i for pull in self._pulls.done for i in pull.blockers)
        ids = [i for i, _ in sorted(counts.items(), key=lambda one: (-one[1], one[0]))]
        first = set(ids[:MOST_BLOCKERS])
        reach = AROUND * problem.radius
        boxes = [
            np.clip(obj.bounds, problem.center - reach, problem.center + reach)
            for obj in problem.standing
            if obj.id in first
        ]
        boxes.append(np.stack([problem.center, problem.center]))
        return corners_of(np.stack(boxes)).reshape(-1, 3)


class GoalPose:
    """One pose, or where straight ways back from it are free, if it is not free itself."""

    def __init__(self, problem: Problem, space: FreeSpace, goal: Floats, until: float) -> None:
        self._problem, self._space, self._goal, self._until = problem, space, goal, until
        self._ways: list[tuple[Floats, Floats]] = []
        aside = ASIDE * problem.radius
        self.corners = problem.box + aside * np.array([[-1.0], [1.0]])

    def poses(self, room: Room, turns: Floats, *, is_turning: bool) -> Floats:
        """The pose, or places before it; none if its turn is not the first one of (k, 3, 3)."""
        if not is_turning and not np.allclose(self._goal[:3, :3], turns[0], atol=SAME):
            return np.empty((0, 4, 4))
        if room.are_free(self._goal[None])[0]:
            return self._goal[None]
        self._ways = [(place, self._goal[None]) for place in self._retreats(room)]
        return np.array([place for place, _ in self._ways]).reshape(-1, 4, 4)

    def beyond(self, pose: Floats) -> Floats:
        """The pose itself, if the place is before it."""
        return _led_on(pose, self._ways)

    def _retreats(self, room: Room) -> list[Floats]:
        """Places (4, 4), free, from which surfaces let the part pass straight to the pose."""
        goal, found = self._goal, list[Floats]()
        own = self._problem.own_axes @ goal[:3, :3].T
        normals = self._space.touch(goal).contact_normals
        for direction in likely_directions(normals, own):
            if time.monotonic() > self._until:
                break
            end = shifted(RETREAT * self._problem.radius * direction) @ goal
            poses = passed(self._problem, room, np.stack([goal, end]), self._until).poses
            first, last = first_run(room.are_free(poses))
            found += [poses[i] for i in sorted({first, last - 1}) if first < last]
        return found


def _led_on(pose: Floats, ways: list[tuple[Floats, Floats]]) -> Floats:
    """The rest (n, 4, 4) of the way that begins at a pose (4, 4); empty if none does."""
    for place, rest in ways:
        if np.allclose(place, pose, atol=SAME):
            return rest
    return np.empty((0, 4, 4))

"""Goals of the planner: poses outside with a free straight path out, or one given pose.

Beyond the convex hull of the objects that stop straight pulls, none of them blocks. A pose there
counts if its straight path out is free. The part is then pushed back in until a hit; the last free
pose is the goal. Other rotations of the part give goals that no pull reaches.
"""

import time
from collections import Counter
from typing import Protocol

import numpy as np

from hapticdb.array_types import Floats
from hapticdb.extraction.directions import AXES, likely_directions
from hapticdb.extraction.free_space import FreeSpace, Room
from hapticdb.extraction.problem import Exit, Problem
from hapticdb.extraction.proof import passed
from hapticdb.extraction.pulls import Pulls, first_run, shifted
from hapticdb.grid import corners_of

MOST_GOALS = 6
"""Goals for each rotation of the part, at most. Larger: more alternatives, a later start of the
plan."""
MOST_BLOCKERS = 8
"""Objects in the hull: those that stop most pulls."""
AROUND = 4.0
"""Half edge of the cube around the part to which the hull's objects are clipped, radii of the part.
Larger: hulls of large objects extend beyond the part's surroundings."""
FEW = 4
"""Goals outside the hull below which goals outside all objects are added, too. Larger: a larger
space."""
N_RANDOM = 18
"""Random directions after the axes. Larger: more candidate goals."""
ROOM = 2.0
"""Distance from the hull, voxels."""
RETREAT = 4.0
"""Length of the retreats from a pose that is not free, radii of the part. Larger: longer bores."""
ASIDE = 2.0
"""Margin of the planner's box around all standing objects, for a given pose, radii of the part."""
SAME = 1e-9
"""Greatest difference of the entries of two equal poses."""


class Goals(Protocol):
    """Goals of the planner.

    corners (n, 3) : points within the planner's box, in addition to starts and goals.
    """

    corners: Floats

    def poses(self, room: Room, turns: Floats, *, is_turning: bool) -> Floats:
        """Free displacements (G, 4, 4); turns (k, 3, 3) : rotations, of the starts first."""

    def beyond(self, pose: Floats) -> Floats:
        """Displacements (n, 4, 4) on from one of the goals; n may be 0."""


class GoalsOutside:
    """Goals from which the parts come out, deterministic for a seed."""

    def __init__(self, problem: Problem, leaving: Exit, pulls: Pulls, seed: int) -> None:
        self._problem, self._leaving, self._pulls, self._seed = problem, leaving, pulls, seed
        self._exits: list[tuple[Floats, Floats]] = []
        self.corners = np.empty((0, 3))

    def poses(self, room: Room, turns: Floats, *, is_turning: bool) -> Floats:  # noqa: ARG002
        """Displacements (G, 4, 4) with rotations (k, 3, 3): outside the hull, and fully out."""
        corners = self._hull()
        rng = np.random.default_rng(self._seed)
        random = rng.normal(size=(N_RANDOM, 3))
        directions = np.concatenate([AXES, random / np.linalg.norm(random, axis=1)[:, None]])
        aside = rng.uniform(-1.0, 1.0, size=(len(directions), 3)) * self._problem.radius
        # along the axes the part leaves centred, in random directions up to a radius aside
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
        """Poses (4, 4) outside the hull with a free path out; stores the ends of these paths."""
        found: list[Floats] = []
        lengths = self._leaving.distances(directions)
        for direction, length, shift in zip(directions, lengths, aside, strict=True):
            if len(found) == MOST_GOALS:
                break
            across = shift - (shift @ direction) * direction
            place = self._outside(corners, direction, across, turn)
            center = turn @ self._problem.center + place[:3, 3]
            distance = float((center - self._problem.center) @ direction)
            out = self._placed(
                turn, center - self._problem.center + (length - distance) * direction
            )
            if distance >= length or not self._leaving.is_out(self._problem.shift(out)[None])[0]:
                continue  # the hull extends as far as all objects
            if room.is_motion_free(np.stack([place, out])):
                # pushed back in until a hit: the last free pose is the goal
                deepest = place.copy()
                deepest[:3, 3] -= distance * direction
                goal = room.farthest(np.stack([place, deepest]))
                found.append(goal)
                self._exits.append((goal, out[None]))
        return found

    def _outside(self, corners: Floats, direction: Floats, across: Floats, turn: Floats) -> Floats:
        """Displacement (4, 4) of the part beyond the hull in a direction."""
        problem = self._problem
        # the direction is turned into the part's frame, instead of all points out of it
        placed = (problem.shell.points - problem.center) @ (turn.T @ direction)
        reach = float((corners @ direction).max()) + ROOM * problem.voxel_size - float(placed.min())
        distance = max(reach - float(problem.center @ direction), 0.0)
        return self._placed(turn, across + distance * direction)

    def _placed(self, turn: Floats, shift: Floats) -> Floats:
        """Displacement (4, 4): a rotation about the part's centre, then a shift."""
        pose = shifted(shift + self._problem.center - turn @ self._problem.center)
        pose[:3, :3] = turn
        return pose

    def _hull(self) -> Floats:
        """Corners (n, 3) of the clipped AABBs of the objects that stop most pulls."""
        problem = self._problem
        counts = Counter(i for pull in self._pulls.done for i in pull.blockers)
        # equal counts by id: the same seed gives the same goals
        ids = [i for i, _ in sorted(counts.items(), key=lambda one: (-one[1], one[0]))]
        first = set(ids[:MOST_BLOCKERS])
        reach = AROUND * problem.radius
        boxes = [
            np.clip(obj.bounds, problem.center - reach, problem.center + reach)
            for obj in problem.standing
            if obj.id in first
        ]
        # a box without extent: the hull has corners even if no object stops a pull
        boxes.append(np.stack([problem.center, problem.center]))
        return corners_of(np.stack(boxes)).reshape(-1, 3)


class GoalPose:
    """A given pose, or poses with free straight paths to it, if it is not free itself."""

    def __init__(self, problem: Problem, space: FreeSpace, goal: Floats, until: float) -> None:
        self._problem, self._space, self._goal, self._until = problem, space, goal, until
        self._ways: list[tuple[Floats, Floats]] = []
        aside = ASIDE * problem.radius
        self.corners = problem.box + aside * np.array([[-1.0], [1.0]])

    def poses(self, room: Room, turns: Floats, *, is_turning: bool) -> Floats:
        """The pose, or poses before it; none if its rotation is not the first one of (k, 3, 3)."""
        # shifts alone cannot reach another rotation
        if not is_turning and not np.allclose(self._goal[:3, :3], turns[0], atol=SAME):
            return np.empty((0, 4, 4))
        if room.are_free(self._goal[None])[0]:
            return self._goal[None]
        self._ways = [(place, self._goal[None]) for place in self._retreats(room)]
        return np.array([place for place, _ in self._ways]).reshape(-1, 4, 4)

    def beyond(self, pose: Floats) -> Floats:
        """The given pose (1, 4, 4), for a pose before it."""
        return _led_on(pose, self._ways)

    def _retreats(self, room: Room) -> list[Floats]:
        """Free poses (4, 4) with a straight path to the given pose, proved by a sweep."""
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


def _led_on(pose: Floats, paths: list[tuple[Floats, Floats]]) -> Floats:
    """The rest (n, 4, 4) of the path that begins at a pose (4, 4); empty without one."""
    for place, rest in paths:
        if np.allclose(place, pose, atol=SAME):
            return rest
    return np.empty((0, 4, 4))

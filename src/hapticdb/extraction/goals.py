"""Places that the planner tries to reach: those from which a straight way leads out.

Beyond the convex hull of what stops the straight pulls nothing of it is in the way. A place there
counts if the straight way from it out is free. The part is then pushed back in from there, as far
as it goes: the end is the goal. Other turns of the part reach places that no pull shows.
"""

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from hapticdb.extraction.directions import AXES
from hapticdb.extraction.free_space import FreeSpace
from hapticdb.extraction.leaving import Exit
from hapticdb.extraction.problem import Problem
from hapticdb.extraction.pulls import Pulls, shifted

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


class GoalSampler:
    """Goals for one problem, the same for the same seed."""

    def __init__(
        self, problem: Problem, space: FreeSpace, leaving: Exit, pulls: Pulls, seed: int
    ) -> None:
        self._problem, self._space, self._leaving = problem, space, leaving
        self._pulls, self._seed = pulls, seed
        self._exits: list[tuple[Floats, Floats]] = []

    def poses(self, turns: Floats, *, is_guarded: bool) -> Floats:
        """Displacements (G, 4, 4), turned by each of (k, 3, 3): outside the hull, and out."""
        corners = self._hull()
        rng = np.random.default_rng(self._seed)
        random = rng.normal(size=(N_RANDOM, 3))
        directions = np.concatenate([AXES, random / np.linalg.norm(random, axis=1)[:, None]])
        aside = rng.uniform(-1.0, 1.0, size=(len(directions), 3)) * self._problem.radius
        aside[: len(AXES)] = 0.0
        found: list[Floats] = []
        for turn in turns:
            found += self._around(corners, directions, aside, turn, is_guarded=is_guarded)
        if len(found) < FEW:
            found += [self._placed(turns[0], shift) for shift in self._leaving.goals(AXES)]
        return np.array(found)

    def exit_of(self, pose: Floats) -> Floats | None:
        """Displacement (4, 4) straight on from a goal outside the hull; None if it is out."""
        for place, out in self._exits:
            if np.allclose(place, pose, atol=1e-9):
                return out
        return None

    def _around(
        self, corners: Floats, directions: Floats, aside: Floats, turn: Floats, *, is_guarded: bool
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
            if way >= length or not self._leaving.is_out(_shift_of(out, self._problem)[None])[0]:
                continue  # the hull reaches as far as everything else
            if self._space.is_motion_free(np.stack([place, out]), is_guarded=is_guarded):
                goal = self._inward(place, direction, way, is_guarded=is_guarded)
                found.append(goal)
                self._exits.append((goal, out))
        return found

    def _inward(self, place: Floats, direction: Floats, way: float, *, is_guarded: bool) -> Floats:
        """Deepest free displacement (4, 4) against a direction from a free one, `way` metres."""
        end = place.copy()
        end[:3, 3] -= way * direction
        return self._space.farthest(np.stack([place, end]), is_guarded=is_guarded)

    def _outside(self, corners: Floats, direction: Floats, across: Floats, turn: Floats) -> Floats:
        """Displacement (4, 4) to where the part lies beyond the hull in a direction."""
        problem = self._problem
        placed = (self._space.shell.points - problem.center) @ (turn.T @ direction)
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
        choose = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T
        return np.concatenate([box[choose, np.arange(3)] for box in boxes])


def _shift_of(pose: Floats, problem: Problem) -> Floats:
    """How far (3,) a displacement shifts the part's middle."""
    return np.asarray(pose[:3, :3] @ problem.center + pose[:3, 3] - problem.center)

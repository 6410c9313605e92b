"""Motions with turns: small ones out of contact, and screws.

Touching surfaces share voxels, so a part in contact is not free at its start. A sweep bounds each
motion out of contact: the part may slide along a surface, but not cut into it.
"""

import heapq
import time
from typing import NamedTuple

import numpy as np

from hapticdb.array_types import Floats
from hapticdb.extraction.directions import (
    AGAINST,
    AXES,
    candidate_directions,
    distinct,
    likely_directions,
)
from hapticdb.extraction.extraction_results import RemovalPath
from hapticdb.extraction.free_space import FreeSpace
from hapticdb.extraction.problem import Exit, Problem
from hapticdb.extraction.proof import passed, prove
from hapticdb.extraction.pulls import MOST_OPPOSED, first_run
from hapticdb.grid import corners_of
from hapticdb.poses import rotation_of

FARTHEST = 4.0
"""Length of a shift in contact, radii of the part. Larger: longer slots, more poses."""
WIDEST = 2.0
"""Angle of a turn in contact, radians. Larger: wider turns, more poses."""
ARC = 0.17
"""Angle of a step of a turn, radians. Smaller: turns about points far from the part's centre are
followed more exactly, by more poses."""
MOST_SHIFTS = 24
"""Shifts tried from a pose, at most. Larger: oblique paths, a slower search."""
MOST_TURNED = 12
"""Turns about a centre, at most: each axis counts once for each sense."""
APART = 2.0
"""Least motion between two poses from which motions are tried, voxels. Larger: fewer poses."""


class EscapePath(NamedTuple):
    """A path out of contact: displacements (M, 4, 4) from the start to a free pose.

    is_wide : whether the end is free in the wide space.
    """

    poses: Floats
    is_wide: bool


class Twist(NamedTuple):
    """A small motion: shift (3,) or turn (3,) about `center` (3,), metres a unit of motion.

    The part's centre or its farthest point moves about one metre a unit. opposed : share of the
    opposing contacts.
    """

    shift: Floats
    turn: Floats
    center: Floats
    opposed: float

    def along(self, pose: Floats, farthest: float, widest: float = WIDEST) -> Floats:
        """Displacements (M, 4, 4) from a first one on: by `farthest` metres, or `widest` radians.

        Between two of them the part's centre moves straight; a turn has steps of `ARC`.
        """
        speed = float(np.linalg.norm(self.turn))
        # a unit of motion is about a metre: one number bounds shift and turn
        amount = min(farthest, widest / speed) if speed > 0.0 else farthest
        # turns in steps of `ARC`, since between two poses the centre moves straight
        angles = np.linspace(0.0, amount * speed, 1 + max(int(np.ceil(amount * speed / ARC)), 1))
        found = np.tile(np.eye(4), (len(angles), 1, 1))
        if speed > 0.0:
            halves = 0.5 * angles[:, None]
            turns = np.hstack([np.cos(halves), np.sin(halves) * self.turn / speed])
            found[:, :3, :3] = rotation_of(turns)
        shares = np.linspace(0.0, amount, len(angles))[:, None]
        found[:, :3, 3] = self.center - found[:, :3, :3] @ self.center + shares * self.shift
        moved = found @ pose
        # exact: the product rounds, and the path must continue without a gap
        moved[0] = pose
        return np.asarray(moved)


class ContactEscape:
    """Best-first search for motions out of contact, of shifts and turns in sequence.

    n_motions : number of motions tried so far.
    """

    def __init__(self, problem: Problem, space: FreeSpace, seed: int) -> None:
        self._problem, self._space, self._seed = problem, space, seed
        self.n_motions = 0

    def search(self, most_motions: int, until: float) -> list[EscapePath]:
        """Paths out of contact, into the wide space first; until a time of `time.monotonic`."""
        found: list[EscapePath] = []
        places = [np.eye(4)]
        waiting: list[tuple[int, int, Floats]] = [(0, 0, np.eye(4)[None])]
        # best first by hits: fewer shared voxels are nearer to free space; the number breaks ties
        while waiting and not found:
            _, _, path = heapq.heappop(waiting)
            for twist in self._twists(path[-1]):
                if self.n_motions >= most_motions or time.monotonic() > until:
                    break
                self.n_motions += 1
                ends, nexts = self._follow(path, twist, until)
                found += ends
                for hits, longer in nexts:
                    if self._is_new(longer[-1], places):
                        places.append(longer[-1])
                        heapq.heappush(waiting, (hits, len(places), longer))
            else:
                continue
            break
        return sorted(found, key=lambda one: not one.is_wide)

    def _follow(
        self, path: Floats, twist: Twist, until: float
    ) -> tuple[list[EscapePath], list[tuple[int, Floats]]]:
        """Follow a twist to its first hit: paths with a free end, or in contact with their hits."""
        room, farthest = self._space.room, FARTHEST * self._problem.radius
        moved = passed(self._problem, room, twist.along(path[-1], farthest), until)
        if len(moved.poses) < 2:
            return [], []
        # after the sweep: the voxels alone cannot tell contact from overlap
        counts = room.hits(moved.poses)

        def longer(n: int) -> Floats:
            return np.concatenate([path[:-1], moved.until(n)])

        first, last = first_run(np.append(False, counts[1:] == 0))
        if first < last:
            chosen, is_wide = self._free(moved.poses[first:last])
            return [EscapePath(longer(first + i), is_wide) for i in chosen], []
        # the middle of the least contact and the far end: the two poses most unlike their start
        least = np.flatnonzero(counts[1:] == counts[1:].min()) + 1
        ends = {int(least[len(least) // 2]), len(counts) - 1}
        return [], [(int(counts[n]), longer(n)) for n in sorted(ends)]

    def _free(self, poses: Floats) -> tuple[list[int], bool]:
        """Middle and last index of free poses (n, 4, 4), preferably in the wide space."""
        first, last = first_run(self._space.wide.are_free(poses))
        is_wide = first < last
        if not is_wide:
            first, last = 0, len(poses)
        return sorted({(first + last) // 2, last - 1}), is_wide

    def _is_new(self, pose: Floats, places: list[Floats]) -> bool:
        """Whether a displacement differs from all others by more than `APART`, estimated."""
        others = np.array(places)
        # Frobenius norm of the difference is sqrt(2) times the turn, for small turns
        turns = np.linalg.norm(pose[:3, :3] - others[:, :3, :3], axis=(1, 2)) / np.sqrt(2.0)
        shifts = (pose[:3, :3] - others[:, :3, :3]) @ self._problem.center
        shifts += pose[:3, 3] - others[:, :3, 3]
        motions = np.linalg.norm(shifts, axis=1) + self._problem.radius * turns
        return bool((motions > APART * self._problem.voxel_size).all())

    def _twists(self, pose: Floats) -> list[Twist]:
        """Shifts and turns at a displacement, in the order of their shares of opposing contacts."""
        problem, touched = self._problem, self._space.touch(pose)
        points, normals = touched.contact_points, touched.contact_normals
        center, still = pose[:3, :3] @ problem.center + pose[:3, 3], np.zeros(3)
        middle = points.mean(axis=0) if len(points) else center
        own = problem.own_axes @ pose[:3, :3].T
        motions = [
            (direction, still, center)
            for direction in candidate_directions(normals, own, self._seed)[:MOST_SHIFTS]
        ]
        # else both centres give almost the same turns
        is_aside = np.linalg.norm(middle - center) > 0.1 * problem.radius
        motions += [
            (still, axis / problem.radius, about)
            for about in ((center, middle) if is_aside else (center,))
            for axis in likely_directions(normals, own)[:MOST_TURNED]
        ]
        found = [Twist(*each, _opposed(*each, points, normals)) for each in motions]
        found = [twist for twist in found if twist.opposed <= MOST_OPPOSED]
        # rounded, and a stable sort: nearly equal shares keep the order of the directions
        return sorted(found, key=lambda twist: round(twist.opposed, 2))


def _opposed(shift: Floats, turn: Floats, about: Floats, points: Floats, normals: Floats) -> float:
    """Share of the contacts, 0 .. 1, opposed to a motion."""
    if not len(points):
        return 0.0
    # velocity field of the twist at each contact; against the normal means into the surface
    speeds = shift + np.cross(turn, points - about)
    along = (speeds * normals).sum(axis=1)
    return float((along < AGAINST * np.linalg.norm(speeds, axis=1).max()).mean())


def unscrewed(problem: Problem, leaving: Exit, pitch: float, until: float) -> RemovalPath | None:
    """First screw motion not refuted, along the part's axes and the world's, of both hands.

    pitch : metres a turn. The axis is through the part's centre. A bolt turns for its own length, a
    nut until it is past the objects in its box; then the part moves straight.
    """
    low, high = problem.corners.min(axis=0), problem.corners.max(axis=0)
    boxes = [obj.bounds for obj in problem.standing]
    near_corners = [
        corners_of(box) for box in boxes if (box[0] <= high).all() and (box[1] >= low).all()
    ]
    axes = distinct(np.concatenate([problem.own_axes, -problem.own_axes, AXES]))
    for direction, exit_distance in zip(axes, leaving.distances(axes).tolist(), strict=True):
        heights = problem.corners @ direction
        # height of the nearest objects' and the part's top over the part's bottom
        past = (
            max((one @ direction).max() for one in [*near_corners, problem.corners]) - heights.min()
        )
        for hand in (1.0, -1.0):
            # a bolt leaves its own thread, a nut the whole of the bolt
            for length in (np.ptp(heights), past):
                if time.monotonic() > until:
                    return None
                turn = hand * 2.0 * np.pi / pitch * direction
                twist = Twist(direction, turn, problem.center, 0.0)
                poses = twist.along(np.eye(4), min(float(length), exit_distance), np.inf)
                last = poses[-1].copy()
                last[:3, 3] += max(exit_distance - float(length), 0.0) * direction
                poses = np.concatenate([poses, last[None]])
                proved = prove(problem, poses, "screw", until)
                if not proved.obstacles:
                    return proved
                if proved.free_share * proved.length < proved.swept.path.parameters[-2]:
                    break  # it is not this thread's
    return None

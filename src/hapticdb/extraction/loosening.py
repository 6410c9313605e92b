"""Small motions, shifts and turns, by which a part leaves what it touches at its start.

Voxels of two surfaces that touch are shared, so a part that touches something is not free at its
start. A motion out of contact is believed while `ContactSpace` allows its poses: sliding along a
surface, not cutting into it. The proof is that of a sweep.
"""

import heapq
import time
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.extraction.directions import (
    AGAINST,
    AXES,
    candidate_directions,
    distinct,
    grouped,
)
from hapticdb.extraction.free_space import ContactSpace, FreeSpace
from hapticdb.extraction.problem import Problem
from hapticdb.extraction.pulls import MOST_OPPOSED, first_run
from hapticdb.poses import rotation_of
from hapticdb.sweeps.path import SweepPath

Floats = NDArray[np.float64]

FARTHEST = 4.0
"""Length of a shift in contact, radii of the part. Larger: longer slots are left, more poses."""
WIDEST = 2.0
"""Angle of a turn in contact, radians. Larger: wider turns are found, more poses."""
MOST_SHIFTS = 24
"""Greatest number of shifts tried from a place. Larger: oblique ways are found, a slower search."""
MOST_TURNED = 6
"""Greatest number of axes of turns through a centre."""
MOST_GROUPS = 60
"""Greatest number of groups of contacts for which a motion that leaves all of them is computed."""
APART = 2.0
"""Motion, voxels, between two places from which motions are tried. Larger: fewer places."""
BLOCK = 32
"""Poses of a motion that are looked at together."""


class Loosened(NamedTuple):
    """A way out of contact: displacements (M, 4, 4) from the start to a place that is free.

    is_guarded : whether that place is free with the guard.
    """

    poses: Floats
    is_guarded: bool


class Twist(NamedTuple):
    """A small motion: shift (3,) or turn (3,) about `center` (3,), metres a unit of motion.

    The farthest point of the part moves about one metre a unit. opposed : share of the contacts
    that the motion presses against.
    """

    shift: Floats
    turn: Floats
    center: Floats
    opposed: float

    def moved(self, pose: Floats, amount: float) -> Floats:
        """Displacement (4, 4) `amount` units after another displacement."""
        angle = amount * float(np.linalg.norm(self.turn))
        step = np.eye(4)
        if angle > 0.0:
            axis = self.turn / np.linalg.norm(self.turn)
            half = 0.5 * angle
            step[:3, :3] = rotation_of(np.concatenate([[np.cos(half)], np.sin(half) * axis]))
        step[:3, 3] = self.center - step[:3, :3] @ self.center + amount * self.shift
        return np.asarray(step @ pose)


class Loosening:
    """Searches motions out of contact, shifts and turns one after another, best places first.

    Attributes
    ----------
    n_motions : int
        Number of motions tried so far.
    """

    def __init__(
        self, problem: Problem, space: FreeSpace, contact: ContactSpace, seed: int
    ) -> None:
        self._problem, self._space, self._contact, self._seed = problem, space, contact, seed
        self.n_motions = 0

    def search(self, most_motions: int, until: float) -> list[Loosened]:
        """Ways out of contact, those free with the guard first; ends at a time of `monotonic`."""
        found: list[Loosened] = []
        places = [np.eye(4)]
        waiting: list[tuple[int, int, Floats]] = [(0, 0, np.eye(4)[None])]
        while waiting and not found:
            _, _, way = heapq.heappop(waiting)
            for twist in self._twists(way[-1]):
                if self.n_motions >= most_motions or time.monotonic() > until:
                    break
                self.n_motions += 1
                ends, nexts = self._follow(way, twist)
                found += ends
                for hits, pose in nexts:
                    if all(self._motion(pose, one) > APART * self._problem.voxel_size
                           for one in places):  # fmt: skip
                        places.append(pose)
                        longer = np.concatenate([way, pose[None]])
                        heapq.heappush(waiting, (hits, len(places), longer))
            else:
                continue
            break
        return sorted(found, key=lambda one: not one.is_guarded)

    def _follow(self, way: Floats, twist: Twist) -> tuple[list[Loosened], list[tuple[int, Floats]]]:
        """Move on while allowed: ends that are free, or places in contact with their hits."""
        radius = self._problem.radius
        turns = float(np.linalg.norm(twist.turn))
        amount = WIDEST / turns if turns > 0.0 else FARTHEST * radius
        ends = np.stack([way[-1], twist.moved(way[-1], amount)])
        path = SweepPath.of(ends, self._space.shell, self._problem.voxel_size)
        poses, counts = self._allowed(path)
        if len(counts) < 2:
            return [], []
        first, last = first_run(np.append(False, counts[1:] == 0))
        if first < last:
            return self._freed(way, poses[first:last]), []
        least = np.flatnonzero(counts[1:] == counts[1:].min()) + 1
        chosen = {int(least[len(least) // 2]), len(counts) - 1}
        return [], [(int(counts[i]), poses[i]) for i in sorted(chosen)]

    def _allowed(self, path: SweepPath) -> tuple[Floats, NDArray[np.int64]]:
        """Poses (n, 4, 4) from the path's start on that are allowed, with their hits (n,)."""
        poses, counts = [np.empty((0, 4, 4))], [np.empty(0, dtype=np.int64)]
        for begin in range(0, len(path), BLOCK):
            some = path.sample(begin, min(begin + BLOCK, len(path)))
            is_allowed = self._contact.are_allowed(some)
            n_allowed = len(some) if is_allowed.all() else int(np.argmin(is_allowed))
            hits = self._space.hits(some[:n_allowed]) if n_allowed else counts[0]
            poses.append(some[:n_allowed])
            counts.append(hits)
            if n_allowed < len(some) or (begin and not hits.any()):
                break
        return np.concatenate(poses), np.concatenate(counts)

    def _freed(self, way: Floats, poses: Floats) -> list[Loosened]:
        """Ways to the middle and to the end of what is free with the guard, or without it."""
        first, last = first_run(self._space.hits(poses, is_guarded=True) == 0)
        is_guarded = first < last
        if not is_guarded:
            first, last = 0, len(poses)
        chosen = sorted({(first + last) // 2, last - 1})
        return [Loosened(np.concatenate([way, poses[i][None]]), is_guarded) for i in chosen]

    def _motion(self, a: Floats, b: Floats) -> float:
        """Greatest motion of a point, metres, from one displacement to another, about."""
        turn = np.linalg.norm(a[:3, :3] - b[:3, :3]) / np.sqrt(2.0)
        center = self._problem.center
        shift = (a[:3, :3] - b[:3, :3]) @ center + a[:3, 3] - b[:3, 3]
        return float(np.linalg.norm(shift) + self._problem.radius * turn)

    def _twists(self, pose: Floats) -> list[Twist]:
        """Motions to try at a displacement: those that press against fewest contacts first."""
        problem = self._problem
        felt = self._contact.touch(pose)
        points, normals = felt.contact_points, felt.contact_normals
        center = pose[:3, :3] @ problem.center + pose[:3, 3]
        found = [
            twist
            for twist in candidate_twists(points, normals, center, problem.radius, self._seed)
            if twist.opposed <= MOST_OPPOSED
        ]
        return sorted(found, key=lambda twist: round(twist.opposed, 2))


def candidate_twists(
    points: Floats, normals: Floats, center: Floats, radius: float, seed: int
) -> list[Twist]:
    """Motions that contacts suggest: leaving all of them, shifts, and turns.

    points, normals (C, 3) : contacts, unit normals away from what is touched; center (3,), radius :
    of the part, metres.
    """
    middle = points.mean(axis=0) if len(points) else center
    still = np.zeros(3)
    leaving = leaving_twist(points, normals, center, radius)
    shifts = candidate_directions(normals, seed)[:MOST_SHIFTS]
    groups = grouped(normals)
    crosses = np.array([np.cross(a, b) for a, b in combinations(groups, 2)]).reshape(-1, 3)
    axes = distinct(np.concatenate([groups, AXES[:3], crosses]))
    kept = [a for i, a in enumerate(axes) if not any(abs(float(a @ b)) > 0.99 for b in axes[:i])]
    motions = [(leaving[:3], leaving[3:] / radius, center)] if leaving.any() else []
    motions += [(direction, still, center) for direction in shifts]
    for about in (center, middle) if np.linalg.norm(middle - center) > 0.1 * radius else (center,):
        motions += [
            (still, sign * axis / radius, about)
            for axis in kept[:MOST_TURNED]
            for sign in (1.0, -1.0)
        ]
    return [
        Twist(shift, turn, about, _opposed(shift, turn, about, points, normals))
        for shift, turn, about in motions
    ]


def leaving_twist(points: Floats, normals: Floats, center: Floats, radius: float) -> Floats:
    """Unit twist (6,) that leaves all contacts: shift, and turn about `center` times radius.

    It is the point of the convex hull of the contacts' wrenches that is nearest to zero: no contact
    is left more slowly by it than the slowest one by any other. Zeros if the contacts hold the part
    to first order, or there are none.
    """
    from scipy.optimize import nnls  # noqa: PLC0415 - a third of a second, for parts in contact

    if not len(points):
        return np.zeros(6)
    wrenches = np.hstack([normals, np.cross(points - center, normals) / radius])
    _, firsts, counts = np.unique(
        np.rint(3.0 * wrenches), axis=0, return_index=True, return_counts=True
    )
    chosen = wrenches[firsts[np.argsort(-counts, kind="stable")[:MOST_GROUPS]]]
    weight = 100.0  # of the condition that the shares sum to 1
    shares, _ = nnls(
        np.vstack([chosen.T, np.full(len(chosen), weight)]), np.array([0.0] * 6 + [weight])
    )
    twist = chosen.T @ shares
    length = float(np.linalg.norm(twist))
    if length < 1e-3 or float((chosen @ twist).min()) < 0.0:
        return np.zeros(6)
    return np.asarray(twist / length)


def _opposed(shift: Floats, turn: Floats, about: Floats, points: Floats, normals: Floats) -> float:
    """Share of the contacts, 0 .. 1, that a motion presses against."""
    if not len(points):
        return 0.0
    speeds = shift + np.cross(turn, points - about)
    along = (speeds * normals).sum(axis=1)
    return float((along < AGAINST * np.linalg.norm(speeds, axis=1).max()).mean())

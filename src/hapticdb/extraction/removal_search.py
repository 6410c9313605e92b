"""Search for a removal path of parts, or a path to a pose: straight pulls, then a planner.

Each path is judged by a sweep. The lack of a path proves nothing: the result then names the objects
in the way of the straight pulls.
"""

import math
import time
from collections import Counter
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from hapticdb.array_types import Floats
from hapticdb.environment import Environment
from hapticdb.errors import MissingExtraError, UsageError
from hapticdb.exact.path import checked_poses
from hapticdb.exact.separation import CONTACT
from hapticdb.extraction.contact_escape import unscrewed
from hapticdb.extraction.extraction_results import Blocker, Extraction, RemovalPath, ids_of
from hapticdb.extraction.free_space import FreeSpace
from hapticdb.extraction.goals import GoalPose, Goals, GoalsOutside
from hapticdb.extraction.planner import Planner
from hapticdb.extraction.problem import Exit, Problem, problem_of
from hapticdb.extraction.proof import prove
from hapticdb.extraction.pulls import Pulls
from hapticdb.resident.table import DEFAULT_BUDGET
from hapticdb.store.base import Object, Progress
from hapticdb.store.finding import Words
from hapticdb.verdicts import PathVerdict

DEFAULT_SECONDS = 60.0
"""Default time of a search."""
DEFAULT_MOTIONS = 20_000
"""Default number of the planner's motion queries."""
MOST_OUT = 8
"""Straight pulls judged of those that lead out by voxels, at most."""
SHARE_OF_LIKELY = 0.3
"""Greatest share of the time for sweeps of likely pulls, before pulls by voxels."""
SHARE_OF_PROOF = 0.2
"""Share of the time reserved for sweeps of paths by voxels and of planned ones."""
MOST_PLANS = 3
"""Planned paths judged until one is not refuted, at most. Larger: more paths past thin
obstacles."""
FARTHEST = 1e3
"""Longest path to a pose, sizes of the standing objects' box: a longer one has a wrong unit."""
MOST_SEED = 1 << 31


def extract(
    env: Environment,
    *words: int | str,
    where: Words = (),
    exclude: Words = (),
    to: ArrayLike | None = None,
    out: float | None = None,
    screw: float | None = None,
    contact: float = CONTACT,
    overlap: float = 0.0,
    seconds: float = DEFAULT_SECONDS,
    seed: int = 0,
    motions: int = DEFAULT_MOTIONS,
    budget_bytes: int = DEFAULT_BUDGET,
    progress: Progress | None = None,
) -> Extraction:
    """Search for a path on which parts come out, or to a pose.

    Parameters
    ----------
    env : Environment, whose order is not lexicographic
    words : int or str
        Parts that move together, as for `Environment.find`.
    where, exclude, contact, overlap
        As for `hapticdb.sweep`; the parts themselves do not collide.
    to : (4, 4) array or None
        Goal displacement of the parts, rigid, metres; out unless given.
    out : float or None
        Metres from the start at which the parts count as out; unless given, their bounding sphere
        has to leave the box of all standing objects.
    screw : float or None
        Pitch of a thread, metres a turn: screw motions of both hands are tried after the pulls.
    seconds : float
        Time of the search with the sweeps that judge its paths, which have a fifth of it at least.
    seed : int
        The same seed gives the same path, unless the deadline ends the search.
    motions : int
        Motion queries of the planner, at most; 0: straight pulls only.
    budget_bytes : int, as for `Environment.batch_tool`
    progress : callable or None
        Called after each straight pull with the pulls tried and their total.

    Raises
    ------
    ObjectNotFoundError
        If a word chooses no object.
    MissingExtraError
        If no straight pull leads out, and the planner is not installed.
    UsageError
        If a number is out of range, or no other object stands.
    """
    request = _Request(None, seconds, seed, motions, out, screw, budget_bytes)
    request.check()
    began = time.monotonic()
    problem = problem_of(env, words, where, exclude, seed=seed, contact=contact, overlap=overlap)
    goal = None if to is None else _checked_goal(problem, to, request)
    problem = problem._replace(until=began + seconds)
    found = _searched(problem, request._replace(to=goal), progress)
    return replace(found, seconds=time.monotonic() - began)


class _Request(NamedTuple):
    """Options of a search, as for `extract`; to : checked."""

    to: Floats | None
    seconds: float
    seed: int
    motions: int
    out: float | None
    screw: float | None
    budget_bytes: int

    def check(self) -> None:
        """Refuse numbers out of range."""
        if not (math.isfinite(self.seconds) and self.seconds > 0.0):
            raise UsageError(f"a search of {self.seconds} seconds: give more than 0")
        if not 0 <= self.seed < MOST_SEED:
            raise UsageError(f"seed {self.seed}: give 0 .. {MOST_SEED - 1}")
        if self.motions < 0:
            raise UsageError(f"{self.motions} motions: give 0 or more")
        for name, length in (("out at", self.out), ("a screw's pitch of", self.screw)):
            if length is not None and not (math.isfinite(length) and length > 0.0):
                raise UsageError(f"{name} {length} m: give a length above 0")


def _checked_goal(problem: Problem, to: ArrayLike, request: _Request) -> Floats:
    """The goal pose (4, 4); UsageError if it is not rigid, or too far away."""
    if request.out is not None or request.screw is not None:
        raise UsageError("a path to a pose: give neither out nor screw")
    goal = np.asarray(checked_poses(np.asarray(to)[None])[0])
    distance, size = (
        problem.path(np.stack([np.eye(4), goal])).length,
        np.ptp(problem.box, axis=0).max(),
    )
    if distance > FARTHEST * (size + problem.radius):
        raise UsageError(
            f"the pose to reach is {distance:.4g} m away, and what stands is {size:.4g} m across: "
            "check its unit"
        )
    return goal


def _searched(problem: Problem, request: _Request, progress: Progress | None) -> Extraction:
    """Pull, plan if no pull is proved, and return the result; its `seconds` is 0."""
    leaving = Exit(
        problem.box[0],
        problem.box[1],
        problem.center,
        problem.radius + problem.voxel_size,
        request.out,
    )
    # time kept back: a path without a sweep proves nothing
    until = problem.until - SHARE_OF_PROOF * request.seconds
    n_motions, is_planned = 0, False
    path = None if request.to is None else prove(problem, np.stack([np.eye(4), request.to]), "pull")
    refuting = () if path is None else path.obstacles
    path = None if refuting else path  # refuted, it only names what is in the way
    with FreeSpace(problem, request.budget_bytes) as space:
        pulls = Pulls(problem, space, leaving, request.seed)
        if path is None or path.verdict is PathVerdict.NOT_DECIDED:
            pulled = pulls.sweep(problem.until - (1.0 - SHARE_OF_LIKELY) * request.seconds)
            # for a pose, pulls give only starts of the planner and objects in the way
            if pulled is None or request.to is not None:
                pulls.run(until, progress)
                pulled = _best_pull(problem, pulls)
            path = pulled if request.to is None else path
            if request.screw is not None and (
                path is None or path.verdict is PathVerdict.NOT_DECIDED
            ):
                path = unscrewed(problem, leaving, request.screw, until) or path
        is_open = path is None or path.verdict is PathVerdict.NOT_DECIDED
        if request.motions and is_open and time.monotonic() <= until:
            goals: Goals = (
                GoalsOutside(problem, leaving, pulls, request.seed)
                if request.to is None
                else GoalPose(problem, space, request.to, until)
            )
            planner = Planner(
                problem, space, pulls, goals,
                leaving=leaving if request.to is None else None, seed=request.seed,
                most_motions=request.motions, until=until,
            )  # fmt: skip
            path, is_planned = _planned(problem, planner, path, pulls), True
            n_motions = planner.n_motions
        n_poses = space.n_poses
    known = {obj.id: obj for obj in problem.standing}
    return Extraction(
        parts=problem.parts,
        shell=problem.shell,
        to=request.to,
        path=path,
        near=tuple(space.start.objects),
        blockers=tuple(Blocker(known[i], n) for i, n in _blockers(pulls, *refuting) if i in known),
        pulls=len(pulls.done) + bool(refuting),
        motions=n_motions,
        poses=n_poses,
        is_planned=is_planned,
        is_out_of_time=time.monotonic() > until
        and (path is None or path.verdict is PathVerdict.NOT_DECIDED),
        seconds=0.0,
        seed=request.seed,
    )


def _best_pull(problem: Problem, pulls: Pulls) -> RemovalPath | None:
    """First proved one of the straight pulls that lead out by voxels; else an undecided one.

    Sweeps then replace the free lengths and blockers of the judged pulls.
    """
    outs = [n for n, pull in enumerate(pulls.done) if pull.is_out]
    # short contacts first: long ones are the likeliest to be refuted by the sweep
    outs.sort(key=lambda n: (pulls.done[n].contact_length, pulls.done[n].length))
    undecided: RemovalPath | None = None
    for n in outs[:MOST_OUT]:
        if undecided is not None and time.monotonic() > problem.until:
            break
        pull = pulls.done[n]
        path = prove(problem, pull.poses(np.array([0.0, pull.length])), "pull")
        if path.swept.is_free:
            return path
        if path.obstacles:
            blockers = ids_of(path.obstacles[:1])  # it ends at the first
            free = path.free_share * pull.length
            pulls.done[n] = pull._replace(free=free, blockers=blockers, is_swept=True)
        elif undecided is None:
            undecided = path
    return undecided


def _planned(
    problem: Problem, planner: Planner, path: RemovalPath | None, pulls: Pulls
) -> RemovalPath | None:
    """Plan and judge; returns the better of the planned path and the path so far.

    After a refuted path, the planner starts elsewhere, `MOST_PLANS` times in all.
    """
    for _ in range(MOST_PLANS):
        poses = _poses_of(problem, planner, path, pulls)
        if poses is None:
            return path
        planned = prove(problem, poses, "plan")
        # without obstacles it may be undecided: then it counts only if there is no other path
        if not planned.obstacles:
            return planned if planned.swept.is_free or path is None else path
        if not planner.can_reject:
            return path
        planner.reject_start()
    return path


def _poses_of(
    problem: Problem, planner: Planner, path: RemovalPath | None, pulls: Pulls
) -> Floats | None:
    """Poses of a planned path; a missing planner is an error unless a path exists already."""
    try:
        return planner.search()
    except MissingExtraError as error:
        if path is not None:
            return None
        ids = [i for i, _ in _blockers(pulls)[:1]]
        name = "".join(f", {obj.name} is in the way" for obj in problem.standing if obj.id in ids)
        raise MissingExtraError(f"no straight pull leads out{name}; {error}") from error


def _blockers(pulls: Pulls, *refuting: Object) -> list[tuple[int, int]]:
    """Ids of the objects that stop pulls, with the number of pulls, largest number first.

    refuting : objects in the way of the straight motion to a pose.
    """
    counts = Counter(i for pull in pulls.done if not pull.is_out for i in pull.blockers)
    counts.update(obj.id for obj in refuting)
    # equal numbers by id: the same seed gives the same result
    return sorted(counts.items(), key=lambda item: (-item[1], item[0]))

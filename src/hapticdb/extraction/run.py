"""Searches a way out for parts: straight pulls first, then a planner; sweeps prove what is found.

A path that is found may be proved or not. That no path is found proves nothing: the result then
names what is in the way of the straight pulls.
"""

import math
import time
from collections import Counter
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.environment import Environment
from hapticdb.errors import MissingExtraError, UsageError
from hapticdb.extraction.free_space import ContactSpace, FreeSpace
from hapticdb.extraction.judge import judge
from hapticdb.extraction.leaving import Exit
from hapticdb.extraction.planner import Planner
from hapticdb.extraction.problem import Problem, problem_of
from hapticdb.extraction.pulls import Pull, Pulls
from hapticdb.extraction.result import Blocker, Extraction, WayOut, WayOutVerdict
from hapticdb.resident.table import DEFAULT_BUDGET
from hapticdb.store.finding import Words
from hapticdb.sweeps.run import SampleCallback

Floats = NDArray[np.float64]

DEFAULT_SECONDS = 60.0
"""Default time of a search."""
DEFAULT_MOTIONS = 20_000
"""Default number of motions that the planner may ask about."""
MOST_JUDGED = 4
"""Greatest number of straight pulls that are proved, one after another, until one is. Larger: a
proof is found more often, at the price of a sweep each."""
MOST_PLANS = 3
"""Greatest number of planned paths that are proved, until one is not refuted. Larger: more ways are
found past places that the search overlooks, at the price of a sweep each."""
MOST_SEED = 1 << 31
RANK: dict[WayOutVerdict, int] = {
    "comes out": 0, "slides out": 1, "comes out of contact": 2, "not decided": 3,
}  # fmt: skip


def extract(
    env: Environment,
    *words: int | str,
    where: Words = (),
    exclude: Words = (),
    seconds: float = DEFAULT_SECONDS,
    seed: int = 0,
    motions: int = DEFAULT_MOTIONS,
    out: float | None = None,
    budget_bytes: int = DEFAULT_BUDGET,
    progress: SampleCallback | None = None,
) -> Extraction:
    """Search a path on which parts come out of what stands around them.

    Parameters
    ----------
    env : Environment
        An environment whose order is not lexicographic, with the files it was imported from.
    words : int or str
        Parts that move together, as for `Environment.find`.
    where, exclude : iterable of int or str
        What is felt, as for `hapticdb.sweep`; the parts themselves are not felt.
    seconds : float
        Time of the search; proofs of what is found may take longer.
    seed : int
        The same seed gives the same path, unless the time ends the search.
    motions : int
        Motions that the planner may ask about; 0: straight pulls only.
    out : float or None
        Metres from the start at which the parts count as out; unless given, where their bounding
        sphere has left the box of all that stands.
    budget_bytes : int
        Memory for resident cells.
    progress : callable or None
        Called after each straight pull with the pulls tried and their total.

    Raises
    ------
    ObjectNotFoundError
        If a word chooses no object.
    NoSurfaceError
        If a part was imported by a version that kept no surfaces.
    MissingExtraError
        If no straight pull leads out, and the planner is not installed.
    UsageError
        If a number is out of range, or nothing stands beside the parts.
    """
    asked = _Asked(seconds, seed, motions, out, budget_bytes)
    asked.check()
    began = time.monotonic()
    problem = problem_of(env, words, where, exclude, seed=seed)
    found = _searched(problem, asked, progress)
    return replace(found, seconds=time.monotonic() - began)


class _Asked(NamedTuple):
    """Options of a search, as `extract` takes them."""

    seconds: float
    seed: int
    motions: int
    out: float | None
    budget_bytes: int

    def check(self) -> None:
        """Refuse numbers out of range."""
        if not (math.isfinite(self.seconds) and self.seconds > 0.0):
            raise UsageError(f"a search of {self.seconds} seconds: give more than 0")
        if not 0 <= self.seed < MOST_SEED:
            raise UsageError(f"seed {self.seed}: give 0 .. {MOST_SEED - 1}")
        if self.motions < 0:
            raise UsageError(f"{self.motions} motions: give 0 or more")
        if self.out is not None and not (math.isfinite(self.out) and self.out > 0.0):
            raise UsageError(f"out at {self.out} m: give a length above 0")


def _searched(problem: Problem, asked: _Asked, progress: SampleCallback | None) -> Extraction:
    """Pull, plan if no pull is proved, and collect the result, without its time."""
    leaving = Exit(
        problem.box[0],
        problem.box[1],
        problem.center,
        problem.radius + problem.voxel_size,
        asked.out,
    )
    until = time.monotonic() + asked.seconds
    n_motions, is_planned = 0, False
    with (
        FreeSpace(problem, asked.budget_bytes) as space,
        ContactSpace(problem, space, asked.budget_bytes) as contact,
    ):
        pulls = Pulls(problem, space, contact, leaving, asked.seed)
        pulls.run(until, progress)
        refuting: Counter[int] = Counter()
        way = _best_pull(problem, pulls.done, asked.budget_bytes, refuting)
        if way is None or way.verdict == "not decided":  # what blocks is counted already
            last = _best_pull(problem, pulls.opposed_out(until), asked.budget_bytes, Counter())
            way = last if last is not None and last.verdict != "not decided" else way
        if asked.motions and (way is None or way.verdict == "not decided"):
            planner = Planner(
                problem, space, contact, leaving, pulls, seed=asked.seed,
                most_motions=asked.motions, until=until,
            )  # fmt: skip
            way, is_planned = _planned(problem, planner, way, pulls, asked.budget_bytes), True
            n_motions = planner.n_motions
        n_poses = space.n_poses
    known = {obj.id: obj for obj in problem.standing}
    return Extraction(
        parts=problem.parts,
        shell=problem.shell,
        way=way,
        touched=tuple(known[i] for i in pulls.touched if i in known),
        blockers=tuple(
            Blocker(known[i], n) for i, n in _blockers(pulls.done, refuting) if i in known
        ),
        pulls=len(pulls.done),
        motions=n_motions,
        poses=n_poses,
        is_planned=is_planned,
        seconds=0.0,
        seed=asked.seed,
    )


def _best_pull(
    problem: Problem, pulls: list[Pull], budget_bytes: int, refuting: Counter[int]
) -> WayOut | None:
    """Prove the straight pulls that lead out, guarded and short ones first; returns the best.

    The dense shell of the proof may hit what the search has not seen: these objects are counted.
    """

    def rank(pull: Pull) -> tuple[bool, float, float]:
        is_unguarded = pull.guarded is None or pull.guarded[1] < pull.length
        return is_unguarded, pull.touching, pull.length

    best: WayOut | None = None
    for pull in sorted((one for one in pulls if one.is_out), key=rank)[:MOST_JUDGED]:
        poses = np.stack([np.eye(4), pull.pose(pull.length)])
        way = judge(problem, poses, "pull", budget_bytes)
        refuting.update(obj.id for obj in way.in_way)
        if way.in_way:
            continue
        if best is None or RANK[way.verdict] < RANK[best.verdict]:
            best = way
        if best.verdict != "not decided":
            break
    return best


def _planned(
    problem: Problem, planner: Planner, way: WayOut | None, pulls: Pulls, budget_bytes: int
) -> WayOut | None:
    """Plan, and prove what is planned; returns the better one of that and the way so far.

    A path that the proof refutes is planned once more from another start, `MOST_PLANS` in all.
    """
    for _ in range(MOST_PLANS):
        poses = _poses_of(problem, planner, way, pulls)
        if poses is None:
            return way
        planned = judge(problem, poses, "plan", budget_bytes)
        if not planned.in_way:
            return planned if way is None or RANK[planned.verdict] < RANK[way.verdict] else way
        if not planner.can_refuse:
            return way
        planner.refuse()
    return way


def _poses_of(
    problem: Problem, planner: Planner, way: WayOut | None, pulls: Pulls
) -> Floats | None:
    """Poses of a planned path; a missing planner is an error unless there is a way already."""
    try:
        return planner.search()
    except MissingExtraError as error:
        if way is not None:
            return None
        ids = [i for i, _ in _blockers(pulls.done, Counter())[:1]]
        name = "".join(f", {obj.name} is in the way" for obj in problem.standing if obj.id in ids)
        raise MissingExtraError(f"no straight pull leads out{name}; {error}") from error


def _blockers(pulls: list[Pull], refuting: Counter[int]) -> list[tuple[int, int]]:
    """Ids of the objects that stop pulls, with the number of pulls, largest number first."""
    counts = refuting + Counter(i for pull in pulls if not pull.is_out for i in pull.blockers)
    return sorted(counts.items(), key=lambda item: (-item[1], item[0]))

"""Random pulls that start in contact: nothing free goes through material, nothing free is hit."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from contact_scenes import (
    CONTACT,
    MM,
    REACH,
    Floats,
    box,
    frame_of,
    imported,
    in_frame,
    judged,
    placed,
    swept,
)
from draws import drawn
from hapticdb import Environment, PointShell
from hapticdb.exact.swept import Swept
from random_pulls import Body, RandomPull, random_pull
from winding import Surface, crossed, distances

SOME, ALL, AT_ONCE = 50, 1000, 50
"""Pulls of the quick test, of the long one, and those that share an environment."""
FREE = {"clear", "slides", "overlaps"}
SLACK = 0.002
"""Rounding, and the search's tolerance where it meets a surface."""
MOST_QUERIES = np.linspace(0.0, 1.0, 7)
"""Fractions of a free path at which the surfaces are compared."""
MET = 0.0105
"""Greatest distance at which surfaces count as met."""
APART = 0.0015
"""Gap of the start above which the sides of surfaces are known."""
GRAVITY = {"far": 0, "apart": 0, "touching": 1, "overlapping": 2, "inside": 3}


class Case(NamedTuple):
    """A pull, and what the sweep has found."""

    seed: int
    pull: RandomPull
    found: Swept

    def steps(self, *fractions: float) -> Floats:
        """Displacements (N, 4, 4) at fractions of the path, in the scene's own frame."""
        path, frame = self.found.path, frame_of(self.seed + 1)
        poses = path.at(path.length * np.array([0.0, *fractions]))
        if self.pull.radius:
            poses = poses @ np.linalg.inv(poses[0])
        poses = poses[1:]
        poses[:, :3, 3] /= MM
        return in_frame(poses, np.asarray(np.linalg.inv(frame)))

    def reach(self, name: str) -> float:
        """Millimetres that the motion that frees an object moves at most, as it is told."""
        told = [one.reach / MM for one in self.found.touching if one.object.name == name]
        return max([REACH, *told]) + SLACK


def swept_case(env: Environment, seed: int) -> Case:
    pull, frame = random_pull(seed), frame_of(seed + 1)
    tool: Floats | PointShell = placed(pull.tool.triangles, frame)
    poses = in_frame(pull.poses, frame)
    if pull.radius:
        tool = PointShell.sphere(pull.radius * MM, points=4)
        center = np.eye(4)
        center[:3, 3] = pull.middle
        poses = poses @ frame @ center
    names = [f"s{seed}_{n}" for n in range(len(pull.objects))]
    return Case(seed, pull, swept(env, tool, poses, names, seated=pull.seated))


def fault(case: Case) -> str:
    """What is wrong with what a sweep has found; empty if nothing is."""
    verdict, truth = str(case.found.verdict), case.pull.truth
    if verdict == "not decided":
        return "not decided"
    if verdict not in FREE:
        return "false hit" if truth in {"free", "not hit"} and not is_met_again(case) else ""
    if truth == "hit":
        return "false clear: it starts or ends in a closed body"
    if truth == "free" and verdict == "overlaps":
        return "false overlap at the start"
    if verdict == "overlaps" and case.pull.kind == "rests":
        told = max(case.reach(f"s{case.seed}_{n}") for n in range(len(case.pull.objects)))
        if told > 1.25 * max(case.pull.sunk, 0.0) + REACH + SLACK and truth == "not hit":
            return f"overlap of {told:.3f} told, {case.pull.sunk:.3f} true"
    for n, body in enumerate(case.pull.objects):
        reach = case.reach(f"s{case.seed}_{n}")
        wrong = against_winding(case, body, reach) or against_tracks(case, body, reach)
        wrong = wrong or against_clashes(case, body, reach)
        if wrong:
            return f"false clear of object {n}: {wrong}"
    return ""


def is_met_again(case: Case) -> bool:
    """Whether what is hit first was not touched before it, or had been left."""
    if case.found.enclosed or not case.found.hits:
        return False
    hit, left = case.found.hits[0], 0.0
    for one in case.found.touching:
        if one.object.id == hit.object.id:
            left = one.until
    body = case.pull.objects[int(hit.object.name.rpartition("_")[2])].triangles
    before, there = (gap(case, body, step) for step in case.steps(left, hit.fraction))
    return left < hit.fraction and before > CONTACT and there <= MET


def gap(case: Case, body: Floats, step: Floats) -> float:
    """Distance of the tool from an object after a displacement, up to 1; 0 where they meet."""
    if case.pull.radius:
        middle = placed(case.pull.middle[None], step)
        return float(distances(middle, body)[0]) - case.pull.radius
    found = judged(placed(case.pull.tool.triangles, step), body)
    return found.at_least if found.kind in {"far", "apart", "touching"} else 0.0


def surfaces_of(case: Case, body: Body) -> tuple[Surface, Surface]:
    tool = case.pull.tool
    return (
        Surface(tool.triangles, seed=case.seed, solid=tool.solid),
        Surface(body.triangles, seed=case.seed, solid=body.solid),
    )


def against_winding(case: Case, body: Body, reach: float) -> str:
    """No place is deeper in a closed body, and no edge through more of a surface, than `reach`."""
    tool, thing = surfaces_of(case, body)
    for n, step in enumerate(case.steps(*MOST_QUERIES)):
        back = np.linalg.inv(step)
        deep = max(
            thing.depth_of(placed(tool.samples, step)), tool.depth_of(placed(thing.samples, back))
        )
        if deep > reach:
            return f"{deep:.3f} deep at look {n}, {reach:.3f} is allowed"
        if (
            crossed(placed(tool.edges, step), thing, reach, reach, reach).any()
            or crossed(placed(thing.edges, back), tool, reach, reach, reach).any()
        ):
            return f"an edge is through a surface at look {n}"
    return ""


def against_tracks(case: Case, body: Body, reach: float) -> str:
    """No corner goes through a surface, from its side at the start or of a leg to the other."""
    poses, tool_body = case.pull.poses, case.pull.tool
    tool, thing = surfaces_of(case, body)
    if np.abs(poses[:, :3, :3] - np.eye(3)).max() > 0.0:
        return ""  # of turns only looks are known
    is_apart = -case.pull.sunk > APART and tool_body.height[0] > thing.triangles[..., 2].max()
    for n, (one, other) in enumerate(zip(poses[:-1, :3, 3], poses[1:, :3, 3], strict=True)):
        before = 1e-6 if n == 0 and is_apart else reach
        lines = np.stack([tool.corners + one, tool.corners + other], axis=1)
        theirs = np.stack([thing.corners - one, thing.corners - other], axis=1)
        if crossed(lines, thing, before, reach, reach).any():
            return f"a corner goes through the object in leg {n}"
        if crossed(theirs, tool, before, reach, reach).any():
            return f"a corner of the object goes through the tool in leg {n}"
    return ""


def against_clashes(case: Case, body: Body, reach: float) -> str:
    """The end is no worse a clash than the start, but for `reach`."""
    start, end = (
        judged(placed(case.pull.tool.triangles, step), body.triangles)
        for step in case.steps(0.0, 1.0)
    )
    if end.kind == "overlapping" and end.at_least <= max(reach, start.at_least) + SLACK:
        is_same = GRAVITY[start.kind] >= 2 or end.at_most <= 1.4 * reach + SLACK
        return "" if is_same else f"touching at the start, {end} at the end"
    if GRAVITY[end.kind] > GRAVITY[start.kind] and end.kind != "touching":
        return f"{start.kind} at the start, {end.kind} {end.at_least:.3f} at the end"
    if end.kind == "overlapping":
        return f"{start.at_least:.3f} deep at the start, {end.at_least:.3f} at the end"
    return ""


def checked(folder: Path, seeds: list[int]) -> list[Case]:
    """Sweep the pulls of seeds; fails with what is wrong with each."""
    cases, wrong = [], []
    for first in range(0, len(seeds), AT_ONCE):
        some = seeds[first : first + AT_ONCE]
        objects = {
            f"s{seed}_{n}": placed(one.triangles, frame_of(seed + 1))
            for seed in some
            for n, one in enumerate(random_pull(seed).objects)
        }
        with imported(folder / f"{first}.db", objects) as env:
            found = [swept_case(env, seed) for seed in some]
        cases += found
        wrong += [(one.seed, one.found.verdict, told) for one in found if (told := fault(one))]
    assert wrong == [], "\n".join(map(str, wrong))
    return cases


def test_sweep_random_pulls_sample(tmp_path: Path) -> None:
    cases = checked(tmp_path, drawn(range(ALL), SOME))
    verdicts = {case.found.verdict for case in cases}
    assert verdicts >= {"clear", "slides", "hits"}


@pytest.mark.long
@pytest.mark.parametrize("part", range(4))
def test_sweep_random_pulls_all(tmp_path: Path, part: int) -> None:
    cases = checked(tmp_path, list(range(part, ALL, 4)))
    n_free = sum(case.found.verdict in FREE for case in cases)
    assert 0.3 * len(cases) < n_free < 0.7 * len(cases)


@pytest.mark.parametrize("seed", range(6))
def test_random_pulls_oracle_closed_form(seed: int) -> None:
    """Winding numbers of a turned block, and lines through it, off it, and at its border."""
    frame = frame_of(seed)
    block = Surface(placed(box((4, 4, 4)), frame), seed=seed)
    places = placed(np.array([[0.0, 0, 0], [1.5, 0, 0], [2.5, 0, 0], [1.9, 1.9, 1.0]]), frame)
    assert block.depth_of(places[:1]) == pytest.approx(2.0)
    assert block.depth_of(places[1:]) == pytest.approx(0.5)
    lines = placed(
        np.array([[[0.0, 0, -5], [0, 0, 5]], [[3, 0, -5], [3, 0, 5]], [[1.95, 0, -5], [1.95, 0, 5]],
                  [[0, 0, 1.5], [0, 0, 2.05]], [[0, 0, 1.5], [0, 0, 2.5]]]), frame,
    )  # fmt: skip
    found = crossed(lines, block, 0.1, 0.1, 0.1)
    assert found.tolist() == [True, False, False, False, True]

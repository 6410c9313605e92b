"""The paper's Figures 8 to 10 and what it leaves out, each as a function from subject to cells."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hapticdb.query.frame import STRATEGIES, Strategy
from hapticdb.query.grouping import cbgroup
from hapticdb.query.quantiles import QuantileVector
from paper.cells import IN_THE_SERVER
from paper.measure import Alternative, Cell, in_turns
from paper.subject import Subject
from paper.workload import RADIUS_VOXELS, SEED, Region, Task, random_poses, sphere_shell

GAPS = (0, 10, 30, 100, 300, 500, 1000, 3000, 10_000, 30_000, 100_000, 1_000_000)
"""MAXGAP of Figure 9, in voxel keys; 500 is the paper's."""
RESOLUTIONS = (10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000, 20_000, 50_000, 100_000)
"""Buckets of the quantile vectors of Figure 8. All divide the largest number, so that each vector's
bounds are among those of the finest."""
SHELLS = (300, 1000, 10_000, 100_000)
"""Points of the shells whose size is varied."""
MOST_POINTS: dict[Strategy, int] = {"points": 1000, "statement": 10_000}
"""Points of the largest shell that a strategy is measured with; a larger one would take seconds a
frame. Strategies that are not listed have no limit."""
PAPERS_GAP = 500
"""The paper's MAXGAP, voxel keys."""


@dataclass(frozen=True)
class Budget:
    """How much is measured.

    cell_s : seconds of frames that one alternative may take; frames : poses of a task; tail :
    frames of the experiment on the slowest frames; cold : frames with empty caches; windows :
    windows whose density is measured to choose regions; gaps, resolutions, shells : values of the
    experiments.
    """

    cell_s: float = 1.5
    frames: int = 1000
    tail: int = 10_000
    cold: int = 40
    windows: int = 400
    gaps: tuple[int, ...] = GAPS
    resolutions: tuple[int, ...] = RESOLUTIONS
    shells: tuple[int, ...] = SHELLS


QUICK = Budget(
    cell_s=0.1,
    frames=100,
    tail=400,
    cold=5,
    windows=60,
    gaps=(0, 100, 500, 3000, 100_000),
    resolutions=(10, 100, 1000, 10_000),
    shells=(300, 1000, 10_000),
)


def figure_8(subject: Subject, task: Task, finest: QuantileVector, budget: Budget) -> list[Cell]:
    """Query time by CBGroup against the resolution of the quantile vector, grouping apart.

    finest : the vector of the largest resolution; the bounds of all others are among its bounds.
    """
    alternatives = []
    grouping_us = []
    for resolution in budget.resolutions:
        if resolution > finest.resolution:
            continue
        vector = coarsened(finest, resolution)
        query = subject.query(vector)
        grouping_us.append(_grouping_us(subject, vector, task))
        alternatives.append(
            subject.alternative(task, "cbgroup", query=query, resolution=vector.resolution)
        )
    cells = _measure(subject, task, alternatives, budget)
    for cell, us in zip(cells, grouping_us, strict=True):
        cell["grouping_us"] = us
    return cells


def coarsened(finest: QuantileVector, resolution: int) -> QuantileVector:
    """The vector of a coarser resolution, which divides the finest one.

    Bound i of R has rank ceil(i N / R), and so has bound i F / R of F.
    """
    step = finest.resolution // resolution
    return QuantileVector(finest.bounds[::step].copy(), finest.n_rows, finest.source)


def _grouping_us(subject: Subject, vector: QuantileVector, task: Task) -> float:
    """Median time of grouping alone, over frames that differ as a hand's do."""
    query = subject.query(vector)
    located = [query.locate(task.shell, pose).keys for pose in task.poses[:200]]
    times = []
    for keys in located + located:
        start = time.perf_counter_ns()
        cbgroup(keys, vector, subject.costs)
        times.append(time.perf_counter_ns() - start)
    return float(np.median(times[len(located) :])) / 1000


def figure_9(subject: Subject, task: Task, budget: Budget) -> list[Cell]:
    """MaxGap over MAXGAP, CBGroup, and `array`; on a server also by its own loop."""
    alternatives = _maxgap_and_others(subject, task, budget)
    query = subject.looping_query
    if query is not None:
        alternatives += [
            subject.alternative(task, "maxgap", gap=gap, query=query, form=IN_THE_SERVER)
            for gap in budget.gaps
        ]
        alternatives.append(subject.alternative(task, "cbgroup", query=query, form=IN_THE_SERVER))
    return _measure(subject, task, alternatives, budget)


def figure_10(
    subject: Subject, shell_task: Task, regions: Sequence[Region], budget: Budget
) -> list[Cell]:
    """Figure 9's strategies in regions of low, middle and high density."""
    cells = []
    for region in regions:
        task = Task(
            "random", shell_task.tool, shell_task.shell, region.poses, region.name, region.density
        )
        cells += _measure(subject, task, _maxgap_and_others(subject, task, budget), budget)
    return cells


def _maxgap_and_others(subject: Subject, task: Task, budget: Budget) -> list[Alternative]:
    """MaxGap for each MAXGAP, and the strategies that it is compared with."""
    gaps = [subject.alternative(task, "maxgap", gap=gap) for gap in budget.gaps]
    return gaps + [subject.alternative(task, name) for name in ("cbgroup", "array", "auto")]


def strategies(subject: Subject, tasks: Sequence[Task], budget: Budget) -> list[Cell]:
    """Every strategy over every task."""
    cells = []
    for task in tasks:
        cells += _measure(subject, task, _each(subject, task, STRATEGIES), budget)
    return cells


def points(subject: Subject, budget: Budget) -> list[Cell]:
    """Spheres of more points at the same density: the radius grows with their number's root."""
    cells = []
    grid = subject.env.grid
    for n_points in budget.shells:
        radius = RADIUS_VOXELS * (n_points / budget.shells[0]) ** 0.5
        if 2 * radius > grid.side:
            continue
        shell = sphere_shell(grid.voxel_size, n_points, radius)
        count = max(budget.frames * budget.shells[0] // n_points, budget.frames // 10)
        poses = random_poses(subject.env, count, SEED, radius)
        task = Task("random", "sphere", shell, poses)
        wanted: tuple[Strategy, ...] = ("auto", "array", "cbgroup", "statement", "points")
        alternatives = [
            subject.alternative(task, name, radius_voxels=radius)
            for name in wanted
            if n_points <= MOST_POINTS.get(name, n_points)
        ]
        cells += _measure(subject, task, alternatives, budget)
    return cells


def tail(subject: Subject, task: Task, budget: Budget) -> list[Cell]:
    """Enough frames for the slowest in a thousand: the poses are repeated."""
    times = -(-budget.tail // len(task.poses))
    poses = np.tile(task.poses, (times, 1, 1))[: budget.tail]
    often = Task(task.name, task.tool, task.shell, poses)
    alternatives = [subject.alternative(often, name) for name in ("array", "cbgroup", "auto")]
    # a higher limit: this experiment needs all its frames
    return in_turns(alternatives, poses, limit_s=20 * budget.cell_s)


COMPARED: tuple[Strategy, ...] = ("array", "maxgap", "cbgroup", "auto")
"""Strategies that are compared under several caches, layouts and curves."""


def cached(subject: Subject, task: Task, budget: Budget) -> list[Cell]:
    """The compared strategies with the file in the operating system's cache."""
    alternatives = _each(subject, task, COMPARED)
    return in_turns(alternatives, task.poses, limit_s=budget.cell_s)


def cold(subject: Subject, task: Task, budget: Budget) -> list[Cell]:
    """A few frames, each with empty caches: the connection's and the operating system's."""
    if subject.drop is None:
        return []
    step = max(1, len(task.poses) // budget.cold)
    few = Task(task.name, task.tool, task.shell, task.poses[::step][: budget.cold])
    alternatives = _each(subject, few, COMPARED, file="cold")
    for alternative in alternatives:
        alternative.before = subject.drop
    return in_turns(alternatives, few.poses, limit_s=4 * budget.cell_s, warm=2)


def _each(
    subject: Subject, task: Task, names: Sequence[Strategy], file: str = "cached"
) -> list[Alternative]:
    """Strategies by name, MaxGap with the paper's MAXGAP."""
    return [
        subject.alternative(task, name, gap=PAPERS_GAP if name == "maxgap" else None, file=file)
        for name in names
    ]


def _measure(
    subject: Subject, task: Task, alternatives: Sequence[Alternative], budget: Budget
) -> list[Cell]:
    return in_turns(
        alternatives, task.poses, limit_s=budget.cell_s, asked_rows=subject.asked_rows(task)
    )

"""The paper's claim and Figures 8 to 10, each as a function from subject to cells."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dense_frame import dense_bitmap, dense_feel
from hapticdb import Environment, Query
from hapticdb.kernels.records.cells import BUFFERS
from hapticdb.kernels.records.hand import RESULT
from hapticdb.paper.grouping import cbgroup
from hapticdb.paper.quantiles import QuantileVector
from hapticdb.paper.strategies import Strategy
from hapticdb.query.haptic_query import locate
from hapticdb.resident.frames import ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import CellTable
from paper.measure import Alternative, Cell, in_turns
from paper.subject import LAWS, Subject
from paper.workload import POINTS, RADIUS_VOXELS, Region, Task, sphere_shell

Floats = NDArray[np.float64]

GAPS = (0, 10, 30, 100, 300, 500, 1000, 3000, 10_000, 30_000, 100_000, 1_000_000)
"""MAXGAP of Figure 9, in voxel keys; 500 is the paper's."""
RESOLUTIONS = (10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000, 20_000, 50_000, 100_000)
"""Buckets of the quantile vectors of Figure 8. All divide the largest number, so that each vector's
bounds are among those of the finest."""
SHELLS = (100, 1000, 10_000, 100_000, 1_000_000)
"""Points of the shells whose keys are grouped."""
COMPARED: tuple[Strategy, ...] = ("points", "statement", "array", "maxgap", "cbgroup")
"""Strategies that are compared; `auto`, the default, is `array` or `cbgroup`."""
RESIDENT_BYTES = 256 << 20
"""Bytes for the cells that a bitmap is made of. They are given back before it is measured."""
LEAST_GROUPED = 5
"""Least number of times that keys are grouped; the first does not count."""
NO_QUERY = Query("bitmap", 0, 0, 0, 0.0)


@dataclass(frozen=True)
class Budget:
    """How much is measured.

    cell_s : seconds of frames that one alternative may take; frames : poses of a task; cold :
    frames with empty caches; windows : windows whose density is measured to choose regions; gaps,
    resolutions, shells : values of the experiments.
    """

    cell_s: float = 1.5
    frames: int = 1000
    cold: int = 40
    windows: int = 400
    gaps: tuple[int, ...] = GAPS
    resolutions: tuple[int, ...] = RESOLUTIONS
    shells: tuple[int, ...] = SHELLS


QUICK = Budget(0.1, 100, 5, 60, (0, 100, 500, 3000, 100_000), RESOLUTIONS[::3], SHELLS[:3])


def figure_8(subject: Subject, task: Task, finest: QuantileVector, budget: Budget) -> list[Cell]:
    """Query time by CBGroup against the resolution of the quantile vector.

    finest : the vector of the largest resolution; the bounds of all others are among its bounds.
    """
    vectors = [coarsened(finest, n) for n in budget.resolutions if n <= finest.resolution]
    alternatives = [
        subject.alternative(task, "cbgroup", query=subject.query(one), resolution=one.resolution)
        for one in vectors
    ]
    return in_turns(alternatives, task.poses, limit_s=budget.cell_s)


def coarsened(finest: QuantileVector, resolution: int) -> QuantileVector:
    """The vector of a coarser resolution, which divides the finest one.

    Bound i of R has rank ceil(i N / R), and so has bound i F / R of F.
    """
    step = finest.resolution // resolution
    return QuantileVector(finest.bounds[::step].copy(), finest.n_rows, finest.source)


def figure_9(subject: Subject, task: Task, budget: Budget) -> list[Cell]:
    """MaxGap over MAXGAP, CBGroup, and `array`."""
    gaps = [subject.alternative(task, "maxgap", gap=gap) for gap in budget.gaps]
    ways = gaps + _each(subject, task, ("cbgroup", "array"))
    return in_turns(ways, task.poses, limit_s=budget.cell_s)


def figure_10(
    subject: Subject, shell_task: Task, regions: Sequence[Region], budget: Budget
) -> list[Cell]:
    """Figure 9's strategies in regions of low, middle and high density."""
    tasks = [Task("random", shell_task.shell, one.poses, one.name, one.density) for one in regions]
    return [cell for task in tasks for cell in figure_9(subject, task, budget)]


def claim(subject: Subject, tasks: Sequence[Task], budget: Budget) -> list[Cell]:
    """Every strategy over every task, under each law that the environment can answer."""
    cells = []
    for task in tasks:
        for law in list(LAWS)[: 1 + subject.env.has_distances]:
            names = [n for n in COMPARED if law == "plane" or n != "statement"]
            ways = _each(subject, task, names, law)
            cells += in_turns(ways, task.poses, limit_s=budget.cell_s)
            cells += cold(subject, task, names, law, budget)
    return cells


def cold(
    subject: Subject, task: Task, names: Sequence[Strategy], law: str, budget: Budget
) -> list[Cell]:
    """A few frames, each with empty caches: the connection's and the operating system's."""
    if subject.drop is None:
        return []
    step = max(1, len(task.poses) // budget.cold)
    few = replace(task, poses=task.poses[::step][: budget.cold])
    alternatives = _each(subject, few, names, law=law, file="cold")
    for alternative in alternatives:
        alternative.before = subject.drop
    return in_turns(alternatives, few.poses, limit_s=4 * budget.cell_s, warm=2)


def in_memory(env: Environment, tasks: Sequence[Task], budget: Budget) -> list[Cell]:
    """The same frames, called one by one, against one dense bitmap: what no database can beat."""
    cells = []
    for task in tasks:
        cells += in_turns([dense(env, task)], task.poses, limit_s=budget.cell_s)
    return cells


def dense(env: Environment, task: Task, **more: Any) -> Alternative:  # noqa: ANN401 - as of `Subject`
    """Frames against a bitmap of the cells at the task's poses, under the law plane."""
    with CellTable.create(RESIDENT_BYTES) as table:
        frames = ResidentFrames(Residency(env.store, table), task.shell, run=0)
        frames.evaluate(task.poses)
        bitmap = dense_bitmap(table.cells, table.version % BUFFERS, env.grid.side)
    cell: Cell = {"engine": "memory", "layout": "dense bitmap", "file": "cached", "law": "plane"}
    cell |= {"strategy": "bitmap", "poses": task.name, "points": len(task.shell)} | more
    return Alternative(cell, _against(bitmap, frames))


def _against(bitmap: NDArray[np.uint32], frames: ResidentFrames) -> Callable[[Floats], Query]:
    """Frames against a bitmap; nothing is read from the database."""
    out, place = np.zeros(1, RESULT), frames.residency.cell_grid

    def frame(pose: Floats) -> Query:
        dense_feel(bitmap, frames.clusters, pose[None], place, frames.law, frames.hits, out)
        return NO_QUERY

    return frame


def grouping(subject: Subject, budget: Budget) -> list[Cell]:
    """Time of CBGroup alone against the number of points; spheres of the same density of points."""
    cells = []
    grid, query = subject.env.grid, subject.query()
    for n_points in budget.shells:
        radius = min(RADIUS_VOXELS * (n_points / POINTS) ** 0.5, 0.45 * grid.side)
        shell = sphere_shell(grid.voxel_size, n_points, radius)
        pose = np.eye(4)
        pose[:3, 3] = np.array(grid.origin) + 0.5 * grid.edge
        keys = locate(shell, pose, query.query.grid).keys
        us: list[float] = []
        while len(us) < LEAST_GROUPED or sum(us) < 1e6 * budget.cell_s / 4:
            start = time.perf_counter_ns()
            ranges = cbgroup(keys, keys, subject.quantiles, subject.costs)
            us.append((time.perf_counter_ns() - start) / 1000)
        about = {"engine": subject.env.engine, "layout": subject.env.layout, "points": n_points}
        about |= {"keys": len(keys), "ranges": len(ranges.lows)}
        cells.append(about | {"grouping_us": float(np.median(us[1:]))})
    return cells


def _each(
    subject: Subject,
    task: Task,
    names: Sequence[Strategy],
    law: str = "plane",
    file: str = "cached",
) -> list[Alternative]:
    """Strategies by name, MaxGap with the paper's MAXGAP."""
    return [subject.alternative(task, name, law=law, file=file) for name in names]

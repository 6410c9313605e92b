"""All experiments on one environment, one after another."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hapticdb.bench import experiments, records
from hapticdb.bench.drawing.draw import draw
from hapticdb.bench.experiments import QUICK, Budget
from hapticdb.bench.measure import Cell
from hapticdb.bench.page import write_bench_page
from hapticdb.bench.subject import PAPER_CACHE, Subject, limited
from hapticdb.bench.workload import (
    Poses,
    Region,
    Task,
    random_poses,
    regions,
    slide_poses,
    sphere_shell,
)
from hapticdb.environment import Environment
from hapticdb.environment import open as open_environment
from hapticdb.errors import ReadOnlyError, UsageError
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.quantiles import QuantileVector
from hapticdb.store.base import SupportsCaches, SupportsServer
from hapticdb.warm import warm_up

ALL_BYTES = 2 << 30
"""Bytes of a cache that holds every page of most environments; it takes memory as it is filled."""
PAGE = "evaluation.md"
"""Name of the page in the folder of results."""

Say = Callable[[str], None]
"""Called with a line that says what is measured next."""


@dataclass(frozen=True)
class Workload:
    """Tasks and regions of one environment, the same under all conditions."""

    slide: Task
    random: Task
    recorded: Task | None
    regions: tuple[Region, ...]
    finest: QuantileVector

    @property
    def tasks(self) -> tuple[Task, ...]:
        """Tasks over the whole environment; without the recorded one where none was given."""
        return tuple(task for task in (self.slide, self.random, self.recorded) if task)


def workload_of(env: Environment, budget: Budget, recorded: Task | None = None) -> Workload:
    """Shells, poses and regions for an environment; the same for all that have its grid."""
    shell = sphere_shell(env.grid.voxel_size)
    slide = Task("slide", "sphere", shell, slide_poses(env, shell, budget.frames))
    near = Task("random", "sphere", shell, random_poses(env, budget.frames))
    found = regions(env, max(budget.frames // 4, 10), windows=budget.windows)
    finest = env.quantiles(max(budget.resolutions))
    return Workload(slide, near, recorded, tuple(found), finest)


def paper_figures(subject: Subject, work: Workload, budget: Budget) -> dict[str, list[Cell]]:
    """Figures 8 to 10 and what the paper leaves out, under one subject's conditions."""
    return {
        "costs": [cost_row(subject, work.slide)],
        "figure8": experiments.figure_8(subject, work.slide, work.finest, budget),
        "figure9": experiments.figure_9(subject, work.slide, budget),
        "figure10": experiments.figure_10(subject, work.slide, work.regions, budget),
        "strategies": experiments.strategies(subject, work.tasks, budget),
        "points": experiments.points(subject, budget),
        "tail": experiments.tail(subject, work.slide, budget),
    }


def measured(
    subject: Subject, work: Workload, budget: Budget, *, is_paper: bool
) -> dict[str, list[Cell]]:
    """All experiments under the paper's cache; under another cache only those that depend on it."""
    cells = (
        paper_figures(subject, work, budget)
        if is_paper
        else {"figure9": experiments.figure_9(subject, work.slide, budget)}
    )
    cells["conditions"] = under_conditions(subject, work, budget, is_first=is_paper)
    return cells


def under_conditions(
    subject: Subject, work: Workload, budget: Budget, *, is_first: bool
) -> list[Cell]:
    """The compared strategies under this cache; with `is_first`, with emptied caches, too."""
    cells = experiments.cached(subject, work.slide, budget)
    return [*cells, *experiments.cold(subject, work.slide, budget)] if is_first else cells


def bench(
    url: str,
    folder: Path,
    *,
    quick: bool = False,
    shell: PointShell | None = None,
    poses: Poses | None = None,
    say: Say = lambda _: None,
) -> tuple[Path, dict[str, dict[str, Any]]]:
    """Run the experiments on an environment, and write JSON, plots and one page.

    Parameters
    ----------
    url : str
        The environment; it is only read.
    folder : Path
        For `NAME.json`, `NAME.svg` and `evaluation.md`; made where it is missing.
    quick : bool
        A few seconds for each experiment: for a first look.
    shell, poses : PointShell and (M, 4, 4), optional
        A tool of one's own along a recorded path, measured beside the sphere.
    say : callable, optional
        Called with a line that says what is measured next.

    Returns
    -------
    page, results : Path and dict
        The page's file, and each experiment by its name, as its own file holds it.
    """
    budget = QUICK if quick else Budget()
    warm_up()
    with opened(url) as env:
        if not env.size().rows:
            raise UsageError(f"{env.url} is empty: import a file before measuring")
        records.make_folder(folder)
        say("inputs: shells, poses, regions")
        recorded = None
        if shell is not None and poses is not None:
            recorded = Task("recorded", "tool", shell, poses[: budget.frames])
        work = workload_of(env, budget, recorded)
        found: dict[str, list[Cell]] = {"table1": [table_1_row(env)]}
        for cache, is_paper in caches_of(env):
            subject = Subject(env, env.name, cache, drop_of(env))
            say(f"database cache {cache}")
            for name, more in measured(subject, work, budget, is_paper=is_paper).items():
                found.setdefault(name, []).extend(more)
    results = {name: records.result(name, cells) for name, cells in found.items()}
    records.write(folder, results)
    say("plots and page")
    draw(results, folder)
    write_bench_page(results, folder / PAGE)
    return folder / PAGE, results


def caches_of(env: Environment) -> Iterator[tuple[str, bool]]:
    """Set the cache to each size in turn; give its name, and whether it is the paper's.

    A server's cache is not changed. An environment that fits into the paper's cache has one size.
    """
    first = limited(env, PAPER_CACHE)
    yield first, True
    if isinstance(env.store, SupportsCaches) and (second := limited(env, ALL_BYTES)) != first:
        yield second, False


def drop_of(env: Environment) -> Callable[[], None] | None:
    """Function that empties all caches of an environment; None where this process cannot."""
    return env.store.drop_caches if isinstance(env.store, SupportsCaches) else None


def cost_row(subject: Subject, task: Task) -> Cell:
    """What the cost model was fitted to under these conditions, microseconds and ratios."""
    costs = subject.costs
    kept = ("environment", "engine", "layout", "curve", "cache", "file", "resolution")
    conditions = subject.conditions(task)
    return {
        **{name: conditions[name] for name in kept},
        **{name: value for name, value in costs.figures().items() if "." not in name},
        "row_scanned": costs.row_scanned,
        "gap_rows": costs.descent / costs.row_in_gap if costs.row_in_gap else None,
    }


def table_1_row(env: Environment, **more: object) -> Cell:
    """Voxels, objects, cells of the data space, as in the paper's Table 1."""
    size, objects = env.size(), env.objects()
    return {
        "environment": env.name,
        "engine": env.engine,
        "layout": env.layout,
        "objects": len(objects),
        "object_voxels": sum(obj.voxels for obj in objects),
        "bits": env.grid.bits,
        "cells_of_space": 8**env.grid.bits,
        "edge": env.grid.edge,
        "voxel_size": env.grid.voxel_size,
        f"rows_{env.layout}": size.rows,
        f"bytes_{env.layout}": size.bytes,
        **more,
    }


def opened(url: str) -> Environment:
    """Open an environment to read it.

    On a server it is opened to write where that is allowed: the paper's loop inside the server is a
    temporary function, which no reader may make.
    """
    reader = open_environment(url, read_only=True)
    if not isinstance(reader.store, SupportsServer):
        return reader
    try:
        writer = open_environment(url)
    except ReadOnlyError:
        return reader
    except BaseException:
        reader.close()
        raise
    reader.close()
    return writer

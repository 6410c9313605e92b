"""The evaluation: the paper's claim and its figures on every engine, many users, and what it costs.

    make figures                    # a quarter of an hour on two processors
    make figures ARGS=--quick       # a coarse model and few frames, into results-quick/

The model is the vintage car in the folder that HAPTICDB_TEST_DATA names; the sample car where there
is none. All inputs are made in a temporary folder: environments on SQLite and on every
PostgreSQL found. Their caches have 4 MB, as in the paper.
"""

import os
import signal
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import costs
import hapticdb
import many
import page_tables
import records
import visits
from awake import awake
from hapticdb import Environment, GridOptions, ImportOptions
from hapticdb.paper.quantiles import QuantileVector
from hapticdb.sample import write_sample
from hapticdb.store.base import LAYOUTS, Layout, SupportsCaches
from hapticdb.store.postgres.address import with_environment
from paper import experiments
from paper.experiments import QUICK, Budget
from paper.measure import Cell
from paper.plots import draw
from paper.subject import Subject, with_papers_cache
from paper.workload import (
    INPUTS,
    Region,
    Task,
    random_poses,
    regions,
    slide_poses,
    sphere_shell,
)
from places import Binaries, find_binaries, serving

SETTINGS = {"max_wal_size": "4GB", "fsync": "off", "shared_buffers": "4MB"}
FILLING = SETTINGS | {"shared_buffers": "1GB"}
"""Of a server while environments are imported."""


@dataclass(frozen=True)
class Workload:
    """Tasks and regions of one environment, the same under all conditions."""

    slide: Task
    random: Task
    regions: tuple[Region, ...]
    finest: QuantileVector

    @classmethod
    def of(cls, env: Environment, budget: Budget) -> "Workload":
        """The same for all environments that have the grid of this one."""
        shell = sphere_shell(env.grid.voxel_size)
        return cls(
            Task("slide", shell, slide_poses(env, shell, budget.frames)),
            Task("random", shell, random_poses(env, budget.frames)),
            tuple(regions(env, max(budget.frames // 4, 10), windows=budget.windows)),
            env.quantiles(max(budget.resolutions)),
        )


@dataclass
class Evaluation:
    """Inputs of one run of the script, and the cells that it has measured."""

    folder: Path
    model: costs.Model
    bits: int
    budget: Budget
    started: float = field(default_factory=time.perf_counter)
    found: dict[str, list[Cell]] = field(default_factory=dict)
    work: dict[Layout, Workload] = field(default_factory=dict)

    def say(self, line: str) -> None:
        """Print what is measured next, and the seconds since the start."""
        print(f"{time.perf_counter() - self.started:6.0f} s  {line}", file=sys.stderr, flush=True)

    def add(self, found: Mapping[str, list[Cell]]) -> None:
        """Keep measured cells by their experiment."""
        for name, cells in found.items():
            self.found.setdefault(name, []).extend(cells)

    def make(self, url: str, layout: Layout) -> str:
        """Import the model; all environments have the same grid."""
        grid = GridOptions(bits=self.bits, extent=self.model.extent)
        options = ImportOptions(grid=grid, layout=layout, distances=layout == "brick")
        (report,) = hapticdb.import_files(url, [self.model.file], options)
        if report.error is not None:
            raise report.error
        return url

    def measure(self, env: Environment) -> None:
        """Run all experiments of the paper on one environment."""
        with_papers_cache(env)
        drop = env.store.drop_caches if isinstance(env.store, SupportsCaches) else None
        subject = Subject(env, self.model.name, drop)
        work, budget = self.work[env.layout], self.budget
        self.say(f"{env.engine}, {env.layout}")
        self.add({
            "claim": experiments.claim(subject, (work.slide, work.random), budget),
            "figure8": experiments.figure_8(subject, work.slide, work.finest, budget),
            "figure9": experiments.figure_9(subject, work.slide, budget),
            "figure10": experiments.figure_10(subject, work.slide, work.regions, budget),
        })  # fmt: skip
        if drop is not None:
            self.add({"grouping": experiments.grouping(subject, budget)})


def on_sqlite(evaluation: Evaluation) -> None:
    """Make the inputs, then run all experiments on SQLite, in both layouts."""
    for layout in LAYOUTS:
        evaluation.say(f"SQLite, {layout}: import")
        evaluation.make(str(evaluation.folder / f"{layout}.db"), layout)
    evaluation.say("inputs: shells, poses, regions")
    with hapticdb.open(evaluation.folder / "brick.db", read_only=True) as env:
        work = Workload.of(env, evaluation.budget)
        tasks = (work.slide, work.random)
        evaluation.add({"claim": experiments.in_memory(env, tasks, evaluation.budget)})
    for layout in LAYOUTS:
        with hapticdb.open(evaluation.folder / f"{layout}.db", read_only=True) as env:
            # every engine has the same rows, so the same quantile vector
            finest = env.quantiles(max(evaluation.budget.resolutions))
            evaluation.work[layout] = replace(work, finest=finest)
            evaluation.measure(env)


def on_postgres(evaluation: Evaluation, binaries: Binaries) -> None:
    """Run all experiments on one PostgreSQL server, restarted with the paper's cache."""
    folder = evaluation.folder / f"postgres{binaries.major}"
    with serving(folder, binaries, FILLING) as server:
        for layout in LAYOUTS:
            evaluation.say(f"PostgreSQL {binaries.major}, {layout}: import")
            evaluation.make(with_environment(server.conninfo(), layout), layout)
    with serving(folder, binaries, SETTINGS) as server:
        for layout in LAYOUTS:
            with hapticdb.open(with_environment(server.conninfo(), layout)) as env:
                evaluation.measure(env)


def visited(evaluation: Evaluation, models: Sequence[costs.Model]) -> list[Cell]:
    """First and second visits on the models that we did not make, or on the sample car."""
    newest = max(find_binaries(), key=lambda found: found.major)
    frames = replace(evaluation.budget, frames=min(300, evaluation.budget.frames))
    say = evaluation.say
    return visits.everywhere(
        evaluation.folder, models[:-1] or models, evaluation.bits, newest, frames, say
    )


def many_at_once(evaluation: Evaluation, effort: many.Effort) -> None:
    """Readers and writers on SQLite and the newest PostgreSQL, with a cache as servers have."""
    url, poses = evaluation.folder / "brick.db", evaluation.work["brick"].slide.poses
    evaluation.say("many at once, SQLite")
    evaluation.add({"many": many.measure(str(url), poses, effort)})
    newest = max(find_binaries(), key=lambda found: found.major)
    folder = evaluation.folder / f"postgres{newest.major}"
    with serving(folder, newest, many.SETTINGS) as server:
        evaluation.say(f"many at once, PostgreSQL {newest.major}")
        url_there = with_environment(server.conninfo(), "brick")
        evaluation.add({"many": many.measure(url_there, poses, effort)})


def evaluate(
    folder: Path, bits: int, budget: Budget, effort: many.Effort, *, real: bool = True
) -> dict[str, dict[str, Any]]:
    """Run all experiments, and return results by name."""
    sample = write_sample(folder / "sample")
    models = costs.models(sample.car, real=real)
    evaluation = Evaluation(folder, models[0], bits, budget)
    with awake():
        on_sqlite(evaluation)
        for binaries in find_binaries():
            on_postgres(evaluation, binaries)
        evaluation.add({"visits": visited(evaluation, models)})
    many_at_once(evaluation, effort)
    evaluation.say("costs")
    evaluation.add({"costs": [costs.measured(folder, model, bits) for model in models]})
    inputs = dict(INPUTS) | {
        "model": f"{models[0].name}, {bits} bits, extent {models[0].extent}",
        "cache": "of the database, 4 MB; 1 GB on PostgreSQL where many read at once",
        "PostgreSQL": "a server of its own, Unix socket, fsync off except where many read at once",
        "awake": "processors are kept awake by processes of idle priority, but for many at once",
        "load": ", ".join(f"{load:.1f}" for load in os.getloadavg()) + " at the end",
    }
    evaluation.say("done")
    return {name: records.result(name, cells, inputs) for name, cells in evaluation.found.items()}


def main() -> None:
    """Measure, write JSON and plots, and fill the page's tables."""
    is_quick, out = records.asked(__doc__, "a coarse model, few frames")
    # SIGTERM raises an exit, so that servers are stopped and files removed
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    with tempfile.TemporaryDirectory(prefix="hapticdb-figures-") as folder:
        sizes = (9, QUICK, many.QUICK) if is_quick else (11, Budget(), many.Effort())
        found = evaluate(Path(folder), *sizes)
    records.write(out, found)
    draw(found, out)
    page_tables.refill("docs/evaluation.md", out, out / "evaluation.md" if is_quick else None)


if __name__ == "__main__":
    main()

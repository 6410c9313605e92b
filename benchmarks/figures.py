"""The evaluation: every figure on every engine, plots, and the tables of docs/evaluation.md.

    make figures                    # the sample at 11 bits: a quarter of an hour on two processors
    make figures ARGS=--quick       # a coarse sample and few frames, into results-quick/

All inputs are made in a temporary folder: the sample, and its environments on SQLite and on a
private server of every PostgreSQL found. They are measured with 4 MB of cache as in the paper, then
with a large cache.
"""

import argparse
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

import hapticdb
import page_tables
import records
from awake import awake
from hapticdb import Environment, GridOptions, ImportOptions, PointShell
from hapticdb.grid import CurveName
from hapticdb.poses import read_poses
from hapticdb.query.quantiles import QuantileVector
from hapticdb.sample import SampleFiles, write_sample
from hapticdb.store.base import BRICK_BYTES, LAYOUTS, Layout, SupportsCaches
from hapticdb.store.postgres.address import with_environment
from hapticdb.store.postgres.private_server import Binaries, find_binaries
from paper import experiments
from paper.experiments import QUICK, Budget
from paper.measure import Cell
from paper.plots import draw
from paper.subject import PAPER_CACHE, Subject, limited
from paper.workload import (
    INPUTS,
    Region,
    Task,
    random_poses,
    regions,
    slide_poses,
    sphere_shell,
)
from places import serving

EXTENT = 1.6
"""Edge of the sample's grid, as a multiple of the car's longest side; more gives larger voxels."""
CAD = (
    ("demo_vintage_car", "*.glb", 1.6),
    ("assembly_vw_t1", "vw_t1.glb", 2.4),
)
"""Real assemblies of Table 1: folder and file under HAPTICDB_TEST_DATA, extent of the grid."""
CACHES = {"4 MB": "4MB", "all cached": "2GB"}
SETTINGS = {"max_wal_size": "4GB", "fsync": "off"}
ALL_BYTES = 2 << 30
"""Bytes of a cache that holds every page of most environments; it takes memory as it is filled."""


@dataclass(frozen=True)
class Workload:
    """Tasks and regions of one environment, the same under all conditions."""

    slide: Task
    random: Task
    recorded: Task
    regions: tuple[Region, ...]
    finest: QuantileVector

    @classmethod
    def of(cls, env: Environment, budget: Budget, files: SampleFiles) -> "Workload":
        """The same for all environments that have the grid of this one."""
        shell = sphere_shell(env.grid.voxel_size)
        wrench = PointShell.from_file(files.wrench, 300)
        return cls(
            Task("slide", "sphere", shell, slide_poses(env, shell, budget.frames)),
            Task("random", "sphere", shell, random_poses(env, budget.frames)),
            Task("recorded", "wrench", wrench, read_poses(files.path)[: budget.frames]),
            tuple(regions(env, max(budget.frames // 4, 10), windows=budget.windows)),
            env.quantiles(max(budget.resolutions)),
        )


@dataclass
class Evaluation:
    """Inputs of one run of the script, and the cells that it has measured."""

    folder: Path
    files: SampleFiles
    bits: int
    budget: Budget
    data: Path | None
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

    def make(self, url: str, layout: Layout, curve: CurveName = "z") -> str:
        """Import the sample; all environments have the same grid except for curve and layout."""
        grid = GridOptions(bits=self.bits, extent=EXTENT, curve=curve)
        import_file(url, self.files.car, ImportOptions(grid=grid, layout=layout, distances=False))
        return url

    def measure(self, subject: Subject, *, is_paper: bool) -> None:
        """Run all experiments with the paper's cache; with a large one those that it affects."""
        work, budget = self.work[subject.env.layout], self.budget
        self.say(f"{subject.env.engine}, {subject.env.layout}: cache {subject.cache}")
        found = {
            "figure9": experiments.figure_9(subject, work.slide, budget),
            "conditions": experiments.cached(subject, work.slide, budget),
        }
        if is_paper:
            found["conditions"] += experiments.cold(subject, work.slide, budget)
            tasks = (work.slide, work.random, work.recorded)
            found |= {
                "figure8": experiments.figure_8(subject, work.slide, work.finest, budget),
                "figure10": experiments.figure_10(subject, work.slide, work.regions, budget),
                "strategies": experiments.strategies(subject, tasks, budget),
                "points": experiments.points(subject, budget),
                "tail": experiments.tail(subject, work.slide, budget),
            }
        self.add(found)


def import_file(url: str, file: Path, options: ImportOptions) -> None:
    """Import one file, or raise its error."""
    (report,) = hapticdb.import_files(url, [file], options)
    if report.error is not None:
        raise report.error


def distinct_voxels(env: Environment) -> int:
    """Voxels of an environment in bricks, each once, of whatever objects."""
    rows = env.store.scan(np.array([0]), np.array([8**env.grid.bits]))
    starts = np.flatnonzero(np.diff(rows.keys, prepend=-1))
    bricks = np.bitwise_or.reduceat(rows.occupancy.reshape(-1, BRICK_BYTES), starts, axis=0)
    return int(np.bitwise_count(bricks).sum())


def table_1_row(name: str, url: str, import_s: float) -> Cell:
    """Voxels, objects, cells of the data space of an environment in bricks."""
    with hapticdb.open(url, read_only=True) as env:
        size, objects = env.size(), env.objects()
        return {
            "environment": name,
            "engine": env.engine,
            "layout": env.layout,
            "objects": len(objects),
            "object_voxels": sum(obj.voxels for obj in objects),
            "distinct_voxels": distinct_voxels(env),
            "bits": env.grid.bits,
            "cells_of_space": 8**env.grid.bits,
            "edge": env.grid.edge,
            "voxel_size": env.grid.voxel_size,
            "rows_brick": size.rows,
            "bytes_brick": size.bytes,
            "import_s": import_s,
        }


def table_1(evaluation: Evaluation) -> None:
    """Real assemblies for Table 1, beside the sample."""
    if evaluation.data is None:
        evaluation.say("no real assemblies: HAPTICDB_TEST_DATA names no folder")
        return
    for folder, pattern, extent in CAD:
        (file,) = sorted((evaluation.data / folder).glob(pattern))
        evaluation.say(f"table 1: {folder}")
        url = str(evaluation.folder / f"{folder}.db")
        grid = GridOptions(bits=evaluation.bits, extent=extent)
        started = time.perf_counter()
        import_file(url, file, ImportOptions(grid=grid, distances=False))
        row = table_1_row(folder, url, time.perf_counter() - started)
        evaluation.add({"table1": [row]})


def caches_of(env: Environment) -> Iterator[tuple[str, bool]]:
    """Set SQLite's cache to each size in turn; give its name, and whether it is the paper's.

    An environment that fits into the paper's cache has one size.
    """
    first = limited(env, PAPER_CACHE)
    yield first, True
    if (second := limited(env, ALL_BYTES)) != first:
        yield second, False


def on_sqlite(evaluation: Evaluation) -> None:
    """Make the inputs, then run all experiments on SQLite, in both layouts."""
    budget = evaluation.budget
    for layout in LAYOUTS:
        evaluation.say(f"SQLite, {layout}: import")
        started = time.perf_counter()
        url = evaluation.make(str(evaluation.folder / f"{layout}.db"), layout)
        seconds = time.perf_counter() - started
        if layout == "brick":
            evaluation.add({"table1": [table_1_row("sample", url, seconds)]})
    evaluation.say("inputs: shells, poses, regions")
    with hapticdb.open(evaluation.folder / "brick.db", read_only=True) as env:
        work = Workload.of(env, budget, evaluation.files)
    for layout in LAYOUTS:
        with hapticdb.open(evaluation.folder / f"{layout}.db", read_only=True) as env:
            assert isinstance(env.store, SupportsCaches)
            # every engine has the same rows, so the same quantile vector
            evaluation.work[layout] = replace(work, finest=env.quantiles(max(budget.resolutions)))
            for cache, is_paper in caches_of(env):
                subject = Subject(env, "sample", cache, env.store.drop_caches)
                evaluation.measure(subject, is_paper=is_paper)


def on_postgres(evaluation: Evaluation, binaries: Binaries) -> None:
    """Run all experiments on one PostgreSQL server, restarted for each size of its cache."""
    folder = evaluation.folder / f"postgres{binaries.major}"
    large = SETTINGS | {"shared_buffers": CACHES["all cached"]}
    with serving(folder, binaries, large) as server:
        for layout in LAYOUTS:
            evaluation.say(f"PostgreSQL {binaries.major}, {layout}: import")
            evaluation.make(with_environment(server.conninfo(), layout), layout)
    measured: set[tuple[Layout, str]] = set()
    for cache, shared_buffers in CACHES.items():
        settings = SETTINGS | {"shared_buffers": shared_buffers}
        with serving(folder, binaries, settings) as server:
            for layout in LAYOUTS:
                with hapticdb.open(with_environment(server.conninfo(), layout)) as env:
                    subject = Subject(env, "sample", limited(env, 0))
                    if (layout, subject.cache) not in measured:  # a small one is cached already
                        measured.add((layout, subject.cache))
                        evaluation.measure(subject, is_paper=cache == "4 MB")


def layouts(evaluation: Evaluation) -> None:
    """Measure the three curves on SQLite in both layouts; lexicographic order has no bricks."""
    made: list[tuple[Layout, CurveName]] = [
        *((layout, "z") for layout in LAYOUTS),
        ("brick", "hilbert"),
        ("voxel", "hilbert"),
        ("voxel", "lexicographic"),
    ]
    for layout, curve in made:
        evaluation.say(f"SQLite, {layout}, {curve}")
        url = str(evaluation.folder / f"{layout}.db")
        if curve != "z":
            url = evaluation.make(str(evaluation.folder / f"{layout}-{curve}.db"), layout, curve)
        with hapticdb.open(url, read_only=True) as env:
            subject = Subject(env, "sample", limited(env, PAPER_CACHE))
            task = evaluation.work[layout].slide
            evaluation.add({"layouts": experiments.cached(subject, task, evaluation.budget)})


def evaluate(
    folder: Path, bits: int, budget: Budget, data: Path | None
) -> dict[str, dict[str, Any]]:
    """Run all experiments, and return results by name."""
    files = write_sample(folder / "sample", budget.frames)
    evaluation = Evaluation(folder, files, bits, budget, data)
    hapticdb.warm_up()
    on_sqlite(evaluation)
    table_1(evaluation)
    layouts(evaluation)
    for binaries in find_binaries():
        on_postgres(evaluation, binaries)
    inputs = dict(INPUTS) | {
        "sample": f"the sample car, {bits} bits, extent {EXTENT}",
        "PostgreSQL": "private server, Unix socket, fsync off",
        "awake": "processors are kept awake by processes of idle priority",
    }
    evaluation.say("done")
    return {name: records.result(name, cells, inputs) for name, cells in evaluation.found.items()}


def main() -> None:
    """Measure, write JSON and plots, and fill the page's tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="a coarse sample, few frames")
    given = parser.parse_args()
    out = Path("results-quick" if given.quick else "results")
    data = os.environ.get("HAPTICDB_TEST_DATA")
    # SIGTERM raises an exit, so that servers are stopped and files removed
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    with awake(), tempfile.TemporaryDirectory(prefix="hapticdb-figures-") as folder:
        found = evaluate(
            Path(folder),
            9 if given.quick else 11,
            QUICK if given.quick else Budget(),
            Path(data) if data else None,
        )
    records.write(out, found)
    draw(found, out)
    page_tables.refill("docs/evaluation.md", out, out / "evaluation.md" if given.quick else None)


if __name__ == "__main__":
    main()

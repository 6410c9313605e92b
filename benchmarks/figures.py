"""The evaluation: every figure on every engine, the peers, plots and the written report.

    make figures                    # the sample at 11 bits: a quarter of an hour on two processors
    make figures ARGS=--quick       # a coarse sample and few frames: whether all of it runs

All inputs are made in a temporary folder: the sample, and its environments on SQLite and on a
private server of every PostgreSQL found. They are measured with 4 MB of cache as in the paper, then
with a large cache.
"""

import argparse
import contextlib
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

import hapticdb
from awake import awake
from hapticdb import Environment, GridOptions, ImportOptions, PointShell
from hapticdb.bench import experiments, records, run
from hapticdb.bench.drawing.draw import draw
from hapticdb.bench.experiments import QUICK, Budget
from hapticdb.bench.measure import Cell
from hapticdb.bench.run import Workload
from hapticdb.bench.subject import PAPER_CACHE, Subject, limited
from hapticdb.bench.workload import RADIUS_VOXELS, Task
from hapticdb.grid import CurveName
from hapticdb.kernels.surfaces.voxelize import count_voxels
from hapticdb.poses import read_poses
from hapticdb.sample import SampleFiles, write_sample
from hapticdb.store.base import LAYOUTS, Layout
from hapticdb.store.postgres.address import with_environment
from hapticdb.store.postgres.private_server import Binaries, find_binaries
from peers import Peer, PeerWork, all_bricks
from peers.run import PeerResults, measure_peers
from peers.voxelizers import measure_voxelizers, read_assembly
from places import serving
from report.page import write_report
from report.plots import REPORT_KINDS
from servers_cold import Cold

EXTENT = 1.6
"""Edge of the sample's grid, as a multiple of the car's longest side; more gives larger voxels."""
CAD = (
    ("demo_vintage_car", "*.glb", 1.6),
    ("assembly_vw_t1", "vw_t1.glb", 2.4),
)
"""Real assemblies of Table 1: folder and file under HAPTICDB_TEST_DATA, extent of the grid."""
VOXELIZED = Path("assembly_vw_t1/vw_t1.glb")
POINTCLOUD_MAJOR = 15
"""Major version of PostgreSQL for which Debian has a package of pgpointcloud."""
CACHES = {"4 MB": "4MB", "all cached": "2GB"}
SETTINGS = {"max_wal_size": "4GB", "fsync": "off"}


@dataclass
class Evaluation:
    """Inputs of one run of the script, and the cells that it has measured."""

    folder: Path
    files: SampleFiles
    bits: int
    budget: Budget
    data: Path | None
    with_peers: bool
    seconds: float = field(default_factory=time.perf_counter)
    found: dict[str, list[Cell]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    work: dict[Layout, Workload] = field(default_factory=dict)

    def say(self, line: str) -> None:
        """Print what is measured next, and the seconds since the start."""
        print(f"{time.perf_counter() - self.seconds:6.0f} s  {line}", file=sys.stderr, flush=True)

    def keep(self, name: str, measured: PeerResults) -> None:
        """Keep measured cells, and notes on measurements that were not possible."""
        self.add(name, measured.cells)
        self.notes += measured.notes

    def add(self, name: str, cells: list[Cell]) -> None:
        """Keep measured cells of one experiment."""
        self.found.setdefault(name, []).extend(cells)

    def make(self, url: str, layout: Layout, curve: CurveName = "z") -> str:
        """Import the sample; all environments have the same grid except for curve and layout."""
        grid = GridOptions(bits=self.bits, extent=EXTENT, curve=curve)
        import_file(url, self.files.car, ImportOptions(grid=grid, layout=layout, distances=False))
        return url

    def describe(self, name: str, url: str, extent: float, import_s: float) -> None:
        """Add an environment in bricks to Table 1."""
        with hapticdb.open(url, read_only=True) as env:
            row = run.table_1_row(
                env,
                extent=extent,
                import_s=import_s,
                distinct_voxels=count_voxels(all_bricks(env).occupancy),
            )
        self.add("table1", [row | {"environment": name}])


def import_file(url: str, file: Path, options: ImportOptions) -> None:
    """Import one file, or raise its error."""
    (report,) = hapticdb.import_files(url, [file], options)
    if report.error is not None:
        raise report.error


def table_1(evaluation: Evaluation) -> None:
    """Add real assemblies to Table 1, beside the sample."""
    if evaluation.data is None:
        evaluation.notes.append("real CAD assemblies: HAPTICDB_TEST_DATA names no folder")
        return
    for folder, pattern, extent in CAD:
        (file,) = sorted((evaluation.data / folder).glob(pattern))
        evaluation.say(f"table 1: {folder}")
        url = str(evaluation.folder / f"{folder}.db")
        options = ImportOptions(
            grid=GridOptions(bits=evaluation.bits, extent=extent), distances=False
        )
        started = time.perf_counter()
        import_file(url, file, options)
        evaluation.describe(folder, url, extent, time.perf_counter() - started)


def on_sqlite(evaluation: Evaluation) -> None:
    """Make the inputs, then run all experiments on SQLite, in both layouts."""
    budget = evaluation.budget
    for layout in LAYOUTS:
        evaluation.say(f"SQLite, {layout}: import")
        started = time.perf_counter()
        url = evaluation.make(str(evaluation.folder / f"{layout}.db"), layout)
        seconds = time.perf_counter() - started
        if layout == "brick":
            evaluation.describe("sample", url, EXTENT, seconds)
    evaluation.say("inputs: shells, poses, regions")
    shell = PointShell.from_file(evaluation.files.wrench, 300)
    recorded = Task("recorded", "wrench", shell, read_poses(evaluation.files.path))
    with hapticdb.open(evaluation.folder / "brick.db", read_only=True) as env:
        work = run.workload_of(env, budget, recorded)
    for layout in LAYOUTS:
        with hapticdb.open(evaluation.folder / f"{layout}.db", read_only=True) as env:
            # every engine has the same rows, so the same quantile vector
            evaluation.work[layout] = replace(work, finest=env.quantiles(max(budget.resolutions)))
            for cache, is_paper in run.caches_of(env):
                subject = Subject(env, "sample", cache, run.drop_of(env))
                measure(evaluation, subject, is_paper=is_paper)


def measure(evaluation: Evaluation, subject: Subject, *, is_paper: bool) -> None:
    """Run all experiments with the paper's cache; with a large cache those that it affects."""
    work, budget = evaluation.work[subject.env.layout], evaluation.budget
    evaluation.say(f"{subject.env.engine}, {subject.env.layout}: cache {subject.cache}")
    for name, more in run.measured(subject, work, budget, is_paper=is_paper).items():
        evaluation.add(name, more)


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
        with serving(folder, binaries, settings) as server, contextlib.ExitStack() as opened:
            drop = None
            if cache == "4 MB":
                drop = Cold(server.conninfo(), folder / "data")
                opened.callback(drop.close)
            for layout in LAYOUTS:
                url = with_environment(server.conninfo(), layout)
                env = opened.enter_context(hapticdb.open(url))
                subject = Subject(env, "sample", limited(env, 0), drop)
                if (layout, subject.cache) in measured:
                    continue  # a small environment was already fully cached
                measured.add((layout, subject.cache))
                measure(evaluation, subject, is_paper=cache == "4 MB")
                if evaluation.with_peers and layout == "brick" and cache == "4 MB":
                    compare(evaluation, env, ())


def curves(evaluation: Evaluation) -> None:
    """Measure the three curves on SQLite in both layouts; lexicographic order has no bricks."""
    made: list[tuple[Layout, CurveName, str]] = [
        ("brick", "z", str(evaluation.folder / "brick.db")),
        ("voxel", "z", str(evaluation.folder / "voxel.db")),
    ]
    others: tuple[tuple[Layout, CurveName], ...] = (
        ("brick", "hilbert"),
        ("voxel", "hilbert"),
        ("voxel", "lexicographic"),
    )
    for layout, curve in others:
        evaluation.say(f"SQLite, {layout}, {curve}: import")
        place = str(evaluation.folder / f"{layout}-{curve}.db")
        made.append((layout, curve, evaluation.make(place, layout, curve)))
    for layout, curve, url in made:
        evaluation.say(f"SQLite, {layout}, {curve}")
        with hapticdb.open(url, read_only=True) as env:
            cache = limited(env, PAPER_CACHE)
            subject = Subject(env, "sample", cache)
            task = evaluation.work[layout].slide
            evaluation.add("layouts", experiments.cached(subject, task, evaluation.budget))


def peers(evaluation: Evaluation) -> None:
    """Measure other systems on the same poses, and other voxelizers."""
    evaluation.say("peers")
    with hapticdb.open(evaluation.folder / "brick.db", read_only=True) as env:
        compare(evaluation, env, None)
    evaluation.say("voxelizing")
    path = evaluation.data / VOXELIZED if evaluation.data else evaluation.files.car
    evaluation.keep(
        "voxelizing", measure_voxelizers(read_assembly(path), 10 * evaluation.budget.cell_s)
    )


def compare(evaluation: Evaluation, env: Environment, among: Sequence[Peer] | None) -> None:
    """Measure frames of an environment in bricks, and of the given peers (None: all peers)."""
    task = evaluation.work["brick"].slide
    radius = RADIUS_VOXELS * env.grid.voxel_size
    ball = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    folder = evaluation.folder / "peers"
    folder.mkdir(exist_ok=True)
    fifteen = [binaries for binaries in find_binaries() if binaries.major == POINTCLOUD_MAJOR]
    work = PeerWork(
        env,
        task.shell,
        evaluation.files.car,
        (np.asarray(ball.vertices), np.asarray(ball.faces)),
        folder,
        fifteen[0] if fifteen else None,
    )
    note = f"{env.engine}: with a database cache of {limited(env, PAPER_CACHE)}"
    evaluation.notes += [note] if note not in evaluation.notes else []
    measured = measure_peers(work, task.poses, 2 * evaluation.budget.cell_s, among)
    conditions = {"environment": "sample", "poses": "slide", "shell": "sphere"}
    cells = [cell | conditions for cell in measured.cells]
    evaluation.keep("peers", PeerResults(cells, measured.notes))


PARTS: dict[str, Callable[[Evaluation], None]] = {"curves": curves, "peers": peers}
ENGINES = "engines"


def evaluate(
    folder: Path, bits: int, budget: Budget, data: Path | None, parts: tuple[str, ...]
) -> dict[str, dict[str, Any]]:
    """Run the named parts, and return results by name."""
    files = write_sample(folder / "sample", budget.frames)
    evaluation = Evaluation(folder, files, bits, budget, data, with_peers=peers.__name__ in parts)
    hapticdb.warm_up()
    on_sqlite(evaluation)
    table_1(evaluation)
    for name, part in PARTS.items():
        if name in parts:
            part(evaluation)
    if ENGINES in parts:
        for binaries in find_binaries():
            on_postgres(evaluation, binaries)
    inputs = dict(records.INPUTS) | {
        "sample": f"the sample car, {bits} bits, extent {EXTENT}",
        "PostgreSQL": "private server, Unix socket, fsync off",
        "processors": "kept awake by processes of idle priority",
    }
    evaluation.say("done")
    return {
        name: records.result(name, cells, inputs=inputs, notes=evaluation.notes)
        for name, cells in evaluation.found.items()
    }


def main(arguments: list[str] | None = None) -> None:
    """Read the command line, measure, write JSON, plots and the report."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="a coarse sample, few frames")
    parser.add_argument("--bits", type=int, help="of the grid; 11 unless given, 9 when quick")
    parser.add_argument("--out", type=Path, help="for JSON and plots; results unless quick")
    parser.add_argument("--report", type=Path, help="docs/evaluation.md unless quick")
    parser.add_argument(
        "--parts", default=",".join([*PARTS, ENGINES]), help="some of these, and SQLite always"
    )
    chosen = parser.parse_args(arguments)
    out = chosen.out or Path("results-quick" if chosen.quick else "results")
    report = chosen.report or (out / run.PAGE if chosen.quick else Path("docs/evaluation.md"))
    data = os.environ.get("HAPTICDB_TEST_DATA")
    # SIGTERM raises an exit, so that servers are stopped and files removed
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    with awake(), tempfile.TemporaryDirectory(prefix="hapticdb-figures-") as folder:
        found = evaluate(
            Path(folder),
            chosen.bits or (9 if chosen.quick else 11),
            QUICK if chosen.quick else Budget(),
            Path(data) if data else None,
            tuple(chosen.parts.split(",")),
        )
    records.write(out, found)
    redraw(out, report)
    print(report)


def redraw(out: Path, report: Path) -> None:
    """Draw plots and write the report from all JSON in a folder, also that of `make scale`."""
    results = records.read(out)
    draw(results, out, REPORT_KINDS)
    report.parent.mkdir(parents=True, exist_ok=True)
    write_report(results, report, os.path.relpath(out, report.parent))


if __name__ == "__main__":
    main()

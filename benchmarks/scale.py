"""Whether a frame costs more in an environment a thousand times as large, and what a voxel costs.

Environments hold the sample car 1, 10 and 104 times side by side, and once a tenth of its voxels;
the same shell goes over the same surfaces in all of them. Building takes minutes, and its result
can be kept. Measuring needs a quiet machine, so each step can be run alone.

    python benchmarks/scale.py --folder DIR --out results/scale.json
"""

import argparse
import contextlib
import itertools
import json
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import hapticdb
from awake import awake
from copies import Plan, Source, write_copies
from figures import redraw
from hapticdb import Environment, PointShell
from hapticdb.bench import records
from hapticdb.bench.measure import Alternative, Cell, in_turns
from hapticdb.bench.subject import CURVES, PAPER_CACHE
from hapticdb.bench.workload import POSES, SEED, random_poses, slide_poses, sphere_shell
from hapticdb.errors import DatabaseError, HapticDBError, UsageError
from hapticdb.query.frame import Strategy
from hapticdb.sample import write_sample
from hapticdb.store.base import SupportsCaches
from hapticdb.store.connect import create_store, exists
from hapticdb.store.sqlite.file import remove_file
from places import CACHE, SETTINGS, EnginePlace, place_of

SIZES = (1.4e6, 1.4e7, 1.4e8, 1.4e9)
ENGINES = ("sqlite", "18")
BITS = 11
EXTENT = 1.6
"""Grid of one car: bits an axis, and its edge as a multiple of the car's longest side."""
STRATEGIES: tuple[Strategy, ...] = ("array", "cbgroup", "auto")
BYTES_A_VOXEL = {"sqlite": 1.3, "postgres": 3.0}
"""Bytes of disk reserved for each voxel, above all measured values; more refuses sooner."""
SPARE_BYTES = 3 << 30
"""Bytes of disk kept free for write-ahead logs and the sample; more refuses a build sooner."""
ROUNDS = 5
"""Turns of every size: a short disturbance of the machine then affects all sizes alike."""
LIMIT_S = 60.0
PROGRESS_S = 5.0
"""Least seconds between two lines of progress."""

NOTES = [
    "The sample car repeated by shifting keys; the smallest size is some of its objects.",
    "Sliding poses go over the copy in the middle, random ones over all copies.",
    "In every size of whole cars the shell meets the same surfaces, poses and hits are the same.",
    "import_s is the time to write the copies and their statistics, without voxelizing.",
]

Poses = NDArray[np.float64]


def say(line: str) -> None:
    """Print a line on standard error."""
    print(line, file=sys.stderr, flush=True)


# --- building -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class ScaleSize:
    """One size of environment.

    plan : places of the copies; copies : number of cars, below 1 a share of one car; home : file of
    the environment with one copy, in which poses are chosen.
    """

    plan: Plan
    copies: float
    home: Path

    @property
    def name(self) -> str:
        """Name of its environment on every engine."""
        return f"scale_{self.plan.voxels}"

    @property
    def cell(self) -> Cell:
        """Conditions that all cells of this size share."""
        return {
            "environment": "sample",
            "layout": self.plan.source.layout,
            "curve": CURVES[self.plan.grid.curve],
            "bits": self.plan.grid.bits,
            "copies": self.copies,
            "object_voxels": self.plan.voxels,
        }


def car_at_home(folder: Path, bits: int) -> tuple[Source, Path]:
    """The sample car and its environment's file, imported if it does not exist."""
    home = folder / f"sample_{bits}.db"
    files = write_sample(folder / "sample", count=2)
    grid = hapticdb.GridOptions(bits=bits, extent=EXTENT)
    hapticdb.import_files(home, [files.car], hapticdb.ImportOptions(grid=grid, distances=False))
    with hapticdb.open(home, read_only=True) as env:
        return Source.of(env), home


def sizes_of(folder: Path, wanted: Sequence[float], bits: int) -> list[ScaleSize]:
    """Sizes nearest to the wanted numbers of voxels: whole cars, or a part of one."""
    car, home = car_at_home(folder, bits)
    return [
        ScaleSize(Plan.of(car, round(voxels / car.voxels)), round(voxels / car.voxels), home)
        if voxels >= car.voxels / 2
        else _part(car, voxels, folder)
        for voxels in wanted
    ]


def _part(car: Source, voxels: float, folder: Path) -> ScaleSize:
    plan = Plan.of(car.within(voxels), 1)
    home = folder / f"part_{plan.voxels}.db"
    remove_file(home)
    with contextlib.closing(create_store(home, plan.grid, car.layout)) as store:
        write_copies(store, plan, lambda _: None)
    return ScaleSize(plan, round(plan.voxels / car.voxels, 3), home)


@dataclass(frozen=True)
class Built:
    """The environment of one size on one engine, whether it is built or not."""

    engine: str
    place: EnginePlace
    size: ScaleSize
    folder: Path

    @property
    def url(self) -> str:
        return self.place.url(self.size.name)

    @property
    def _record(self) -> Path:
        return self.folder / f"{self.engine}_{self.size.name}.json"

    def cell(self) -> Cell | None:
        """The cell measured when the environment was built; None until it is complete."""
        if not (self._record.exists() and exists(self.url)):
            return None
        cell: Cell = json.loads(self._record.read_text())
        return cell if self.size.cell.items() <= cell.items() else None

    def build(self) -> Cell:
        """Delete the environment, write it again, and measure its size and time."""
        plan = self.size.plan
        self._record.unlink(missing_ok=True)
        self.place.remove(self.size.name)
        started = time.perf_counter()
        last = [started]

        def progress(copies: int) -> None:
            now = time.perf_counter()
            if now - last[0] > PROGRESS_S:
                last[0] = now
                say(f"{self.engine}: copy {copies} of {len(plan.tiles)}, {now - started:.0f} s")

        store = create_store(self.url, plan.grid, plan.source.layout)
        with contextlib.closing(store):
            write_copies(store, plan, progress)
        import_s = time.perf_counter() - started
        with hapticdb.open(self.url, read_only=True) as env:
            size = env.size()
            cell = self.size.cell | {
                "engine": env.engine,
                "objects": len(env.objects()),
                "rows": size.rows,
                "bytes": size.bytes,
                "bytes_per_voxel": size.bytes / plan.voxels,
                "import_s": import_s,
            }
        self._record.write_text(json.dumps(cell))
        return cell


def check_room(wanted: Sequence[Built], folder: Path) -> None:
    """Raise `DatabaseError` if the disk cannot hold the environments that are to be built."""
    missing = [built for built in wanted if built.cell() is None]
    if not missing:
        return
    needed = SPARE_BYTES + sum(
        built.size.plan.voxels * BYTES_A_VOXEL[built.place.kind] for built in missing
    )
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise DatabaseError(
            f"{folder} has {free / 1e9:.1f} GB free, building needs {needed / 1e9:.1f} GB: "
            "give --folder on a larger disk, or fewer --sizes or --engines"
        )


# --- measuring ----------------------------------------------------------------------------------


def poses_at_home(home: Path, shell: PointShell, count: int) -> dict[str, Poses]:
    """Sliding and random poses in the environment of one copy."""
    with hapticdb.open(home, read_only=True) as env:
        return {
            "slide": slide_poses(env, shell, count),
            "random": random_poses(env, count),
        }


def parked_poses(plan: Plan, at_home: dict[str, Poses]) -> dict[str, Poses]:
    """The same poses among all copies: sliding ones at the middle copy, random ones at any copy."""
    offsets = plan.offsets()
    count = len(at_home["random"])
    copies = np.random.default_rng(SEED).integers(len(offsets), size=count)
    found = {kind: poses.copy() for kind, poses in at_home.items()}
    found["slide"][:, :3, 3] += offsets[plan.middle]
    found["random"][:, :3, 3] += offsets[copies]
    return found


class Run:
    """All strategies over the poses of one kind in one environment."""

    def __init__(
        self, env: Environment, shell: PointShell, cell: Cell, poses: Poses, limit_s: float
    ) -> None:
        self._env = env
        self._shell = shell
        self._poses = poses
        self._limit_s = limit_s
        self._alternatives = [
            Alternative(cell | {"strategy": strategy}, self._frame(strategy))
            for strategy in STRATEGIES
        ]

    def _frame(self, strategy: Strategy) -> Callable[[Poses], Any]:
        return lambda pose: self._env.touch(self._shell, pose, strategy).query

    def turn(self, number: int) -> None:
        """Measure all strategies on one of `ROUNDS` parts of the poses."""
        share = np.array_split(self._poses, ROUNDS)[number]
        in_turns(self._alternatives, share, limit_s=self._limit_s)

    def cells(self) -> list[Cell]:
        """Cells of all turns; hits and false rows come from one more touch of each pose."""
        touches = [self._env.touch(self._shell, pose, "array") for pose in self._poses]
        asked = float(np.mean([touch.query.rows for touch in touches]))
        hits = float(np.mean([len(touch.hits) for touch in touches]))
        cells = []
        for alternative in self._alternatives:
            cell = alternative.record() | {"hits": hits}
            cell["cut_short"] = cell["frames"] < len(self._poses)
            if not cell["cut_short"]:
                cell["false_rows"] = cell["rows"] - asked
            cells.append(cell)
        return cells


def measure(builds: Sequence[Built], n_poses: int, limit_s: float) -> list[Cell]:
    """Measure frames in all sizes on one engine, in turns."""
    runs = []
    at_home: dict[Path, dict[str, Poses]] = {}
    with contextlib.ExitStack() as opened:
        for built in builds:
            size = built.size
            shell = sphere_shell(size.plan.grid.voxel_size)
            if size.home not in at_home:
                at_home[size.home] = poses_at_home(size.home, shell, n_poses)
            env = opened.enter_context(hapticdb.open(built.url, read_only=True))
            if isinstance(env.store, SupportsCaches):  # a server got its cache when it was started
                env.store.limit_cache(PAPER_CACHE)
            env.calibrate(keep=False)
            storage = built.cell() or {}
            conditions = {
                "cache": CACHE,
                "file": "cached",
                "shell": "sphere",
                "points": len(shell.points),
            }
            for kind, poses in parked_poses(size.plan, at_home[size.home]).items():
                cell = storage | conditions | {"poses": kind}
                runs.append(Run(env, shell, cell, poses, limit_s))
        for number, run in itertools.product(range(ROUNDS), runs):
            run.turn(number)
        return [cell for run in runs for cell in run.cells()]


# --- the command --------------------------------------------------------------------------------


def evaluate(
    folder: Path,
    sizes: Sequence[ScaleSize],
    engines: Sequence[str],
    steps: Sequence[str],
    *,
    n_poses: int = POSES,
    limit_s: float = LIMIT_S,
) -> list[Cell]:
    """Cells of all sizes on all engines; `steps` are ``build``, ``measure`` or both."""
    with contextlib.ExitStack() as running:
        places = {engine: running.enter_context(place_of(engine, folder)) for engine in engines}
        builds = [Built(e, place, size, folder) for e, place in places.items() for size in sizes]
        if "build" in steps:
            check_room(builds, folder)
        cells = [stored(built, may_build="build" in steps) for built in builds]
        if "measure" in steps:
            for engine in engines:
                say(f"{engine}: measuring")
                ours = [built for built in builds if built.engine == engine]
                with awake():
                    cells += measure(ours, n_poses, limit_s)
    return cells


def stored(built: Built, *, may_build: bool) -> Cell:
    """The cell of an environment's size on disk; build the environment first if it is missing."""
    cell = built.cell()
    voxels = f"{built.engine}, {built.size.plan.voxels:,} voxels"
    if cell is None:
        if not may_build:
            raise UsageError(f"{voxels}: not built in {built.folder}; give --build, too")
        say(f"{voxels}: building")
        cell = built.build()
    say(
        f"{voxels}: {cell['rows']:,} rows, {cell['bytes_per_voxel']:.2f} bytes a voxel, "
        f"written in {cell['import_s']:.1f} s"
    )
    return cell


def main(arguments: Sequence[str] | None = None) -> None:
    """Read the command line, build, measure, write the JSON."""
    chosen = _parser().parse_args(arguments)
    steps = [step for step in ("build", "measure") if getattr(chosen, step)]
    engines = chosen.engines.split(",")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # servers end, files are removed
    with contextlib.ExitStack() as stack:
        try:
            wanted = [float(word) for word in chosen.sizes.split(",")]
            folder = chosen.folder or Path(
                stack.enter_context(tempfile.TemporaryDirectory(prefix="hapticdb-scale-"))
            )
            folder.mkdir(parents=True, exist_ok=True)
            sizes = sizes_of(folder, wanted, chosen.bits)
            cells = evaluate(
                folder, sizes, engines, steps or ("build", "measure"), n_poses=chosen.poses
            )
        except (HapticDBError, ValueError, OSError) as error:
            sys.exit(f"scale: {error}")
        records.write(chosen.out.parent, {chosen.out.stem: result_of(cells, chosen)})
        if chosen.report:
            redraw(chosen.out.parent, chosen.report)


def result_of(cells: Sequence[Cell], chosen: argparse.Namespace) -> dict[str, Any]:
    """The result in the form that the evaluation reads."""
    inputs = {
        "sample": f"the sample car, {chosen.bits} bits of its own, extent {EXTENT}",
        "poses": f"{chosen.poses} of each kind, seed {SEED}",
        "PostgreSQL": ", ".join(f"{name} = {value}" for name, value in SETTINGS.items()),
        "processors": "kept awake by processes of idle priority",
    }
    return records.result("scale", cells, inputs=inputs, notes=NOTES)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--folder", type=Path, help="keep what is built there; else it is removed afterwards"
    )
    sizes = ",".join(f"{size:.2g}" for size in SIZES)
    parser.add_argument("--sizes", default=sizes, help=f"object voxels; {sizes} unless given")
    parser.add_argument(
        "--engines", default=",".join(ENGINES), help="sqlite, or majors of PostgreSQL"
    )
    parser.add_argument("--build", action="store_true", help="build what is missing, no more")
    parser.add_argument("--measure", action="store_true", help="measure what is built, no more")
    parser.add_argument("--poses", type=int, default=POSES, help="of each kind")
    parser.add_argument("--bits", type=int, default=BITS, help="of one car's grid")
    parser.add_argument("--out", type=Path, default=Path("results/scale.json"))
    parser.add_argument("--report", type=Path, help="write the evaluation anew, with this in it")
    return parser


if __name__ == "__main__":
    main()

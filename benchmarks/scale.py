"""Whether a frame costs more in an environment a thousand times as large, and what a voxel costs.

    make scale                       # 1.4 million to 1.4 billion voxels: 10 GB of disk
    make scale ARGS=--quick          # tiny sizes, into results-quick/

Environments hold the sample car 1, 10 and 104 times side by side, and once a tenth of its voxels;
the same shell goes over the same surfaces in all of them. All sizes of an engine take turns.
"""

import argparse
import contextlib
import itertools
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import hapticdb
import page_tables
import records
from awake import awake
from copies import Plan, Source, write_copies
from hapticdb import Environment, PointShell
from hapticdb.paper.strategies import Strategy
from hapticdb.sample import write_sample
from hapticdb.store.connect import create_store
from hapticdb.store.postgres.address import with_environment
from paper.measure import Alternative, Cell, in_turns
from paper.plots import draw
from paper.subject import with_papers_cache
from paper.workload import SEED, random_poses, slide_poses, sphere_shell
from places import find_binaries, serving

EXTENT = 1.6
"""Edge of one car's grid as a multiple of the car's longest side."""
SETTINGS = {"shared_buffers": "4MB", "max_wal_size": "2GB"}
STRATEGIES: tuple[Strategy, ...] = ("array", "cbgroup")
ROUNDS = 5
"""Turns of every size: a short disturbance of the machine then affects all sizes alike."""
LIMIT_S = 60.0
"""Seconds of frames that a strategy may take in one environment."""
Poses = NDArray[np.float64]


@dataclass(frozen=True)
class Effort:
    """Object voxels of each size, bits of one car's grid on each axis, poses of each kind."""

    sizes: tuple[float, ...] = (1.4e6, 1.4e7, 1.4e8, 1.4e9)
    bits: int = 11
    poses: int = 1000


QUICK = Effort((3e3, 3e4, 1e5), 7, 50)


def say(line: str) -> None:
    """Print a line on standard error."""
    print(line, file=sys.stderr, flush=True)


class ScaleSize(NamedTuple):
    """Places of the copies; the number of cars, below 1 a share of one; poses for one copy."""

    plan: Plan
    copies: float
    at_home: dict[str, Poses]

    @property
    def cell(self) -> Cell:
        """Conditions that all cells of this size share."""
        return {
            "environment": "sample",
            "layout": self.plan.source.layout,
            "bits": self.plan.grid.bits,
            "copies": self.copies,
            "object_voxels": self.plan.voxels,
        }

    def parked_poses(self) -> dict[str, Poses]:
        """The poses among all copies: sliding ones at the middle copy, random ones at any copy."""
        offsets = self.plan.offsets()
        count = len(self.at_home["random"])
        copies = np.random.default_rng(SEED).integers(len(offsets), size=count)
        found = {kind: poses.copy() for kind, poses in self.at_home.items()}
        found["slide"][:, :3, 3] += offsets[self.plan.middle]
        found["random"][:, :3, 3] += offsets[copies]
        return found


def sizes_of(folder: Path, effort: Effort) -> list[ScaleSize]:
    """Sizes nearest to the wanted numbers of voxels: whole cars, or a part of one."""
    home = folder / "home.db"
    grid = hapticdb.GridOptions(bits=effort.bits, extent=EXTENT)
    options = hapticdb.ImportOptions(grid=grid, distances=False)
    hapticdb.import_files(home, [write_sample(folder / "sample", count=2).car], options)
    with hapticdb.open(home, read_only=True) as env:
        car, whole = Source.of(env), poses_at_home(env, effort.poses)
    found = []
    for voxels in effort.sizes:
        copies = round(voxels / car.voxels)
        if copies:
            found.append(ScaleSize(Plan.of(car, copies), copies, whole))
            continue
        plan = Plan.of(car.within(voxels), 1)
        part = folder / "part.db"
        with contextlib.closing(create_store(part, plan.grid, car.layout)) as store:
            write_copies(store, plan)
        with hapticdb.open(part, read_only=True) as env:
            poses = poses_at_home(env, effort.poses)
        found.append(ScaleSize(plan, round(plan.voxels / car.voxels, 3), poses))
    return found


def poses_at_home(env: Environment, count: int) -> dict[str, Poses]:
    """Sliding and random poses in the environment of one copy."""
    shell = sphere_shell(env.grid.voxel_size)
    return {"slide": slide_poses(env, shell, count), "random": random_poses(env, count)}


def built(url: str, size: ScaleSize) -> Cell:
    """Write an environment; its size on disk, and the time that it took."""
    started = time.perf_counter()
    with contextlib.closing(create_store(url, size.plan.grid, size.plan.source.layout)) as store:
        write_copies(store, size.plan)
    import_s = time.perf_counter() - started
    with hapticdb.open(url, read_only=True) as env:
        stored = env.size()
        say(f"{env.engine}: {stored.rows:,} rows in {import_s:.1f} s")
        return size.cell | {
            "engine": env.engine,
            "objects": len(env.objects()),
            "rows": stored.rows,
            "bytes": stored.bytes,
            "bytes_per_voxel": stored.bytes / size.plan.voxels,
            "import_s": import_s,
        }


class Run:
    """All strategies over the poses of one kind in one environment."""

    def __init__(self, env: Environment, shell: PointShell, cell: Cell, poses: Poses) -> None:
        self._env, self._shell, self._poses = env, shell, poses
        self._alternatives = [
            Alternative(cell | {"strategy": strategy}, self._frame(strategy))
            for strategy in STRATEGIES
        ]

    def _frame(self, strategy: Strategy) -> Callable[[Poses], Any]:
        return lambda pose: self._env.touch(self._shell, pose, strategy).query

    def turn(self, number: int) -> None:
        """Measure all strategies on one of `ROUNDS` parts of the poses."""
        share = np.array_split(self._poses, ROUNDS)[number]
        in_turns(self._alternatives, share, limit_s=LIMIT_S)

    def cells(self) -> list[Cell]:
        """Cells of all turns; hits come from one more touch of each pose."""
        touches = [self._env.touch(self._shell, pose, "array") for pose in self._poses]
        found = {"hits": float(np.mean([len(touch.hits) for touch in touches]))}
        cells = [alternative.record() | found for alternative in self._alternatives]
        return [cell | {"cut_short": cell["frames"] < len(self._poses)} for cell in cells]


def measure(urls: Sequence[str], sizes: Sequence[ScaleSize]) -> list[Cell]:
    """Build all sizes on one engine, then measure frames in them, in turns."""
    storage = [built(url, size) for url, size in zip(urls, sizes, strict=True)]
    runs = []
    with awake(), contextlib.ExitStack() as opened:
        for url, size, stored in zip(urls, sizes, storage, strict=True):
            shell = sphere_shell(size.plan.grid.voxel_size)
            env = opened.enter_context(hapticdb.open(url, read_only=True))
            with_papers_cache(env)
            env.calibrate(keep=False)
            conditions = {"file": "cached"}
            for kind, poses in size.parked_poses().items():
                cell = stored | conditions | {"points": len(shell), "poses": kind}
                runs.append(Run(env, shell, cell, poses))
        for number, run in itertools.product(range(ROUNDS), runs):
            run.turn(number)
        return storage + [cell for run in runs for cell in run.cells()]


def evaluate(folder: Path, effort: Effort) -> dict[str, Any]:
    """All sizes on SQLite and on the newest PostgreSQL found, as the evaluation reads them."""
    sizes = sizes_of(folder, effort)
    names = [f"scale_{size.plan.voxels}" for size in sizes]
    cells = measure([str(folder / f"{name}.db") for name in names], sizes)
    binaries = max(find_binaries(), key=lambda found: found.major)
    with serving(folder / "server", binaries, SETTINGS) as server:
        cells += measure([with_environment(server.conninfo(), name) for name in names], sizes)
    inputs = {
        "sample": f"the sample car, {effort.bits} bits of its own, extent {EXTENT}",
        "poses": f"{effort.poses} of each kind, seed {SEED}",
        "PostgreSQL": ", ".join(f"{name} = {value}" for name, value in SETTINGS.items()),
    }
    return records.result("scale", cells, inputs)


def main() -> None:
    """Build, measure, and fill the tables of docs/evaluation.md."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="tiny sizes, into results-quick/")
    given = parser.parse_args()
    out = Path("results-quick" if given.quick else "results")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # servers end, files are removed
    with tempfile.TemporaryDirectory(prefix="hapticdb-scale-") as folder:
        found = {"scale": evaluate(Path(folder), QUICK if given.quick else Effort())}
    records.write(out, found)
    draw(found, out)
    if not given.quick:
        page_tables.refill("docs/evaluation.md", out)


if __name__ == "__main__":
    main()

"""Whether a frame costs more in an environment a thousand times as large, and what a voxel costs.

    make scale                       # 1.4 million to 1.4 billion voxels: 10 GB of disk
    make scale ARGS=--quick          # tiny sizes, into results-quick/

Environments hold the sample car 1, 10 and 104 times side by side, and once a tenth of its voxels;
the same shell goes over the same surfaces in all of them. All sizes of an engine take turns.
"""

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
from copies import Copies
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


class ScaleSize(NamedTuple):
    """Places of the copies; the number of cars, below 1 a share of one; poses for one copy."""

    plan: Copies
    copies: float
    at_home: dict[str, Poses]

    @property
    def cell(self) -> Cell:
        """Conditions that all cells of this size share."""
        return {
            "environment": "sample",
            "layout": self.plan.layout,
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
        car, whole = Copies.of(env), poses_at_home(env, effort.poses)
    found = []
    for voxels in effort.sizes:
        copies = round(voxels / car.voxels)
        if copies:
            found.append(ScaleSize(car.times(copies), copies, whole))
            continue
        plan = car.within(voxels)
        part = folder / "part.db"
        with contextlib.closing(create_store(part, plan.grid, plan.layout)) as store:
            plan.write(store)
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
    with contextlib.closing(create_store(url, size.plan.grid, size.plan.layout)) as store:
        size.plan.write(store)
    import_s = time.perf_counter() - started
    with hapticdb.open(url, read_only=True) as env:
        stored = env.size()
        print(f"{env.engine}: {stored.rows:,} rows in {import_s:.1f} s", flush=True)
        return size.cell | {
            "engine": env.engine,
            "objects": len(env.objects()),
            "rows": stored.rows,
            "bytes": stored.bytes,
            "bytes_per_voxel": stored.bytes / size.plan.voxels,
            "import_s": import_s,
        }


def frames(env: Environment, shell: PointShell, strategy: Strategy) -> Callable[[Poses], Any]:
    """Frames by one strategy in one environment."""
    return lambda pose: env.touch(shell, pose, strategy).query


def measure(urls: Sequence[str], sizes: Sequence[ScaleSize]) -> list[Cell]:
    """Build all sizes on one engine, then measure frames in them, in turns."""
    storage = [built(url, size) for url, size in zip(urls, sizes, strict=True)]
    runs: list[tuple[Poses, list[Alternative]]] = []
    with awake(), contextlib.ExitStack() as opened:
        for url, size, stored in zip(urls, sizes, storage, strict=True):
            shell = sphere_shell(size.plan.grid.voxel_size)
            env = opened.enter_context(hapticdb.open(url, read_only=True))
            with_papers_cache(env)
            env.calibrate(keep=False)
            about = stored | {"file": "cached", "points": len(shell)}
            for kind, poses in size.parked_poses().items():
                cells = {one: about | {"poses": kind, "strategy": one} for one in STRATEGIES}
                ways = [Alternative(cells[one], frames(env, shell, one)) for one in STRATEGIES]
                runs.append((poses, ways))
        for number, (poses, ways) in itertools.product(range(ROUNDS), runs):
            in_turns(ways, np.array_split(poses, ROUNDS)[number], limit_s=LIMIT_S)
    measured = [(len(poses), one.record()) for poses, ways in runs for one in ways]
    return storage + [cell | {"cut_short": cell["frames"] < count} for count, cell in measured]


def evaluate(folder: Path, effort: Effort) -> dict[str, Any]:
    """All sizes on SQLite and on the newest PostgreSQL found, as the evaluation reads them."""
    sizes = sizes_of(folder, effort)
    names = [f"scale_{size.plan.voxels}" for size in sizes]
    cells = measure([str(folder / f"{name}.db") for name in names], sizes)
    binaries = find_binaries()[0]
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
    is_quick, out = records.asked(__doc__, "tiny sizes, into results-quick/")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # servers end, files are removed
    with tempfile.TemporaryDirectory(prefix="hapticdb-scale-") as folder:
        found = {"scale": evaluate(Path(folder), QUICK if is_quick else Effort())}
    records.write(out, found)
    draw(found, out)
    if not is_quick:
        page_tables.refill("docs/evaluation.md", out)


if __name__ == "__main__":
    main()

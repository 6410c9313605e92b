"""What rows on other servers cost, and what a network adds: ratios, measured in turns.

    python benchmarks/partitions.py

All servers run on this machine. The sample car lies on one server, and on 1, 2 and 4 partitions;
the one server is asked through a relay that delays, too.
"""

import contextlib
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

import hapticdb
import page_tables
import records
from delaying import delayed
from hapticdb import Environment
from hapticdb.sample import write_sample
from hapticdb.store.base import BRICK_SHIFT, CELL_SHIFT
from hapticdb.store.postgres.private_server import PORT, USER, find_binaries
from hapticdb.store.urls import with_partitions
from hapticdb.transfer import copy_environment
from paper.workload import SEED, slide_poses, sphere_shell
from places import serving

BITS, ROUNDS, CELLS = 8, 80, 8
"""Bits of the grid; how often each is measured; cells that one statement reads."""
PARTITIONS, DELAYS_MS = (1, 2, 4), (0.0, 2.0, 10.0)
CELL_OF_BRICK = CELL_SHIFT - BRICK_SHIFT
"""Bits of a brick's key below the key of its cell."""
SETTINGS = {"shared_buffers": "256MB"}


def jobs_in(env: Environment) -> dict[str, Callable[[int], object]]:
    """What is measured in an environment, by its name: called with the number of the round."""
    shell = sphere_shell(env.grid.voxel_size)
    poses = slide_poses(env, shell, ROUNDS)
    keys = np.unique(env.store.scan(np.array([0]), np.array([2**62])).keys >> CELL_OF_BRICK)
    rng = np.random.default_rng(SEED)
    chosen = [np.sort(rng.choice(keys, CELLS, replace=False)) << CELL_OF_BRICK for _ in poses]
    moved = min(env.objects(), key=lambda obj: obj.voxels).id
    last = (1 << CELL_OF_BRICK) - 1
    return {
        "a round trip": lambda _: env.store.revision(),
        "a frame": lambda n: env.touch(shell, poses[n], "array", law="plane"),
        f"{CELLS} cells": lambda n: env.store.scan(chosen[n], chosen[n] + last, distances=True),
        "a move": lambda n: env.shift([moved], (1e-3 * (-1) ** n, 0.0, 0.0)),
    }


@contextlib.contextmanager
def opened(folder: Path) -> Iterator[dict[str, Environment]]:
    """The environments that are compared, by their names."""
    car, home = write_sample(folder / "sample", count=2).car, folder / "home.db"
    hapticdb.import_files(home, [car], hapticdb.ImportOptions(grid=hapticdb.GridOptions(bits=BITS)))
    binaries = max(find_binaries(), key=lambda found: found.major)
    with contextlib.ExitStack() as ending:
        servers = [
            ending.enter_context(serving(folder / f"server{n}", binaries, SETTINGS)).conninfo()
            for n in range(1 + max(PARTITIONS))
        ]
        urls = {"one server": f"{servers[0]}&environment=alone"}
        copy_environment(home, urls["one server"])
        for count in PARTITIONS:
            url = f"{servers[0]}&environment=on{count}"
            copy_environment(home, with_partitions(url, ",".join(servers[1 : 1 + count])))
            urls[f"{count} partition{'s' * (count > 1)}"] = url
        socket = Path(parse_qs(urlsplit(servers[0]).query)["host"][0], f".s.PGSQL.{PORT}")
        for delay in DELAYS_MS:
            port = ending.enter_context(delayed(socket, 1e-3 * delay))
            place = f"postgresql://{USER}@127.0.0.1:{port}/postgres?environment=alone"
            urls[f"one server, relay, {delay:g} ms more"] = place
        yield {name: ending.enter_context(hapticdb.open(url)) for name, url in urls.items()}


def measured(envs: dict[str, Environment]) -> list[dict[str, Any]]:
    """Median milliseconds of each job in each environment, in turns, and ratios to the first."""
    jobs = {name: jobs_in(env) for name, env in envs.items()}
    times = {name: {job: [0.0] * ROUNDS for job in found} for name, found in jobs.items()}
    rng = np.random.default_rng(SEED)
    for job in next(iter(jobs.values())):  # moves last: a frame after one lists all objects anew
        for n in range(ROUNDS):
            for name in rng.permutation(list(jobs)).tolist():
                began = time.perf_counter()
                jobs[name][job](n)
                times[name][job][n] = 1e3 * (time.perf_counter() - began)
    middle = {
        name: {job: float(np.median(some[ROUNDS // 8 :])) for job, some in found.items()}
        for name, found in times.items()
    }
    first = next(iter(middle.values()))
    return [
        {"rows": name, "ms": found, "ratio": {job: found[job] / first[job] for job in found}}
        for name, found in middle.items()
    ]


def main() -> None:
    """Measure, write the results, and fill the table of docs/scale.md."""
    with tempfile.TemporaryDirectory() as folder, opened(Path(folder)) as envs:
        cells = measured(envs)
    inputs = {"scene": f"the sample car, {BITS} bits", "rounds": ROUNDS}
    records.write(Path("results"), {"partitions": records.result("partitions", cells, inputs)})
    page_tables.refill("docs/scale.md", Path("results"))


if __name__ == "__main__":
    main()

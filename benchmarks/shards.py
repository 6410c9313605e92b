"""An environment on several servers beside the same on one: copies, frames, prefetches and edits.

    python benchmarks/shards.py car.db --out results/shards.json

Large environments are copied first, and measured when the machine is at rest:

    python benchmarks/shards.py plant.db --shards 4 --folder servers --out plant.json --only-copy
    python benchmarks/shards.py plant.db --shards 4 --folder servers --out plant.json

All servers are private ones on this machine, so they share its processors and its disk: what is
shown is what several servers cost, not what they bring.
"""

import argparse
import atexit
import contextlib
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import hapticdb
from awake import awake
from hapticdb import Environment
from hapticdb.bench import records
from hapticdb.bench.measure import Alternative, in_turns, summary
from hapticdb.bench.workload import SEED, sphere_shell
from hapticdb.kernels.resident import cell_table
from hapticdb.query.frame import Strategy
from hapticdb.query.grouping import object_ranges
from hapticdb.resident.source import CellSource
from hapticdb.resident.table import CellTable
from hapticdb.sample.path import slide_over_voxels
from hapticdb.store.base import CELL_SHIFT, Store
from hapticdb.store.connect import open_store
from hapticdb.transfer import copy_environment

COUNTS = (1, 2, 4)
"""Numbers of shards beside one server."""
STRATEGIES: tuple[Strategy, ...] = ("array", "cbgroup")
POSES = 400
BATCH = 256
"""Cells of a prefetch: those of a statement of the fetching process."""
PREFETCHES = 60
EDITS = 40
LIMIT_S = 60.0
MAP_CELLS = 512
"""Cells of the map of heights that a path follows, along its longest side."""
Poses = NDArray[np.float64]
BUDGET = 256 << 20
"""Bytes of the table of cells."""


def urls_of(folder: Path, counts: Sequence[int]) -> dict[str, str]:
    """URL of each place, by name: one server, and so many shards."""
    found = {"one server": f"postgresql:///bench?data={folder}/one"}
    for count in counts:
        name = f"{count} shard{'s' if count > 1 else ''}"
        found[name] = f"postgresql:///bench?data={folder}/of{count}&shards={count}"
    return found


def copied(source: str, urls: dict[str, str], known: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Copies of the environment to each place, one after another; `known` ones are there."""
    cells = list(known)
    done = {cell["place"] for cell in known}
    for name, url in urls.items():
        if name in done:
            continue
        load = os.getloadavg()[0]
        started = time.perf_counter()
        copy_environment(source, url)
        took = time.perf_counter() - started
        with contextlib.closing(open_store(url, read_only=True)) as store:
            size = store.size()
        rows = size.rows + size.band_rows
        cells.append({"place": name, "s": took, "rows": rows, "rows_a_s": rows / took,
                      "bytes": size.bytes, "load_before": load})  # fmt: skip
        print(f"copy, {name:12s} {took:7.1f} s, {rows / took:9,.0f} rows a second", flush=True)
    return cells


def sliding(env: Environment, tool_points: NDArray[np.float64], frames: int) -> Poses:
    """Poses (frames, 4, 4) over the largest object and its neighbours, in a scene of any size."""
    largest = max(env.objects(), key=lambda obj: (obj.voxels, -obj.id))
    low, high = largest.bounds
    near = [
        obj
        for obj in env.objects()
        if (obj.bounds[1] >= low).all() and (obj.bounds[0] <= high).all()
    ]
    centers = np.concatenate([env.grid.centers(env.voxels(obj.id)) for obj in near])
    span = float((centers.max(axis=0) - centers.min(axis=0)).max())
    step = env.grid.voxel_size * max(1, round(span / (env.grid.voxel_size * MAP_CELLS)))
    return slide_over_voxels(centers, step, tool_points, frames)


def framed(envs: dict[str, Environment]) -> list[dict[str, Any]]:
    """Frames of a sliding sphere by every strategy in every place, in turns."""
    home = next(iter(envs.values()))
    shell = sphere_shell(home.grid.voxel_size)
    poses = sliding(home, shell.points, POSES)
    ways = []
    for strategy in STRATEGIES:
        for name, env in envs.items():

            def frame(pose: Any, env: Environment = env, strategy: Strategy = strategy) -> Any:  # noqa: ANN401 - as `Alternative` calls it
                return env.touch(shell, pose, strategy=strategy, law="plane").query

            ways.append(Alternative({"place": name, "strategy": strategy}, frame))
    cells = in_turns(ways, poses, limit_s=LIMIT_S)
    for cell in cells:
        p50 = cell["us"]["p50"]
        print(f"frame, {cell['place']:12s} {cell['strategy']:8s} {p50:8.0f} us", flush=True)
    return cells


def prefetched(home: Environment, stores: dict[str, Store]) -> list[dict[str, Any]]:
    """Batches of cells that the fetching process reads, around places on surfaces, in turns."""
    rng = np.random.default_rng(SEED)
    table = CellTable.create(BUDGET)
    sources = {
        name: CellSource(store, np.empty(0, np.int64), time.perf_counter, may_measure=True)
        for name, store in stores.items()
    }
    grid = home.grid
    side = grid.side >> 5
    slots = np.arange(BATCH, dtype=np.int64)
    times: dict[str, list[float]] = {name: [] for name in stores}
    rows = []
    shell = sphere_shell(grid.voxel_size)
    for n, pose in enumerate(sliding(home, shell.points, PREFETCHES + 3)):
        middle = ((pose[:3, 3] - grid.origin) / grid.voxel_size).astype(np.int64) >> 5
        ijk = middle - [4, 4, 2] + np.stack(np.unravel_index(np.arange(BATCH), (8, 8, 4)), axis=1)
        ijk = ijk[((ijk >= 0) & (ijk < side)).all(axis=1)]
        on_curve = grid.encode(32 * ijk) >> CELL_SHIFT
        cells = np.empty_like(on_curve)
        cell_table.cells_of_curve_keys(on_curve, grid.bits, grid.curve_code, cells)
        for name in rng.permutation(list(sources)).tolist():
            started = time.perf_counter_ns()
            read = sources[name].read(cells, table, slots[: len(cells)])
            if n >= 3:
                times[name].append((time.perf_counter_ns() - started) / 1000)
                rows.append(read.n_rows)
    table.close()
    found = []
    for name, took in times.items():
        us = summary(took)
        found.append({"place": name, "us": us, "rows": float(np.mean(rows))})
        print(f"prefetch, {name:12s} {us['p50']:8.0f} us", flush=True)
    return found


def edited(envs: dict[str, Environment]) -> list[dict[str, Any]]:
    """Writes of one object's rows in a new version, each a commit, in turns."""
    home = next(iter(envs.values()))
    moved = sorted(home.objects(), key=lambda obj: obj.voxels)[len(home.objects()) // 2]
    times: dict[str, list[float]] = {name: [] for name in envs}
    for _ in range(EDITS):
        for name, env in envs.items():
            arguments = again(env, moved.id)
            started = time.perf_counter_ns()
            env.store.replace(*arguments)
            times[name].append((time.perf_counter_ns() - started) / 1000)
    found = []
    for name, took in times.items():
        us = summary(took[4:])
        found.append({"place": name, "us": us})
        print(f"edit, {name:12s} {us['p50']:8.0f} us", flush=True)
    return found


def again(env: Environment, object_id: int) -> tuple[Any, Any, Callable[..., Any]]:
    """Arguments that write an object's rows anew, where they are."""
    store = env.store
    known = store.object(object_id)
    ranges = object_ranges(store.grid, store.layout, known)
    distances = known.has_distances
    rows = store.rows_of(object_id, *ranges, distances=distances)
    record = replace(known, revision=0)
    pairs = list(zip(ranges.lows.tolist(), ranges.highs.tolist(), strict=True))
    return record, rows, lambda _: pairs


def main() -> None:
    """Measure, print, and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", help="environment whose rows are copied")
    parser.add_argument("--shards", type=int, nargs="*", default=list(COUNTS))
    parser.add_argument("--folder", type=Path, help="where the servers are kept")
    parser.add_argument("--out", type=Path, help="file of figures, JSON")
    parser.add_argument("--only-copy", action="store_true", help="measure nothing else yet")
    given = parser.parse_args()
    if given.only_copy and not (given.folder and given.out):
        parser.error("--only-copy needs --folder and --out, where the copies are found again")
    folder = given.folder
    if folder is None:
        folder = Path(tempfile.mkdtemp())
        atexit.register(shutil.rmtree, folder, ignore_errors=True)  # after the servers have ended
    with awake(), contextlib.ExitStack() as stack:
        urls = urls_of(folder, given.shards)
        found: dict[str, Any] = {"commit": records.commit(), "load_before": os.getloadavg()[0]}
        known = []
        if given.folder and given.out and given.out.exists():
            known = json.loads(given.out.read_text())["copies"]
        found["copies"] = copied(given.source, urls, known)
        if given.only_copy:
            given.out.write_text(json.dumps(found, indent=1) + "\n")
            return
        envs = {name: stack.enter_context(hapticdb.open(url)) for name, url in urls.items()}
        found["conditions"] = {
            "engine": next(iter(envs.values())).engine,
            "objects": len(next(iter(envs.values())).objects()),
            "points": 300, "poses": POSES, "prefetch_cells": BATCH,
        }  # fmt: skip
        found["frames"] = framed(envs)
        home = next(iter(envs.values()))
        found["prefetches"] = prefetched(home, {name: env.store for name, env in envs.items()})
        found["edits"] = edited(envs)
        stack.close()
    if given.out:
        given.out.write_text(json.dumps(found, indent=1) + "\n")
    else:
        json.dump(found, sys.stdout, indent=1)


if __name__ == "__main__":
    main()

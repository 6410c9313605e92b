"""Real time: frames against memory beside a dense bitmap, and sessions beside an empty loop.

    make realtime                              # the sample car, ten seconds a session
    python benchmarks/in_real_time.py --model FILE --seconds 60 --out results/realtime.json

Frames: the resident cells' kernels and the same flat loop over one dense bitmap take turns on the
same poses. Sessions: `hapticdb feel` as a user runs it, on SQLite and on a private server. Edits:
the time until a session feels a commit of another process.
"""

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import hapticdb
from awake import awake
from dense_frame import dense_bitmap, dense_feel
from editing import edits
from hapticdb import GridOptions, ImportOptions, PointShell
from hapticdb.bench import records
from hapticdb.kernels.resident.cells import BUFFERS, RESULTS
from hapticdb.kernels.resident.feeling import feel_kernel
from hapticdb.mesh import read_file
from hapticdb.poses import read_poses, write_poses
from hapticdb.resident.frames import ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import CellTable
from hapticdb.sample import write_sample
from hapticdb.store.postgres.address import with_environment
from hapticdb.store.postgres.private_server import find_binaries
from places import serving

BITS = 11
EXTENT = 1.6
"""Grid: bits an axis, and its edge as a multiple of the model's longest side."""
ROUNDS = 15
"""Number of timed passes over all poses; the result is their median."""
LIFT = 1.0
"""Way in metres by which a part is lifted out of the car."""
N_LIFTED = 40
"""Number of poses on that way."""
PARTS = ("body/hood", "body/door_front_left", "supply/fuel_tank", "seats/bench_cushion")
RUNS = {"flat": 0, "clusters": None}
"""Argument `run` of `ResidentFrames` (points of a cluster): 0 for none, None for the default."""
RATES = (1000, 5000, 10_000)
LARGE = 100_000
"""Number of points of the large shells."""
PATIENCE = 600.0
"""Seconds beyond its own duration after which a command is killed."""
SETTINGS = {"shared_buffers": "256MB"}


def measure_frames(
    database: Path, shell: PointShell, poses: NDArray[np.float64], exclude: Sequence[int]
) -> dict[str, Any]:
    """Medians, in us a frame, of the flat loop, clusters and the dense bitmap, in turns."""
    with hapticdb.open(database, read_only=True) as env, CellTable.create() as table:
        residency = Residency(env.store, table, exclude)
        frames = {name: ResidentFrames(residency, shell, run=run) for name, run in RUNS.items()}
        frames["flat"].feel(poses)
        bitmap = dense_bitmap(table.cells, table.version % BUFFERS, env.grid.side)
        first = frames["flat"]
        times: dict[str, list[float]] = {"dense": [], **{name: [] for name in RUNS}}
        found: dict[str, NDArray[np.float64]] = {}
        with table.reading() as row, awake():
            for _ in range(ROUNDS + 1):
                for name, spent in times.items():
                    out = np.zeros((len(poses), RESULTS))
                    started = time.perf_counter()
                    if name == "dense":
                        dense_feel(
                            bitmap,
                            first.clusters,
                            poses,
                            residency.place,
                            first.law,
                            first.met,
                            out,
                        )
                    else:
                        one = frames[name]
                        feel_kernel(
                            table.cells, row, one.clusters, poses, residency.place, one.law,
                            one.met, one.missed, out,
                        )  # fmt: skip
                    spent.append((time.perf_counter() - started) / len(poses) * 1e6)
                    found[name] = out
        assert all(np.array_equal(out, found["dense"]) for out in found.values()), "bit for bit"
        medians = {name: float(np.median(spent[1:])) for name, spent in times.items()}
        return {
            "points": len(shell),
            "poses": len(poses),
            "extent_m": np.ptp(shell.points, axis=0).round(3).tolist(),
            "hits": float(found["dense"][:, 6].mean()),
            "cells": residency.writer.n_resident,
            "bitmap_mb": bitmap.nbytes / 1e6,
            "us_per_frame": medians,
            "ratio": {name: medians[name] / medians["dense"] for name in RUNS},
        }


def lifted(database: Path, model: Path, name: str) -> dict[str, Any]:
    """Frames of a part of the car, with 100,000 points, that is lifted out of the car."""
    with hapticdb.open(database, read_only=True) as env:
        (own,) = [obj for obj in env.objects() if obj.name == name]
    (part,) = [part for part in read_file(model).parts if part.name == name]
    assert part.faces is not None
    placed = part.vertices @ part.world_from_part[:3, :3].T + part.world_from_part[:3, 3]
    shell = PointShell.from_mesh(placed, part.faces, points=LARGE)
    poses = np.tile(np.eye(4), (N_LIFTED, 1, 1))
    poses[:, 2, 3] = np.linspace(0.0, LIFT, N_LIFTED)
    return {"part": name} | measure_frames(database, shell, poses, [own.id])


def session(
    url: str, tool: Path, path: Path, rate: int, seconds: float, options: Sequence[str] = ()
) -> dict[str, Any]:
    """Report of `hapticdb feel`; if it fails, exit with its error text."""
    command = [
        str(Path(sys.executable).with_name("hapticdb")), "feel", url, "--tool", str(tool),
        "--device", str(path), "--loop", "--speed", "0.2", "--rate", str(rate),
        "--seconds", str(seconds), "--json", *options,
    ]  # fmt: skip
    limit = seconds + PATIENCE
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=limit)
    if done.returncode:
        raise SystemExit(done.stderr)
    report: dict[str, Any] = json.loads(done.stdout)
    return report


@contextlib.contextmanager
def environments(folder: Path, model: Path) -> Iterator[dict[str, str]]:
    """The model on SQLite and on the newest PostgreSQL found: engine -> URL."""
    options = ImportOptions(grid=GridOptions(bits=BITS, extent=EXTENT), distances=False)
    file = str(folder / "environment.db")
    hapticdb.import_files(file, [model], options)
    binaries = max(find_binaries(), key=lambda found: found.major)
    with serving(folder / "server", binaries, SETTINGS) as server:
        url = with_environment(server.conninfo(), "environment")
        hapticdb.import_files(url, [model], options)
        yield {"SQLite": file, f"PostgreSQL {binaries.major}": url}


def about() -> dict[str, Any]:
    """Commit, machine and versions: the head of both result files of a run."""
    return {
        **records.conditions(),
    }


def measure(
    folder: Path, model: Path | None, seconds: float, rates: Sequence[int]
) -> dict[str, Any]:
    """Measure frames, sessions and edits; results as records for JSON."""
    sample = write_sample(folder)
    results: dict[str, Any] = about() | {"seconds": seconds}
    with environments(folder, model or sample.car) as urls:
        database = Path(urls["SQLite"])
        tool, path = sample.wrench, sample.path
        if model is not None:
            along = folder / "along"
            command = [str(Path(sys.executable).with_name("hapticdb")), "sample", str(along)]
            command += ["--along", str(database)]
            subprocess.run(command, check=True, capture_output=True, timeout=PATIENCE)
            tool, path = along / "wrench.stl", along / "path.csv"
        with hapticdb.open(database, read_only=True) as env:
            results["object_voxels"] = sum(obj.voxels for obj in env.objects())
            results["voxel_size"] = env.grid.voxel_size
        poses = read_poses(path)
        round_trip = folder / "round_trip.csv"  # a loop without a jump back
        write_poses(round_trip, np.concatenate([poses, poses[::-1]]))
        results["frames"] = [
            {"part": "wrench, sliding"}
            | measure_frames(database, PointShell.from_file(tool, points), poses[::step], [])
            for points, step in ((300, 1), (LARGE, 20))
        ]
        if model is None:
            results["frames"] += [lifted(database, sample.car, name) for name in PARTS]
        results["sessions"] = [
            {"engine": engine} | session(url, tool, round_trip, rate, seconds)
            for engine, url in urls.items()
            for rate in rates
        ]
        results["edits"] = [
            {"engine": engine} | edits(url, tool, round_trip) for engine, url in urls.items()
        ]
    return results


def table(results: dict[str, Any]) -> str:
    """The figures as Markdown."""
    lines = [
        "| shell | points | hits | dense bitmap, us | flat, times dense | clusters, times dense |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    lines += [
        f"| {one['part']} | {one['points']:,} | {one['hits']:,.0f} | "
        f"{one['us_per_frame']['dense']:,.1f} | {one['ratio']['flat']:.2f} | "
        f"{one['ratio']['clusters']:.2f} |"
        for one in results["frames"]
    ]
    lines += [
        "",
        (
            "| engine | rate asked | rate | missed | late p50 / p99 / p99.9 / worst, us | "
            "computing, us | empty loop: rate, missed, late | unknown frames |"
        ),
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for one in results["sessions"]:
        loop, empty = one["loop"], one["empty"]
        lines.append(
            f"| {one['engine']} | {one['rate']:,.0f} | {loop['rate']:,.1f} | {loop['missed']:,} | "
            f"{_spread(loop['lateness'])} | {_spread(loop['elapsed'])} | "
            f"{empty['rate']:,.1f}, {empty['missed']:,}, {_spread(empty['lateness'])} | "
            f"{one['unknown_frames']:,} |"
        )
    lines += [
        "",
        "| engine | edits | voxels | felt after p50 / p90 / worst, ms | unknown frames |",
        "| --- | --- | --- | --- | --- |",
    ]
    for one in results["edits"]:
        felt = " / ".join(f"{ms:,.1f}" for ms in one["felt_after_ms"].values())
        lines.append(
            f"| {one['engine']} | {one['edits']:,} | {one['voxels']:,} | {felt} | "
            f"{one['unknown_frames']:,} |"
        )
    return "\n".join(lines)


def _spread(spread: dict[str, float]) -> str:
    return " / ".join(f"{1e6 * spread[name]:,.1f}" for name in ("p50", "p99", "p999", "worst"))


def main() -> None:
    """Measure, print the figures, and write them to files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--model", type=Path, help="a car or another model; the sample otherwise")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each session")
    parser.add_argument("--rates", default=",".join(map(str, RATES)), help="of the sessions, Hz")
    parser.add_argument("--out", type=Path, default=Path("results/realtime.json"))
    given = parser.parse_args()
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory(prefix="hapticdb-realtime-") as folder:
        rates = [int(word) for word in given.rates.split(",") if word]
        results = measure(Path(folder), given.model, given.seconds, rates)
    print(table(results))
    kept = about() | {"edits": results.pop("edits")}
    given.out.write_text(json.dumps(results, indent=1) + "\n")
    given.out.with_name("edits.json").write_text(json.dumps(kept, indent=1) + "\n")


if __name__ == "__main__":
    main()

"""Real time: frames against memory beside a dense bitmap, and sessions beside an empty loop.

    make realtime                              # the vintage car, or the sample car
    make realtime ARGS=--quick                 # short sessions, into results-quick/

Frames: the resident cells' kernels and the same flat loop over one dense bitmap take turns on the
same poses, and so do both laws. Sessions: `hapticdb feel` as a user runs it, on SQLite and on a
private server. Edits: the time until a session feels a commit of another process.
"""

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import hapticdb
import page_tables
import records
from awake import awake
from dense_frame import dense_bitmap, dense_feel
from editing import edits
from hapticdb import GridOptions, ImportOptions, PointShell
from hapticdb.kernels.large.budget import feel_kernel
from hapticdb.kernels.resident.cells import BUFFERS, RESULTS
from hapticdb.poses import read_poses, write_poses
from hapticdb.query.law import DistanceField, ForceLaw, TangentPlane
from hapticdb.resident.frames import ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import CellTable
from hapticdb.sample import write_sample
from hapticdb.store.postgres.address import with_environment
from hapticdb.store.postgres.private_server import find_binaries
from places import serving
from slide_paths import write_along

CAR = "demo_vintage_car/vintage_car.glb"
EXTENT = 1.6
"""Edge of the grid as a multiple of the model's longest side."""
ROUNDS = 15
"""Number of timed passes over all poses; the result is their median."""
RUNS = {"flat": 0, "clusters": None}
"""Argument `run` of `ResidentFrames` (points of a cluster): 0 for none, None for the default."""
LAWS: dict[str, ForceLaw] = {"plane": TangentPlane(), "smooth": DistanceField()}
RATES = (1000, 5000)
"""Frames a second of the sessions."""
FRAMES = 1000
"""Poses of the path over a model."""
LARGE = 100_000
"""Number of points of the large shells."""
PATIENCE = 600.0
"""Seconds beyond its own duration after which a command is killed."""


@dataclass(frozen=True)
class Effort:
    """Seconds of a session, edits that it feels, and bits of the grid on each axis."""

    seconds: float = 60.0
    edits: int = 60
    bits: int = 11


QUICK = Effort(2.0, 5, 8)
SETTINGS = {"shared_buffers": "256MB"}


def measure_frames(database: Path, shell: PointShell, poses: NDArray[np.float64]) -> dict[str, Any]:
    """Medians, in us a frame, of the flat loop, clusters and the dense bitmap, in turns."""
    with hapticdb.open(database, read_only=True) as env, CellTable.create() as table:
        residency = Residency(env.store, table)
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
                            first.hits,
                            out,
                        )
                    else:
                        one = frames[name]
                        feel_kernel(
                            table.cells, row, one.clusters, poses, residency.place, one.law,
                            one.hits, one.missed, out, one.asleep,
                        )  # fmt: skip
                    spent.append((time.perf_counter() - started) / len(poses) * 1e6)
                    found[name] = out
        assert all(np.array_equal(out, found["dense"]) for out in found.values()), "bit for bit"
        medians = {name: float(np.median(spent[1:])) for name, spent in times.items()}
        return {
            "points": len(shell),
            "poses": len(poses),
            "hits": float(found["dense"][:, 6].mean()),
            "cells": residency.writer.n_resident,
            "bitmap_mb": bitmap.nbytes / 1e6,
            "us_per_frame": medians,
            "ratio": {name: medians[name] / medians["dense"] for name in RUNS},
        }


def measure_laws(database: Path, shell: PointShell, poses: NDArray[np.float64]) -> dict[str, Any]:
    """Medians, in us a frame, of both laws over the same cells, in turns."""
    with (
        hapticdb.open(database, read_only=True) as env,
        CellTable.create(distances=True) as table,
        awake(),
    ):
        residency = Residency(env.store, table)
        frames = {name: ResidentFrames(residency, shell, law) for name, law in LAWS.items()}
        times: dict[str, list[float]] = {name: [] for name in LAWS}
        for _ in range(ROUNDS + 1):
            for name, spent in times.items():
                started = time.perf_counter()
                frames[name].feel(poses)
                spent.append((time.perf_counter() - started) / len(poses) * 1e6)
        medians = {name: float(np.median(spent[1:])) for name, spent in times.items()}
        return {
            "points": len(shell),
            "us_per_frame": medians,
            "ratio": medians["smooth"] / medians["plane"],
        }


def session(url: str, tool: Path, path: Path, rate: int, seconds: float) -> dict[str, Any]:
    """Report of `hapticdb feel`; if it fails, exit with its error text."""
    command = [
        str(Path(sys.executable).with_name("hapticdb")), "feel", url, "--tool", str(tool),
        "--device", str(path), "--loop", "--speed", "0.2", "--rate", str(rate),
        "--seconds", str(seconds), "--json",
    ]  # fmt: skip
    limit = seconds + PATIENCE
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=limit)
    if done.returncode:
        raise SystemExit(done.stderr)
    report: dict[str, Any] = json.loads(done.stdout)
    return report


@contextlib.contextmanager
def environments(folder: Path, model: Path, bits: int) -> Iterator[dict[str, str]]:
    """The model on SQLite and on the newest PostgreSQL found: engine -> URL."""
    options = ImportOptions(grid=GridOptions(bits=bits, extent=EXTENT))
    file = str(folder / "environment.db")
    hapticdb.import_files(file, [model], options)
    binaries = max(find_binaries(), key=lambda found: found.major)
    with serving(folder / "server", binaries, SETTINGS) as server:
        url = with_environment(server.conninfo(), "environment")
        hapticdb.import_files(url, [model], options)
        yield {"SQLite": file, f"PostgreSQL {binaries.major}": url}


def measure(folder: Path, model: Path | None, effort: Effort) -> dict[str, Any]:
    """Measure frames, laws, sessions and edits; results as records for JSON."""
    sample = write_sample(folder)
    results = records.conditions() | {"seconds": effort.seconds}
    with environments(folder, model or sample.car, effort.bits) as urls:
        database = Path(urls["SQLite"])
        tool, path = sample.wrench, sample.path
        if model is not None:
            tool, path = write_along(folder / "along", database, FRAMES)
        with hapticdb.open(database, read_only=True) as env:
            results["object_voxels"] = sum(obj.voxels for obj in env.objects())
        poses = read_poses(path)
        round_trip = folder / "round_trip.csv"  # a loop without a jump back
        write_poses(round_trip, np.concatenate([poses, poses[::-1]]))
        results |= {"frames": [], "laws": [], "sessions": [], "edits": []}
        for points, step in ((300, 1), (LARGE, 20)):
            shell = PointShell.from_file(tool, points)
            for kind, one in (("frames", measure_frames), ("laws", measure_laws)):
                found = one(database, shell, poses[::step])
                results[kind].append({"part": "wrench, sliding"} | found)
        for engine, url in urls.items():
            for rate in RATES:
                found = session(url, tool, round_trip, rate, effort.seconds)
                results["sessions"].append({"engine": engine} | found)
            results["edits"].append({"engine": engine} | edits(url, tool, round_trip, effort.edits))
    return results


def main() -> None:
    """Measure, and fill the tables of docs/evaluation.md."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="short sessions, a coarse sample")
    given = parser.parse_args()
    out = Path("results-quick" if given.quick else "results")
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
    real = Path(os.environ.get("HAPTICDB_TEST_DATA", ""), CAR)
    model = None if given.quick or not real.is_file() else real
    with tempfile.TemporaryDirectory(prefix="hapticdb-realtime-") as folder:
        results = measure(Path(folder), model, QUICK if given.quick else Effort())
    records.write(out, {"realtime": results})
    made = {"realtime": results}
    for one in (page_tables.frames, page_tables.laws, page_tables.sessions, page_tables.edits):
        print(one(made), end="\n\n")
    if not given.quick:
        page_tables.refill("docs/evaluation.md", out)


if __name__ == "__main__":
    main()

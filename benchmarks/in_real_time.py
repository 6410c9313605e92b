"""Real time: frames against memory beside a dense bitmap, and sessions beside an empty loop.

    make realtime                              # the vintage car, or the sample car
    make realtime ARGS=--quick                 # short sessions, into results-quick/

Frames: the resident cells' kernels and the same flat loop over one dense bitmap take turns on the
same poses, and so does the law distance. Sessions: `hapticdb feel` as a user runs it, on SQLite and
on PostgreSQL. Edits: how soon a session feels another one's commit.
"""

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
from hapticdb.kernels.records.cells import BUFFERS
from hapticdb.kernels.records.hand import RESULT
from hapticdb.kernels.resident.cell_frames import evaluate_frames
from hapticdb.poses import read_poses, write_poses
from hapticdb.query.law import DistanceField
from hapticdb.resident.frames import ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import CellTable
from hapticdb.sample import write_sample
from hapticdb.store.postgres.address import with_environment
from places import find_binaries, serving
from slide_paths import write_along

CAR = "demo_vintage_car/vintage_car.glb"
EXTENT = 1.6
"""Edge of the grid as a multiple of the model's longest side."""
ROUNDS = 7
"""Number of timed passes over all poses; the result is their median."""
FORMS: dict[str, dict[str, Any]] = {"flat": {"run": 0}, "session": {}}
"""Options of `ResidentFrames`: no clusters; as a session has it."""
RATES = (1000, 5000)
"""Frames a second of the sessions."""
FRAMES = 1000
"""Poses of the path over a model."""
SHELLS = ((300, 1000), (100_000, 200), (1_000_000, 50))
"""Points of a shell, and poses of the path at which it is felt, one after another."""
CELL_BYTES = 1 << 30
"""Bytes for cells."""
TIMEOUT = 600.0
"""Seconds beyond its own duration after which a command is killed."""


@dataclass(frozen=True)
class Effort:
    """Seconds of a session, edits that it feels, bits of the grid on each axis, sizes of shells."""

    seconds: float = 15.0
    edits: int = 30
    bits: int = 11
    shells: int = len(SHELLS)


QUICK = Effort(2.0, 5, 8, 1)
SETTINGS = {"shared_buffers": "256MB"}


def measure_frames(database: Path, shell: PointShell, poses: NDArray[np.float64]) -> dict[str, Any]:
    """Medians, in us a frame, of all ways and the dense bitmap, in turns; by distance, too."""
    with (
        hapticdb.open(database, read_only=True) as env,
        CellTable.create(CELL_BYTES, distances=True) as table,
    ):
        residency = Residency(env.store, table)
        frames = {name: ResidentFrames(residency, shell, **form) for name, form in FORMS.items()}
        frames["distance"] = ResidentFrames(residency, shell, DistanceField())
        frames["distance"].evaluate(poses)  # fetches the cells that its band reaches
        bitmap = dense_bitmap(table.cells, table.version % BUFFERS, env.grid.side)
        first = frames["flat"]
        times: dict[str, list[float]] = {"dense": [], **{name: [] for name in frames}}
        found: dict[str, NDArray[np.void]] = {}
        with table.reading() as row, awake():
            for _ in range(ROUNDS + 1):
                for name, spent in times.items():
                    out = np.zeros(len(poses), RESULT)
                    started = time.perf_counter()
                    if name == "dense":
                        place, hits = residency.cell_grid, first.hits
                        dense_feel(bitmap, first.clusters, poses, place, first.law, hits, out)
                    else:
                        one = frames[name]
                        evaluate_frames(
                            table.cells, row, one.clusters, poses, residency.cell_grid, one.law,
                            one.hits, one.missed, out,
                        )  # fmt: skip
                    spent.append((time.perf_counter() - started) / len(poses) * 1e6)
                    found[name] = out
        assert all(np.array_equal(found[name], found["dense"]) for name in FORMS), "bit for bit"
        medians = {name: float(np.median(spent[1:])) for name, spent in times.items()}
        return {
            "points": len(shell),
            "poses": len(poses),
            "hits": float(found["dense"]["hits"].mean()),
            "cells": residency.writer.n_resident,
            "bitmap_mb": bitmap.nbytes / 1e6,
            "us_per_frame": medians,
            "ratio": {name: medians[name] / medians["dense"] for name in frames},
        }


def session(
    url: str, tool: Path, path: Path, rate: int, seconds: float, *words: str
) -> dict[str, Any]:
    """Report of `hapticdb feel`, with more words; if it fails, exit with its error text."""
    command = [
        str(Path(sys.executable).with_name("hapticdb")), "feel", url, "--tool", str(tool),
        "--device", str(path), "--rate", str(rate), "--seconds", str(seconds), "--json", *words,
    ]  # fmt: skip
    limit = seconds + TIMEOUT
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
    binaries = find_binaries()[0]
    with serving(folder / "server", binaries, SETTINGS) as server:
        url = with_environment(server.conninfo(), "environment")
        hapticdb.import_files(url, [model], options)
        yield {"SQLite": file, f"PostgreSQL {binaries.major}": url}


def measure(folder: Path, model: Path | None, effort: Effort) -> dict[str, Any]:
    """Measure frames, sessions and edits; results as records for JSON."""
    sample = write_sample(folder)
    results = records.conditions() | {"seconds": effort.seconds}
    with environments(folder, model or sample.car, effort.bits) as urls:
        database = Path(urls["SQLite"])
        tool, path = sample.spanner, sample.path
        if model is not None:
            tool, path = write_along(folder / "along", database, FRAMES)
        with hapticdb.open(database, read_only=True) as env:
            results["object_voxels"] = sum(obj.voxels for obj in env.objects())
        poses = read_poses(path)
        round_trip = folder / "round_trip.csv"  # a loop without a jump back
        write_poses(round_trip, np.concatenate([poses, poses[::-1]]))
        results |= {"frames": [], "sessions": [], "edits": []}
        for points, count in SHELLS[: effort.shells]:
            shell = PointShell.from_file(tool, points)
            results["frames"].append(measure_frames(database, shell, poses[:count]))
        for engine, url in urls.items():
            for rate in RATES:
                more = "--loop", "--speed", "0.2"
                found = session(url, tool, round_trip, rate, effort.seconds, *more)
                results["sessions"].append({"engine": engine} | found)
            results["edits"].append({"engine": engine} | edits(url, tool, round_trip, effort.edits))
    return results


def main() -> None:
    """Measure, and fill the tables of docs/realtime.md."""
    is_quick, out = records.asked(__doc__, "short sessions, a coarse sample")
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
    model = None if is_quick else records.data(CAR)
    with tempfile.TemporaryDirectory(prefix="hapticdb-realtime-") as folder:
        results = measure(Path(folder), model, QUICK if is_quick else Effort())
    records.write(out, {"realtime": results})
    if not is_quick:
        page_tables.refill("docs/realtime.md", out)


if __name__ == "__main__":
    main()

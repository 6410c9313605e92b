"""What the smooth law costs beside the tangent plane: frames, and sessions at 1 and 5 kHz.

    python benchmarks/both_laws.py                      # the vintage car, or the sample car
    python benchmarks/both_laws.py --voxels 1.4e9       # and copies of the sample car

Frames of both laws take turns on the same poses: resident frames of 300 and 100,000 points, and
frames of the database by several strategies. Sessions are `hapticdb feel` as a user runs it.
"""

import argparse
import contextlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

import hapticdb
from awake import awake
from copies import Plan, Source, write_copies
from hapticdb import (
    DistanceField,
    Environment,
    GridOptions,
    ImportOptions,
    PointShell,
    TangentPlane,
)
from hapticdb.bench import records
from hapticdb.demo import write_along
from hapticdb.kernels.resident.cells import RESULTS
from hapticdb.kernels.resident.feeling import feel_kernel
from hapticdb.mesh import read_file
from hapticdb.poses import read_poses, write_poses
from hapticdb.query.frame import Strategy
from hapticdb.query.law import ForceLaw
from hapticdb.resident.frames import ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import CellTable
from hapticdb.sample import write_sample
from hapticdb.store.connect import create_store
from in_real_time import session
from report.laws_page import law_frame_table, law_session_table

Floats = NDArray[np.float64]
Line = dict[str, Any]
LAWS: dict[str, ForceLaw] = {"plane": TangentPlane(), "smooth": DistanceField()}
CAR = "demo_vintage_car/vintage_car.glb"
BITS, EXTENT = 11, 1.6
"""Grid: bits an axis, and its edge as a multiple of the model's longest side."""
ROUNDS = 15
"""Number of timed passes over all poses; the result is their median."""
STRATEGIES: tuple[Strategy, ...] = ("array", "cbgroup", "maxgap", "points")
LARGE = 100_000
"""Number of points of the large shells."""
RATES = (1000, 5000)
SEED = 20140


def in_turns(ways: dict[str, Callable[[], object]], n_frames: int) -> dict[str, float]:
    """Medians, in us a frame, of ways that take turns, after a pass of each to warm up."""
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(ROUNDS + 1):
        for name, way in ways.items():
            started = time.perf_counter()
            way()
            times[name].append((time.perf_counter() - started) / n_frames * 1e6)
    return {name: float(np.median(spent[1:])) for name, spent in times.items()}


def line_of(frame: str, shell: PointShell, poses: Floats, medians: dict[str, float]) -> Line:
    """One line of the results."""
    return {
        "frame": frame,
        "points": len(shell),
        "poses": len(poses),
        "us_per_frame": medians,
        "ratio": medians["smooth"] / medians["plane"],
    }


def resident_line(env: Environment, frame: str, shell: PointShell, poses: Floats) -> Line:
    """Frames over resident cells by both laws."""
    with CellTable.create(distances=True) as table, contextlib.ExitStack() as open_frames:
        residency = Residency(env.store, table)
        frames = {law: ResidentFrames(residency, shell, LAWS[law]) for law in LAWS}
        for one in frames.values():
            open_frames.callback(one.close)
        felt = {law: one.feel(poses) for law, one in frames.items()}
        out = np.zeros((len(poses), RESULTS))
        with table.reading() as row, awake():

            def passes(one: ResidentFrames) -> Callable[[], object]:
                return lambda: feel_kernel(
                    one.cells, row, one.clusters, poses, residency.place, one.law, one.met,
                    one.missed, out,
                )  # fmt: skip

            medians = in_turns({law: passes(one) for law, one in frames.items()}, len(poses))
        return line_of(frame, shell, poses, medians) | {
            "pushing": {law: float(one.contacts.mean()) for law, one in felt.items()},
            "cells": residency.writer.n_resident,
        }


def database_line(env: Environment, strategy: Strategy, shell: PointShell, poses: Floats) -> Line:
    """Frames of the database by both laws."""

    def passes(law: str) -> Callable[[], object]:
        return lambda: [env.touch(shell, pose, strategy, law=LAWS[law]) for pose in poses]

    with awake():
        medians = in_turns({law: passes(law) for law in LAWS}, len(poses))
    return line_of(f"database, {strategy}", shell, poses, medians)


def part_in_place(model: Path) -> tuple[str, PointShell]:
    """The part with the largest box as a shell of `LARGE` points, where the model has it."""
    parts = [part for part in read_file(model).parts if part.faces is not None]
    part = max(parts, key=lambda each: float(np.prod(np.ptp(each.vertices, axis=0))))
    placed = part.vertices @ part.world_from_part[:3, :3].T + part.world_from_part[:3, 3]
    return part.name, PointShell.from_mesh(placed, cast("NDArray[np.int64]", part.faces), LARGE)


def shaken(count: int, size: float) -> Floats:
    """Poses (count, 4, 4) within half a voxel of the identity."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = np.random.default_rng(SEED).uniform(-0.5, 0.5, (count, 3)) * size
    return poses


def frames_of(database: Path, model: Path, tool: Path, path: Path) -> list[Line]:
    """All lines of frames in one environment."""
    poses = read_poses(path)
    with hapticdb.open(database) as env:
        env.calibrate()
        small, large = (PointShell.from_file(tool, n) for n in (300, LARGE))
        name, part = part_in_place(model)
        return [
            resident_line(env, "resident, the tool sliding", small, poses),
            resident_line(env, "resident, the tool sliding", large, poses[::20]),
            resident_line(env, "resident, all touching", part, shaken(10, env.grid.voxel_size))
            | {"part": name},
            *(database_line(env, strategy, small, poses[::5]) for strategy in STRATEGIES),
        ]  # fmt: skip


def sessions_of(
    database: Path, tool: Path, path: Path, rates: Sequence[int], seconds: float
) -> list[Line]:
    """Sessions of both laws at each rate along a path, there and back."""
    poses = read_poses(path)
    round_trip = path.with_name(f"round_trip_{database.stem}.csv")  # a loop without a jump back
    write_poses(round_trip, np.concatenate([poses, poses[::-1]]))
    with hapticdb.open(database, read_only=True) as env:
        about = {
            "environment": database.stem,
            "object_voxels": sum(obj.voxels for obj in env.objects()),
            "bytes": env.size().bytes,
        }
    return [
        about
        | {"law": law}
        | session(str(database), tool, round_trip, rate, seconds, ["--law", law])
        for law in LAWS
        for rate in rates
    ]


def copied(folder: Path, n_voxels: float) -> tuple[Path, Path, Path]:
    """The sample car repeated to so many voxels, with its tool and its path at the middle copy."""
    sample = write_sample(folder / "sample")
    home, database = folder / "one.db", folder / "copies.db"
    options = ImportOptions(grid=GridOptions(bits=BITS, extent=EXTENT))
    hapticdb.import_files(home, [sample.car], options)
    with hapticdb.open(home, read_only=True) as env:
        source = Source.of(env)
    plan = Plan.of(source, max(1, round(n_voxels / source.voxels)))
    with contextlib.closing(
        create_store(database, plan.grid, source.layout, distances=True)
    ) as store:
        write_copies(store, plan, lambda n: print(f"copy {n}", file=sys.stderr, flush=True))
    poses = read_poses(sample.path)
    poses[:, :3, 3] += plan.offsets()[plan.middle]
    path = folder / "path_of_copy.csv"
    write_poses(path, poses)
    return database, sample.wrench, path


def measure(folder: Path, given: argparse.Namespace) -> dict[str, Any]:
    """Measure frames and sessions; records for JSON."""
    data = os.environ.get("HAPTICDB_TEST_DATA")
    model = Path(data, CAR) if data else write_sample(folder / "car").car
    database = folder / f"{model.stem}.db"
    options = ImportOptions(grid=GridOptions(bits=BITS, extent=EXTENT))
    hapticdb.import_files(database, [model], options)
    tool, path = write_along(folder / "along", database, frames=1000)
    rates = [int(word) for word in given.rates.split(",") if word]
    found: dict[str, Any] = {
        **records.conditions(),
        "model": model.name,
        "frames": frames_of(database, model, tool, path),
        "sessions": sessions_of(database, tool, path, rates, given.seconds),
    }
    if given.voxels:
        found["sessions"] += sessions_of(*copied(folder, given.voxels), rates, given.seconds)
    return found


def main() -> None:
    """Measure, print the figures, and write them to a file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--voxels", type=float, default=0.0, help="of copies of the sample car")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each session")
    parser.add_argument("--rates", default=",".join(map(str, RATES)), help="of the sessions, Hz")
    parser.add_argument("--out", type=Path, default=Path("results/both_laws.json"))
    parser.add_argument(
        "--folder", type=Path, help="for the environments; a temporary one unless given"
    )
    given = parser.parse_args()
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory(prefix="hapticdb-laws-", dir=given.folder) as folder:
        found = measure(Path(folder), given)
    print(law_frame_table(found), law_session_table(found), sep="\n\n")
    given.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()

"""Batches of poses: poses a second beside python-fcl, coal and Open3D, on the same questions.

    make paths                        # a real assembly of 1,428 parts, or the sample car
    python benchmarks/batches.py --quick

A tool is far from all parts (free), within a few voxels of one (near), or in contact (touching).
Every side says of each pose whether the tool touches, and how far it is from the nearest part. All
sides are built and warmed up first, and take turns in one run. hapticdb answers by the points of a
shell, in all threads and in one. "Does it touch?" is answered by the first hit, as others answer
it, and beside that by the force, also on a dense bitmap; only the first hit is compared with the
best of the others.
"""

import os
import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray

import hapticdb
import page_tables
import records
from batch_peers import PEERS, Open3DBatch, PeerMissingError
from dense_frame import dense_bitmap, dense_feel
from hapticdb import Environment, GridOptions, ImportOptions, PointShell
from hapticdb.batches.batch_tool import BatchTool
from hapticdb.kernels.records.cells import BUFFERS
from hapticdb.kernels.records.hand import RESULT
from hapticdb.mesh import read_file
from hapticdb.poses import read_poses
from hapticdb.sample import write_sample
from paper.tables import speed
from slide_paths import write_along

Floats = NDArray[np.float64]
MODEL = "assembly_vw_t1/vw_t1.glb"
"""A van of 1,428 parts, below the folder that HAPTICDB_TEST_DATA names."""
BITS, EXTENT = 11, 1.6
"""Grid: bits an axis, and its edge as a multiple of the model's longest side."""
POINTS = (300, 10_000, 100_000)
NEAR = 8.0
"""Voxels: a tool is near if it is no farther away and does not touch."""
REACH = 32.0
"""Greatest distance that hapticdb searches, voxels. A farther tool is that far away at least."""
MOST_POSES = 4096
"""Poses of each situation."""
FEW, TIMES_OF_FEW = 1000, 4
"""A tool of so many points or less gets so many times as many poses: fewer would be answered in a
few milliseconds, of which much is the call itself."""
PATH_FRAMES = 400
"""Poses of the path that a tool slides along, where poses are chosen around it."""
FIRST_POSES = 4
"""Poses with which each side begins; the number is doubled until a turn lasts long enough."""
ROUNDS = 3
"""Turns of each side. The result is the median of its rates."""
OWN, OWN_ONE = "hapticdb", "hapticdb, one thread"
FORCE, FORCE_ONE = "hapticdb, with force", "hapticdb, with force, one thread"

Answers = NDArray[Any]
Side = Callable[[Floats], Answers]


class Tool(NamedTuple):
    """A tool: its shell of points, and its triangles for those that compare triangles."""

    shell: PointShell
    mesh: tuple[Floats, NDArray[np.int64]]


class Settings(NamedTuple):
    """seconds : the least length of a turn; most_poses : of a situation; points : of the shells."""

    seconds: float
    most_poses: int = MOST_POSES
    points: tuple[int, ...] = POINTS


def poses_by_situation(
    env: Environment, shell: PointShell, path: Floats, most: int
) -> dict[str, Floats]:
    """Poses of each situation, (B, 4, 4), `most` at most: around a path and all over the scene.

    Each is a pose of the path that was turned and shifted at random, by a voxel or by metres.
    """
    rng = np.random.default_rng(0)
    n_tried = 8 * most
    poses = path[rng.integers(0, len(path), n_tried)].copy()
    far = 10.0 ** rng.uniform(0.0, 2.5, n_tried) * env.grid.voxel_size
    poses[:, :3, 3] += rng.normal(size=(n_tried, 3)) * far[:, None]
    turns = rng.uniform(-np.pi, np.pi, n_tried)
    about_z = np.tile(np.eye(4), (n_tried, 1, 1))
    about_z[:, 0, 0], about_z[:, 1, 1] = np.cos(turns), np.cos(turns)
    about_z[:, 1, 0], about_z[:, 0, 1] = np.sin(turns), -np.sin(turns)
    poses = poses @ about_z
    distances = env.clearance(shell, poses, REACH * env.grid.voxel_size).distances
    near = NEAR * env.grid.voxel_size
    chosen = {
        "free": distances > near,
        "near": (distances > 0.0) & (distances <= near),
        "touching": distances == 0.0,
    }
    return {name: poses[which][:most] for name, which in chosen.items()}


def turn(side: Side, poses: Floats, n_poses: int) -> tuple[float, Answers]:
    """Poses a second of wall time, and the answers, of one turn."""
    part, began = poses[:n_poses], time.perf_counter()
    answers = side(part)
    return n_poses / (time.perf_counter() - began), answers


def poses_for(side: Side, poses: Floats, seconds: float) -> int:
    """Number of poses with which a turn lasts about so long; warms the side up."""
    n_poses = min(FIRST_POSES, len(poses))
    side(poses[:n_poses])
    while n_poses < len(poses):
        rate, _ = turn(side, poses, n_poses)
        if n_poses / rate >= 0.5 * seconds:
            break
        n_poses = min(2 * n_poses, len(poses))
    side(poses[:n_poses])
    return n_poses


def compare(
    sides: Mapping[str, Side], poses: Floats, seconds: float, agree: Callable[..., float]
) -> dict[str, Any]:
    """Rates of all sides, in turns, and how far each agrees with hapticdb."""
    counts = {name: poses_for(side, poses, seconds) for name, side in sides.items()}
    rates: dict[str, list[float]] = {name: [] for name in sides}
    answers: dict[str, Answers] = {}
    for _ in range(ROUNDS):
        for name, side in sides.items():
            rate, answers[name] = turn(side, poses, counts[name])
            rates[name].append(rate)
    cells = {}
    for name, found in rates.items():
        n_both = min(counts[name], counts[OWN])
        cells[name] = {
            "poses": counts[name],
            "poses_per_s": float(np.median(found)),
            "agree": agree(answers[OWN][:n_both], answers[name][:n_both]),
        }
    return {"sides": cells}


def on_bitmap(tool: BatchTool, poses: Floats, side: int) -> Side:
    """The force at some of the poses, by a flat loop over a dense bitmap of their cells."""
    tool.touch(poses)  # fetches them
    frames, table = tool._frames, tool._table  # noqa: SLF001 - no user has bitmaps
    bitmap = dense_bitmap(table.cells, table.version % BUFFERS, side)

    def felt(some: Floats) -> Answers:
        out, grid = np.zeros(len(some), RESULT), frames.residency.cell_grid
        dense_feel(bitmap, frames.clusters, some, grid, frames.law, frames.hits, out)
        return out["hits"] > 0

    return felt


def measure_tool(
    env: Environment, tool: Tool, parts: list[Floats], path: Floats, settings: Settings
) -> tuple[list[dict[str, Any]], list[str]]:
    """Cells of one shell, for each situation and question, and notes of the peers not measured."""
    size, points = env.grid.voxel_size, tool.shell.points
    reach = REACH * size
    peers, notes = [], []
    for kind in PEERS:
        try:
            peers.append(kind(parts, tool.mesh))
        except PeerMissingError as error:
            notes.append(f"{kind.name}: {error}")
    for peer in peers:
        if isinstance(peer, Open3DBatch):
            peer.close = 0.5 * size
    cells: list[dict[str, Any]] = []
    with (
        env.batch_tool(tool.shell, law="plane") as all_of,
        env.batch_tool(tool.shell, law="plane", jobs=1) as one,
    ):

        def felt(batch_tool: BatchTool) -> Side:
            return lambda poses: batch_tool.touch(poses).hits > 0

        def far(batch_tool: BatchTool) -> Side:
            return lambda poses: batch_tool.clearance(poses, reach).distances

        touch: dict[str, Side] = {
            OWN: all_of.collides, OWN_ONE: one.collides, FORCE: felt(all_of), FORCE_ONE: felt(one)
        }  # fmt: skip
        distance: dict[str, Side] = {OWN: far(all_of), OWN_ONE: far(one)}
        for peer in peers:
            touch[peer.name] = partial(peer.touches, points)
            distance[peer.name] = partial(peer.distances, points)

        def agree_on_distance(own: Floats, other: Floats) -> float:
            """Share of poses that differ by less than two voxels' diagonals, within reach."""
            gap = np.minimum(np.maximum(other, 0.0), reach) - own
            return float((np.abs(gap) <= 2.0 * np.sqrt(3.0) * size).mean())

        most = settings.most_poses * (TIMES_OF_FEW if len(points) <= FEW else 1)
        for situation, poses in poses_by_situation(env, tool.shell, path, most).items():
            if not len(poses):
                notes.append(f"no pose is {situation} with {len(points)} points")
                continue
            about = {"points": len(points), "situation": situation, "poses": len(poses)}
            touch["hapticdb, dense bitmap"] = on_bitmap(one, poses, env.grid.side)
            cells.append(
                about
                | {"question": "touch"}
                | compare(touch, poses, settings.seconds, lambda a, b: float((a == b).mean()))
            )
            cells.append(
                about
                | {"question": "clearance"}
                | compare(distance, poses, settings.seconds, agree_on_distance)
            )
    return cells, notes


def measure(folder: Path, model: Path | None, bits: int, settings: Settings) -> dict[str, Any]:
    """Measure all shells; results as records for JSON."""
    sample = write_sample(folder)
    car = model or sample.car
    options = ImportOptions(grid=GridOptions(bits=bits, extent=EXTENT), distances=False)
    hapticdb.import_files(folder / "car.db", [car], options)
    load = os.getloadavg()
    parts = [part.triangles() for part in read_file(car).parts]
    cells: list[dict[str, Any]] = []
    notes: list[str] = []
    with hapticdb.open(folder / "car.db", read_only=True) as env:
        along = sample.spanner, sample.path
        if model is not None:
            along = write_along(folder / "along", folder / "car.db", PATH_FRAMES)
        path = read_poses(along[1])
        tool = trimesh.load_mesh(along[0])
        mesh = np.asarray(tool.vertices, np.float64), np.asarray(tool.faces, np.int64)
        for n_points in settings.points:
            shell = PointShell.from_file(along[0], points=n_points)
            found, missing = measure_tool(env, Tool(shell, mesh), parts, path, settings)
            cells += found
            notes += [note for note in missing if note not in notes]
        scene = {
            "model": car.name,
            "parts": len(parts),
            "triangles": sum(map(len, parts)),
            "tool_triangles": len(mesh[1]),
            "object_voxels": sum(obj.voxels for obj in env.objects()),
            "voxel_size": env.grid.voxel_size,
        }
    loads = {"load_before": load[0], "load_after": os.getloadavg()[0]}
    return records.conditions() | loads | {"scene": scene, "cells": cells, "notes": notes}


def main() -> None:
    """Measure, and fill the table of docs/evaluation.md."""
    is_quick, out = records.asked(__doc__, "short turns")
    model = records.data(MODEL)
    settings = Settings(0.1, 256, POINTS[:2]) if is_quick else Settings(0.4)
    with tempfile.TemporaryDirectory(prefix="hapticdb-batches-") as folder:
        found = measure(Path(folder), model, BITS, settings)
    records.write(out, {"batches": found})
    print(speed({"batches": found}), *found["notes"], sep="\n")
    if not is_quick:
        page_tables.refill("docs/evaluation.md", out)


if __name__ == "__main__":
    main()

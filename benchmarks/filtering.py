"""What a filter of the felt objects costs: frames with `where` beside frames without, in turns.

    python benchmarks/filtering.py                              # SQLite
    python benchmarks/filtering.py postgresql://host/database   # and a server

An environment of 4,000 spheres is made and left. `where` chooses 10, 400 and 3,990 of them by name.
Every way to answer a frame runs the same poses unfiltered and filtered, one pose after another.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

import hapticdb
from awake import awake
from hapticdb import Environment, GridOptions, ImportOptions, PointShell
from hapticdb.query.frame import STRATEGIES
from hapticdb.query.law import LawName
from hapticdb.resident.frames import ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import CellTable

Floats = NDArray[np.float64]
Frame = Callable[[Floats], object]

ACROSS = 16
"""Places along each axis of the lattice of spheres; 4,000 of the 4,096 are filled."""
N_OBJECTS = 4000
SPACING = 0.05
"""Metres from place to place; the spheres overlap."""
RADIUS = 0.03
"""Metres."""
BITS = 9
"""Bits an axis of the grid: a sphere is about 40 voxels wide."""
FEW, SOME = 10, 400
"""Objects that the first and second filter choose; the third chooses all but `FEW`."""
FILTERS: dict[int, list[str]] = {
    FEW: ["few_*"],
    SOME: ["few_*", "some_*"],
    N_OBJECTS - FEW: ["few_*", "some_*", "most_*"],
}
"""Words of `where`, by the number of objects that they choose."""
POINTS, TOOL_RADIUS = 300, 0.06
"""Points of the tool, a sphere, and its radius in metres."""
N_POSES = 40
ROUNDS = 25
"""Timed passes over all poses. More: a steadier median."""


def write_spheres(file: Path) -> None:
    """Write a GLB of all spheres, each a node of one geometry."""
    ball = trimesh.creation.icosphere(subdivisions=1, radius=RADIUS)
    scene = trimesh.Scene()
    order = np.random.default_rng(1).permutation(ACROSS**3)[:N_OBJECTS]
    groups = [(FEW, "few"), (SOME, "some"), (N_OBJECTS - FEW, "most"), (N_OBJECTS, "rest")]
    for n, place in enumerate(order.tolist()):
        placed = np.eye(4)
        placed[:3, 3] = SPACING * np.array(np.unravel_index(place, (ACROSS,) * 3))
        group = next(name for end, name in groups if n < end)
        scene.add_geometry(ball, node_name=f"{group}_{n}", geom_name="ball", transform=placed)
    file.write_bytes(scene.export(file_type="glb"))


def poses() -> Floats:
    """Places of the tool among the spheres (n, 4, 4)."""
    rng = np.random.default_rng(2)
    found = np.tile(np.eye(4), (N_POSES, 1, 1))
    # the file's y points up: the scene is turned, and its middle is where it was
    middle = SPACING * (ACROSS - 1) / 2
    found[:, :3, 3] = rng.uniform(-0.3, 0.3, (N_POSES, 3)) + np.array([middle, middle, middle])
    return found


def in_turns(frames: dict[str, Frame], where: Floats) -> dict[str, float]:
    """Median microseconds of each way to answer a frame; they take turns at every pose."""
    took: dict[str, list[float]] = {name: [] for name in frames}
    names = list(frames)
    for n in range(ROUNDS + 1):
        for m, pose in enumerate(where):
            turn = (n + m) % len(names)
            for name in (*names[turn:], *names[:turn]):
                started = time.perf_counter_ns()
                frames[name](pose)
                if n:
                    took[name].append((time.perf_counter_ns() - started) / 1000)
    return {name: float(np.median(times)) for name, times in took.items()}


def of_database(env: Environment, shell: PointShell, places: Floats) -> dict[str, Any]:
    """Figures of every strategy under each law."""
    found: dict[str, Any] = {}
    laws: tuple[LawName, ...] = ("plane", "smooth") if env.has_distances else ("plane",)
    for law in laws:
        for strategy in STRATEGIES:
            if strategy == "statement" and law == "smooth":
                continue

            frame = partial(env.touch, shell, strategy=strategy, law=law)
            frames: dict[str, Frame] = {"all": frame}
            frames |= {str(n): partial(frame, where=words) for n, words in FILTERS.items()}
            found[f"{strategy}, {law}"] = in_turns(frames, places)
    return found


def of_cells(env: Environment, shell: PointShell, places: Floats) -> dict[str, Any]:
    """Figures of frames against resident cells: a table for each filter."""
    frames: dict[str, Frame] = {}
    tables, alive = [], []
    for name, words in (("all", []), *((str(n), words) for n, words in FILTERS.items())):
        table = CellTable.create(256 << 20)
        tables.append(table)
        felt = ResidentFrames(Residency(env.store, table, where=words), shell)
        alive.append(felt)
        felt.feel(places)
        frames[name] = felt.feel
    found = in_turns(frames, places)
    for felt in alive:
        felt.close()
    for table in tables:
        table.close()
    return {"resident cells, plane": found}


def measured(url: str, file: Path) -> dict[str, Any]:
    """Figures of one environment, made if it is not there."""
    options = ImportOptions(grid=GridOptions(bits=BITS))
    hapticdb.import_files(url, [file], options)
    shell = PointShell.sphere(TOOL_RADIUS, POINTS)
    with hapticdb.open(url) as env:
        places = poses()
        for n, words in FILTERS.items():
            assert len(env.felt(words)) == n, "the filters choose what they say"
        env.calibrate()
        hits = [len(env.touch(shell, pose, law="plane").hits) for pose in places]
        found = of_database(env, shell, places) | of_cells(env, shell, places)
        conditions = {
            "engine": env.engine, "objects": len(env.objects()), "rows": env.size().rows,
            "points": POINTS, "hits, median": float(np.median(hits)), "poses": N_POSES,
            "rounds": ROUNDS,
        }  # fmt: skip
    return {"conditions": conditions, "us": found}


def show(figures: dict[str, Any]) -> None:
    """Print a table: microseconds unfiltered, and ratios."""
    print(figures["conditions"])
    for name, times in figures["us"].items():
        everything = times["all"]
        ratios = "  ".join(f"{n}: {times[str(n)] / everything:.2f}" for n in FILTERS)
        print(f"{name:24s} all: {everything:7.1f} us  {ratios}")


def main() -> None:
    """Measure SQLite, and the servers that are named."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("urls", nargs="*", help="more environments to make and measure")
    parser.add_argument("--folder", type=Path, help="where the SQLite environment is kept")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as made, awake():
        folder = given.folder or Path(made)
        file = folder / "spheres.glb"
        if not file.exists():
            write_spheres(file)
        results = []
        for url in (str(folder / "spheres.db"), *given.urls):
            results.append(measured(url, file))
            show(results[-1])
        print(json.dumps(results))


if __name__ == "__main__":
    main()

"""Inputs on which `same_bits` compares two commits: the car's environments, tool and poses.

As in `same_bits`, only public names of hapticdb and its command line are used.
"""

import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import hapticdb
from places import find_binaries, serving
from slide_paths import write_along

Floats = NDArray[np.float64]
Layout = Literal["brick", "voxel"]
CAR = Path("demo_vintage_car", "vintage_car.glb")
"""The car's file, below the folder that HAPTICDB_TEST_DATA names."""
GRID = hapticdb.GridOptions(bits=11, extent=1.6)
N_POINTS, SEED = 300, 13
ON_PATH, ANYWHERE = 0.1, 0.1
"""Shares of poses on the sample's path and anywhere in the grid; the others are at surfaces."""
HAND = slice(200, 700)
"""Poses of the path that a session's hand follows; at the first the tool touches nothing."""


class Place(NamedTuple):
    """An environment: its name in the results, its URL and its layout."""

    name: str
    url: str
    layout: Layout


class Tool(NamedTuple):
    """The tool's inputs: mesh, path, the hand's part of the path, shell, poses (n, 4, 4)."""

    mesh: Path
    path: Path
    hand: Path
    shell: hapticdb.PointShell
    poses: Floats


def command(*words: object, **variables: str) -> dict[str, Any]:
    """Run ``hapticdb`` and return its JSON; exit codes 1 and 3 are verdicts, not failures."""
    line = [sys.executable, "-m", "hapticdb", *map(str, words), "--json"]
    done = subprocess.run(
        line, env=os.environ | variables, capture_output=True, text=True, timeout=600, check=False
    )
    if done.returncode not in {0, 1, 3} or not done.stdout:
        raise SystemExit(f"{' '.join(line)} ends with {done.returncode}: {done.stderr}")
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


def import_car(folder: Path, servers: contextlib.ExitStack, *, is_quick: bool) -> list[Place]:
    """Import the car into each environment, unless the folder has it already.

    servers : gets the servers, which run until it is closed; is_quick : bricks on SQLite alone.
    """

    def place_of(word: str, url: str, layout: Layout) -> Place:
        done = folder / f"{word}.imported"
        if not done.exists():
            file = Path(os.environ["HAPTICDB_TEST_DATA"]) / CAR
            options = hapticdb.ImportOptions(grid=GRID, layout=layout, distances=False)
            (report,) = hapticdb.import_files(url, [file], options)
            if report.error is not None:
                raise report.error
            done.touch()
        with hapticdb.open(url, read_only=True) as env:
            engine, version = env.engine.split()[:2]
        major = "" if engine == "SQLite" else version.partition(".")[0]
        return Place(f"{engine.lower()}{major}-{layout}", url, layout)

    layouts: tuple[Layout, ...] = ("brick",) if is_quick else ("brick", "voxel")
    places = [place_of(layout, str(folder / f"{layout}.db"), layout) for layout in layouts]
    for found in () if is_quick else find_binaries():
        word = f"server{found.major}"
        server = servers.enter_context(serving(folder / word, found, {}))
        places.append(place_of(word, server.conninfo(), "brick"))
    return places


def sample_tool(folder: Path, place: Place, n_poses: int) -> Tool:
    """Write the sample's spanner and its path along the environment, and choose the poses."""
    mesh, path = write_along(folder / "sample", place.url, 1000)
    hand = path.with_name("hand.csv")
    slide = hapticdb.read_poses(path)
    hapticdb.write_poses(hand, slide[HAND])
    shell = hapticdb.PointShell.from_file(mesh, N_POINTS)
    with hapticdb.open(place.url, read_only=True) as env:
        poses = choose_poses(env, shell, slide, n_poses)
    return Tool(mesh, path, hand, shell, poses)


def choose_poses(
    env: hapticdb.Environment, shell: hapticdb.PointShell, path: Floats, n_poses: int
) -> Floats:
    """Poses (n, 4, 4): anywhere, with one of the shell's points near a voxel, and on the path."""
    rng = np.random.default_rng(SEED)
    size, objects = env.grid.voxel_size, env.objects()
    poses = np.tile(np.eye(4), (n_poses, 1, 1))
    poses[:, :3, :3] = Rotation.random(n_poses, rng).as_matrix()
    chosen, share = rng.integers(len(objects), size=n_poses), rng.random(n_poses)
    places = rng.normal(scale=size, size=(n_poses, 3))
    for at in np.unique(chosen):
        voxels, mine = env.voxels(objects[at].id), np.flatnonzero(chosen == at)
        places[mine] += env.grid.centers(voxels[(share[mine] * len(voxels)).astype(np.int64)])
    points = shell.points[rng.integers(len(shell), size=n_poses)]
    poses[:, :3, 3] = places - (poses[:, :3, :3] * points[:, None, :]).sum(axis=2)
    n_anywhere, n_on_path = round(ANYWHERE * n_poses), min(round(ON_PATH * n_poses), len(path))
    edge = env.grid.side * size
    anywhere = np.array(env.grid.origin) + edge * rng.uniform(-0.1, 1.1, size=(n_anywhere, 3))
    poses[:n_anywhere, :3, 3] = anywhere
    poses[n_poses - n_on_path :] = path[:n_on_path]
    return poses

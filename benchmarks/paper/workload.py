"""Shells, poses and regions of the experiments, all fixed by a seed.

Everything is drawn from the environment's own surface, so that the same experiments run on any.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticdb.environment import Environment
from hapticdb.ingest.layout import voxels_of_rows
from hapticdb.pointshell.shell import PointShell
from hapticdb.store.base import row_shift
from hapticdb.store.covering import box_ranges
from slide_paths import slide_along

POINTS = 300
"""The paper's PointShell."""
RADIUS_VOXELS = 12.0
"""Radius of the sphere with that many points, voxels. A larger one spreads the points farther."""
POSES = 1000
"""Poses of a task, unless a budget says otherwise."""
WINDOW = 64
"""Edge of the windows whose density is measured, voxels."""
WINDOWS = 400
"""Windows whose density is measured. More find the percentiles more exactly, and take longer."""
PERCENTILES = {"low": 10, "middle": 50, "high": 90}
"""Percentile of the windows' densities that each region stands for."""
SEED = 20
"""Of all random poses and windows."""

INPUTS = {
    "sphere": f"{POINTS} points spread evenly over a sphere, radius {RADIUS_VOXELS:g} voxels",
    "slide": "poses that slide the shell over the largest objects, from above",
    "random": f"poses turned at random, near voxels drawn evenly over the index, seed {SEED}",
    "regions": f"windows of {WINDOW}^3 around drawn surface voxels: the 10th, 50th and 90th "
    "percentile of their share of occupied voxels (low, middle, high)",
}
"""What the experiments are measured on, in words."""

Poses = NDArray[np.float64]


@dataclass(frozen=True)
class Task:
    """A shell and where it goes.

    name : ``slide`` or ``random``; region, density : name and density of the window that the poses
    stay in, if any.
    """

    name: str
    shell: PointShell
    poses: Poses
    region: str = ""
    density: float = 0.0


class Region(NamedTuple):
    """A window chosen by its density: share of its voxels that are occupied; poses in it."""

    name: str
    density: float
    poses: Poses


def sphere_shell(
    voxel_size: float, points: int = POINTS, radius_voxels: float = RADIUS_VOXELS
) -> PointShell:
    """Shell of a sphere whose size in voxels is the same in every environment."""
    return PointShell.sphere(radius_voxels * voxel_size, points)


def slide_poses(env: Environment, shell: PointShell, count: int = POSES) -> Poses:
    """Poses (count, 4, 4) that slide a shell over the environment's largest objects."""
    return slide_along(env, shell.points, count)


def random_poses(
    env: Environment,
    count: int = POSES,
    seed: int = SEED,
    reach_voxels: float = RADIUS_VOXELS,
) -> Poses:
    """Poses (count, 4, 4) near surfaces: turned at random, the middle within reach of one."""
    rng = np.random.default_rng(seed)
    return _poses_near(env, surface_voxels(env, count, rng), rng, reach_voxels)


def surface_voxels(env: Environment, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Occupied voxels (count, 3), drawn evenly over the rows of the index table."""
    quantiles = env.quantiles()
    row_keys = rng.choice(quantiles.bounds, size=count)
    with env.store.snapshot():
        rows = env.store.lookup(np.unique(row_keys))
    # a server's own statistics are a sample: some of its keys may be gone
    row_keys = rng.choice(np.unique(rows.keys), size=count)
    voxels = voxels_of_rows(rows, env.grid, env.layout)
    held = env.grid.encode(voxels) >> row_shift(env.layout)
    first, after = np.searchsorted(held, row_keys), np.searchsorted(held, row_keys, "right")
    return np.asarray(voxels[rng.integers(first, after)])


def _poses_near(
    env: Environment, voxels: NDArray[np.int64], rng: np.random.Generator, reach_voxels: float
) -> Poses:
    """Turned at random, with the middle within reach of each voxel (M, 3)."""
    count = len(voxels)
    away = rng.normal(size=(count, 3))
    away /= np.linalg.norm(away, axis=1)[:, None]
    distance = rng.uniform(0.5, 1.0, size=(count, 1)) * reach_voxels * env.grid.voxel_size
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, random_state=rng).as_matrix()
    poses[:, :3, 3] = env.grid.centers(voxels) + away * distance
    return poses


def regions(env: Environment, count: int, seed: int = SEED, windows: int = WINDOWS) -> list[Region]:
    """Windows of low, middle and high density among those around surface voxels, with poses.

    Density is the share of occupied voxels in a window of 64^3 around a voxel drawn from the
    surface; the windows are those at the 10th, 50th and 90th percentile.

    count : poses in each; windows : how many are measured, around voxels drawn with the seed.
    """
    rng = np.random.default_rng(seed)
    side = min(WINDOW, env.grid.side)
    drawn = surface_voxels(env, windows, rng)
    # aligned to bricks, so that a window is whole bricks
    corners = np.clip((drawn // 8) * 8 - side // 2, 0, env.grid.side - side)
    densities = np.array([len(window_voxels(env, corner, side)) for corner in corners]) / side**3
    found = []
    for name, percentile in PERCENTILES.items():
        wanted = np.percentile(densities, percentile)
        at = int(np.argmin(np.abs(densities - wanted)))
        inside = window_voxels(env, corners[at], side)
        voxels = inside[rng.integers(len(inside), size=count)]
        poses = _poses_near(env, voxels, rng, RADIUS_VOXELS)
        found.append(Region(name, float(densities[at]), poses))
    return found


def window_voxels(env: Environment, corner: NDArray[np.int64], side: int) -> NDArray[np.int64]:
    """Occupied voxels (V, 3), each once, of a cube of that edge at `corner` (3,)."""
    lows, highs = box_ranges(env.grid, env.layout, corner, corner + side - 1)
    voxels = voxels_of_rows(env.store.scan(lows, highs), env.grid, env.layout)
    inside = voxels[np.all((voxels >= corner) & (voxels < corner + side), axis=1)]
    return env.grid.decode(np.unique(env.grid.encode(inside)))

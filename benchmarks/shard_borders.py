"""Ranges of the curve against hashed cells: how many shards a frame and a prefetch touch.

    HAPTICDB_TEST_DATA=DATA python benchmarks/shard_borders.py    # the vintage car or the sample

Ranges: borders at quantiles of the rows, on whole cells. Hashed: the cell's number, mixed, modulo
the number of shards. No server is asked; shards are counted on the keys of real frames.
"""

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import hapticdb
from hapticdb import Environment, PointShell
from hapticdb.bench import records
from hapticdb.bench.workload import random_poses, slide_poses
from hapticdb.sample import write_sample
from served import car_or_sample

Keys = NDArray[np.int64]
CELL_SHIFT = 15
BRICKS_A_CELL_SHIFT = 6
SHARDS = (2, 3, 4, 8, 16)
POINTS = 300
RADIUS = 24.0
"""Radius of the ball, voxels."""
PREFETCHED = 256
"""Cells of a prefetch: those nearest to the tool."""
N_POSES = 400
BITS = 10
"""Bits an axis of the car's grid."""


def mixed(cells: Keys) -> NDArray[np.uint64]:
    """Cells' numbers with their bits mixed well (splitmix64)."""
    z = cells.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(z ^ (z >> np.uint64(31)), dtype=np.uint64)


class Spread:
    """Rows' cells (R,), ascending, on a number of shards, by one of both rules."""

    def __init__(self, cells: Keys, count: int, *, is_range: bool) -> None:
        self._count = count
        at = [len(cells) * n // count for n in range(1, count)]
        self._borders = cells[at] if is_range else None
        rows = np.bincount(self.of(cells), minlength=count)
        self.balance = float(rows.max() / rows.mean())

    def of(self, cells: Keys) -> Keys:
        """Shard of each cell."""
        if self._borders is not None:
            return np.searchsorted(self._borders, cells, side="right")
        return (mixed(cells) % np.uint64(self._count)).astype(np.int64)

    def touched(self, frames: list[Keys]) -> dict[str, float]:
        """Shards that a frame touches: the mean, the most, and the share of frames with one."""
        counts = np.array([len(np.unique(self.of(cells))) for cells in frames])
        return {
            "mean": float(counts.mean()),
            "most": int(counts.max()),
            "one": float(np.mean(counts == 1)),
        }


def frames_of(env: Environment, shell: PointShell, poses: NDArray[np.float64]) -> list[Keys]:
    """Cells of the shell's points inside the grid, at each pose."""
    found = []
    for pose in poses:
        voxels = env.grid.voxels_of(shell.points @ pose[:3, :3].T + pose[:3, 3])
        keys = env.grid.encode(voxels[env.grid.contains(voxels)])
        found.append(np.unique(keys >> CELL_SHIFT))
    return [cells for cells in found if len(cells)]


def prefetches_of(env: Environment, poses: NDArray[np.float64]) -> list[Keys]:
    """The cells nearest to the tool, occupied or not: what a session keeps around it."""
    side = env.grid.side >> 5
    axis = np.arange(side)
    cells = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    numbers = env.grid.encode(cells << 5) >> CELL_SHIFT
    found = []
    for pose in poses:
        at = env.grid.to_voxel_units(pose[:3, 3]) / 32 - 0.5
        far = ((cells - at) ** 2).sum(axis=1)
        count = min(PREFETCHED, len(cells) - 1)
        found.append(np.sort(numbers[np.argpartition(far, count)[:count]]))
    return found


def counted(env: Environment) -> list[dict[str, Any]]:
    """A line for each number of shards, rule and kind of poses."""
    whole = np.array([0], dtype=np.int64), np.array([8**env.grid.bits], dtype=np.int64)
    cells = env.store.scan(*whole).keys >> BRICKS_A_CELL_SHIFT
    shell = PointShell.sphere(RADIUS * env.grid.voxel_size, POINTS)
    lines = []
    for kind, poses in (
        ("slide", slide_poses(env, shell, N_POSES)),
        ("random", random_poses(env, N_POSES)),
    ):
        frames, prefetches = frames_of(env, shell, poses), prefetches_of(env, poses)
        for count in SHARDS:
            for is_range in (True, False):
                spread = Spread(cells, count, is_range=is_range)
                lines.append(
                    {
                        "shards": count,
                        "rule": "ranges" if is_range else "hash",
                        "poses": kind,
                        "most_rows_over_mean": spread.balance,
                        "frame": spread.touched(frames),
                        "prefetch": spread.touched(prefetches),
                    }
                )
    return lines


def main() -> None:
    """Count, print lines, and write them to a file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--url", help="of an environment in bricks")
    parser.add_argument("--out", type=Path, default=Path("results/shard_borders.json"))
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="hapticdb-borders-") as folder:
        sample = write_sample(Path(folder) / "sample")
        url = given.url or car_or_sample(Path(folder), sample.car, BITS)
        with hapticdb.open(url, read_only=True) as env:
            lines = counted(env)
            rows = env.quantiles().n_rows
    found = {
        **records.conditions(),
        "environment": Path(url).stem,
        "rows": rows,
        "points": POINTS,
        "prefetched_cells": PREFETCHED,
        "lines": lines,
    }
    for line in lines:
        print(json.dumps(line))
    given.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()

"""Environments, shells and poses for the tests of resident cells."""

import dataclasses
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import hapticdb
from hapticdb import Environment, Grid, PointShell
from hapticdb.grid import CurveName
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.kernels.force_law import TangentPlaneLaw
from hapticdb.kernels.records.cells import MISSED
from hapticdb.kernels.records.hand import RESULT
from hapticdb.kernels.resident.cell_frames import evaluate_frames
from hapticdb.kernels.resident.cells import CellGrid, Cells
from hapticdb.paper.cost_model import CostModel, machine_name
from hapticdb.resident.point_runs import clusters_of
from hapticdb.resident.table import CellTable
from hapticdb.store.base import Layout, Store
from naive import Voxel
from voxels import voxel_object, write_voxels

Voxels = NDArray[np.int64]
HIERARCHICAL: list[tuple[Layout, CurveName]] = [
    ("voxel", "z"),
    ("voxel", "hilbert"),
    ("brick", "z"),
    ("brick", "hilbert"),
]
SIZE = 0.002
"""Voxel size in metres."""


def make(
    folder: Path, bits: int = 7, layout: Layout = "brick", curve: CurveName = "z"
) -> Environment:
    """An empty environment with 2 mm voxels; the world's origin is the grid's middle.

    Cost figures are kept in it, so that nothing is measured.
    """
    half = SIZE * (1 << bits) / 2
    grid = Grid(SIZE, (-half, -half, -half), bits, curve)
    env = hapticdb.create(folder / f"{layout}-{curve}-{bits}.db", grid, layout=layout)
    env.store.save_costs(machine_name(), CostModel.of_equal_parts().figures())
    return env


def scatter(env: Environment, n_objects: int = 3, n_voxels: int = 4000, seed: int = 0) -> None:
    """Write objects of random voxels, in clumps; some voxels belong to several objects."""
    rng = np.random.default_rng(seed)
    side = env.grid.side
    for n in range(n_objects):
        centers = rng.integers(0, side, (12, 3))
        ijk = centers[rng.integers(0, 12, n_voxels)] + rng.integers(-9, 10, (n_voxels, 3))
        ijk = np.unique(ijk[env.grid.contains(ijk)], axis=0)
        write_voxels(env.store, ijk, f"object {n}")


def ids_by_voxel(env: Environment) -> dict[Voxel, list[int]]:
    """Voxel -> ids of the objects in the voxel."""
    found: dict[Voxel, list[int]] = {}
    for obj in env.objects():
        for i, j, k in env.voxels(obj.id).tolist():
            found.setdefault((i, j, k), []).append(obj.id)
    return found


def move(store: Store, object_id: int, ijk: Voxels) -> None:
    """Replace an object's voxels by `ijk`, in one transaction."""
    before = store.object(object_id)
    after = voxel_object(store.grid, ijk, before.name)
    record = dataclasses.replace(
        before, voxels=after.voxels, bounds=after.bounds, digest=after.digest
    )
    store.replace(record, rows_of_voxels(ijk, store.grid, store.layout))


def block(low: Iterable[int], high: Iterable[int]) -> Voxels:
    """Voxels (n, 3) from one corner to the other, both included."""
    axes = [np.arange(a, b + 1) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def cells_of(grid: Grid) -> Voxels:
    """Keys of all cells of a grid, in the form that cell directories use."""
    n = max(grid.side >> 5, 1)
    ijk = block((0, 0, 0), (n - 1, n - 1, n - 1))
    return (ijk[:, 0] << 32) | (ijk[:, 1] << 16) | ijk[:, 2]


def cloud(n_points: int, seed: int = 0, extent: float = 0.02) -> PointShell:
    """A shell of random points about the tool's origin, with random normals."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(n_points, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    points = rng.normal(0, extent, (n_points, 3))
    return PointShell(points[np.argsort(points[:, 0])], normals, np.array([0.001, 0.002, -0.003]))


def random_shell(seed: int, n_points: int, reach: float, size: float) -> PointShell:
    """A shell of random points within a reach, in voxels of a size, with random normals."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(n_points, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    points = rng.uniform(-reach, reach, (n_points, 3)) * size
    return PointShell(points=points, normals=normals, center=rng.normal(size=3) * size)


def turned(rng: np.random.Generator, place: NDArray[np.float64]) -> NDArray[np.float64]:
    """A pose (4, 4) at a place (3,), with a random rotation."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    if np.linalg.det(q) < 0:
        q[:, 0] *= -1
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = q, place
    return pose


def poses_in(grid: Grid, count: int, seed: int = 0, beyond: float = 0.1) -> NDArray[np.float64]:
    """Poses (count, 4, 4) in a grid and up to `beyond` times its edge outside the grid."""
    rng = np.random.default_rng(seed)
    low, high = grid.bounds
    spare = beyond * grid.edge
    return np.stack([turned(rng, rng.uniform(low - spare, high + spare)) for _ in range(count)])


class Reader:
    """Frames of one reader of a cell table; the reader fetches nothing."""

    def __init__(self, table: CellTable, grid: Grid, shell: PointShell) -> None:
        self.table = table
        self.cells: Cells = table.cells
        self.place = CellGrid(*grid.origin, grid.voxel_size, float(grid.side))
        self.clusters = clusters_of(shell, grid.voxel_size)
        self.row = table.join()
        self.hits = np.empty(len(shell), dtype=np.int64)
        self.missed = np.zeros((), MISSED)
        self.out = np.zeros(1, RESULT)

    def evaluate(self, pose: NDArray[np.float64]) -> tuple[list[int], bytes, int]:
        """Hits, wrench and number of unknown points."""
        evaluate_frames(
            self.cells, self.row, self.clusters, pose[None], self.place,
            TangentPlaneLaw(1000.0), self.hits, self.missed, self.out,
        )  # fmt: skip
        row = self.out[0]
        wrench = row["wrench"] + 0.0  # turns -0.0 into 0.0
        return self.hits[: int(row["hits"])].tolist(), wrench.tobytes(), int(row["unknown"])

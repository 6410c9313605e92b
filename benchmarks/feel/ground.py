"""Ground: scenes imported into a temporary environment, and their cells in memory.

The scenes go the way of a user's files: written as a mesh, imported, stored, fetched into cells.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from feel.scenes import SEED, Scene
from hapticdb.environment import Environment, create
from hapticdb.environment import open as open_environment
from hapticdb.errors import UsageError
from hapticdb.grid import Grid
from hapticdb.kernels.resident import cell_table as kernels
from hapticdb.kernels.resident.cells import UNKNOWN
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import CellTable

Floats = NDArray[np.float64]

APART = 24.0
"""Voxels between the reaches of two scenes. Smaller: a tool in one scene might meet the next."""
BUDGET = 128 << 20
"""Memory for cells, bytes. Larger: more or larger scenes fit at once."""
CELL = 32.0
"""Edge of a cell, voxels."""


class Ground:
    """An opened environment with all its scenes in memory. Also a context manager.

    url : an environment, which `of_scenes` makes; origins : origin (3,) of each scene, metres,
    world frame; distances : whether the cells have distances, which the environment must hold then.
    """

    def __init__(
        self,
        url: Path | str,
        origins: dict[str, Floats] | None = None,
        *,
        distances: bool = False,
    ) -> None:
        self.environment: Environment = open_environment(url, read_only=True)
        self.origins = origins or {}
        self.table = CellTable.create(BUDGET, distances=distances)
        self.residency = Residency(self.environment.store, self.table)
        self.size = self.environment.grid.voxel_size

    @classmethod
    def of_scenes(
        cls, folder: Path, scenes: Sequence[Scene], voxel_size: float, *, distances: bool
    ) -> Self:
        """Import scenes, far apart and not aligned to the grid, and fetch their cells.

        Parameters
        ----------
        folder : Path
            For the mesh and the database; they get a name of their own.
        voxel_size : float
            Metres.
        distances : bool
            Whether the environment holds distances to surfaces, for the distance law.
        """
        pitch = 2.0 * max(scene.reach for scene in scenes) + APART
        n_a_side = math.ceil(round(len(scenes) ** (1 / 3), 9))
        slots = np.stack(np.unravel_index(np.arange(len(scenes)), (n_a_side,) * 3), axis=1)
        shifts = np.random.default_rng(SEED).uniform(-0.5, 0.5, (len(scenes), 3))
        places = (slots + 0.5) * pitch + shifts
        name = f"ground-{len(list(folder.iterdir()))}"
        mesh, url = folder / f"{name}.obj", folder / f"{name}.db"
        triangles = [scene.triangles + place for scene, place in zip(scenes, places, strict=True)]
        write_mesh(mesh, np.concatenate(triangles) * voxel_size)
        bits = max(math.ceil(math.log2(n_a_side * pitch)), 5)
        grid = Grid(voxel_size, (0.0, 0.0, 0.0), bits)
        with create(url, grid, distances=distances) as environment:
            environment.add(mesh)
            if distances and not environment.has_distances:
                raise UsageError("imported parts have no distances to their surfaces")
        origins = {s.name: p * voxel_size for s, p in zip(scenes, places, strict=True)}
        ground = cls(url, origins, distances=distances)
        for scene in scenes:
            ground.fetch(origins[scene.name], scene.reach)
        return ground

    def fetch(self, place: Floats, reach: float) -> None:
        """Make the cells within `reach` voxels of a place (3,) resident, on each axis."""
        n = math.ceil(reach / CELL)
        steps = np.linspace(-reach, reach, 2 * n + 1) * self.size
        lattice = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3) + place
        found = np.full(1 << (8 * len(lattice) - 1).bit_length(), UNKNOWN, dtype=np.int64)
        kernels.cells_in_reach(
            lattice, 0, 0, 0.0, np.eye(4)[None], self.residency.cell_grid, found, len(found) // 2
        )
        self.residency.make_resident(found[found >= 0])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the environment and free the memory."""
        self.environment.close()
        self.table.close()


def write_mesh(path: Path, triangles: Floats) -> None:
    """Write triangles (T, 3, 3), metres, as an OBJ file, every digit of their numbers."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in triangles.reshape(-1, 3).tolist()]
    lines += [f"f {n} {n + 1} {n + 2}" for n in range(1, 3 * len(triangles), 3)]
    path.write_text("\n".join(lines) + "\n")

"""Scenes in closed form, imported into a temporary environment, and their cells in memory.

They go the way of a user's files: written as a mesh, imported, stored, fetched into cells. Lengths
of a scene are in voxels. Its x and y lie along its surface, z points away from it; its origin lies
on the surface. Tools lie exactly along a surface, or are balls.
"""

import contextlib
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from hapticdb.environment import Environment, create
from hapticdb.environment import open as open_environment
from hapticdb.errors import UsageError
from hapticdb.grid import Grid
from hapticdb.kernels.field.distance_law import ONSET
from hapticdb.kernels.resident import cell_table as kernels
from hapticdb.kernels.resident.cells import UNKNOWN
from hapticdb.pointshell.shell import PointShell
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import CellTable

Floats = NDArray[np.float64]

HALF = 30.0
"""Half edge of a scene, voxels. Larger: tools may slide farther, and environments are larger."""
SLOPES = (0.0, 5.0, 20.0, 45.0)
"""Angles of the named planes to the grid, degrees."""
N_RANDOM = 24
"""Planes of random orientation. More: the worst one is found more surely."""
SEED = 14
"""Of all random orientations and places."""
SIZE = 0.005
"""Voxel size, metres, where a measure names no other."""
FILLING = (0.0, 0.45, 0.9, 1.35, 1.8, 2.25, 2.7)
"""Depths, voxels, of the sheets of a scene that is solid for the tangent plane: no voxel between
two of them stays free. The plane law has no force where a point has left the one layer of voxels
that a single sheet marks."""
PITCH = 0.7
"""Distance of neighbouring points of a flat tool, voxels. A whole number would put all points into
the same place within their voxels."""
APART = 24.0
"""Voxels between the reaches of two scenes. Smaller: a tool in one scene might meet the next."""
BUDGET = 128 << 20
"""Memory for cells, bytes. Larger: more or larger scenes fit at once."""
CELL = 32.0
"""Edge of a cell, voxels."""


class Scene(NamedTuple):
    """A surface in closed form, in which tools may be up to `HALF` voxels from the origin.

    name : of its own among the scenes of an environment; triangles (T, 3, 3), voxels, about the
    scene's origin, world axes; axes (3, 3): columns x, y, z of the scene in the world.
    """

    name: str
    triangles: Floats
    axes: Floats

    @classmethod
    def of(cls, name: str, axes: Floats, quads: ArrayLike) -> Self:
        """Flat figures with corners (Q, 4, 3) in order, in the scene's axes."""
        corners = np.asarray(quads, dtype=np.float64)[:, [[0, 1, 2], [0, 2, 3]]]
        return cls(name, corners.reshape(-1, 3, 3) @ axes.T, axes)


def slope_axes(degrees: float) -> Floats:
    """Axes of a plane that rises by an angle along the world's x axis."""
    return np.asarray(Rotation.from_euler("y", -degrees, degrees=True).as_matrix())


def planes(layers: Sequence[float] = (0.0,), n_random: int = N_RANDOM) -> list[Scene]:
    """Squares at the slopes of `SLOPES`, and random ones; layers : depths of each one's sheets."""
    h = HALF
    quads = [[[-h, -h, -z], [h, -h, -z], [h, h, -z], [-h, h, -z]] for z in layers]
    axes = {f"{slope:g} degrees": slope_axes(slope) for slope in SLOPES}
    turned = Rotation.random(N_RANDOM, random_state=SEED).as_matrix()[:n_random]
    axes |= {f"random {n}": one for n, one in enumerate(turned, 1)}
    return [Scene.of(name, one, quads) for name, one in axes.items()]


def convex_edge(axes: Floats) -> Scene:
    """An edge of 90 degrees along y: the solid is where x < 0 and z < 0."""
    h = HALF
    top = [[-h, -h, 0.0], [0.0, -h, 0.0], [0.0, h, 0.0], [-h, h, 0.0]]
    side = [[0.0, -h, -h], [0.0, h, -h], [0.0, h, 0.0], [0.0, -h, 0.0]]
    return Scene.of("convex edge", axes, [top, side])


def flat_tool(n_across: int, voxel_size: float, axes: Floats) -> PointShell:
    """A square of n_across^2 points in the plane of a scene's x and y; its inside is at +z."""
    across = (np.arange(n_across) - (n_across - 1) / 2.0) * PITCH * voxel_size
    x, y = np.meshgrid(across, across, indexing="ij")
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(n_across**2)]) @ axes.T
    normals = np.tile(axes[:, 2], (len(points), 1))
    return PointShell(points, normals, np.zeros(3), is_closed=False)


def posed(position: Floats) -> Floats:
    """Pose (4, 4), upright, at a position (3,)."""
    pose = np.eye(4)
    pose[:3, 3] = position
    return pose


class Stand(NamedTuple):
    """A place on a plane: the onset of contact there (3,), metres, and the scene's axes (3, 3)."""

    onset: Floats
    axes: Floats

    @property
    def normal(self) -> Floats:
        """Unit vector (3,) away from the surface."""
        return np.asarray(self.axes[:, 2])

    def at(self, depth: float, along: float = 0.0) -> Floats:
        """Point (3,) at a depth below the onset, and metres along, askew to both axes."""
        way = np.cos(np.pi / 6) * self.axes[:, 0] + np.sin(np.pi / 6) * self.axes[:, 1]
        return np.asarray(self.onset - depth * self.normal + along * way)


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
        distances: bool = True,
    ) -> None:
        self.environment: Environment = open_environment(url, read_only=True)
        self.origins = origins or {}
        self.table = CellTable.create(BUDGET, distances=distances)
        self.residency = Residency(self.environment.store, self.table)
        self.size = self.environment.grid.voxel_size

    @classmethod
    def of_scenes(
        cls,
        folder: Path,
        scenes: Sequence[Scene],
        voxel_size: float = SIZE,
        *,
        distances: bool = True,
    ) -> Self:
        """Import scenes, far apart and not aligned to the grid, and fetch their cells.

        folder : for mesh and database, which get a name of their own; voxel_size in metres.
        """
        pitch = 2.0 * HALF + APART
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
        for origin in origins.values():
            ground.fetch(origin, HALF)
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

    def stand(self, scene: Scene) -> Stand:
        """The onset of contact over a scene's origin."""
        return Stand(self.origins[scene.name] + ONSET * self.size * scene.axes[:, 2], scene.axes)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.environment.close()
        self.table.close()


@contextlib.contextmanager
def on_slope(folder: Path, voxel_size: float = SIZE) -> Iterator[tuple[Ground, Stand]]:
    """The plane at 20 degrees alone, and the onset of contact on it."""
    (scene,) = (one for one in planes(n_random=0) if one.name == "20 degrees")
    with Ground.of_scenes(folder, [scene], voxel_size) as ground:
        yield ground, ground.stand(scene)


def write_mesh(path: Path, triangles: Floats) -> None:
    """Write triangles (T, 3, 3), metres, as an OBJ file, every digit of their numbers."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in triangles.reshape(-1, 3).tolist()]
    lines += [f"f {n} {n + 1} {n + 2}" for n in range(1, 3 * len(triangles), 3)]
    path.write_text("\n".join(lines) + "\n")

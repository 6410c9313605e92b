"""Object voxels a second: hapticdb, Open3D and trimesh on the parts of one assembly.

Each tool voxelizes part by part, so that all count object voxels: each part's, once for each part.
Their counts differ by some hundredths, as their boxes are not closed in the same way. A slow tool
gets as many parts as its time allows, drawn by a fixed seed; its cell says how many.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray

from hapticdb.bench.measure import Cell
from hapticdb.kernels.surfaces.voxelize import count_voxels, voxelize
from hapticdb.mesh import read_file
from peers import INSTALL, PeerMissingError
from peers.run import PeerResults

BITS = 10
EDGE = 2.0**BITS
ROUNDS = 3
SEED = 4
MOST_HALVINGS = 24
"""Of a triangle's edges, until none is longer than half a voxel: trimesh gives up at 10."""
Triangles = NDArray[np.float64]


class VoxelizingTool(NamedTuple):
    """A voxelizer; only `make` is timed.

    take : a part (T, 3, 3), in voxels of the grid, into the tool's own mesh; make : the mesh into
    voxels; count : the voxels.
    """

    take: Callable[[Triangles], Any]
    make: Callable[[Any], Any]
    count: Callable[[Any], int]


class CadAssembly(NamedTuple):
    """Parts (T, 3, 3) in voxels of the tight cube, and the name of the model that they make."""

    name: str
    parts: list[Triangles]


def tight(name: str, parts: Sequence[Triangles]) -> CadAssembly:
    """Parts in metres into the tight cube: its edge is the longest side, a hair larger."""
    low = np.min([part.min(axis=(0, 1)) for part in parts], axis=0)
    high = np.max([part.max(axis=(0, 1)) for part in parts], axis=0)
    scale = EDGE * (1 - 1e-9) / float((high - low).max())
    return CadAssembly(name, [(part - low) * scale for part in parts])


def read_assembly(path: Path) -> CadAssembly:
    """All parts of a file, every instance a part of its own."""
    parts = [part.triangles() for part in read_file(path).parts]
    return tight(path.name, [part for part in parts if len(part)])


def by_hapticdb() -> VoxelizingTool:
    return VoxelizingTool(lambda part: part, lambda part: voxelize(part, BITS)[1], count_voxels)


def by_open3d() -> VoxelizingTool:
    """Open3D's grid, one a part.

    Raises
    ------
    PeerMissingError
        When it does not load.
    """
    try:
        open3d = import_module("open3d")
    except (ImportError, OSError) as error:
        raise PeerMissingError(INSTALL) from error
    voxels_within = open3d.geometry.VoxelGrid.create_from_triangle_mesh_within_bounds
    corner, far = np.zeros(3), np.full(3, EDGE)

    def take(part: Triangles) -> Any:  # noqa: ANN401 - Open3D is not always there
        points = open3d.utility.Vector3dVector(part.reshape(-1, 3))
        faces = np.arange(3 * len(part), dtype=np.int32).reshape(-1, 3)
        return open3d.geometry.TriangleMesh(points, open3d.utility.Vector3iVector(faces))

    return VoxelizingTool(
        take,
        lambda mesh: voxels_within(mesh, 1.0, corner, far),
        lambda grid: len(grid.get_voxels()),
    )


def by_trimesh() -> VoxelizingTool:
    """trimesh's own way: cut triangles until they are small, then take the voxels of corners."""

    def take(part: Triangles) -> trimesh.Trimesh:
        corners = part.reshape(-1, 3)
        return trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)

    cut = trimesh.voxel.creation.voxelize_subdivide
    return VoxelizingTool(
        take,
        lambda mesh: cut(mesh, 1.0, max_iter=MOST_HALVINGS),
        lambda grid: int(grid.filled_count),
    )


TOOLS: Mapping[str, Callable[[], VoxelizingTool]] = {
    "hapticdb": by_hapticdb,
    "Open3D": by_open3d,
    "trimesh": by_trimesh,
}


def measure_voxelizers(assembly: CadAssembly, seconds: float) -> PeerResults:
    """Object voxels a second of each tool; about `seconds` for each."""
    measured = PeerResults([], [])
    for name, get in TOOLS.items():
        try:
            tool = get()
        except PeerMissingError as error:
            measured.notes.append(f"{name}: {error}")
        else:
            measured.cells.append(_measure(name, tool, assembly, seconds))
    return measured


def _measure(name: str, tool: VoxelizingTool, assembly: CadAssembly, seconds: float) -> Cell:
    """Median of some rounds over the parts that a first one, which warms up, had time for."""
    order = np.random.default_rng(SEED).permutation(len(assembly.parts))
    meshes = []
    voxels = 0
    started = time.perf_counter()
    for index in order:
        meshes.append(tool.take(assembly.parts[index]))
        voxels += tool.count(tool.make(meshes[-1]))
        if time.perf_counter() - started > seconds / (ROUNDS + 1):
            break
    rounds: list[float] = []
    while len(rounds) < ROUNDS and (not rounds or time.perf_counter() - started < seconds):
        start = time.perf_counter()
        for mesh in meshes:
            tool.make(mesh)
        rounds.append(time.perf_counter() - start)
    typical = float(np.median(rounds))
    return {
        "environment": assembly.name,
        "tool": name,
        "parts": len(meshes),
        "object_voxels": voxels,
        "seconds": typical,
        "voxels_per_second": voxels / typical,
    }

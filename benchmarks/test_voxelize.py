"""Voxelizing an assembly at 1024^3: hapticdb beside a plain test of every voxel, and Open3D.

The assembly is `assembly_vw_t1/vw_t1.glb` under HAPTICDB_TEST_DATA, each instance as a part, or a
ring of tori if the variable is not set. Its grid is the tight cube: the edge is the longest side of
the bounding box, slightly enlarged so that the upper border lies inside. A speed counts object
voxels: each part's voxels, once for each part. With --benchmark-disable a few parts run as a test.

Open3D also does not merge voxels of different parts: each part has its own grid. It runs on a share
of the parts, as it is slow. Its count differs, since it closes boxes in another way.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from pytest_benchmark.fixture import BenchmarkFixture

from hapticdb.kernels.surfaces.voxelize import count_voxels, voxelize
from peers import PeerMissingError
from peers.voxelizers import BITS, EDGE, CadAssembly, Triangles, by_open3d, read_assembly, tight

T = TypeVar("T")
Bricks = tuple[NDArray[np.int64], NDArray[np.uint8]]


def tori() -> trimesh.Scene:
    """Build a ring of 60 tori in different directions, with small triangles."""
    torus = trimesh.creation.torus(0.1, 0.03, major_sections=96, minor_sections=40)
    scene = trimesh.Scene()
    for angle in np.linspace(0, 2 * np.pi, 60, endpoint=False):
        turn = trimesh.transformations.rotation_matrix(angle, (1, 2, 3))
        turn[:3, 3] = np.cos(angle), np.sin(angle), 0.4 * np.cos(5 * angle)
        scene.add_geometry(torus, transform=turn)
    return scene


@pytest.fixture(scope="module")
def assembly() -> CadAssembly:
    folder = os.environ.get("HAPTICDB_TEST_DATA")
    if folder:
        return read_assembly(Path(folder) / "assembly_vw_t1" / "vw_t1.glb")
    scene = tori()
    parts = []
    for node in scene.graph.nodes_geometry:
        world_from_node, name = scene.graph[node]
        mesh = scene.geometry[name]
        points = trimesh.transform_points(mesh.vertices, world_from_node)
        parts.append(np.asarray(points[mesh.faces], dtype=np.float64))
    return tight("a ring of 60 tori", parts)


def subset(assembly: CadAssembly, benchmark: BenchmarkFixture, one_in: int = 1) -> list[Triangles]:
    """Every n-th part; only the three smallest when benchmarks run as tests."""
    if benchmark.disabled:
        return sorted(assembly.parts, key=len)[:3]
    return assembly.parts[::one_in]


def measure(benchmark: BenchmarkFixture, run: Callable[[], list[T]], rounds: int) -> list[T]:
    """Time `run` after a warm-up, and return its result."""
    result: list[T] = benchmark.pedantic(run, rounds=rounds, warmup_rounds=1)
    return result


def report(
    benchmark: BenchmarkFixture, assembly: CadAssembly, parts: list[Any], voxels: int
) -> None:
    """Print speed and conditions, and store both in the benchmark's extra info."""
    benchmark.extra_info.update(
        model=assembly.name,
        parts=len(parts),
        triangles=sum(map(len, parts)),
        object_voxels=voxels,
    )
    if benchmark.stats is not None:
        speed = voxels / benchmark.stats.stats.median
        benchmark.extra_info["object_voxels_per_second"] = speed
        print(f"\n{benchmark.name}: {benchmark.extra_info}")


@numba.njit(nogil=True)  # type: ignore[untyped-decorator] # numba has no types
def plain_kernel(triangles: Triangles, edge: int, dense: NDArray[np.uint8]) -> None:
    """Mark dense (n, n, n) by testing 13 axes in every voxel of each triangle's bounding box.

    axes (10, 5): a direction (3), and its least and greatest value at the lower corner of voxels
    that touch. The other three axes are the box normals, tested by the bounding box.
    """
    axes = np.zeros((10, 5))
    local = np.empty((3, 3))
    first = np.empty(3, np.int64)
    last = np.empty(3, np.int64)
    for t in range(triangles.shape[0]):
        for axis in range(3):
            low = min(triangles[t, 0, axis], triangles[t, 1, axis], triangles[t, 2, axis])
            high = max(triangles[t, 0, axis], triangles[t, 1, axis], triangles[t, 2, axis])
            first[axis] = max(np.ceil(low - 1e-9) - 1, 0)
            last[axis] = min(np.floor(high + 1e-9), edge - 1)
            for n in range(3):
                local[n, axis] = triangles[t, n, axis] - first[axis]
        for n in range(3):
            x = local[(n + 1) % 3, 0] - local[n, 0]
            y = local[(n + 1) % 3, 1] - local[n, 1]
            z = local[(n + 1) % 3, 2] - local[n, 2]
            axes[1 + 3 * n, 1], axes[1 + 3 * n, 2] = -z, y
            axes[2 + 3 * n, 0], axes[2 + 3 * n, 2] = z, -x
            axes[3 + 3 * n, 0], axes[3 + 3 * n, 1] = -y, x
        # the normal, from components of the first and last edge, which their axes contain
        axes[0, 0] = axes[1, 2] * axes[8, 0] - axes[2, 0] * axes[7, 2]
        axes[0, 1] = axes[2, 0] * axes[9, 1] - axes[3, 1] * axes[8, 0]
        axes[0, 2] = axes[3, 1] * axes[7, 2] - axes[1, 2] * axes[9, 1]
        for n in range(10):
            x, y, z = axes[n, 0], axes[n, 1], axes[n, 2]
            slack = 1e-9 * np.sqrt(x * x + y * y + z * z)
            a = x * local[0, 0] + y * local[0, 1] + z * local[0, 2]
            b = x * local[1, 0] + y * local[1, 1] + z * local[1, 2]
            c = x * local[2, 0] + y * local[2, 1] + z * local[2, 2]
            axes[n, 3] = min(a, b, c) - slack - max(x, 0.0) - max(y, 0.0) - max(z, 0.0)
            axes[n, 4] = max(a, b, c) + slack - min(x, 0.0) - min(y, 0.0) - min(z, 0.0)
        for i in range(last[0] - first[0] + 1):
            for j in range(last[1] - first[1] + 1):
                for k in range(last[2] - first[2] + 1):
                    for n in range(10):
                        at = axes[n, 0] * i + axes[n, 1] * j + axes[n, 2] * k
                        if at < axes[n, 3] or at > axes[n, 4]:
                            break
                    else:
                        dense[first[0] + i, first[1] + j, first[2] + k] = 1


def plain(part: Triangles) -> int:
    """Count the part's voxels by the plain test, in a dense array over its bounding box."""
    corner = np.floor(part.min(axis=(0, 1))) - 1
    size = int(np.ceil(part.max() - corner.min())) + 2
    shape = np.ceil(part.max(axis=(0, 1)) - corner).astype(np.int64) + 2
    dense = np.zeros(shape, np.uint8)
    # cut at the grid's border, as hapticdb does
    low = np.maximum(-corner, 0).astype(np.int64)
    high = np.minimum(EDGE - corner, shape).astype(np.int64)
    plain_kernel(part - corner, size, dense)
    return int(dense[low[0] : high[0], low[1] : high[1], low[2] : high[2]].sum())


def test_hapticdb(benchmark: BenchmarkFixture, assembly: CadAssembly) -> None:
    parts = subset(assembly, benchmark)

    def run() -> list[Bricks]:
        return [voxelize(part, BITS) for part in parts]

    bricks = measure(benchmark, run, rounds=9)
    voxels = sum(count_voxels(occupancy) for _, occupancy in bricks)
    for n in sorted(range(len(parts)), key=lambda n: len(parts[n]))[:3]:
        assert count_voxels(bricks[n][1]) == plain(parts[n])
    report(benchmark, assembly, parts, voxels)


def test_plain_separating_axes(benchmark: BenchmarkFixture, assembly: CadAssembly) -> None:
    parts = subset(assembly, benchmark)

    def run() -> list[int]:
        return [plain(part) for part in parts]

    counts = measure(benchmark, run, rounds=2)
    assert counts == [count_voxels(voxelize(part, BITS)[1]) for part in parts]
    report(benchmark, assembly, parts, sum(counts))


def test_open3d(benchmark: BenchmarkFixture, assembly: CadAssembly) -> None:
    try:
        tool = by_open3d()
    except PeerMissingError as error:
        pytest.skip(f"nothing to compare with, Open3D does not load: {error}")
    parts = subset(assembly, benchmark, one_in=20)
    meshes = [tool.take(part) for part in parts]
    grids = measure(benchmark, lambda: [tool.make(mesh) for mesh in meshes], rounds=5)
    voxels = sum(tool.count(grid) for grid in grids)
    own = sum(count_voxels(voxelize(part, BITS)[1]) for part in parts)
    assert 0.9 < voxels / own < 1.1
    report(benchmark, assembly, parts, voxels)

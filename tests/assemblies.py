"""Assemblies for tests of the import: shapes, files, and what a database then holds."""

import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, cast

import numpy as np
import trimesh
from numpy.typing import NDArray

import hapticdb
from hapticdb import Environment, Grid, GridOptions, ImportOptions
from hapticdb.grid import CurveName
from hapticdb.mesh import Part
from hapticdb.store.base import Layout
from hapticdb.store.connect import open_store
from naive import Voxel, voxels_of_triangles
from voxels import KINDS

Mesh = tuple[NDArray[np.float64], NDArray[np.int64]]
Rows = dict[str, list[tuple[Any, ...]]]
Kind = tuple[Layout, CurveName]

PAIRS = [*zip(KINDS, [*KINDS[1:], KINDS[0]], strict=True), (KINDS[3], KINDS[3])]
"""Kinds of environments that are copied or compared: each kind takes both parts."""

SIZE = 0.01
ORIGIN = (-0.16, -0.16, -0.16)
BITS = 5
"""A grid around the world's origin: 32 voxels of 10 mm on each axis."""


def small_grid(curve: CurveName = "z") -> Grid:
    return Grid(SIZE, ORIGIN, BITS, curve)


def make(path: Path, kind: Kind = ("brick", "z"), bits: int = 5) -> Environment:
    """An empty environment of a kind."""
    layout, curve = kind
    return hapticdb.create(path, Grid(0.01, (-0.1, 0.2, -0.3), bits, curve), layout=layout)


def small_options(
    curve: CurveName | None = None, layout: Layout | None = None, jobs: int | None = None
) -> ImportOptions:
    """Options that ask for `small_grid`."""
    grid = GridOptions(bits=BITS, voxel_size=SIZE, origin=ORIGIN, curve=curve)
    return ImportOptions(grid=grid, layout=layout, jobs=jobs)


def placement(x: float, y: float, z: float, turn: float = 0.0) -> NDArray[np.float64]:
    """A pose (4, 4): a rotation about z in radians, then a translation in metres."""
    placed = np.eye(4)
    placed[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    placed[:3, 3] = (x, y, z)
    return placed


def box(low: Iterable[float], high: Iterable[float]) -> Mesh:
    """The twelve triangles of a box."""
    ends = np.array([list(low), list(high)], dtype=np.float64)
    corners = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return np.take_along_axis(ends, corners, axis=0), np.array(faces, dtype=np.int64)


def ball(center: Iterable[float], radius: float, n_turns: int = 8) -> Mesh:
    """A sphere of `n_turns` meridians and half as many parallels."""
    n_rings = n_turns // 2
    tilt = np.linspace(0, np.pi, n_rings + 1)[:, None]
    turn = np.linspace(0, 2 * np.pi, n_turns, endpoint=False)[None, :]
    unit = np.stack(
        [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt) + 0 * turn], axis=-1
    )
    here = np.arange(n_rings * n_turns).reshape(n_rings, n_turns)
    beside = np.roll(here, -1, axis=1)
    below = n_turns
    faces = np.stack(
        [here, here + below, beside + below, here, beside + below, beside], axis=-1
    ).reshape(-1, 3)
    return np.array(list(center)) + radius * unit.reshape(-1, 3), faces


def write_obj(path: Path, parts: Mapping[str, Mesh]) -> Path:
    """Write an OBJ file with these named parts, in this order."""
    lines: list[str] = []
    n_before = 1
    for name, (vertices, faces) in parts.items():
        lines.append(f"o {name}")
        lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (faces + n_before).tolist()]
        n_before += len(vertices)
    path.write_text("\n".join(lines) + "\n")
    return path


def assembly(n_parts: int = 3) -> dict[str, Mesh]:
    """Boxes and balls that overlap, inside `small_grid`; some faces lie on borders of voxels."""
    rng = np.random.default_rng(7)
    parts: dict[str, Mesh] = {}
    for n in range(n_parts):
        center = rng.uniform(-0.08, 0.08, 3)
        if n % 3 == 1:
            low = np.round(center, 2) - 0.03
            parts[f"box {n}"] = box(low, low + np.array([0.05, 0.06, 0.035]))
        else:
            parts[f"ball {n}"] = ball(center, 0.04)
    return parts


def oracle_voxels(part: Part, grid: Grid) -> set[Voxel]:
    """Voxels of a part as the oracle finds them (`naive.voxels_of_triangles`)."""
    return voxels_of_triangles(grid.to_voxel_units(part.triangles()).tolist(), grid.bits)


def voxel_set(ijk: NDArray[np.int64]) -> set[Voxel]:
    found = {(i, j, k) for i, j, k in ijk.tolist()}
    assert len(found) == len(ijk)
    return found


TABLES = ("environment", "object", "voxel", "brick", "surface", "change", "quantile")


def rows_of(database: Path, *tables: str) -> Rows:
    """Rows of an environment's tables, by the standard library."""
    with closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True)) as plain:
        assert plain.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        return {
            table: plain.execute(f"SELECT * FROM {table} ORDER BY 1, 2").fetchall()
            for table in tables or TABLES
        }


def drop_surfaces(url: str | Path, *digests: str) -> None:
    """Take surfaces, all unless digests are given, out of an environment."""
    with closing(open_store(url)) as store:
        driver = cast("Any", store)._connection.driver
        for digest in digests or sorted(store.surface_digests()):
            driver.execute(f"DELETE FROM surface WHERE digest = '{digest}'")


def index_rows(env: Environment) -> set[tuple[int, int, bytes]]:
    """The whole index table: key, id, and the occupancy of a brick."""
    found = env.store.scan(np.array([0]), np.array([2**62]))
    width = 64 if env.layout == "brick" else 0
    bits = found.occupancy.tobytes()
    table = {
        (key, i, bits[n * width : (n + 1) * width])
        for n, (key, i) in enumerate(zip(found.keys.tolist(), found.ids.tolist(), strict=True))
    }
    assert len(table) == len(found)
    return table


def left_behind(folder: Path) -> list[str]:
    """Names in a folder that are not input files."""
    inputs = {".obj", ".ply", ".glb", ".gltf", ".stl", ".las"}
    return sorted(p.name for p in folder.iterdir() if p.suffix not in inputs)


def row_of_boxes(path: Path, n_boxes: int, step: float = 0.1, names: Sequence[str] = ()) -> Path:
    """An environment of cubes of 0.1 m in a row along x, `step` apart."""
    scene = trimesh.Scene()
    for n in range(n_boxes):
        cube = trimesh.creation.box((0.1, 0.1, 0.1))
        placed = trimesh.transformations.translation_matrix((step * n, 0.0, 0.0))
        name = names[n] if names else f"cube{n}"
        scene.add_geometry(cube, node_name=name, geom_name=f"cube{n}", transform=placed)
    file = path.with_suffix(".glb")
    file.write_bytes(scene.export(file_type="glb"))
    grid = hapticdb.Grid(0.02, (-2.0, -2.0, -2.0), 8)
    with hapticdb.create(path, grid, distances=False) as env:
        env.add(file)
    return path

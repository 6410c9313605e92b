"""Rows of parts with distances: the voxels' rows and those of the bricks near the surface."""

import shutil
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from typer.testing import CliRunner

import hapticdb
from assemblies import assembly, small_grid, small_options, write_obj
from bands import band_of
from hapticdb import PointShell
from hapticdb.cli import app
from hapticdb.errors import FileError, UsageError
from hapticdb.grid import CurveName, Grid
from hapticdb.ingest import voxelizing
from hapticdb.ingest.files import ImportOptions, import_files
from hapticdb.ingest.layout import bricks_of_rows
from hapticdb.ingest.voxelizing import rows_of_part
from hapticdb.kernels.field.lattice import BEYOND
from hapticdb.kernels.field.packing import unpack
from hapticdb.mesh import Part, parse_in_process, read_file
from hapticdb.store.base import Layout
from hapticdb.store.covering import object_ranges
from mesh_files import text

FACES = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0.2 0.3 0.9\nf 1 2 3\nf 1 2 4\n"


def a_part(folder: Path) -> Part:
    return read_file(text(folder / "a.obj", FACES)).parts[0]


def a_grid(curve: CurveName) -> Grid:
    return Grid(0.02, (-0.3, -0.3, -0.3), 7, curve)


@pytest.mark.parametrize("curve", ["z", "hilbert"])
def test_rows_of_part_distances_are_union(tmp_path: Path, curve: CurveName) -> None:
    part, grid = a_part(tmp_path), a_grid(curve)
    rows, n_voxels = rows_of_part(part, grid, "brick", distances=True)
    alone, n_alone = rows_of_part(part, grid, "brick")
    assert alone.distances is None
    assert n_voxels == n_alone
    assert (np.diff(rows.keys) > 0).all()
    is_met = rows.occupancy.reshape(-1, 64).any(axis=1)
    assert 0 < is_met.sum() < len(rows)
    np.testing.assert_array_equal(rows.keys[is_met], alone.keys)
    np.testing.assert_array_equal(rows.occupancy.reshape(-1, 64)[is_met].ravel(), alone.occupancy)
    assert rows.distances is not None
    assert len(rows.distances.ends) == len(rows)
    assert (unpack(*rows.distances) != BEYOND).any(axis=1).all()


def test_rows_of_part_distances_same_on_both_curves(tmp_path: Path) -> None:
    part = a_part(tmp_path)
    found = []
    for curve in ("z", "hilbert"):
        grid = a_grid(curve)
        rows, _ = rows_of_part(part, grid, "brick", distances=True)
        found.append(bricks_of_rows(rows, grid, "brick"))
    np.testing.assert_array_equal(found[0].keys, found[1].keys)
    np.testing.assert_array_equal(found[0].occupancy, found[1].occupancy)
    assert found[0].distances is not None
    assert found[1].distances is not None
    np.testing.assert_array_equal(found[0].distances.data, found[1].distances.data)
    np.testing.assert_array_equal(found[0].distances.ends, found[1].distances.ends)
    keys, data, ends = band_of(grid.to_voxel_units(part.triangles()), grid.bits)
    np.testing.assert_array_equal(found[0].keys, keys)
    np.testing.assert_array_equal(found[0].distances.data, data)
    np.testing.assert_array_equal(found[0].distances.ends, ends)


def test_rows_of_part_cloud_distances(tmp_path: Path) -> None:
    header = "ply\nformat ascii 1.0\nelement vertex 2\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    cloud = read_file(text(tmp_path / "a.ply", header + "0.105 0.1 0.1\n0.9 0.9 0.9\n")).parts[0]
    assert cloud.is_cloud
    grid = a_grid("z")
    rows, n_voxels = rows_of_part(cloud, grid, "brick", distances=True)
    assert n_voxels == 2
    assert rows.distances is not None
    values = unpack(*rows.distances)
    assert 8 < (values != BEYOND).sum() < 8 * 2 * 4 / 3 * np.pi * 2.75**3
    assert values.min() < 0.9 * 254 / 2.75


def test_rows_of_part_distances_out_of_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(voxelizing, "bytes_available", lambda: 1000)
    with pytest.raises(FileError, match=r"part 'a': its .* take more than .*fewer --bits"):
        rows_of_part(a_part(tmp_path), a_grid("z"), "brick", distances=True)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return write_obj(tmp_path / "assembly.obj", assembly(7))


def options(distances: bool | None) -> ImportOptions:
    return ImportOptions(grid=small_options().grid, distances=distances)


def test_import_files_distances_by_environment(file: Path, tmp_path: Path) -> None:
    import_files(tmp_path / "e.db", [file], options(distances=True))
    parts = {part.name: part for part in parse_in_process(file).parts}
    with hapticdb.open(tmp_path / "e.db") as env:
        assert env.has_distances
        for obj in env.objects():
            ranges = object_ranges(env.grid, env.layout, obj)
            found = env.store.rows_of(obj.id, *ranges, distances=True)
            wanted, _ = rows_of_part(parts[obj.name], small_grid(), "brick", distances=True)
            assert found.keys.tolist() == wanted.keys.tolist()
            assert found.occupancy.tolist() == wanted.occupancy.tolist()
            assert found.distances is not None
            assert wanted.distances is not None
            assert found.distances.data.tolist() == wanted.distances.data.tolist()


def test_move_preserves_distances(file: Path, tmp_path: Path) -> None:
    import_files(tmp_path / "e.db", [file], options(distances=True))
    with hapticdb.open(tmp_path / "e.db") as env:
        obj = env.objects()[0]
        voxel = env.grid.voxel_size
        shell = PointShell(
            points=np.array([obj.bounds[0] - [2.0 * voxel, 0, 0]]),
            normals=np.array([[1.0, 0, 0]]),
            center=np.zeros(3),
        )
        placed = obj.transform.copy()
        placed[0, 3] += 3.0 * voxel
        env.move(obj.id, placed)
        assert env.has_distances
        assert env.touch(shell, np.eye(4)).law == hapticdb.DistanceField()


def test_import_files_distances_default_by_layout(file: Path, tmp_path: Path) -> None:
    grid = small_options().grid
    layouts: tuple[Layout, ...] = get_args(Layout)
    for layout in layouts:
        url = tmp_path / f"{layout}.db"
        import_files(url, [file], ImportOptions(grid=grid, layout=layout))
        made = tmp_path / f"{layout}_made.db"
        fitted = hapticdb.Grid(0.01, (0.0, 0.0, 0.0), 6)
        with hapticdb.open(url) as env, hapticdb.create(made, fitted, layout=layout) as new:
            assert env.has_distances == (layout == "brick")
            assert env.store.wants_distances == new.store.wants_distances == (layout == "brick")


@pytest.mark.parametrize("made_with", [False, True])
def test_import_files_existing_distances_option(
    file: Path, tmp_path: Path, made_with: bool
) -> None:
    import_files(tmp_path / "e.db", [file], options(distances=made_with))
    with pytest.raises(UsageError, match="leave --"):
        import_files(tmp_path / "e.db", [file], options(distances=not made_with))


def test_import_files_voxel_layout_refuses_distances(file: Path, tmp_path: Path) -> None:
    wrong = ImportOptions(grid=small_options().grid, layout="voxel", distances=True)
    with pytest.raises(UsageError, match="the layout voxel has no distances"):
        import_files(tmp_path / "e.db", [file], wrong)
    assert not (tmp_path / "e.db").exists()


@pytest.mark.parametrize(("option", "has_them"), [("--distances", True), ("--no-distances", False)])
def test_import_distances_option(file: Path, tmp_path: Path, option: str, has_them: bool) -> None:
    shutil.copy(file, tmp_path / "a.obj")
    url = str(tmp_path / "e.db")
    done = CliRunner().invoke(app, ["import", url, str(tmp_path / "a.obj"), "--bits", "7", option])
    assert done.exit_code == 0, done.output
    with hapticdb.open(url) as env:
        assert env.has_distances is has_them

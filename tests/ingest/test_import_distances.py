"""Imports with distances to surfaces: which environments get them, and that edits keep them."""

import shutil
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from typer.testing import CliRunner

import hapticdb
from assemblies import assembly, small_grid, small_options, write_obj
from hapticdb import PointShell
from hapticdb.cli import app
from hapticdb.errors import UsageError
from hapticdb.ingest.files import ImportOptions, import_files
from hapticdb.ingest.voxelizing import rows_of_part
from hapticdb.mesh import parse_in_process
from hapticdb.query.grouping import object_ranges
from hapticdb.store.base import Layout


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return write_obj(tmp_path / "assembly.obj", assembly(7))


def options(distances: bool | None) -> ImportOptions:
    return ImportOptions(grid=small_options().grid, distances=distances)


def test_parts_get_distances_where_the_environment_wants_them(file: Path, tmp_path: Path) -> None:
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


def test_a_moved_object_keeps_its_distances(file: Path, tmp_path: Path) -> None:
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


def test_bricks_have_them_by_default_and_voxels_do_not(file: Path, tmp_path: Path) -> None:
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
def test_an_existing_environment_keeps_to_its_kind(
    file: Path, tmp_path: Path, made_with: bool
) -> None:
    import_files(tmp_path / "e.db", [file], options(distances=made_with))
    with pytest.raises(UsageError, match="leave --"):
        import_files(tmp_path / "e.db", [file], options(distances=not made_with))


def test_voxels_refuse_distances(file: Path, tmp_path: Path) -> None:
    wrong = ImportOptions(grid=small_options().grid, layout="voxel", distances=True)
    with pytest.raises(UsageError, match="the layout voxel has no distances"):
        import_files(tmp_path / "e.db", [file], wrong)
    assert not (tmp_path / "e.db").exists()


@pytest.mark.parametrize(("option", "has_them"), [("--distances", True), ("--no-distances", False)])
def test_the_command_line_asks_for_distances(
    file: Path, tmp_path: Path, option: str, has_them: bool
) -> None:
    shutil.copy(file, tmp_path / "a.obj")
    url = str(tmp_path / "e.db")
    done = CliRunner().invoke(app, ["import", url, str(tmp_path / "a.obj"), "--bits", "7", option])
    assert done.exit_code == 0, done.output
    with hapticdb.open(url) as env:
        assert env.has_distances is has_them

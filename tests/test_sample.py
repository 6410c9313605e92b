"""The sample: a car of closed, distinct parts that keep apart; a spanner; a path that touches."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

import hapticdb
from hapticdb.clashes.rules import add_rules
from hapticdb.errors import FileError, UsageError
from hapticdb.mesh import Defects, parse_in_process
from hapticdb.poses import read_poses
from hapticdb.sample import SampleFiles, write_sample

Floats = NDArray[np.float64]
PLANTED = {("engine/block", "engine/alternator"), ("frame/cross_member_middle", "supply/fuel_line")}
"""Pairs of the car's parts that overlap on purpose, in the order of the file."""


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> SampleFiles:
    return write_sample(tmp_path_factory.mktemp("sample") / "new" / "folder")


@pytest.fixture(scope="module")
def spanner(files: SampleFiles) -> Floats:
    """Vertices (V, 3) of the spanner, metres."""
    return np.asarray(trimesh.load_mesh(files.spanner).vertices)


def moved_points(points: Floats, poses: Floats) -> Floats:
    moved: Floats = points @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
    return moved


def assert_rigid(poses: Floats) -> None:
    rotation = poses[:, :3, :3]
    assert np.isfinite(poses).all()
    assert np.allclose(rotation @ rotation.transpose(0, 2, 1), np.eye(3), atol=1e-9)
    assert np.allclose(np.linalg.det(rotation), 1.0)
    assert np.array_equal(poses[:, 3], np.tile([0.0, 0.0, 0.0, 1.0], (len(poses), 1)))


def test_sample_car_closed_distinct_parts(files: SampleFiles) -> None:
    car = parse_in_process(files.car)
    assert len({part.name for part in car.parts}) == len(car.parts) == 217
    assert car.defects == Defects()
    assert np.ptp(car.bounds, axis=0) == pytest.approx([4.28, 2.04, 1.72], abs=0.02)


def test_sample_clashes_and_rules(files: SampleFiles, tmp_path: Path) -> None:
    options = hapticdb.ImportOptions(grid=hapticdb.GridOptions(bits=6), distances=False)
    hapticdb.import_files(tmp_path / "car.db", [files.car], options)
    with hapticdb.open(tmp_path / "car.db") as env:
        name = {obj.id: obj.name for obj in env.objects()}
        found = hapticdb.find_clashes(env)
        add_rules(env.store, (), 1e-3, files.rules)
        ruled = hapticdb.find_clashes(env)
    assert (found.counts()["inside"], found.counts()["not known"]) == (0, 0)
    deep = {(name[one.a], name[one.b]) for one in found.pairs if one.kind == "overlapping"}
    assert deep == PLANTED
    left = {(name[one.a], name[one.b]) for one in ruled.pairs if one.is_open}
    assert left == {("frame/cross_member_middle", "supply/fuel_line")}


def test_sample_spanner_one_closed_body(files: SampleFiles) -> None:
    mesh = trimesh.load_mesh(files.spanner)
    assert mesh.is_volume
    assert mesh.body_count == 1
    assert mesh.extents == pytest.approx([0.25, 0.054, 0.010], abs=0.003)


def test_sample_path_smooth_from_above(files: SampleFiles, spanner: Floats) -> None:
    poses = read_poses(files.path)
    assert len(poses) == 1000
    assert_rigid(poses)
    steps = np.diff(moved_points(spanner, poses), axis=0)
    assert np.linalg.norm(steps, axis=2).max() < 0.010
    assert steps[:20, :, 2].mean() < 0.0


@pytest.mark.parametrize("count", [1, 7, 999])
def test_write_sample_fewer_poses(files: SampleFiles, tmp_path: Path, count: int) -> None:
    whole = files.path.read_text().splitlines()
    fewer = write_sample(tmp_path, count).path.read_text().splitlines()
    assert fewer[:2] == whole[:2]
    assert len(fewer) == len(set(fewer)) == count + 1
    assert count == 1 or fewer[-1] == whole[-1]


def test_write_sample_bad_arguments(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match="file"):
        write_sample(tmp_path / "file")
    for count in (0, 1001):
        with pytest.raises(UsageError, match="1 to 1,000"):
            write_sample(tmp_path, count)

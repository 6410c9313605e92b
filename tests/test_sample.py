"""The sample: a car of closed, distinct parts; a wrench; a path that touches."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from hapticdb.errors import FileError, UsageError
from hapticdb.mesh import Defects, parse_in_process
from hapticdb.poses import read_poses
from hapticdb.sample import SampleFiles, slide_over_voxels, write_sample, write_wrench
from hapticdb.sample.path import heights_of_voxels

Floats = NDArray[np.float64]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> SampleFiles:
    return write_sample(tmp_path_factory.mktemp("sample") / "new" / "folder")


@pytest.fixture(scope="module")
def wrench(files: SampleFiles) -> Floats:
    """Vertices (V, 3) of the wrench, metres."""
    return np.asarray(trimesh.load_mesh(files.wrench).vertices)


def moved_points(points: Floats, poses: Floats) -> Floats:
    moved: Floats = points @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
    return moved


def assert_rigid(poses: Floats) -> None:
    rotation = poses[:, :3, :3]
    assert np.isfinite(poses).all()
    assert np.allclose(rotation @ rotation.transpose(0, 2, 1), np.eye(3), atol=1e-9)
    assert np.allclose(np.linalg.det(rotation), 1.0)
    assert np.array_equal(poses[:, 3], np.tile([0.0, 0.0, 0.0, 1.0], (len(poses), 1)))


def test_the_car_is_read_as_closed_parts_of_distinct_names(files: SampleFiles) -> None:
    car = parse_in_process(files.car)
    assert len({part.name for part in car.parts}) == len(car.parts) == 217
    assert car.defects == Defects()
    assert np.ptp(car.bounds, axis=0) == pytest.approx([4.28, 2.04, 1.72], abs=0.02)


@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_the_wrench_is_one_closed_piece_of_any_size(tmp_path: Path, scale: float) -> None:
    mesh = trimesh.load_mesh(write_wrench(tmp_path, scale))
    assert mesh.is_volume
    assert mesh.body_count == 1
    assert mesh.extents / scale == pytest.approx([0.25, 0.054, 0.010], abs=0.003)


def test_the_path_is_smooth_and_comes_down_from_above(files: SampleFiles, wrench: Floats) -> None:
    poses = read_poses(files.path)
    assert len(poses) == 1000
    assert_rigid(poses)
    steps = np.diff(moved_points(wrench, poses), axis=0)
    assert np.linalg.norm(steps, axis=2).max() < 0.010
    assert steps[:20, :, 2].mean() < 0.0


@pytest.mark.parametrize("count", [1, 7, 999])
def test_fewer_poses_are_spread_over_the_whole_path(
    files: SampleFiles, tmp_path: Path, count: int
) -> None:
    whole = files.path.read_text().splitlines()
    fewer = write_sample(tmp_path, count).path.read_text().splitlines()
    assert fewer[:2] == whole[:2]
    assert len(fewer) == len(set(fewer)) == count + 1
    assert count == 1 or fewer[-1] == whole[-1]


def test_what_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match="file"):
        write_sample(tmp_path / "file")
    for count in (0, 1001):
        with pytest.raises(UsageError, match="1 to 1,000"):
            write_sample(tmp_path, count)


def plane_of_voxels(size: float) -> Floats:
    i, j = np.meshgrid(np.arange(300), np.arange(120), indexing="ij")
    return size * np.stack([i.ravel() + 0.5, j.ravel() + 0.5, np.full(i.size, 7.5)], axis=1)


def test_over_a_plane_of_voxels_the_tool_lies_flat_and_pressed_in(wrench: Floats) -> None:
    size = 0.004
    poses = slide_over_voxels(plane_of_voxels(size), size, wrench, 200)
    assert_rigid(poses)
    lowest = moved_points(wrench, poses)[..., 2].min(axis=1)
    press = 8.0 * size - lowest
    assert press.min() == pytest.approx(0.5 * size)
    assert press.max() == pytest.approx(1.5 * size, rel=1e-2)
    steps = np.linalg.norm(np.diff(moved_points(wrench, poses), axis=0), axis=2)
    assert steps.max() < 2.5 * size


def test_one_voxel_is_enough_and_none_is_told(wrench: Floats) -> None:
    assert_rigid(slide_over_voxels([[0.5, 0.5, 0.5]], 0.01, wrench, 10))
    with pytest.raises(UsageError, match="no voxels"):
        slide_over_voxels(np.zeros((0, 3)), 0.01, wrench, 10)
    with pytest.raises(UsageError, match="two poses"):
        slide_over_voxels([[0.5, 0.5, 0.5]], 0.01, wrench, 1)
    with pytest.raises(UsageError, match="positive"):
        slide_over_voxels([[0.5, 0.5, 0.5]], 0.0, wrench, 10)
    with pytest.raises(UsageError, match="no points"):
        slide_over_voxels([[0.5, 0.5, 0.5]], 0.01, np.zeros((0, 3)), 10)


def test_heights_of_voxels_are_the_tops_of_their_columns() -> None:
    map_ = heights_of_voxels([[0.5, 0.5, 0.5], [0.5, 0.5, 4.5], [2.5, 0.5, 1.5]], 1.0)
    assert map_.top.tolist() == [[5.0], [-np.inf], [2.0]]
    beyond = map_.at(np.array([0.1, 2.9, 3.1, -0.1]), np.full(4, 0.5))
    assert beyond.tolist() == [5.0, 2.0, -np.inf, -np.inf]

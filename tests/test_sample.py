"""The sample: closed, outward, distinct parts; a path that touches; reproducible bytes."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from children import finished
from hapticdb.errors import FileError, UsageError
from hapticdb.poses import read_poses
from hapticdb.sample import (
    SampleFiles,
    SamplePart,
    build_car,
    build_wrench,
    slide_over_voxels,
    write_sample,
)
from hapticdb.sample import shapes as s
from hapticdb.sample.path import heights_of_triangles, heights_of_voxels

Floats = NDArray[np.float64]


@pytest.fixture(scope="module")
def car() -> list[SamplePart]:
    return build_car()


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> SampleFiles:
    return write_sample(tmp_path_factory.mktemp("sample") / "new" / "folder")


def assert_closed_and_outward(mesh: s.Mesh) -> None:
    """Each edge is used once in each direction, every vertex is used, no face is degenerate."""
    n = len(mesh.vertices)
    assert np.isfinite(mesh.vertices).all()
    assert np.array_equal(np.unique(mesh.faces), np.arange(n))
    start = mesh.faces[:, [0, 1, 2]].ravel()
    end = mesh.faces[:, [1, 2, 0]].ravel()
    there, back = start * n + end, end * n + start
    assert len(np.unique(there)) == len(there)
    assert np.array_equal(np.sort(there), np.sort(back))
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).min() > 1e-12
    assert s.volume(mesh) > 0.0


def moved_points(points: Floats, poses: Floats) -> Floats:
    moved: Floats = points @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
    return moved


def assert_rigid(poses: Floats) -> None:
    rotation = poses[:, :3, :3]
    assert np.isfinite(poses).all()
    assert np.allclose(rotation @ rotation.transpose(0, 2, 1), np.eye(3), atol=1e-9)
    assert np.allclose(np.linalg.det(rotation), 1.0)
    assert np.array_equal(poses[:, 3], np.tile([0.0, 0.0, 0.0, 1.0], (len(poses), 1)))


# ---- shapes ----------------------------------------------------------------------------------


def test_volumes_of_shapes_are_those_of_geometry() -> None:
    fine = 400
    assert s.volume(s.tube(0.02, 0.01, 0.1, fine)) == pytest.approx(3e-5 * np.pi, rel=1e-3)
    assert s.volume(s.slab(1.0, 2.0, 3.0)) == pytest.approx(6.0)
    assert s.volume(s.torus(0.1, 0.02, fine, fine)) == pytest.approx(
        2.0 * np.pi**2 * 0.1 * 0.02**2, rel=1e-3
    )
    assert s.volume(s.bored_block(0.4, 0.2, 0.1, 0.05, fine)) == pytest.approx(
        0.1 * (0.08 - np.pi * 0.05**2), rel=1e-3
    )


@given(st.integers(8, 60), st.floats(0.01, 0.2), st.floats(0.002, 0.05))
def test_every_gear_is_closed_and_keeps_its_teeth_apart(n: int, r: float, width: float) -> None:
    outline, _ = s.gear_outline(n, r, 0.3 * r)
    angle = np.unwrap(np.arctan2(outline[:, 1], outline[:, 0]))
    assert (np.diff(angle) > -1e-9).all()
    mesh = s.gear(n, r, width, 0.3 * r)
    start, end = mesh.faces.ravel(), mesh.faces[:, [1, 2, 0]].ravel()
    assert set(zip(start, end, strict=True)) == set(zip(end, start, strict=True))
    assert s.volume(mesh) > 0.0


def test_moving_keeps_volume_and_mirroring_keeps_the_winding() -> None:
    mesh = s.hex_bolt(0.02, 0.05)
    placed = s.moved(mesh, s.shift(1.0, 2.0, 3.0) @ s.turn("x", 30.0) @ s.turn("y", -70.0))
    assert s.volume(placed) == pytest.approx(s.volume(mesh))
    assert s.volume(s.mirrored(placed)) == pytest.approx(s.volume(mesh))


# ---- car and wrench --------------------------------------------------------------------------


def test_the_car_has_about_two_hundred_parts_of_distinct_names(car: list[SamplePart]) -> None:
    names = [part.name for part in car]
    leaves = [name.rsplit("/", 1)[1] for name in names]
    groups = {name.split("/")[0] for name in names}
    assert 180 <= len(names) <= 220
    assert len(set(names)) == len(names)
    assert len(set(leaves) | groups) == len(leaves) + len(groups)


def test_every_part_is_closed_and_wound_outward(car: list[SamplePart]) -> None:
    for mesh in {id(part.mesh): part.mesh for part in car}.values():
        assert_closed_and_outward(mesh)


def test_every_part_is_placed_rigidly_and_somewhere_of_its_own(car: list[SamplePart]) -> None:
    assert_rigid(np.array([part.world_from_part for part in car]))
    places = np.array(
        [np.concatenate([p.triangles().min((0, 1)), p.triangles().max((0, 1))]) for p in car]
    )
    assert len(np.unique(places.round(6), axis=0)) == len(car)
    assert (places[:, 2] > -1e-9).all()


def test_the_car_is_as_large_as_a_car(car: list[SamplePart]) -> None:
    corners = np.concatenate([part.triangles().reshape(-1, 3) for part in car])
    assert np.ptp(corners, axis=0) == pytest.approx([4.28, 2.04, 1.72], abs=0.02)
    assert sum(len(part.faces) for part in car) < 550_000


def test_the_car_has_surface_for_about_fourteen_million_voxels(car: list[SamplePart]) -> None:
    # 11 bits, extent 1.6 times the car's length. A plane of area A meets A / s^2 to sqrt(3) A / s^2
    # voxels of size s. The two sides of a sheet thinner than a voxel share their voxels.
    size = 1.6 * 4.28 / 2**11
    corners = np.concatenate([part.triangles() for part in car])
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * float(np.linalg.norm(sides, axis=1).sum())
    assert 11e6 < area / size**2 < 14e6


def test_the_wrench_is_one_closed_piece_of_a_quarter_metre() -> None:
    wrench = build_wrench()
    assert_closed_and_outward(wrench)
    mesh = trimesh.Trimesh(*wrench, process=False)
    assert mesh.body_count == 1
    # genus 1: the ring end has a hole, the open end has none
    assert mesh.euler_number == 0
    assert mesh.extents == pytest.approx([0.25, 0.054, 0.010], abs=0.003)


# ---- files -----------------------------------------------------------------------------------


def test_the_files_are_the_same_bytes_in_another_process(
    files: SampleFiles, tmp_path: Path
) -> None:
    code = "import sys; from hapticdb.sample import write_sample; write_sample(sys.argv[1])"
    environment = {**os.environ, "PYTHONHASHSEED": "17"}
    finished([sys.executable, "-c", code, str(tmp_path)], check=True, env=environment)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(f.name for f in files)
    for path in files:
        assert (tmp_path / path.name).read_bytes() == path.read_bytes()
    assert files.car.stat().st_size < 15e6


def test_the_car_comes_back_from_its_file(files: SampleFiles, car: list[SamplePart]) -> None:
    scene = trimesh.load_scene(files.car, process=False)
    parents = scene.graph.transforms.parents
    placed = {}
    for node in scene.graph.nodes_geometry:
        path, parent = [node], parents[node]
        while parent != scene.graph.base_frame:
            path, parent = [parent, *path], parents[parent]
        placed["/".join(path)] = scene.graph[node]
    assert placed.keys() == {part.name for part in car}
    assert len(scene.geometry) == len({id(part.mesh) for part in car})
    for part in car:
        world, geometry = placed[part.name]
        assert np.allclose(world, part.world_from_part, atol=1e-9)
        assert len(scene.geometry[geometry].faces) == len(part.faces)


def test_the_wrench_comes_back_from_its_file(files: SampleFiles) -> None:
    mesh = trimesh.load_mesh(files.wrench)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(s.volume(build_wrench()), rel=1e-4)


def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match="file"):
        write_sample(tmp_path / "file")


# ---- paths -----------------------------------------------------------------------------------


def test_the_path_is_smooth_and_long(files: SampleFiles) -> None:
    poses = read_poses(files.path)
    assert len(poses) == 1000
    assert_rigid(poses)
    points = moved_points(build_wrench().vertices, poses)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=2).max(axis=1)
    assert steps.max() < 0.010
    assert np.ptp(poses[:, 0, 3]) > 3.5


def test_the_path_touches_the_car_nearly_everywhere(
    files: SampleFiles, car: list[SamplePart]
) -> None:
    outside = [p.triangles() for p in car if p.name.startswith(("body/", "trim/"))]
    map_ = heights_of_triangles(np.concatenate(outside), 0.005)
    points = moved_points(build_wrench().vertices, read_poses(files.path)[::10])
    above = (points[..., 2] - map_.at(points[..., 0], points[..., 1])).min(axis=1)
    # the map's columns of 5 mm are wrong by up to 4 mm where the surface is steepest
    assert (np.abs(above) < 0.006).mean() > 0.9
    assert above.min() > -0.012


def test_the_path_begins_above_the_car(files: SampleFiles, car: list[SamplePart]) -> None:
    """A session in which the tool begins in something would feel nothing."""
    outside = [p.triangles() for p in car if p.name.startswith(("body/", "trim/"))]
    map_ = heights_of_triangles(np.concatenate(outside), 0.005)
    points = moved_points(build_wrench().vertices, read_poses(files.path)[:30])
    above = (points[..., 2] - map_.at(points[..., 0], points[..., 1])).min(axis=1)
    assert above[0] > 0.04
    assert above[25:].max() < 0.006


def plane_of_voxels(size: float) -> Floats:
    i, j = np.meshgrid(np.arange(300), np.arange(120), indexing="ij")
    return size * np.stack([i.ravel() + 0.5, j.ravel() + 0.5, np.full(i.size, 7.5)], axis=1)


@pytest.mark.parametrize("seed", range(3))
def test_over_a_plane_of_voxels_the_tool_lies_flat_and_pressed_in(seed: int) -> None:
    size = 0.004
    tool = build_wrench().vertices
    poses = slide_over_voxels(plane_of_voxels(size), size, tool, 200, seed)
    assert_rigid(poses)
    lowest = moved_points(tool, poses)[..., 2].min(axis=1)
    press = 8.0 * size - lowest
    assert press.min() == pytest.approx(0.5 * size)
    assert press.max() == pytest.approx(1.5 * size, rel=1e-2)
    steps = np.linalg.norm(np.diff(moved_points(tool, poses), axis=0), axis=2)
    assert steps.max() < 2.5 * size


def test_seeds_choose_paths_and_each_is_reproducible() -> None:
    voxels, tool = plane_of_voxels(0.004), build_wrench().vertices
    first = slide_over_voxels(voxels, 0.004, tool, 50, seed=1)
    assert np.array_equal(first, slide_over_voxels(voxels, 0.004, tool, 50, seed=1))
    assert not np.array_equal(first, slide_over_voxels(voxels, 0.004, tool, 50, seed=2))


def test_one_voxel_is_enough_and_none_is_told() -> None:
    tool = build_wrench().vertices
    assert_rigid(slide_over_voxels([[0.5, 0.5, 0.5]], 0.01, tool, 10))
    with pytest.raises(UsageError, match="no voxels"):
        slide_over_voxels(np.zeros((0, 3)), 0.01, tool, 10)
    with pytest.raises(UsageError, match="two poses"):
        slide_over_voxels([[0.5, 0.5, 0.5]], 0.01, tool, 1)
    with pytest.raises(UsageError, match="positive"):
        slide_over_voxels([[0.5, 0.5, 0.5]], 0.0, tool, 10)
    with pytest.raises(UsageError, match="no points"):
        slide_over_voxels([[0.5, 0.5, 0.5]], 0.01, np.zeros((0, 3)), 10)


def test_heights_of_voxels_are_the_tops_of_their_columns() -> None:
    map_ = heights_of_voxels([[0.5, 0.5, 0.5], [0.5, 0.5, 4.5], [2.5, 0.5, 1.5]], 1.0)
    assert map_.top.tolist() == [[5.0], [-np.inf], [2.0]]
    beyond = map_.at(np.array([0.1, 2.9, 3.1, -0.1]), np.full(4, 0.5))
    assert beyond.tolist() == [5.0, 2.0, -np.inf, -np.inf]


def test_heights_of_a_slope_are_exact_in_the_middle_of_cells() -> None:
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 2.0], [1.0, 1.0, 5.0], [0.0, 1.0, 3.0]])
    map_ = heights_of_triangles(corners[[[0, 1, 2], [0, 2, 3]]], 0.125)
    middle = (np.arange(8) + 0.5) * 0.125
    expected = 2.0 * middle[:, None] + 3.0 * middle[None, :]
    assert np.allclose(map_.top[:8, :8], expected)

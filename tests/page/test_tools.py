"""Tools of the page: built-in probes, shells in any frame, and where they start."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from hapticdb import PointShell
from hapticdb.errors import UsageError
from hapticdb.kernels.field.distance_law import ONSET
from hapticdb.page import colours, tools
from hapticdb.page.scene.surroundings import set_first_view
from hapticdb.page.site import SceneFacts
from hapticdb.store.base import Object

VOXEL = 0.002


@pytest.mark.parametrize("has_distances", [True, False])
def test_built_in_probes_closed_and_centred(has_distances: bool) -> None:
    small = tools.built_in(1e-3, VOXEL, has_distances=has_distances)[0]
    assert small.radius == pytest.approx(tools.LEAST_VOXELS * VOXEL, rel=0.01)
    probes = tools.built_in(1.0, VOXEL, has_distances=has_distances)
    assert [probe.name for probe in probes] == ["ball", "peg"]
    for probe in probes:
        assert probe.shell.is_closed
        assert np.allclose(tools.middle_of(probe.shell), 0.0, atol=1e-6)
        corners = probe.vertices[probe.faces]
        volume = np.einsum("fk,fk->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
        assert volume > 0.0  # wound outward
        deepest = float(probe.shell.inset.max())
        assert deepest == pytest.approx(ONSET * VOXEL if has_distances else 0.0, rel=0.05)


def test_from_shell_centred_with_normals() -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]) + 40.0
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    shell = PointShell.from_mesh(corners, faces, 50)
    held = tools.from_shell("corner", shell)
    assert np.allclose(held.shell.points + 40.5, shell.points)
    assert np.array_equal(held.shell.normals, shell.normals)
    assert np.allclose(held.vertices.min(axis=0), -0.5)
    assert held.radius == pytest.approx(np.sqrt(0.75))


def test_from_shell_convex_hull() -> None:
    ball = PointShell.sphere(0.5, 200)
    saved = PointShell(ball.points + 3.0, ball.normals, ball.center + 3.0)
    held = tools.from_shell("ball", saved)
    corners = held.vertices[held.faces]
    volume = np.einsum("fk,fk->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert volume == pytest.approx(4 / 3 * np.pi * 0.125, rel=0.1)
    flat = PointShell(np.eye(3), np.eye(3), np.zeros(3))
    with pytest.raises(UsageError, match="mesh"):
        tools.from_shell("flat", flat)


@pytest.mark.parametrize(("unit", "notes"), [(None, 1), ("m", 0), ("mm", 0)])
def test_from_files_unit(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, unit: str | None, notes: int
) -> None:
    trimesh.creation.box((60.0, 6.0, 6.0)).export(tmp_path / "probe.stl")
    (held,) = tools.from_files(
        [str(tmp_path / "probe.stl")], VOXEL, has_distances=True, unit=unit, extent=0.24
    )
    assert np.ptp(held.vertices[:, 0]) == pytest.approx(0.06 if unit == "mm" else 60.0)
    text = "the tool probe.stl is 60 m long, longer than the scene (0.24 m): would --tool-unit mm"
    assert [text in record.message for record in caplog.records] == [True] * notes


@pytest.mark.parametrize("up", [0, 1, 2])
def test_start_pose_free_and_apart(up: int) -> None:
    bounds = np.array([[-1.0, -0.5, -0.2], [1.0, 0.5, 0.4]])
    axes = np.eye(3)
    radius = 0.1
    poses = [
        tools.start_pose(bounds, axes[up], axes[(up + 2) % 3], radius, number)
        for number in range(5)
    ]
    for pose in poses:
        assert pose[up, 3] - radius > bounds[1, up]
        assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
        assert np.allclose(pose[:3, 2], axes[up])
    places = np.array([pose[:3, 3] for pose in poses])
    gaps = np.linalg.norm(places[:, None] - places[None], axis=-1) + 9.0 * np.eye(5)
    assert gaps.min() > 2.0 * radius


@pytest.mark.parametrize("radius", [1e-4, 0.1, 1.0, 100.0])
def test_first_view_contains_scene_and_tool(radius: float) -> None:
    bounds = np.array([[-1.0, -0.5, -0.2], [1.0, 0.5, 0.4]])
    facts = SceneFacts(bounds, np.eye(3)[2], np.eye(3)[1], VOXEL, has_distances=True)
    server = SimpleNamespace(initial_camera=SimpleNamespace())
    set_first_view(server, bounds, 2, facts.reach(radius))  # type: ignore[arg-type]
    camera = server.initial_camera
    way = np.array(camera.look_at) - camera.position
    start = facts.start(radius, 0)[:3, 3]
    assert start[2] > bounds[1, 2] + max(radius, 3 * VOXEL)
    for middle, size in ((bounds.mean(axis=0), facts.diagonal / 2), (start, radius)):
        seen = middle - camera.position
        away = np.linalg.norm(seen)
        angle = np.arccos(seen @ way / away / np.linalg.norm(way)) + np.arcsin(size / away)
        assert angle <= camera.fov / 2 + 1e-6
        assert camera.near < away - size < away + size < camera.far


def test_of_contacts_colour_of_nearest_object() -> None:
    def box(number: int, low: float) -> Object:
        bounds = np.array([[low] * 3, [low + 1.0] * 3])
        return Object("part", "", "", np.eye(4), 1, bounds, id=number)

    points = np.array([[0.5, 0.5, 0.5], [2.5, 2.5, 2.5], [1.9, 1.9, 1.9]])
    found = colours.of_contacts(points, [box(7, 0.0), box(8, 2.0)])
    assert [tuple(row) for row in found] == [colours.of_object(n) for n in (7, 8, 8)]
    assert len(colours.of_contacts(points, [])) == 3
    assert len(colours.of_contacts(points[:0], [box(7, 0.0)])) == 0

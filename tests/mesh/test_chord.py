"""The chord error that is stored: never less than what samples of the true surfaces show."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import step_files
from hapticdb.errors import FileError, UsageError
from hapticdb.kernels.surfaces.triangle_bvh import triangle_bvh
from hapticdb.mesh import Part, parse_in_process, read_file
from hapticdb.mesh import reader as reader_module
from hapticdb.mesh.chord import DEFAULT, chord_error
from hapticdb.mesh.parsed import UnreadableError
from mesh_files import TRIANGLE, gltf, text
from point_distances import distances_to

Floats = NDArray[np.float64]
TURN = np.linspace(0.0, 2.0 * np.pi, 331)
SHARE = np.linspace(0.0, 1.0, 101)


def distance(part: Part, points: Floats) -> float:
    """Greatest distance of points (..., 3) from a part's triangles, metres."""
    triangles = part.triangles()
    tree = triangle_bvh(triangles, np.zeros(len(triangles), dtype=np.int64))
    return float(distances_to(tree, points.reshape(-1, 3)).max())


def revolved(radii: Floats, heights: Floats) -> Floats:
    """Points of a surface of revolution."""
    flat = radii[:, None] * np.cos(TURN), radii[:, None] * np.sin(TURN)
    return np.stack([*flat, np.broadcast_to(heights[:, None], flat[0].shape)], axis=-1)


ANGLES = SHARE * 2.0 * np.pi
SOLIDS: dict[str, tuple[Callable[[float], Floats], Callable[[Path, float, str], Path]]] = {
    "sphere": (
        lambda r: revolved(r * np.sin(ANGLES / 2), r * np.cos(ANGLES / 2)),
        step_files.sphere,
    ),
    "torus": (
        lambda r: revolved(r * (3.0 + 0.5 * np.cos(ANGLES)), 0.5 * r * np.sin(ANGLES)),
        lambda path, r, unit: step_files.torus(path, 3.0 * r, 0.5 * r, unit),
    ),
    "cylinder": (
        lambda r: revolved(np.full(101, r), 2.0 * r * SHARE),
        lambda path, r, unit: step_files.cylinder(path, r, 2.0 * r, unit),
    ),
    "cone": (
        lambda r: revolved(r * SHARE, 2.0 * r * SHARE),
        lambda path, r, unit: step_files.cone(path, r, 2.0 * r, unit),
    ),
    "flat cone": (
        lambda r: revolved(r * SHARE, 0.1 * r * SHARE),
        lambda path, r, unit: step_files.cone(path, r, 0.1 * r, unit),
    ),
    "sheet": (lambda r: revolved(r * SHARE, np.zeros(101)), step_files.sheet),
}
"""Samples of the true surface of a solid of a radius, metres, and its STEP file."""


@pytest.mark.parametrize("kind", SOLIDS)
@pytest.mark.parametrize(("unit", "chord"), [("mm", DEFAULT), ("in", 1e-4)])
def test_chord_error_bounds_true_error(tmp_path: Path, kind: str, unit: str, chord: float) -> None:
    """In each unit alike: a sphere is tessellated twice as coarse as was asked for."""
    size, (samples, write) = {"mm": 10.0, "in": 0.4}[unit], SOLIDS[kind]
    (part,) = parse_in_process(write(tmp_path / "a.step", size, unit), chord=chord).parts
    true = distance(part, samples(size * step_files.UNITS[unit][1]))
    assert true <= part.chord <= (3.0 if kind == "sheet" else 1.5) * true
    assert part.chord <= 1.05 * chord or kind == "sphere"


@pytest.mark.parametrize(
    ("name", "chord", "is_over"),
    [
        ("dirty/trimesh_featuretype.STEP", DEFAULT, True),
        ("reports/s04_latin1.step", DEFAULT, False),
        ("reports/s13_far_mm.step", 1e-4, False),
    ],
)
def test_chord_error_bounds_finer_tessellation(
    real_files: Path, name: str, chord: float, is_over: bool
) -> None:
    """Not even where OpenCASCADE exceeds its tolerance ten times; then a note says so."""
    file = parse_in_process(real_files / name, chord=chord)
    finer = parse_in_process(real_files / name, chord=chord / 7)
    for part, other in zip(file.parts, finer.parts, strict=True):
        assert distance(part, other.world_points()) <= part.chord
    assert (max(part.chord for part in file.parts) > 1.05 * chord) == is_over
    assert any("chord error" in note for note in file.notes) == is_over


def test_chord_error_of_flat_shape() -> None:
    """A tetrahedron, each face with vertices of its own, far from the origin; then without one."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) + 7.3
    vertices = corners[[0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]].astype(np.float32)
    flat = vertices.reshape(4, 3, 3)
    normals = np.cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0])
    normals = np.repeat(normals / np.linalg.norm(normals, axis=1)[:, None], 3, axis=0)
    faces = np.arange(12).reshape(4, 3)
    assert chord_error(vertices, normals, faces, 1e-5) == 0.0
    assert chord_error(vertices, normals, faces[:3], 1e-5) == pytest.approx(1e-5, rel=0.1)
    assert chord_error(vertices, None, faces, 1e-5) == pytest.approx(1e-5, rel=0.1)


def test_placed_chord_scaled_and_zero_for_meshes(tmp_path: Path) -> None:
    world = np.diag([1.0, -3.0, 2.0, 1.0])
    corners = TRIANGLE.astype(np.float64)
    part = Part("a", corners, np.array([[0, 1, 2]]), world, chord=1e-5)
    assert part.placed_chord == pytest.approx(3e-5)
    (part,) = parse_in_process(gltf({}, tmp_path / "a.gltf"), chord=1e-3).parts
    assert part.chord == part.placed_chord == 0.0


def test_digest_depends_on_chord_error() -> None:
    corners, faces = TRIANGLE.astype(np.float64), np.array([[0, 1, 2]])
    plain, one, other = (
        Part("a", corners, faces, np.eye(4), chord=chord) for chord in (0.0, 1e-5, 2e-5)
    )
    assert len({plain.digest, one.digest, other.digest}) == 3


def test_read_file_chord_error_from_child(tmp_path: Path) -> None:
    path = step_files.cylinder(tmp_path / "a.step", 10.0, 20.0)
    here, there = parse_in_process(path, chord=1e-4), read_file(path, chord=1e-4)
    assert here.parts[0].chord == there.parts[0].chord > 0.0
    assert here.parts[0].digest == there.parts[0].digest
    assert len(here.parts[0].triangles()) < len(parse_in_process(path).parts[0].triangles())


@pytest.mark.parametrize("chord", [0.0, float("nan"), float("inf"), 1e-12])
@pytest.mark.parametrize("read", [read_file, parse_in_process])
def test_read_file_chord_out_of_range(
    tmp_path: Path, chord: float, read: Callable[..., object]
) -> None:
    with pytest.raises(UsageError, match="chord error"):
        read(text(tmp_path / "a.step", ""), chord=chord)


def test_read_file_timeout_suggests_larger_chord(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def late(*_: object) -> None:
        raise UnreadableError(f"it took long; {reader_module._MORE_TIME}")

    monkeypatch.setattr(reader_module, "_run_child", late)
    step = step_files.sphere(tmp_path / "a.step", 1.0)
    for path, is_told in ((step, True), (text(tmp_path / "a.off", "OFF"), False)):
        with pytest.raises(FileError) as refused:
            read_file(path)
        assert str(refused.value).endswith("larger --chord") == is_told

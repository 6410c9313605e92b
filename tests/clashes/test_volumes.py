"""Volumes of overlaps against closed forms."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

import hapticdb
from hapticdb import GridOptions, ImportOptions
from hapticdb.clashes.clash_results import Clashes
from hapticdb.clashes.search import find_clashes
from hapticdb.clashes.volumes import with_volumes
from hapticdb.errors import MissingExtraError, UsageError

FAR = (500.0, -300.0, 40.0)
"""Metres: a place where 32-bit numbers would lose a tenth of a millimetre."""


def searched(
    folder: Path, *meshes: trimesh.Trimesh, least: float = 0.0, scene: trimesh.Scene | None = None
) -> Clashes:
    made = (
        trimesh.Scene({f"part{n}": mesh for n, mesh in enumerate(meshes)})
        if scene is None
        else scene
    )
    path, url = folder / "a.glb", folder / "a.db"
    path.write_bytes(made.export(file_type="glb"))
    hapticdb.import_files(url, [path], ImportOptions(grid=GridOptions(bits=5)))
    with hapticdb.open(url) as env:
        return with_volumes(env.store, find_clashes(env), least)


def box(size: float, at: tuple[float, ...]) -> trimesh.Trimesh:
    return trimesh.creation.box((size,) * 3, np.eye(4) + translation(at))


def translation(by: tuple[float, ...]) -> np.ndarray:
    return np.pad(np.array(by)[:, None], ((0, 1), (3, 0)))


def test_with_volumes_two_cubes(tmp_path: Path) -> None:
    (one,) = searched(tmp_path, box(0.1, (0, 0, 0)), box(0.1, (0.06, 0.07, 0.08))).pairs
    assert one.volume == pytest.approx(0.04 * 0.03 * 0.02, rel=1e-5)  # positions of 32 bits
    assert one.length_text().endswith(", 24 cm³")


def test_with_volumes_transformed_parts(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(0.7, (1, 2, 3))
    move = np.eye(4) + translation(FAR)
    scene.add_geometry(box(0.1, (0, 0, 0)), "a", transform=move @ turn @ np.diag([2, 2, 2, 1]))
    scene.add_geometry(box(0.1, (0.1, 0, 0)), "b", transform=move @ turn @ np.diag([-1, 3, 1, 1]))
    (one,) = searched(tmp_path, scene=scene).pairs
    assert one.volume == pytest.approx(0.05 * 0.2 * 0.1, rel=1e-3)  # glTF rounds the placement


def test_with_volumes_any_winding_and_torn_edges(tmp_path: Path) -> None:
    inverted, torn = box(0.1, (0, 0, 0)), box(0.1, (0.06, 0.07, 0.08))
    inverted.invert()
    torn.faces[::2] = torn.faces[::2, ::-1]
    torn.unmerge_vertices()
    (one,) = searched(tmp_path, inverted, torn).pairs
    assert one.volume == pytest.approx(0.04 * 0.03 * 0.02, rel=1e-5)


def test_with_volumes_spherical_caps(tmp_path: Path) -> None:
    radius, apart = 0.05, 0.08
    one = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    other = one.copy()
    other.apply_translation((apart, 0, 0))
    corners = one.triangles
    chord = radius - np.linalg.norm(corners.mean(axis=1), axis=1).min()

    def lens(r: float) -> float:
        return float(np.pi * (2 * r - apart) ** 2 * (apart**2 + 4 * r * apart) / (12 * apart))

    (pair,) = searched(tmp_path, one, other).pairs
    assert pair.volume is not None
    assert lens(radius - chord) < pair.volume < lens(radius)


def test_with_volumes_open_surfaces_unknown(tmp_path: Path) -> None:
    sheet = box(0.1, (0.06, 0.07, 0.08))
    sheet.update_faces(np.arange(12) > 0)
    (one,) = searched(tmp_path, box(0.1, (0, 0, 0)), sheet, least=1.0).pairs
    assert one.volume is None
    assert one.kind == "overlapping"


@pytest.mark.parametrize(("least", "n"), [(2e-5, 2), (3e-5, 1)])
def test_with_volumes_least_volume(tmp_path: Path, least: float, n: int) -> None:
    boxes = box(0.1, (0, 0, 0)), box(0.1, (0.06, 0.07, 0.08)), box(0.1, (0, 0, -0.1))
    found = searched(tmp_path, *boxes, least=least)
    assert len(found.pairs) == n
    assert found.counts()["overlapping"] == n - 1
    assert found.counts()["touching"] == 1
    assert len(found.of()) == n - 1


def test_with_volumes_bad_limit_and_missing_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UsageError, match="least volume"):
        searched(tmp_path, box(0.1, (0, 0, 0)), least=-1.0)
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with hapticdb.open(tmp_path / "a.db") as env, pytest.raises(MissingExtraError, match="pip"):
        with_volumes(env.store, find_clashes(env))

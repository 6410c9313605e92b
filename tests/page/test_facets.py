"""Triangles that are shown are those of the files; edges are sharp where faces meet at an angle."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from hapticdb.page.scene.facets import Facets, block_facets, coarsened, sharpened


def facets_of(mesh: trimesh.Trimesh) -> Facets:
    return Facets(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64))


@given(st.integers(0, 2**32), st.integers(1, 40))
def test_sharpened_triangles_unchanged(seed: int, n_faces: int) -> None:
    rng = np.random.default_rng(seed)
    vertices = rng.integers(-2, 3, (12, 3)) / 2.0  # many equal positions
    before = Facets(vertices, rng.integers(0, 12, (n_faces, 3)))
    (after,) = sharpened([before])
    assert np.array_equal(after.vertices[after.faces], before.vertices[before.faces])
    assert len(after.vertices) <= 3 * n_faces


def test_sharpened_cylinder_rims_only() -> None:
    rod = facets_of(trimesh.creation.cylinder(1.0, 2.0, sections=64))
    assert len(sharpened([rod])[0].vertices) == 4 * 64 + 2  # each rim twice, and two centres


@given(st.integers(0, 2**32), st.integers(1, 60))
def test_block_facets_volume_and_outer_sides(seed: int, n: int) -> None:
    voxels = np.unique(np.random.default_rng(seed).integers(0, 5, (n, 3)), axis=0)
    shown = block_facets(voxels, 1)
    sides = sum(
        not (np.abs(voxels - (voxel + step)).sum(axis=1) == 0).any()
        for voxel in voxels
        for axis in range(3)
        for step in (np.eye(3, dtype=np.int64)[axis], -np.eye(3, dtype=np.int64)[axis])
    )
    corners = shown.vertices[shown.faces]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert len(shown.faces) == 2 * sides
    assert volume == pytest.approx(len(voxels))


@given(st.integers(0, 2**32), st.integers(1, 50))
def test_coarsened_cubes_enclose_voxels(seed: int, most: int) -> None:
    voxels = np.unique(np.random.default_rng(seed).integers(0, 200, (300, 3)), axis=0)
    places, edge = coarsened(voxels, most)
    assert len(places) <= most
    assert {*map(tuple, (voxels // edge).tolist())} == {*map(tuple, places.tolist())}

"""Rows of parts with distances: the voxels' rows and those of the bricks near the surface."""

from pathlib import Path

import numpy as np
import pytest

from bands import band_of
from hapticdb.errors import FileError
from hapticdb.grid import CurveName, Grid
from hapticdb.ingest import voxelizing
from hapticdb.ingest.layout import bricks_of_rows
from hapticdb.ingest.voxelizing import rows_of_part
from hapticdb.kernels.field.lattice import BEYOND
from hapticdb.kernels.field.packing import unpack
from hapticdb.mesh import Part, read_file
from mesh_files import text

FACES = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0.2 0.3 0.9\nf 1 2 3\nf 1 2 4\n"


def a_part(folder: Path) -> Part:
    return read_file(text(folder / "a.obj", FACES)).parts[0]


def a_grid(curve: CurveName) -> Grid:
    return Grid(0.02, (-0.3, -0.3, -0.3), 7, curve)


@pytest.mark.parametrize("curve", ["z", "hilbert"])
def test_rows_with_distances_are_the_union(tmp_path: Path, curve: CurveName) -> None:
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


def test_either_curve_gives_a_brick_the_same_distances(tmp_path: Path) -> None:
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


def test_a_cloud_has_distances_to_its_points(tmp_path: Path) -> None:
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


def test_distances_that_do_not_fit_into_memory_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(voxelizing, "bytes_available", lambda: 1000)
    with pytest.raises(FileError, match=r"part 'a': its .* take more than .*fewer --bits"):
        rows_of_part(a_part(tmp_path), a_grid("z"), "brick", distances=True)

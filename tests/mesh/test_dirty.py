"""Every file of the dirty folder is read with known counts, or refused with a one-line error."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from hapticdb.mesh import Defects, MeshFile, parse_in_process, read_file
from mesh_files import cause

CLEAN = Defects()


class Reads(NamedTuple):
    """Expected content of a file: parts, triangles or points, extents in metres, and defects."""

    n_parts: int
    n_pieces: int
    extents: tuple[float, float, float]
    defects: Defects = CLEAN
    is_cloud: bool = False


EXPECTED: dict[str, Reads | str] = {
    "AllIndicesOutOfRange.bin": "no known kind of file",
    "LICENSE.assimp.txt": "no known kind of file",
    "LICENSE.trimesh.md": "no known kind of file",
    "TRIMESH_BEHAVIOUR.txt": "no known kind of file",
    "assimp_AllIndicesOutOfRange.gltf": "12 out of range",
    "assimp_BoxBadNormals.glb": Reads(1, 12, (1, 1, 1)),
    "assimp_ConcavePolygon.dae": Reads(1, 64, (0, 1.485, 1.485)),
    "assimp_OutOfMemory.off": "promises 353,535,235,358 vertices",
    "assimp_badArray.gltf": "'primitives' is no list of objects",
    "assimp_crash_30d6.ply": "its header has no 'end_header'",
    "assimp_empty.obj": "it is empty",
    "assimp_invalid.off": "fewer corners than its first word says",
    "assimp_issue623.ply": Reads(1, 24, (3.7537, 3.7537, 3.7537), is_cloud=True),
    # f 4 12 2 1 loses one of its two triangles, f 0 7 8 5 loses both; one of f 5 8 8 1 has no area.
    "assimp_malformed.obj": Reads(1, 9, (1, 1, 1), Defects(degenerate=1, out_of_range=3)),
    "assimp_malformed2.obj": Reads(1, 10, (1, 1, 1), Defects(incomplete=1)),
    "assimp_malformed_property_index_oob.3mf": Reads(1, 1, (0.01, 0.02, 0)),
    "assimp_sphereWithHole.stl": Reads(1, 285, (3, 3, 3)),
    "assimp_triangle_with_empty_solid.stl": Reads(1, 1, (2, 2, 0), Defects(empty=1)),
    "assimp_triangle_with_two_solids.stl": Reads(2, 2, (4, 4, 0)),
    "derived_dup_and_degenerate_faces.obj": Reads(1, 9800, (0.021, 0.021, 0.01),
        Defects(degenerate=200)),
    "derived_flat_sheet.stl": Reads(1, 4800, (0.021, 0, 0.01), Defects(degenerate=384)),
    "derived_inside_out.stl": Reads(1, 4800, (0.021, 0.021, 0.01)),
    "derived_mirrored_singular_scaled_nodes.glb": Reads(5, 4582, (16, 4.8, 8),
        Defects(degenerate=236)),
    "derived_nan_vertices.ply": Reads(1, 4659, (0.021, 0.021, 0.01), Defects(non_finite=141)),
    "derived_outlier_vertex.ply": Reads(1, 4800, (72.1844, 9.5109, 50.005)),
    "derived_random_winding.stl": Reads(1, 4800, (0.021, 0.021, 0.01)),
    "derived_truncated.glb": "cut short: 619,032 bytes where its header promises 928,548",
    # float32 has steps of 0.5 at five million, so that small triangles lose their area.
    "derived_utm_offset_mm.ply": Reads(1, 4800, (21, 21, 10), Defects(degenerate=416)),
    "trimesh_1002_tray_bottom.STL": Reads(1, 4520, (355.6, 3.175, 355.6)),
    "trimesh_busted.STL": Reads(1, 3878, (10.6755, 11.3847, 9.5724)),
    "trimesh_counterXP.3MF": Reads(6, 83750, (0.3048, 0.3044, 0.0258)),
    "trimesh_cube_and_sphere_same_name.3mf": Reads(2, 5132, (0.0928, 0.04, 0.04)),
    "trimesh_empty.stl": "1 empty",
    "trimesh_empty_nodes.glb": "2 empty",
    "trimesh_featuretype.STEP": Reads(1, 9564, (0.127, 0.0635, 0.0349)),
    "trimesh_mirror.ply": Reads(1, 286, (1.118, 1.118, 0.118)),
    "trimesh_mode5.gltf": Reads(54, 2786, (57.15, 64.5358, 76.1178)),
    "trimesh_multibody.stl": Reads(2, 32, (0.636, 1.0884, 0.3399)),
    "trimesh_nancolor.obj": Reads(1, 12, (1, 1, 1)),
    "trimesh_negative_indices.obj": Reads(1, 12, (2, 2, 2)),
    "trimesh_no_indices_3storybuilding.glb": Reads(3, 72, (56.0801, 9, 63.3614)),
    "trimesh_not_convex.obj": Reads(1, 96, (0.366, 0.762, 0.762)),
    "trimesh_notenoughindices.obj": Reads(1, 1, (1000, 500, 0), Defects(incomplete=1)),
    "trimesh_obj_wireframe.obj": "12 of an unsupported kind",
    "trimesh_ply_points_bin.ply": Reads(1, 8, (2, 2, 2), is_cloud=True),
    "trimesh_points_emptyface.ply": Reads(1, 1024, (265.5073, 209.3957, 167.8175), is_cloud=True),
    "trimesh_soup.stl": Reads(1, 100, (0.9974, 0.9965, 0.9929)),
    "trimesh_two_objects_mixed_case_names.stl": Reads(2, 24, (6, 1, 1)),
    "trimesh_wallhole.obj": Reads(1, 66, (10, 15, 10), Defects(degenerate=9)),
}  # fmt: skip


def n_pieces(file: MeshFile) -> int:
    return sum(len(part.vertices if part.faces is None else part.faces) for part in file.parts)


def check(path: Path, expected: Reads | str, read: Callable[..., MeshFile]) -> None:
    if isinstance(expected, str):
        assert expected in cause(path, read)
        return
    file = read(path)
    assert (len(file.parts), n_pieces(file)) == (expected.n_parts, expected.n_pieces)
    points = np.concatenate([part.world_points() for part in file.parts])
    np.testing.assert_allclose(np.ptp(points, axis=0), expected.extents, atol=6e-5)
    assert file.defects == expected.defects
    assert {part.is_cloud for part in file.parts} == {expected.is_cloud}
    assert len({part.name for part in file.parts}) == len(file.parts)
    for part in file.parts:
        assert np.isfinite(part.world_points()).all()


@pytest.mark.parametrize("name", EXPECTED)
def test_dirty_file_counts_or_refusal(real_files: Path, name: str) -> None:
    check(real_files / "dirty" / name, EXPECTED[name], parse_in_process)


def test_dirty_files_all_expected(real_files: Path) -> None:
    assert sorted(path.name for path in (real_files / "dirty").iterdir()) == sorted(EXPECTED)


@pytest.mark.parametrize("name", ["assimp_malformed.obj", "assimp_AllIndicesOutOfRange.gltf"])
def test_dirty_file_in_child(real_files: Path, name: str) -> None:
    check(real_files / "dirty" / name, EXPECTED[name], read_file)


def test_gltf_assemblies_share_geometry(real_files: Path) -> None:
    for name, n_parts, n_shapes in (
        ("demo_vintage_car/vintage_car.glb", 200, 66),
        ("robot_lekiwi/lekiwi.glb", 42, 42),
    ):
        file = parse_in_process(real_files / name)
        assert len(file.parts) == n_parts
        assert len({id(part.vertices) for part in file.parts}) == n_shapes


def test_las_laz_file_one_cloud(real_files: Path) -> None:
    file = parse_in_process(real_files / "pointcloud" / "lone-star.laz")
    assert file.parts[0].is_cloud
    assert n_pieces(file) == 518_862
    np.testing.assert_allclose(file.bounds[1] - file.bounds[0], (32.44, 40.76, 15.68), atol=0.01)

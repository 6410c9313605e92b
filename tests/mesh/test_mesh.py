"""Files become parts: names, placements, units, and counts of defects."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hapticdb.mesh import UNITS, Defects, parse_in_process
from hapticdb.mesh.clean import clean
from hapticdb.mesh.parsed import Parsed, Placement, Shape, UnreadableError
from hapticdb.mesh.polygons import triangulated
from mesh_files import MESH_3MF, TRIANGLE, glb_of, gltf, names, text, threemf

# --- names and placements -------------------------------------------------------------------


def test_gltf_instances_are_parts_named_by_path(tmp_path: Path) -> None:
    tree = {
        "nodes": [
            {"name": "car", "children": [1, 2, 3], "translation": [10, 0, 0]},
            {"name": "wheel", "mesh": 0, "translation": [0, 1, 0]},
            {"name": "wheel", "mesh": 0, "translation": [0, 2, 0]},
            {"name": "a/b", "children": [4]},
            {"name": "nut", "mesh": 0, "scale": [2, 2, 2]},
        ]
    }
    file = parse_in_process(gltf(tree, tmp_path / "car.gltf"))
    assert names(file) == ["car/wheel", "car/wheel #2", "car/a/b/nut"]
    assert [part.bounds[0].tolist() for part in file.parts] == [[10, 1, 0], [10, 2, 0], [10, 0, 0]]
    assert file.parts[2].bounds[1].tolist() == [12, 2, 0]
    assert len({id(part.vertices) for part in file.parts}) == 1
    assert len({part.digest for part in file.parts}) == 1


def test_gltf_node_transform_order(tmp_path: Path) -> None:
    half = np.sqrt(0.5)
    node = {"mesh": 0, "translation": [5, 0, 0], "rotation": [0, 0, half, half], "scale": [2, 1, 1]}
    corners = parse_in_process(gltf({"nodes": [node]}, tmp_path / "a.gltf")).parts[0].triangles()[0]
    np.testing.assert_allclose(corners, [[5, 0, 0], [5, 2, 0], [4, 0, 0]], atol=1e-15)


def test_gltf_primitives_of_a_mesh_are_one_part(tmp_path: Path) -> None:
    piece = {"attributes": {"POSITION": 0}, "indices": 1}
    lines = {"attributes": {"POSITION": 0}, "mode": 1}
    path = gltf({"meshes": [{"primitives": [piece, piece, lines]}]}, tmp_path / "pieces.gltf")
    file = parse_in_process(path)
    assert len(file.parts) == 1
    assert file.parts[0].faces is not None
    assert file.parts[0].faces.tolist() == [[0, 1, 2], [0, 1, 2]]
    assert len(file.parts[0].vertices) == 3
    assert file.defects == Defects(unsupported=1)


def test_gltf_children_of_camera(tmp_path: Path) -> None:
    nodes = [{"name": "eye", "camera": 0, "children": [1]}, {"name": "tool", "mesh": 0}]
    tree = {"nodes": nodes, "cameras": [{"type": "perspective"}]}
    assert names(parse_in_process(gltf(tree, tmp_path / "eye.gltf"))) == ["eye/tool"]


def test_glb_equals_gltf(tmp_path: Path) -> None:
    one = gltf({"nodes": [{"name": "n", "mesh": 0, "scale": [1, 2, 3]}]}, tmp_path / "one.gltf")
    other = glb_of(one, tmp_path / "other.glb")
    a, b = parse_in_process(one).parts[0], parse_in_process(other).parts[0]
    assert (a.name, a.digest) == (b.name, b.digest)
    np.testing.assert_array_equal(a.world_from_part, b.world_from_part)


def test_part_names_control_characters(tmp_path: Path) -> None:
    tree = {"nodes": [{"name": "a\x00b\n\ud800", "mesh": 0}]}
    assert names(parse_in_process(gltf(tree, tmp_path / "odd.gltf"))) == ["a b ?"]


def test_obj_objects_and_groups_are_parts(tmp_path: Path) -> None:
    path = text(
        tmp_path / "two.obj",
        "v 0 0 0\nv 1 0 0\nv 0 1 0\no body\ng left\nusemtl a\nf 1 2 3\nusemtl b\nf 3 2 1\n"
        "g right\nf 1/1/1 2/1/1 3/1/1\no lid\nf 1 2 3\n",
    )
    file = parse_in_process(path)
    assert names(file) == ["body/left", "body/right", "lid"]
    assert [len(part.triangles()) for part in file.parts] == [2, 1, 1]


def test_obj_negative_indices(tmp_path: Path) -> None:
    content = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 0 0 5\nv 1 0 5\nv 0 1 5\nf -3 -2 -1\n"
    path = text(tmp_path / "relative.obj", content)
    heights = parse_in_process(path).parts[0].triangles()[:, :, 2]
    assert heights.tolist() == [[0, 0, 0], [5, 5, 5]]


def test_stl_text_solids_are_parts(tmp_path: Path) -> None:
    facet = (
        "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\n"
        "endfacet\n"
    )
    path = text(
        tmp_path / "solids.stl",
        f"solid vertex Holder\n{facet}endsolid solid Holder\nsolid\n{facet}{facet}endsolid\n"
        "solid hollow\nendsolid hollow\n",
    )
    file = parse_in_process(path)
    assert names(file) == ["vertex Holder", "solids"]
    assert [len(part.triangles()) for part in file.parts] == [1, 2]
    assert file.defects == Defects(empty=1)


def test_threemf_nested_components(tmp_path: Path) -> None:
    resources = f'<object id="1" name="bolt">{MESH_3MF}</object>'
    for n in range(2, 7):
        one = f'<component objectid="{n - 1}" transform="1 0 0 0 1 0 0 0 1 {n} 0 0"/>'
        whole = f'<component objectid="{n - 1}"/>'
        resources += f'<object id="{n}" name="n{n}"><components>{one}{whole}</components></object>'
    build = '<item objectid="6" partnumber="p"/>' * 2
    file = parse_in_process(threemf(tmp_path / "nest.3mf", resources, build))
    assert len(file.parts) == 2 * 2**5
    assert file.parts[0].name == "n6/n5/n4/n3/n2/bolt"
    assert len(set(names(file))) == len(file.parts)
    assert len({id(part.vertices) for part in file.parts}) == 1
    np.testing.assert_allclose(file.parts[0].bounds[0], [0.020, 0, 0])


# --- units ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("unit", "metres"), [(None, 1.0), *UNITS.items()])
def test_parse_unit_of_unitless_file(tmp_path: Path, unit: str | None, metres: float) -> None:
    path = text(tmp_path / "a.off", "OFF\n3 1 0\n0 0 0\n2 0 0\n0 4 0\n3 0 1 2\n")
    part = parse_in_process(path, unit=unit).parts[0]
    np.testing.assert_allclose(part.bounds[1], [2 * metres, 4 * metres, 0])


def test_parse_unit_of_file_wins(tmp_path: Path) -> None:
    plain = gltf({}, tmp_path / "a.gltf")
    file = parse_in_process(plain, unit="mm")
    assert file.parts[0].bounds[1].tolist() == [1, 1, 0]
    assert file.notes == ("it has a unit of its own: the one that was given does not apply",)
    assert parse_in_process(plain, unit="m").notes == ()
    build = '<item objectid="1" transform="1 0 0 0 1 0 0 0 1 100 0 0"/>'
    resources = f'<object id="1">{MESH_3MF}</object>'
    inches = threemf(tmp_path / "a.3mf", resources, build, 'unit="inch"')
    high = parse_in_process(inches, unit="mm").parts[0].bounds[1]
    np.testing.assert_allclose(high, [101 * 0.0254, 0.0254, 0])


# --- counts of defects ------------------------------------------------------------------------


def test_obj_bad_triangles_counted(tmp_path: Path) -> None:
    path = text(
        tmp_path / "bad.obj",
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv nan 0 0\nv inf 0 0\nv 9 9 9\n"
        "f 1 2 3\nf 1 2 2\nf 1 2 4\nf 2 3 5\nf 1 2 7\nf 0 1 2\nf 1 2 -9\nf 1 2\nl 1 2\n"
        "f 1 2 99999999999999999999999\n",
    )
    file = parse_in_process(path)
    assert file.defects == Defects(
        degenerate=1, non_finite=2, out_of_range=4, incomplete=1, unsupported=1
    )
    part = file.parts[0]
    assert part.faces is not None
    assert part.faces.tolist() == [[0, 1, 2], [0, 1, 1]]
    assert part.vertices.tolist() == TRIANGLE.tolist()
    assert file.defects.describe() == (
        "1 degenerate, 2 non-finite, 4 out of range, 1 incomplete, 1 of an unsupported kind"
    )


def test_gltf_index_out_of_primitive(tmp_path: Path) -> None:
    piece = {"attributes": {"POSITION": 0}, "indices": 1}
    plain = {"attributes": {"POSITION": 2}}
    path = gltf({}, tmp_path / "reach.gltf", indices=[0, 1, 4])
    tree = json.loads(path.read_text())
    tree["accessors"].append(dict(tree["accessors"][0]))
    tree["meshes"] = [{"primitives": [piece, plain]}]
    path.write_text(json.dumps(tree))
    file = parse_in_process(path)
    assert file.defects == Defects(out_of_range=1)
    assert len(file.parts[0].triangles()) == 1


def test_gltf_mirrored_flattened_scaled_placements(tmp_path: Path) -> None:
    places: dict[str, dict[str, list[float]]] = {
        "mirrored": {"scale": [-1, 1, 1]},
        "to a line": {"scale": [1, 0, 1]},
        "large": {"scale": [1000, 1000, 1000]},
        "nowhere": {"translation": [float("nan"), 0, 0]},
        "far": {"scale": [1e200, 1, 1]},
    }
    nodes = [{"mesh": 0, "name": name} | place for name, place in places.items()]
    tree = {"nodes": nodes, "scenes": [{"nodes": [*range(5)]}]}
    file = parse_in_process(gltf(tree, tmp_path / "scales.gltf"))
    assert names(file) == ["mirrored", "to a line", "large"]
    assert [part.defects.degenerate for part in file.parts] == [0, 1, 0]
    assert file.defects == Defects(degenerate=1, non_finite=2)


def test_ply_non_finite_points_counted(tmp_path: Path) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 3\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    file = parse_in_process(text(tmp_path / "a.ply", f"{head}end_header\n0 0 0\nnan 0 0\n1 2 3\n"))
    (part,) = file.parts
    assert part.is_cloud
    assert part.faces is None
    assert part.world_points().tolist() == [[0, 0, 0], [1, 2, 3]]
    assert part.triangles().shape == (0, 3, 3)
    assert file.defects == Defects(non_finite=1)


COORDINATE = st.floats(-10, 10) | st.sampled_from([np.nan, np.inf])


@given(
    st.lists(st.tuples(*[st.integers(-2, 6)] * 3), max_size=20),
    st.lists(st.tuples(*[COORDINATE] * 3), min_size=1, max_size=5),
)
def test_clean_all_triangles_accounted_for(
    corners: list[tuple[int, int, int]], points: list[tuple[float, float, float]]
) -> None:
    vertices = np.array(points, dtype=np.float64)
    faces = np.array(corners, dtype=np.int64).reshape(-1, 3)
    inside = [f for f in corners if all(0 <= i < len(points) for i in f)]
    sound = [f for f in inside if np.isfinite(vertices[list(f)]).all()]
    parsed = Parsed([Shape(vertices, faces)], [Placement("p", 0, np.eye(4))])
    if not sound:
        with pytest.raises(UnreadableError):
            clean(parsed, 1.0, "p.obj")
        return
    cleaned = clean(parsed, 1.0, "p.obj")
    kept, indices = cleaned.parts[0].vertices, cleaned.parts[0].faces
    assert indices is not None
    np.testing.assert_array_equal(kept[indices], vertices[np.array(sound)])
    assert cleaned.defects.out_of_range == len(corners) - len(inside)
    assert cleaned.defects.non_finite == len(inside) - len(sound)
    assert len(np.unique(indices)) == len(kept)


@given(
    st.lists(st.floats(0.2, 1), min_size=3, max_size=9), st.integers(0, 8), st.sampled_from([1, -1])
)
def test_triangulated_star_polygons_covered_once(radii: list[float], first: int, step: int) -> None:
    n = len(radii)
    angles = 2 * np.pi * np.arange(n) / n
    ring = np.stack([np.cos(angles), np.sin(angles), np.full(n, 1e3)], axis=1)
    ring[:, :2] *= np.array(radii)[:, None]
    faces, incomplete = triangulated(ring, [[(first + step * i) % n for i in range(n)], [0, 1]])
    a, b, c = (ring[faces[:, i], :2] for i in range(3))
    turns = step * np.linalg.det(np.stack([b - a, c - a], axis=1))
    assert (turns > -1e-6).all()
    after = np.roll(ring, -1, axis=0)
    assert turns.sum() == pytest.approx((ring[:, 0] * after[:, 1] - ring[:, 1] * after[:, 0]).sum())
    assert incomplete == 1

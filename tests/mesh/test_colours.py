"""Colours of triangles and points, as each format has them; a broken one loses no geometry."""

from pathlib import Path

import laspy
import numpy as np
import pytest
from numpy.typing import NDArray

from hapticdb.mesh import parse_in_process, read_file
from mesh_files import COLLADA, MESH_3MF, gltf, text, threemf, with_arrays

RED, GREEN, GLASS = (255, 0, 0, 255), (0, 255, 0, 255), (0, 0, 255, 64)


def colours_of(path: Path) -> NDArray[np.uint8]:
    """Colours of the file's first part."""
    colours = parse_in_process(path).parts[0].colours
    assert colours is not None
    return colours


def test_gltf_base_colours_linear_and_alpha_mode(tmp_path: Path) -> None:
    material = {"pbrMetallicRoughness": {"baseColorFactor": [0.5, 0, 1, 0.25]}}
    piece = {"attributes": {"POSITION": 0}, "indices": 1, "material": 0}
    plain = {"attributes": {"POSITION": 0}, "indices": 1, "material": 7}
    tree = {"meshes": [{"primitives": [piece, plain]}]}
    for mode, opacity in (("OPAQUE", 255), ("BLEND", 64)):
        path = gltf(tree | {"materials": [material | {"alphaMode": mode}]}, tmp_path / "a.gltf")
        first, second = colours_of(path)
        np.testing.assert_array_equal(first, [188, 0, 255, opacity])
        assert second[3] == 255  # of a material that is not there
    for broken in ([None], [{"pbrMetallicRoughness": {"baseColorFactor": "red"}}], "none"):
        path = gltf(tree | {"materials": broken}, tmp_path / "broken.gltf")
        assert parse_in_process(path).parts[0].colours is None


def test_gltf_vertex_colours_averaged(tmp_path: Path) -> None:
    """Also where the file is read in another process, as users read it."""
    shades = np.array([[255, 0, 0, 255]] * 3, dtype=np.uint8)
    piece = {"attributes": {"POSITION": 0, "COLOR_0": 2}, "indices": 1}
    tree = {"meshes": [{"primitives": [piece]}]}
    path = with_arrays(tmp_path / "a.gltf", tree, shades, normalized=True)
    for colours in (colours_of(path), read_file(path).parts[0].colours):
        np.testing.assert_array_equal(colours, [RED])


def test_obj_material_file(tmp_path: Path) -> None:
    body = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\n"
    faces = "usemtl pane\nf 1 2 3\nusemtl red\nf 2 3 4\nf -1 -2 -3\nusemtl none\nf 1 2 4\n"
    text(tmp_path / "m.mtl", "newmtl red\nKd 1 0 0\nmap_Kd x.png\nnewmtl pane\nKd 0 0 1\nTr 0.75\n")
    path = text(tmp_path / "a.obj", "mtllib m.mtl\n" + body + faces)
    found = colours_of(path)
    np.testing.assert_array_equal(found[:3], [GLASS, RED, RED])
    assert len(found) == 4
    assert found[3, 3] == 255
    for elsewhere in (f"{tmp_path}/m.mtl", "../m.mtl", "missing.mtl"):
        path = text(tmp_path / "b.obj", f"mtllib {elsewhere}\n" + body + faces)
        assert parse_in_process(path).parts[0].colours is None


def test_obj_vertex_colours(tmp_path: Path) -> None:
    path = text(tmp_path / "a.obj", "v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\nf 1 2 3\n")
    np.testing.assert_array_equal(colours_of(path), [RED])


def test_threemf_triangle_and_object_colours(tmp_path: Path) -> None:
    group = '<basematerials id="5"><base name="r" displaycolor="#FF0000"/>'
    group += '<base name="b" displaycolor="#0000FF40"/></basematerials>'
    two = MESH_3MF.replace("</triangles>", '<triangle v1="0" v2="2" v3="1" p1="1"/></triangles>')
    thing = f'{group}<object id="1" type="model" pid="5" pindex="0">{two}</object>'
    path = threemf(tmp_path / "a.3mf", thing, '<item objectid="1"/>')
    np.testing.assert_array_equal(colours_of(path), [RED, GLASS])


@pytest.mark.parametrize(
    ("clearness", "opacity"),
    [
        ("", 1),
        ("<transparency><float>0</float></transparency>", 1),
        ("<transparency><float>0.3</float></transparency>", 0.3),
        ("<transparent><color>1 1 1 0.2</color></transparent>", 0.2),
        ('<transparent opaque="RGB_ZERO"/><transparency><float>0.3</float></transparency>', 0.7),
        ('<transparent opaque="RGB_ZERO"><color>0 0 0 1</color></transparent>', 1),
        ('<transparent opaque="RGB_ZERO"><color>0 1 0 1</color></transparent>', 1 - 0.71516),
        ('<transparent opaque="RGB_ZERO"><color>1 1 1 1</color></transparent>', 1),
    ],
)
def test_collada_materials_of_placement(tmp_path: Path, clearness: str, opacity: float) -> None:
    effect = (
        '<library_effects><effect id="e"><profile_COMMON><technique sid="t"><lambert><diffuse>'
        f"<color>1 0 0 1</color></diffuse>{clearness}</lambert></technique></profile_COMMON>"
        '</effect></library_effects><library_materials><material id="m"><instance_effect url="#e"/>'
        "</material></library_materials>"
    )
    bound = (
        '<instance_geometry url="#g"><bind_material><technique_common><instance_material '
        'symbol="paint" target="#m"/></technique_common></bind_material></instance_geometry>'
    )
    content = COLLADA.replace("<library_geometries>", effect + "<library_geometries>")
    content = content.replace('<instance_geometry url="#g"/>', bound)
    content = content.replace('<polylist count="2">', '<polylist count="2" material="paint">')
    found = colours_of(text(tmp_path / "a.dae", content))
    np.testing.assert_array_equal(found[:3], [(255, 0, 0, round(255 * opacity))] * 3)
    assert len(found) == 4


def test_collada_corner_colours(tmp_path: Path) -> None:
    shades = (
        '<source id="c"><float_array id="ca" count="8">1 0 0 1 0 1 0 1</float_array>'
        '<technique_common><accessor source="#ca" count="2" stride="4"><param name="R"/>'
        '<param name="G"/><param name="B"/><param name="A"/></accessor></technique_common></source>'
    )
    content = COLLADA.replace('<vertices id="v">', shades + '<vertices id="v">')
    one = '<input semantic="COLOR" source="#c" offset="1"/><vcount>'
    content = content.replace("<vcount>", one)
    content = content.replace("<p>0 1 2 3 0 1 2<", "<p>0 0 1 0 2 0 3 0 0 1 1 1 2 1<")
    found = colours_of(text(tmp_path / "a.dae", content))
    np.testing.assert_array_equal(found[:3], [RED, RED, GREEN])
    assert found[3, 0] not in {0, 255}  # the triangles beside them have none


def test_ply_face_and_vertex_colours(tmp_path: Path) -> None:
    shade = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
    place = "property float x\nproperty float y\nproperty float z\n"
    corners = "property list uchar int vertex_indices\n"
    head = "ply\nformat ascii 1.0\nelement vertex 3\n" + place
    of_vertices = f"{head}{shade}element face 1\n{corners}end_header\n"
    of_vertices += "0 0 0 0 255 0\n1 0 0 0 255 0\n0 1 0 0 255 0\n3 0 1 2\n"
    np.testing.assert_array_equal(colours_of(text(tmp_path / "v.ply", of_vertices)), [GREEN])
    of_faces = f"{head}element face 1\n{corners}{shade}end_header\n"
    of_faces += "0 0 0\n1 0 0\n0 1 0\n3 0 1 2 255 0 0\n"
    np.testing.assert_array_equal(colours_of(text(tmp_path / "f.ply", of_faces)), [RED])
    cloud = f"{head}{shade}end_header\n0 0 0 0 255 0\n1 0 0 255 0 0\n0 1 0 0 255 0\n"
    found = colours_of(text(tmp_path / "c.ply", cloud))
    np.testing.assert_array_equal(found, [GREEN, RED, GREEN])


def test_las_point_colours(tmp_path: Path) -> None:
    """Of 16 bits, or of 8 as some programs write them."""
    for most in (65535, 255):
        cloud = laspy.LasData(laspy.LasHeader(point_format=2, version="1.2"))
        cloud.x, cloud.y, cloud.z = np.eye(3)
        cloud.red, cloud.green, cloud.blue = np.array([[most, 0, most], [0, most, 0], [0, 0, 0]])
        cloud.write(tmp_path / "a.las")
        np.testing.assert_array_equal(colours_of(tmp_path / "a.las"), [RED, GREEN, RED])

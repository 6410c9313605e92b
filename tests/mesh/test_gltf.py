"""glTF files as programs write them: read rightly, or told what is not read."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hapticdb.mesh import parse_in_process
from mesh_files import TRIANGLE, area_and_volume, cause, gltf, names, with_arrays


def test_gltf_skin_joints(tmp_path: Path) -> None:
    joints = np.array([[0, 1, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0]], dtype=np.uint8)
    weights = np.array([[0.5, 0.5, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0]], dtype="<f4")
    bind = np.stack([np.eye(4), np.eye(4)])
    bind[1, :3, 3] = [-5, 0, 0]
    inverse = bind.transpose(0, 2, 1).reshape(2, 16).astype("<f4")
    attributes = {"POSITION": 0, "JOINTS_0": 2, "WEIGHTS_0": 3}
    tree = {
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 1}]}],
        "nodes": [
            {"mesh": 0, "skin": 0, "name": "arm", "translation": [9, 9, 9]},
            {"name": "root", "translation": [0, 0, 2], "children": [2]},
            {"name": "tip", "translation": [5, 4, 0]},
        ],
        "skins": [{"joints": [1, 2], "inverseBindMatrices": 4}],
        "scenes": [{"nodes": [0, 1]}],
    }
    path = with_arrays(tmp_path / "skin.gltf", tree, joints, weights, inverse)
    moved = TRIANGLE + np.array([[0, 2, 2], [0, 4, 2], [0, 4, 2]])
    np.testing.assert_allclose(parse_in_process(path).parts[0].triangles()[0], moved, atol=1e-6)
    outside = tree | {"scenes": [{"nodes": [0]}]}
    path = with_arrays(tmp_path / "lost.gltf", outside, joints, weights, inverse)
    assert "a joint of its skin 0 is not in its scene" in cause(path)


def test_gltf_node_weights_override_mesh(tmp_path: Path) -> None:
    target = np.array([[0, 0, 1]] * 3, dtype="<f4")
    piece = {"attributes": {"POSITION": 0}, "indices": 1, "targets": [{"POSITION": 2}]}
    nodes: list[dict[str, Any]] = [{"mesh": 0}, {"mesh": 0, "weights": [0.25]}]
    tree = {"meshes": [{"primitives": [piece], "weights": [2]}], "nodes": nodes}
    path = with_arrays(tmp_path / "a.gltf", tree | {"scenes": [{"nodes": [0, 1]}]}, target)
    assert [part.bounds[0, 2] for part in parse_in_process(path).parts] == [2.0, 0.25]


def test_gltf_instances_within_node(tmp_path: Path) -> None:
    turned = np.array([[0, 0, 23170, 23170]], dtype="<i2")  # a quarter turn about z, normalized
    extension = {"EXT_mesh_gpu_instancing": {"attributes": {"ROTATION": 2}}}
    tree = {"nodes": [{"mesh": 0, "translation": [1, 0, 0], "extensions": extension}]}
    path = with_arrays(tmp_path / "a.gltf", tree, turned, normalized=True)
    corners = parse_in_process(path).parts[0].triangles()[0]
    np.testing.assert_allclose(corners, [[1, 0, 0], [1, 1, 0], [0, 0, 0]], atol=1e-4)


def test_gltf_extensions_counted_or_refused(tmp_path: Path) -> None:
    nodes = [{"mesh": 0, "extensions": {"KHR_implicit_shapes": {}, "KHR_xmp_json_ld": {}}}] * 2
    tree: dict[str, Any] = {"nodes": nodes, "scenes": [{"nodes": [0, 1]}]}
    file = parse_in_process(gltf(tree, tmp_path / "a.gltf"))
    assert file.notes == ("its extension KHR_implicit_shapes is not read (2x)",)
    tree["extensionsRequired"] = ["KHR_implicit_shapes"]
    assert "requires the glTF extension KHR_implicit" in cause(gltf(tree, tmp_path / "b.gltf"))


def test_gltf_instances_without_position(tmp_path: Path) -> None:
    numbers = np.array([[1], [2]], dtype="<f4")
    extension = {"EXT_mesh_gpu_instancing": {"attributes": {"_ID": 2}}}
    tree = {"nodes": [{"mesh": 0, "extensions": extension}]}
    assert len(parse_in_process(with_arrays(tmp_path / "a.gltf", tree, numbers)).parts) == 2
    extension["EXT_mesh_gpu_instancing"]["attributes"] = {"_ID": 2, "TRANSLATION": 0}
    path = with_arrays(tmp_path / "b.gltf", tree, numbers)
    assert "the attributes of its instances are not of one length" in cause(path)


def test_gltf_damage_beside_geometry(tmp_path: Path) -> None:
    plain: dict[str, Any] = {"attributes": {"POSITION": 0}, "indices": 1}
    trees: list[dict[str, Any]] = [
        {"meshes": [{"primitives": [plain, {"attributes": {"_X": 0}}, {"attributes": {}}]}]},
        {"meshes": [{"primitives": [plain | {"material": 0}]}], "materials": [{"extensions": []}]},
        {"nodes": [{"mesh": 0, "extensions": []}]},
        {"nodes": [{"mesh": 0, "extensions": {"KHR_node_visibility": True}}]},
        {"meshes": [{"primitives": [plain | {"extensions": {"KHR_draco_mesh_compression": {}}}]}]},
        {"nodes": [{"mesh": 0, "weights": None}]},
        {"extensionsRequired": ["ADOBE_materials_clearcoat_tint"]},
    ]
    for n, tree in enumerate(trees):
        file = parse_in_process(gltf(tree, tmp_path / f"{n}.gltf"))
        assert area_and_volume(file)[0] == pytest.approx(0.5)
        assert file.defects.unsupported == (2 if n == 0 else 0)


def test_gltf_float_integers_and_zero_accessors(
    tmp_path: Path,
) -> None:
    path = gltf({"nodes": [{"mesh": 0}]}, tmp_path / "a.gltf")
    text = re.sub(r'("(?:count|bufferView|mesh)": \d+)', r"\1.0", path.read_text())
    assert text.count(".0") >= 3
    path.write_text(text)
    assert area_and_volume(parse_in_process(path))[0] == pytest.approx(0.5)
    tree = json.loads(text)
    del tree["accessors"][1]["bufferView"]  # three indices 0
    path.write_text(json.dumps(tree))
    assert parse_in_process(path).defects.degenerate == 1
    path.write_text(json.dumps(tree | {"extensionsUsed": ["KHR_draco_mesh_compression"]}))
    assert "packed numbers are not read" in cause(path)


def test_gltf_mesh_without_node(tmp_path: Path) -> None:
    mesh = {"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}
    file = parse_in_process(gltf({"meshes": [mesh, mesh]}, tmp_path / "a.gltf"))
    assert file.notes == ("1 mesh is in no node and is left out",)


def test_gltf_node_listed_twice_placed_once(tmp_path: Path) -> None:
    nodes = [{"mesh": 0}, {"children": [2], "translation": [1, 0, 0]}, {"children": [0]}]
    tree = {"nodes": nodes, "scenes": [{"nodes": [0, 1, 2]}]}
    file = parse_in_process(gltf(tree, tmp_path / "a.gltf"))
    assert [part.bounds[0, 0] for part in file.parts] == [1.0]


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1"])
def test_gltf_text_encoding(tmp_path: Path, encoding: str) -> None:
    path = gltf({"nodes": [{"mesh": 0, "name": "NAME"}]}, tmp_path / "a.gltf")
    path.write_bytes(path.read_text().replace("NAME", "Größe").encode(encoding))
    assert names(parse_in_process(path)) == ["Größe"]

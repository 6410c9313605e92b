"""Files that cannot be read end in one line that names file and cause."""

import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hapticdb.mesh import SUFFIXES, parse_in_process, read_file
from hapticdb.mesh.raw import UnreadableError, walk
from mesh_files import MESH_3MF, cause, glb_of, gltf, text, threemf


def test_what_is_no_readable_file_is_named_with_its_cause(tmp_path: Path) -> None:
    assert "no such file" in cause(tmp_path / "gone.stl", read_file)
    assert "directory" in cause(tmp_path, read_file)
    assert "'.xyz'" in cause(text(tmp_path / "a.xyz", "1 2 3"), read_file)
    assert "empty" in cause(text(tmp_path / "a.stl", ""), read_file)
    os.mkfifo(tmp_path / "pipe.stl")
    assert "regular" in cause(tmp_path / "pipe.stl", read_file)
    loop = tmp_path / "loop.stl"
    loop.symlink_to(loop)
    cause(loop, read_file)


def test_a_file_without_permission_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    path = text(tmp_path / "a.off", "OFF")
    monkeypatch.setattr(Path, "open", refuse)
    assert "permission denied" in cause(path, read_file)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_bytes_of_another_format_end_in_one_line(tmp_path: Path, suffix: str) -> None:
    strangers = {
        "stl": b"\0" * 80 + struct.pack("<I", 1) + b"\1" * 50,
        "text": b"The quick brown fox\njumps over the lazy dog\n" * 9,
        "noise": bytes(range(256)) * 8,
        "zip": b"PK\x03\x04" + b"\0" * 100,
        "null": b"\0" * 200,
    }
    for name, content in strangers.items():
        if suffix == ".stl" and name == "stl":
            continue
        path = tmp_path / f"{name}{suffix}"
        path.write_bytes(content)
        cause(path)


@pytest.mark.parametrize("kept", [0.5, 0.99])
def test_a_file_cut_short_is_refused(tmp_path: Path, kept: float) -> None:
    corners = np.random.default_rng(1).random((60, 3))
    rows = "".join(f"{x} {y} {z}\n" for x, y, z in corners)
    faces = "".join(f"3 {i} {i + 1} {i + 2}\n" for i in range(0, 60, 3))
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    header = (
        f"element vertex 60\n{properties}element face 20\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    facet = np.zeros(20, dtype=[("f", "<f4", 12), ("a", "<u2")])
    face = np.zeros(20, dtype=[("n", "u1"), ("i", "<i4", 3)])
    face["n"], face["i"] = 3, np.arange(60).reshape(20, 3)
    binary = b"ply\nformat binary_little_endian 1.0\n" + header.encode()
    solid = "".join(
        "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\n"
        "endfacet\n"
        for _ in range(20)
    )
    whole = {
        "a.off": f"OFF\n60 20 0\n{rows}{faces}".encode(),
        "a.ply": f"ply\nformat ascii 1.0\n{header}{rows}{faces}".encode(),
        "b.ply": binary + corners.astype("<f4").tobytes() + face.tobytes(),
        "a.stl": b"\0" * 80 + struct.pack("<I", 20) + facet.tobytes(),
        "b.stl": f"solid a\n{solid}endsolid a".encode(),
    }
    whole["a.glb"] = glb_of(gltf({}, tmp_path / "s.gltf"), tmp_path / "s.glb").read_bytes()
    whole["a.3mf"] = threemf(
        tmp_path / "s.3mf", f'<object id="1">{MESH_3MF}</object>', '<item objectid="1"/>'
    ).read_bytes()
    for name, content in whole.items():
        path = tmp_path / name
        path.write_bytes(content)
        parse_in_process(path)
        path.write_bytes(content[: int(len(content) * kept)])
        cause(path)


def test_a_glTF_that_would_be_read_wrongly_is_refused(tmp_path: Path) -> None:  # noqa: N802
    packed = {"extensionsRequired": ["KHR_draco_mesh_compression"]}
    assert "KHR_draco" in cause(gltf(packed, tmp_path / "a.gltf"))
    assert "mesh 7" in cause(gltf({"nodes": [{"mesh": 7}]}, tmp_path / "b.gltf"))
    assert "node 9" in cause(gltf({"scenes": [{"nodes": [9]}]}, tmp_path / "c.gltf"))
    lost = {"buffers": [{"byteLength": 48, "uri": "lost.bin"}]}
    assert "lost.bin" in cause(gltf(lost, tmp_path / "d.gltf"))
    bent = {"nodes": [{"mesh": 0, "matrix": [1, 0, 0, 5, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}]}
    assert "affine" in cause(gltf(bent, tmp_path / "e.gltf"))
    assert "version 1" in cause(_version_one(tmp_path / "f.glb"))


def _version_one(path: Path) -> Path:
    path.write_bytes(struct.pack("<4s2I", b"glTF", 1, 20) + b"\0\0\0\0JSON")
    return path


def test_nodes_that_hold_themselves_are_refused(tmp_path: Path) -> None:
    nodes = [{"children": [1]}, {"children": [0], "mesh": 0}]
    assert "own ancestor" in cause(gltf({"nodes": nodes}, tmp_path / "cycle.gltf"))
    resources = (
        '<object id="1"><components><component objectid="2"/></components></object>'
        '<object id="2"><components><component objectid="1"/></components></object>'
    )
    path = threemf(tmp_path / "cycle.3mf", resources, '<item objectid="1"/>')
    assert "own ancestor" in cause(path)


def test_deep_nodes_cost_no_stack(tmp_path: Path) -> None:
    depth = 5000
    nodes: list[dict[str, Any]] = [{"name": "n", "children": [i + 1]} for i in range(depth)]
    nodes.append({"mesh": 0, "name": "leaf"})
    file = parse_in_process(gltf({"nodes": nodes}, tmp_path / "deep.gltf"))
    assert file.parts[0].name.count("/") == depth


def test_placements_that_multiply_are_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hapticdb.mesh.raw.MAX_NODES", 1000)
    eye = np.eye(4)
    with pytest.raises(UnreadableError, match="1,000"):
        for _ in walk([(0, eye)], lambda i: [(2 * i + 1, eye), (2 * i + 2, eye)]):
            pass

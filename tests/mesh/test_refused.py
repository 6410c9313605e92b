"""Files that cannot be read end in one line that names file and cause."""

import os
import struct
from pathlib import Path
from typing import Any

import pytest

from file_seeds import seeds
from hapticdb.mesh import SUFFIXES, parse_in_process, read_file
from mesh_files import cause, gltf, text, threemf


def test_read_file_unreadable_paths(tmp_path: Path) -> None:
    assert "no such file" in cause(tmp_path / "gone.stl", read_file)
    assert "directory" in cause(tmp_path, read_file)
    assert "'.xyz'" in cause(text(tmp_path / "a.xyz", "1 2 3"), read_file)
    assert "empty" in cause(text(tmp_path / "a.stl", ""), read_file)
    os.mkfifo(tmp_path / "pipe.stl")
    assert "regular" in cause(tmp_path / "pipe.stl", read_file)
    loop = tmp_path / "loop.stl"
    loop.symlink_to(loop)
    cause(loop, read_file)


def test_read_file_permission_denied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    path = text(tmp_path / "a.off", "OFF")
    monkeypatch.setattr(Path, "open", refuse)
    assert "permission denied" in cause(path, read_file)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_parse_content_of_another_format(tmp_path: Path, suffix: str) -> None:
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


@pytest.mark.parametrize("suffix", [".off", ".ply", ".stl", ".glb", ".3mf"])
@pytest.mark.parametrize("kept", [0.45, 0.85])
def test_parse_truncated_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, kept: float
) -> None:
    monkeypatch.delenv("HAPTICDB_TEST_DATA", raising=False)
    path = tmp_path / f"a{suffix}"
    for content in seeds(suffix, tmp_path):
        path.write_bytes(content)
        parse_in_process(path)
        path.write_bytes(content[: int(len(content) * kept)])
        cause(path)


@pytest.mark.parametrize(
    ("tree", "word"),
    [
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "KHR_draco"),
        ({"nodes": [{"mesh": 7}]}, "mesh 7"),
        ({"scenes": [{"nodes": [9]}]}, "node 9"),
        ({"buffers": [{"byteLength": 48, "uri": "lost.bin"}]}, "lost.bin"),
        ({"nodes": [{"mesh": 0, "matrix": [1, 0, 0, 5] * 4}]}, "affine"),
        ({"nodes": [{"children": [1]}, {"children": [0], "mesh": 0}]}, "own ancestor"),
    ],
)
def test_gltf_unsupported_features_refused(tmp_path: Path, tree: dict[str, Any], word: str) -> None:
    assert word in cause(gltf(tree, tmp_path / "a.gltf"))


def test_parse_glb_version_1_and_cyclic_threemf(tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    path.write_bytes(struct.pack("<4s2I", b"glTF", 1, 20) + b"\0\0\0\0JSON")
    assert "version 1" in cause(path)
    holds = '<object id="{}"><components><component objectid="{}"/></components></object>'
    resources = holds.format(1, 2) + holds.format(2, 1)
    path = threemf(tmp_path / "cycle.3mf", resources, '<item objectid="1"/>')
    assert "own ancestor" in cause(path)


def test_gltf_deep_nodes_no_recursion(tmp_path: Path) -> None:
    depth = 5000
    nodes: list[dict[str, Any]] = [{"name": "n", "children": [i + 1]} for i in range(depth)]
    nodes.append({"mesh": 0, "name": "leaf"})
    file = parse_in_process(gltf({"nodes": nodes}, tmp_path / "deep.gltf"))
    assert file.parts[0].name.count("/") == depth

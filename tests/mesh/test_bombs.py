"""Small files that would take much memory or time, or declare points that are missing."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from children import TIMEOUT
from hapticdb.errors import FileError, UsageError
from hapticdb.ingest.files import ImportOptions, import_files
from hapticdb.mesh import parse_in_process, read_file
from hapticdb.mesh.formats import accessors
from mesh_files import TRIANGLE, cause, glb_of, gltf, text


def test_gltf_self_reference_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """9,000 buffers that all name the file itself once took 5.6 GB of memory."""
    n = 500
    view = {"componentType": 5126, "count": 3, "type": "VEC3"}
    tree = {
        "buffers": [{"byteLength": 100, "uri": "self.gltf"}] * n,
        "bufferViews": [{"buffer": i, "byteLength": 36} for i in range(n)],
        "accessors": [view | {"bufferView": i} for i in range(n)],
        "meshes": [{"primitives": [{"attributes": {"POSITION": i}}]} for i in range(n)],
        "nodes": [{"mesh": i} for i in range(n)],
        "scenes": [{"nodes": list(range(n))}],
    }
    path = gltf(tree, tmp_path / "self.gltf")
    read: list[Path] = []
    bytes_of = accessors._bytes_of

    def counted(file: Path) -> bytes:
        read.append(file)
        return bytes_of(file)

    monkeypatch.setattr(accessors, "_bytes_of", counted)
    assert len(parse_in_process(path).parts) == n
    assert len(read) == 1


def test_gltf_unused_data_not_read(tmp_path: Path) -> None:
    tree = json.loads(gltf({}, tmp_path / "a.gltf").read_text())
    tree["buffers"].append({"byteLength": 1 << 40, "uri": "picture.bin"})
    tree["accessors"].append({"componentType": 5126, "count": 1 << 40, "type": "VEC3"})
    path = text(tmp_path / "b.gltf", json.dumps(tree))
    np.testing.assert_array_equal(parse_in_process(path).parts[0].vertices, TRIANGLE)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"buffers": {"a": 1}}, "'buffers' is no list of objects"),
        ({"accessors": [None]}, "'accessors' is no list of objects"),
        ({"scenes": 3}, "'scenes' is no list of objects"),
        ({"buffers": [{"byteLength": 48, "uri": 5}]}, "'uri'"),
        ({"buffers": [{"byteLength": 48, "uri": "data:,abc"}]}, "base64"),
        ({"scenes": [{"nodes": {"a": 1}}]}, "'nodes'"),
        ({"scenes": [{"nodes": [True]}]}, "no whole number"),
        ({"nodes": [{"mesh": 0, "children": [0.5]}]}, "no whole number"),
        ({"nodes": [{"mesh": -1}]}, "no whole number"),
        ({"scene": 4}, "scene 4 of 1"),
    ],
)
def test_gltf_bad_types_and_numbers(tmp_path: Path, change: dict[str, Any], word: str) -> None:
    assert word in cause(gltf(change, tmp_path / "a.gltf"))


@pytest.mark.parametrize("suffix", [".gltf", ".glb"])
def test_gltf_unbounded_nesting(tmp_path: Path, suffix: str) -> None:
    path = text(tmp_path / "a.gltf", '{"asset":{"version":"2.0"},"nodes":' + "[" * 100_000)
    if suffix == ".glb":
        path = glb_of(path, tmp_path / "a.glb")
    assert "nested too deeply" in cause(path, read_file)


def _las(tmp_path: Path, **counts: int) -> Path:
    """A LAS 1.4 file of three points in format 0, with the given counts in its header."""
    header = bytearray(375)
    header[:4], header[24], header[25], header[105] = b"LASF", 1, 4, 20
    given = {"size": 375, "points_at": 375} | counts
    struct.pack_into("<HI", header, 94, given["size"], given["points_at"])
    struct.pack_into("<I", header, 107, 3)
    struct.pack_into("<3d", header, 131, 0.01, 0.01, 0.01)
    struct.pack_into("<Q", header, 247, 3)
    path = tmp_path / "a.las"
    path.write_bytes(bytes(header) + bytes(60))
    return path


def test_las_declared_counts_beyond_file(tmp_path: Path) -> None:
    assert len(parse_in_process(_las(tmp_path)).parts[0].vertices) == 3
    assert "points begin" in cause(_las(tmp_path, points_at=1 << 31))
    assert "points begin" in cause(_las(tmp_path, size=12))


def test_import_options_time_and_memory_limit(tmp_path: Path) -> None:
    path = text(tmp_path / "a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n" * 20_000 + "f 1 2 3\n")
    for options in ({"time_limit": 1e-3}, {"memory_limit": 1}):
        with pytest.raises(FileError, match=f"--{next(iter(options)).replace('_', '-')}"):
            import_files(tmp_path / "a.db", [path], ImportOptions(**options))
    (report,) = import_files(tmp_path / "a.db", [path], ImportOptions(time_limit=TIMEOUT))
    assert report.status == "imported"
    with pytest.raises(UsageError, match="above 0"):
        ImportOptions(time_limit=0.0)


def _laz(path: Path, point_format: int, n_points: int) -> Path:
    """A LAZ file with points of the given format and extra bytes."""
    laspy = pytest.importorskip("laspy", reason="the extra 'pointcloud' is not installed")
    header = laspy.LasHeader(point_format=point_format, version="1.4")
    header.add_extra_dims([laspy.ExtraBytesParams("a", "f8"), laspy.ExtraBytesParams("b", "u2")])
    cloud = laspy.LasData(header)
    rng = np.random.default_rng(point_format)
    cloud.x, cloud.y, cloud.z = rng.random((3, n_points)) * 100.0
    cloud.a = rng.random(n_points)
    cloud.write(str(path))
    return path


def test_read_file_laz_crash_is_damage(tmp_path: Path) -> None:
    path = _laz(tmp_path / "a.laz", 3, 100)
    content = bytearray(path.read_bytes())
    points_at = int.from_bytes(content[96:100], "little")
    table_at = int.from_bytes(content[points_at : points_at + 8], "little")
    content[table_at + 4 : table_at + 8] = b"\xff" * 4  # number of chunks
    path.write_bytes(content)
    with pytest.raises(FileError, match=r"a\.laz: it is damaged or cut short, .*: copy it anew"):
        read_file(path)


@pytest.mark.parametrize("point_format", [3, 6, 10])
def test_las_laz_point_formats_in_chunks(tmp_path: Path, point_format: int) -> None:
    n_points = 110_000  # chunks have 50,000 points
    file = parse_in_process(_laz(tmp_path / "a.laz", point_format, n_points))
    assert len(file.parts[0].vertices) == n_points

"""Small mesh files for tests, and the line with which a file is refused."""

import base64
import json
import struct
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from hapticdb.errors import FileError
from hapticdb.mesh import MeshFile, parse_in_process

TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=np.float32)


def gltf(
    tree: dict[str, Any],
    path: Path,
    vertices: NDArray[np.float32] = TRIANGLE,
    indices: Sequence[int] = (0, 1, 2),
) -> Path:
    """A glTF file of one mesh (accessor 0: positions, 1: indices); `tree` replaces parts of it."""
    corners = np.asarray(indices, dtype=np.uint32)
    content = vertices.tobytes() + corners.tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(content).decode()
    whole: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(content), "uri": uri}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": vertices.nbytes},
            {"buffer": 0, "byteOffset": vertices.nbytes, "byteLength": corners.nbytes},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(vertices), "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": corners.size, "type": "SCALAR"},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }
    path.write_text(json.dumps(whole | tree))
    return path


def with_arrays(path: Path, tree: dict[str, Any], *arrays: NDArray[Any], **extra: object) -> Path:
    """A glTF file of one triangle with more accessors, from number 2 on; `extra` goes into each."""
    whole = json.loads(gltf(tree, path).read_text())
    kinds = {"f4": 5126, "u1": 5121, "i2": 5122, "u2": 5123}
    shapes = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
    for n, array in enumerate(arrays, 1):
        uri = "data:;base64," + base64.b64encode(array.tobytes()).decode()
        whole["buffers"].append({"byteLength": array.nbytes, "uri": uri})
        whole["bufferViews"].append({"buffer": n, "byteLength": array.nbytes})
        kind, shape = kinds[array.dtype.str[1:]], shapes[array.shape[1]]
        view = {"bufferView": n + 1, "componentType": kind, "type": shape, "count": len(array)}
        whole["accessors"].append(view | extra)
    path.write_text(json.dumps(whole))
    return path


def glb_of(path: Path, out: Path) -> Path:
    """The same file as GLB, its buffer still inside the JSON."""
    text = path.read_bytes()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4s2I2I", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A)
    out.write_bytes(head + text)
    return out


def threemf(path: Path, resources: str, build: str, unit: str = 'unit="millimeter"') -> Path:
    core = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
    model = (
        f'<?xml version="1.0"?><model {unit} xmlns="{core}"><resources>{resources}</resources>'
        f"<build>{build}</build></model>"
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("3D/3dmodel.model", model)
    return path


MESH_3MF = (
    '<mesh><vertices><vertex x="0" y="0" z="0"/><vertex x="1" y="0" z="0"/>'
    '<vertex x="0" y="1" z="0"/></vertices><triangles><triangle v1="0" v2="1" v3="2"/>'
    "</triangles></mesh>"
)

COLLADA = """<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema"
version="1.4.1"><asset><unit meter="0.01"/><up_axis>Z_UP</up_axis></asset><library_geometries>
<geometry id="g" name="leaf"><mesh><source id="p"><float_array id="pa" count="12">0 0 0 1 0 0 1 1 0
0 1 0</float_array><technique_common><accessor source="#pa" count="4" stride="3">
<param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
</accessor></technique_common></source><vertices id="v"><input semantic="POSITION" source="#p"/>
</vertices><polylist count="2"><input semantic="VERTEX" source="#v" offset="0"/>
<vcount>4 3</vcount><p>0 1 2 3 0 1 2</p></polylist><triangles count="1">
<input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p></triangles></mesh></geometry>
</library_geometries><library_visual_scenes><visual_scene id="s"><node id="a" name="tree">
<translate>100 0 0</translate><node id="b" name="branch"><scale>2 2 2</scale>
<instance_geometry url="#g"/></node></node></visual_scene></library_visual_scenes><scene>
<instance_visual_scene url="#s"/></scene></COLLADA>"""
"""A quadrilateral and two triangles in the nodes tree/branch; hundredths of a metre, z up."""


def text(path: Path, content: str) -> Path:
    path.write_text(content)
    return path


def names(file: MeshFile) -> list[str]:
    return [part.name for part in file.parts]


def cause(path: Path, read: Callable[..., MeshFile] = parse_in_process, **options: float) -> str:
    """The one line with which a file is refused; fails if the file is read."""
    with pytest.raises(FileError) as raised:
        read(path, **options)
    line = str(raised.value)
    assert str(path) in line
    assert "\n" not in line
    assert line.isprintable()
    return line


def area_and_volume(file: MeshFile) -> tuple[float, float]:
    """Area and enclosed volume of all triangles."""
    area = volume = 0.0
    for part in file.parts:
        corners = part.triangles()
        corners = corners - part.bounds[0]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area += float(np.linalg.norm(normals, axis=1).sum()) / 2
        volume += float(np.einsum("ij,ij", corners[:, 0], normals)) / 6
    return area, volume

"""glTF and GLB: meshes through trimesh's loader, nodes by our own walk.

trimesh's scene graph names the pieces of one mesh at random, drops what hangs under a camera, and
keeps one of several placements of a node. So trimesh gets the file's meshes alone, renamed by
number, and the node tree is read here: one part a placed mesh, its pieces joined.
"""

import io
import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray
from trimesh.exchange.gltf import load_glb, load_gltf
from trimesh.resolvers import FilePathResolver

from hapticdb.mesh.part import Defects
from hapticdb.mesh.raw import Parsed, Placement, Shape, UnreadableError, walk

_MAGIC = b"glTF"
_POINTS, _TRIANGLES, _STRIP = 0, 4, 5
# Extensions that leave the geometry where it is; a file that requires another is refused.
_HARMLESS = (
    "KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "KHR_lights_", "KHR_xmp",
    "KHR_animation_", "KHR_node_", "KHR_mesh_quantization", "AGI_", "CESIUM_", "EXT_mesh_features",
)  # fmt: skip


def read(path: Path) -> Parsed:
    """Parts of the file's default scene, in metres."""
    content = path.read_bytes()
    tree = load_tree(content, path.suffix.lower())
    _refuse_unreadable(tree)
    shapes = _shapes(tree, content, path)
    placements, empty = _placements(tree, shapes)
    used = sorted({placement.shape for placement in placements})
    number = {mesh: i for i, mesh in enumerate(used)}
    return Parsed(
        shapes=[shapes[mesh] for mesh in used],
        placements=[Placement(p.name, number[p.shape], p.world_from_part) for p in placements],
        metres=1.0,
        defects=Defects(empty=empty),
        up=_up_axis(tree),
    )


def _up_axis(tree: dict[str, Any]) -> str:
    """Axis that points up: y by the specification, unless the file says that it differs."""
    extras = tree.get("asset", {}).get("extras") if isinstance(tree.get("asset"), dict) else None
    up = extras.get("up_axis") if isinstance(extras, dict) else None
    return up if isinstance(up, str) and up in {"x", "y", "z"} else "y"


def load_tree(content: bytes, suffix: str) -> dict[str, Any]:
    """JSON part of a glTF or GLB file."""
    if content[:4] == _MAGIC:
        if len(content) < 20 or content[16:20] != b"JSON":
            raise UnreadableError(
                "it is cut short or no GLB file: no JSON chunk follows its header"
            )
        version, length, n_json = struct.unpack("<3I", content[4:16])
        if version != 2:
            raise UnreadableError(f"it is of glTF version {version}; version 2 can be read")
        if length > len(content):
            raise UnreadableError(
                f"it is cut short: {len(content):,} bytes where its header promises {length:,}"
            )
        text = content[20 : 20 + n_json]
    elif suffix == ".glb":
        raise UnreadableError("it is no GLB file: it does not start with 'glTF'")
    else:
        text = content
    try:
        tree = json.loads(text.decode("utf-8-sig"))
    except ValueError:
        raise UnreadableError("it is no glTF file, or damaged: its text is not JSON") from None
    if not isinstance(tree, dict) or "asset" not in tree:
        raise UnreadableError("it is no glTF file: its JSON has no 'asset'")
    return tree


def external_bytes(path: Path) -> int:
    """Size of the files that a glTF file refers to, as far as they are there."""
    total = 0
    for buffer in load_tree(path.read_bytes(), path.suffix.lower()).get("buffers", []):
        file = path.parent / unquote(_external_name(buffer) or "")
        if file.is_file():
            total += file.stat().st_size
    return total


def _external_name(buffer: dict[str, Any]) -> str | None:
    """File that a buffer is kept in, None where the glTF holds it."""
    name = buffer.get("uri")
    return None if name is None or name.startswith("data:") else str(name)


def _refuse_unreadable(tree: dict[str, Any]) -> None:
    """Say what trimesh would read wrongly in silence: packed, sparse or scaled positions."""
    for extension in tree.get("extensionsRequired", []):
        if not str(extension).startswith(_HARMLESS):
            raise UnreadableError(f"it requires the glTF extension {extension}, which is not read")
    accessors = tree.get("accessors", [])
    for number, mesh in enumerate(tree.get("meshes", [])):
        if not isinstance(mesh.get("primitives"), list):
            raise UnreadableError(f"it is damaged: the primitives of its mesh {number} are no list")
        for primitive in mesh["primitives"]:
            position = primitive.get("attributes", {}).get("POSITION")
            if position is None:
                continue
            accessor = accessors[position]
            if "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
                raise UnreadableError("its meshes are packed with Draco, which is not read")
            if "sparse" in accessor or accessor.get("normalized"):
                raise UnreadableError("its positions are sparse or normalized, which is not read")


def _shapes(tree: dict[str, Any], content: bytes, path: Path) -> list[Shape]:
    """Geometry of every mesh, its pieces joined, in the order of the file."""
    meshes = tree.get("meshes", [])
    pieces = []
    for i, mesh in enumerate(meshes):
        for j, piece in enumerate(mesh["primitives"]):
            if piece.get("mode", _TRIANGLES) in {_POINTS, _TRIANGLES, _STRIP}:
                kept = {key: piece[key] for key in ("mode", "indices") if key in piece}
                kept["attributes"] = {"POSITION": piece["attributes"]["POSITION"]}
                pieces.append({"name": f"{i}.{j}", "primitives": [kept]})
    loaded = _load(tree | {"meshes": pieces}, content, path) if pieces else {}
    return [_joined(mesh["primitives"], i, loaded) for i, mesh in enumerate(meshes)]


def _load(tree: dict[str, Any], content: bytes, path: Path) -> dict[str, dict[str, Any]]:
    """Vertices and faces of the meshes of `tree`, by name, through trimesh."""
    kept = ("asset", "buffers", "bufferViews", "accessors", "meshes")
    reduced = {key: tree[key] for key in kept if key in tree}
    for buffer in reduced.get("buffers", []):
        name = _external_name(buffer)
        if name is not None and not (path.parent / name).is_file():
            if not (path.parent / unquote(name)).is_file():
                raise UnreadableError(f"it refers to {name}, which is not beside it")
            buffer["uri"] = unquote(name)
    text = json.dumps(reduced).encode()
    resolver = FilePathResolver(str(path))
    if content[:4] != _MAGIC:
        stream = io.BytesIO(text)
        return dict(load_gltf(stream, resolver=resolver, skip_materials=True)["geometry"])
    chunks = content[20 + struct.unpack("<I", content[12:16])[0] :]
    head = struct.pack("<4s2I2I", _MAGIC, 2, 20 + len(text) + len(chunks), len(text), 0x4E4F534A)
    stream = io.BytesIO(b"".join((head, text, chunks)))
    return dict(load_glb(stream, resolver=resolver, skip_materials=True)["geometry"])


def _joined(pieces: list[dict[str, Any]], mesh: int, loaded: dict[str, dict[str, Any]]) -> Shape:
    """One shape of a mesh's pieces; vertices that pieces share are kept once."""
    vertices: list[NDArray[np.generic]] = []
    faces: list[NDArray[np.int64]] = []
    points: list[NDArray[np.generic]] = []
    offsets: dict[int, int] = {}
    n_vertices = unsupported = 0
    for j, piece in enumerate(pieces):
        geometry = loaded.get(f"{mesh}.{j}")
        if geometry is None:
            unsupported += 1
        elif geometry.get("faces") is None:
            points.append(geometry["vertices"])
        else:
            accessor = piece["attributes"]["POSITION"]
            if accessor not in offsets:
                offsets[accessor] = n_vertices
                vertices.append(geometry["vertices"])
                n_vertices += len(geometry["vertices"])
            # An index out of its own piece must not reach into the next one's vertices.
            corners = np.asarray(geometry["faces"], dtype=np.int64)
            inside = (corners >= 0) & (corners < len(geometry["vertices"]))
            faces.append(np.where(inside, corners + offsets[accessor], -1))
    defects = Defects(unsupported=unsupported)
    if faces:
        lost = Defects(unsupported=len(points))
        return Shape(np.concatenate(vertices), np.concatenate(faces), defects + lost)
    if points:
        return Shape(np.concatenate(points), None, defects)
    return Shape(np.empty((0, 3)), np.empty((0, 3), dtype=np.int64), defects)


def _placements(tree: dict[str, Any], shapes: list[Shape]) -> tuple[list[Placement], int]:
    """Placed meshes of the default scene, and how many nodes hold nothing at all."""
    nodes = tree.get("nodes", [])
    links = [(node, _parent_from_node(node)) for node in nodes]
    roots = _roots(tree, nodes)
    placements: list[Placement] = []
    empty = 0
    for path, world_from_node in walk(
        ((i, links[_checked(i, nodes)][1]) for i in roots),
        lambda i: [
            (child, links[_checked(child, nodes)][1])
            for child in dict.fromkeys(nodes[i].get("children", []))
        ],
    ):
        node = nodes[path[-1]]
        if "mesh" in node:
            mesh = node["mesh"]
            if not 0 <= mesh < len(shapes):
                raise UnreadableError(f"one of its nodes refers to mesh {mesh} of {len(shapes)}")
            names = [_name(nodes[i], i) for i in path]
            if "name" not in node and tree["meshes"][mesh].get("name"):
                names[-1] = str(tree["meshes"][mesh]["name"])
            placements.append(Placement("/".join(names), mesh, world_from_node))
        elif not node.get("children") and "camera" not in node and "extensions" not in node:
            empty += 1
    return placements, empty


def _roots(tree: dict[str, Any], nodes: list[dict[str, Any]]) -> list[int]:
    """Nodes without a parent, of the default scene or else of the file."""
    scenes = tree.get("scenes", [])
    if scenes:
        return list(dict.fromkeys(scenes[tree.get("scene", 0)].get("nodes", [])))
    below = {child for node in nodes for child in node.get("children", [])}
    return [i for i in range(len(nodes)) if i not in below]


def _checked(node: int, nodes: list[dict[str, Any]]) -> int:
    """Refuse the number of a node that is not there."""
    if not 0 <= node < len(nodes):
        raise UnreadableError(f"its scene refers to node {node} of {len(nodes)}")
    return node


def _name(node: dict[str, Any], number: int) -> str:
    """Name of a node, or its number where it has none."""
    return str(node.get("name") or number)


def _parent_from_node(node: dict[str, Any]) -> NDArray[np.float64]:
    """Transform (4, 4) of a node: its matrix, or T R S."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    transform = np.eye(4)
    if "rotation" in node:
        transform[:3, :3] = _rotation(np.array(node["rotation"], dtype=np.float64).reshape(4))
    if "scale" in node:
        transform[:3, :3] *= np.array(node["scale"], dtype=np.float64).reshape(3)
    if "translation" in node:
        transform[:3, 3] = np.array(node["translation"], dtype=np.float64).reshape(3)
    return transform


def _rotation(xyzw: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation (3, 3) of a quaternion x, y, z, w of any length; of a zero one, none."""
    length = np.linalg.norm(xyzw)
    if length == 0:
        return np.eye(3)
    x, y, z, w = xyzw / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )

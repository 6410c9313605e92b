"""glTF and GLB: one part for each placed mesh, its primitives joined, named by its node path.

trimesh is not used: its scene graph names the primitives of one mesh at random, drops nodes below a
camera, and keeps one of several placements of a node. See `accessors` for the arrays.
"""

import json
import struct
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticdb.mesh.formats.accessors import (
    Accessors,
    chunks_of,
    extension_of,
    external_bytes,
    item,
    objects_of,
    whole,
)
from hapticdb.mesh.formats.skinning import (
    INSTANCING,
    Pose,
    instances,
    joints_of,
    parent_from_node,
    pose_of,
    positions,
)
from hapticdb.mesh.formats.srgb import Colours, joined, mean_of_corners, of_light, rgba
from hapticdb.mesh.parsed import (
    ANIMATED,
    HIDDEN,
    Parsed,
    Placement,
    Shape,
    UnreadableError,
    count_note,
    missing_note,
    require,
    walk,
)
from hapticdb.mesh.part import Defects
from hapticdb.mesh.polygons import fan, strip
from hapticdb.mesh.text import text_of

_MAGIC = b"glTF"
_Materials = list[NDArray[np.float64] | None]
_POINTS, _TRIANGLES, _STRIP, _FAN = 0, 4, 5, 6
# Extensions that are read or do not change geometry; a file that requires another one is refused.
_HARMLESS = (
    "KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "KHR_lights_", "KHR_xmp",
    "KHR_animation_", "KHR_node_", "KHR_mesh_quantization", "AGI_", "CESIUM_", "EXT_mesh_features",
    "EXT_lights_", "EXT_instance_features", "EXT_structural_metadata", "EXT_mesh_manifold",
    "ADOBE_materials_", "NV_materials_", "MSFT_packing_", "KHR_techniques_webgl", INSTANCING,
)  # fmt: skip


def read(path: Path) -> Parsed:
    """Parts of the file's default scene, in metres."""
    return parsed(path.read_bytes(), path)


def parsed(content: bytes, path: Path, *, normals: bool = False) -> Parsed:
    """Parts of a file's content; referenced files are in the folder of `path`.

    normals : whether shapes get the normals at their vertices, if all have some.
    """
    tree = _load_tree(content, path.suffix.lower())
    chunks = chunks_of(content) if content[:4] == _MAGIC else []
    accessors = Accessors(tree, chunks, path.parent)
    required = tree.get("extensionsRequired", [])
    for extension in required if isinstance(required, list) else [required]:
        require(str(extension).startswith(_HARMLESS), f"glTF extension {extension}")
    placements, poses, worlds, empty = _placements(tree, accessors)
    joints: dict[int | None, NDArray[np.float64]] = {
        pose.skin: joints_of(tree, pose.skin, worlds, accessors)
        for pose in poses
        if pose.skin is not None
    }
    meshes, materials = objects_of(tree, "meshes"), _base_colours(tree)
    return Parsed(
        shapes=[
            _shape(meshes[one.mesh], one, joints.get(one.skin), accessors, materials, normals)
            for one in poses
        ],
        placements=placements,
        metres=1.0,
        defects=Defects(empty=empty),
        up=_up_axis(tree),
        notes=_notes(tree, worlds, path.parent),
    )


def _notes(tree: dict[str, Any], worlds: dict[int, NDArray[np.float64]], folder: Path) -> list[str]:
    """Notes of content outside the scene, not read, or hidden."""
    nodes = objects_of(tree, "nodes")
    outside = sum("mesh" in node for n, node in enumerate(nodes) if n not in worlds)
    found: Counter[str] = Counter()
    hidden = 0
    pictures: list[str] = []
    moved: set[int] = set()
    waiting: list[Any] = [tree]
    while waiting:
        one = waiting.pop()
        if isinstance(one, list):
            waiting += (inner for inner in one if isinstance(inner, (dict, list)))
            continue
        waiting += (inner for inner in one.values() if isinstance(inner, (dict, list)))
        if isinstance(extensions := one.get("extensions"), dict):
            found.update(extensions.keys())
            hidden += (extension_of(one, "KHR_node_visibility") or {}).get("visible") is False
        if isinstance(one.get("uri"), str) and "byteLength" not in one:
            pictures.append(one["uri"])
        if "path" in one and type(one.get("node")) is int:
            moved.add(one["node"])  # the target of a channel of an animation
    slashed = sum("/" in _name(nodes[n], n) for n in worlds)
    unread = {name: n for name, n in found.items() if not name.startswith(_HARMLESS)}
    placed = {str(node.get("mesh")) for node in nodes}
    unplaced = sum(str(n) not in placed for n in range(len(objects_of(tree, "meshes"))))
    return [
        *count_note(outside, "node{s} with a mesh {are} not in its scene and {are} left out"),
        *count_note(unplaced, "mesh{es} {are} in no node and {are} left out"),
        *count_note(
            slashed, "name{s} {hold} '/', which also separates a part's name from one above it"
        ),
        *count_note(len(moved & worlds.keys()), ANIMATED),
        *missing_note(folder, pictures),
        *count_note(hidden, HIDDEN),
        *(f"its extension {name} is not read ({n}x)" for name, n in unread.items()),
    ]


def _up_axis(tree: dict[str, Any]) -> str:
    """Up axis: y by the specification, unless the asset's extras differ."""
    extras = tree.get("asset", {}).get("extras") if isinstance(tree.get("asset"), dict) else None
    up = extras.get("up_axis") if isinstance(extras, dict) else None
    return up if isinstance(up, str) and up in {"x", "y", "z"} else "y"


def _load_tree(content: bytes, suffix: str) -> dict[str, Any]:
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
        tree = json.loads(text_of(text))
    except ValueError:
        raise UnreadableError("it is no glTF file, or damaged: its text is not JSON") from None
    if not isinstance(tree, dict) or not isinstance(tree.get("asset"), dict):
        raise UnreadableError("it is no glTF file: its JSON has no 'asset'")
    version = str(tree["asset"].get("version", "2.0"))
    if not version.startswith("2"):
        raise UnreadableError(f"it is of glTF version {version[:9]}; version 2 can be read")
    return tree


def bytes_beside(path: Path) -> int:
    """Total size of the existing files that a glTF file refers to; 0 if parsing will fail."""
    with suppress(UnreadableError, ValueError, RecursionError):
        return external_bytes(_load_tree(path.read_bytes(), path.suffix.lower()), path.parent)
    return 0


def _shape(
    mesh: dict[str, Any],
    pose: Pose,
    joints: NDArray[np.float64] | None,
    accessors: Accessors,
    materials: _Materials,
    normals: bool,  # noqa: FBT001 - as of `parsed`
) -> Shape:
    """One shape of a mesh's primitives; shared vertices occur once."""
    vertices: dict[object, NDArray[np.generic]] = {}
    upright: list[NDArray[np.generic]] = []
    offsets: dict[object, int] = {}
    faces: list[NDArray[np.int64]] = []
    points: list[NDArray[np.generic]] = []
    painted: list[tuple[Colours | None, int]] = []
    dotted: list[tuple[Colours | None, int]] = []
    n_vertices = unsupported = 0
    for number, piece in enumerate(objects_of(mesh, "primitives")):
        mode = piece.get("mode", _TRIANGLES)
        position = piece.get("attributes", {}).get("POSITION")
        if mode not in (_POINTS, _TRIANGLES, _STRIP, _FAN) or position is None:
            unsupported += 1
            continue
        corners = positions(piece, pose, joints, accessors)
        if "targets" in piece or joints is not None:
            position = f"piece {number}"
        if mode == _POINTS:
            points.append(corners)
            each = np.repeat(np.arange(len(corners))[:, None], 3, axis=1)
            dotted.append((_paint(piece, each, accessors, materials), len(corners)))
            continue
        if position not in offsets:
            offsets[position], vertices[position] = n_vertices, corners
            n_vertices += len(corners)
            if normals and "NORMAL" in piece["attributes"]:
                upright.append(accessors.array(piece["attributes"]["NORMAL"]))
        # An index outside its own piece must not reach into the next piece's vertices.
        found = _corners(piece, mode, len(corners), accessors, pose.mesh)
        inside = (found >= 0) & (found < len(corners))
        faces.append(np.where(inside, found + offsets[position], -1))
        painted.append((_paint(piece, found, accessors, materials), len(found)))
    defects = Defects(unsupported=unsupported)
    if faces:
        lost = Defects(unsupported=len(points))
        whole_faces = _one(faces)
        all_upright = _one(upright) if len(upright) == len(vertices) else None
        found = _one(list(vertices.values()))
        return Shape(found, whole_faces, defects + lost, joined(painted), all_upright)
    if points:
        return Shape(_one(points), None, defects, joined(dotted))
    return Shape(np.empty((0, 3)), np.empty((0, 3), dtype=np.int64), defects)


def _base_colours(tree: dict[str, Any]) -> _Materials:
    """Base colour of each material, linear light and opacity; None if a texture gives it."""
    found: _Materials = []
    materials = tree.get("materials")
    for material in materials if isinstance(materials, list) else []:
        colour = None
        try:
            surface = material.get("pbrMetallicRoughness", {})
            old = extension_of(material, "KHR_materials_pbrSpecularGlossiness") or {}
            values = surface.get("baseColorFactor", old.get("diffuseFactor"))
            if values is not None or "baseColorTexture" not in surface:
                colour = np.array(values or (1, 1, 1, 1), dtype=np.float64).reshape(4)
                if material.get("alphaMode", "OPAQUE") != "BLEND":
                    colour[3] = 1.0
        except (AttributeError, TypeError, ValueError):
            colour = None
        found.append(colour)
    return found


def _paint(
    piece: dict[str, Any], faces: NDArray[np.int64], accessors: Accessors, materials: _Materials
) -> Colours | None:
    """Colours (F, 4) of a primitive's triangles, or (1, 4) for all; None if it has none."""
    base = None
    if "material" in piece:
        with suppress(UnreadableError):
            (base,) = materials[whole(piece["material"], "a material") :][:1] or [None]
    try:
        values: NDArray[Any] = accessors.array(piece["attributes"]["COLOR_0"])
    except (KeyError, UnreadableError):
        return None if base is None else rgba(of_light(base[None]))
    if values.shape[1] not in (3, 4) or not len(values):
        return None
    most = 1 if values.dtype.kind == "f" else np.iinfo(values.dtype).max
    light = np.ones((len(faces), 4))
    light[:, : values.shape[1]] = mean_of_corners(values, faces) / most
    return rgba(of_light(light if base is None else light * base))


def _one(arrays: list[Any]) -> NDArray[Any]:
    """Concatenate arrays; a single one is not copied, because thousands of meshes may share it."""
    return np.asarray(arrays[0] if len(arrays) == 1 else np.concatenate(arrays))


def _corners(
    piece: dict[str, Any], mode: int, n_vertices: int, accessors: Accessors, number: int
) -> NDArray[np.int64]:
    """Corners (F, 3) of a primitive's triangles: indexed, or successive vertices."""
    if "indices" in piece:
        listed = accessors.array(whole(piece["indices"], "the 'indices' of a mesh"))
        if listed.dtype.kind == "f":
            raise UnreadableError(f"it is damaged: the indices of its mesh {number} are fractions")
        flat = np.ascontiguousarray(listed).reshape(-1).astype(np.int64)
    else:
        flat = np.arange(n_vertices, dtype=np.int64)
    if mode != _TRIANGLES:
        return strip(flat) if mode == _STRIP else fan(flat)
    if flat.size % 3:
        raise UnreadableError(f"it is damaged: mesh {number} ends within a triangle")
    return flat.reshape(-1, 3)


def _placements(
    tree: dict[str, Any], accessors: Accessors
) -> tuple[list[Placement], list[Pose], dict[int, NDArray[np.float64]], int]:
    """Placements, poses, node transforms and number of empty nodes of the default scene."""
    nodes, meshes = objects_of(tree, "nodes"), objects_of(tree, "meshes")
    placements: list[Placement] = []
    poses: dict[Pose, int] = {}
    worlds: dict[int, NDArray[np.float64]] = {}
    empty = 0

    def placed(numbers: list[int]) -> list[tuple[int, NDArray[np.float64]]]:
        return [(number, parent_from_node(nodes[number])) for number in numbers]

    def below(number: int) -> list[tuple[int, NDArray[np.float64]]]:
        return placed(_numbers(nodes[number], "children", len(nodes)))

    for path, world_from_node in walk(placed(_roots(tree, nodes)), below):
        node = nodes[path[-1]]
        worlds[path[-1]] = world_from_node
        if "mesh" in node:
            mesh = whole(node["mesh"], "the 'mesh' of a node")
            if mesh >= len(meshes):
                raise UnreadableError(f"one of its nodes refers to mesh {mesh} of {len(meshes)}")
            names = [_name(nodes[i], i) for i in path]
            if "name" not in node and meshes[mesh].get("name"):
                names[-1] = str(meshes[mesh]["name"])
            pose = pose_of(node, mesh, meshes[mesh])
            shape = poses.setdefault(pose, len(poses))
            # Joints place a skinned mesh; the transform of its node has no effect.
            world = world_from_node if pose.skin is None else np.eye(4)
            for node_from_part in instances(node, accessors):
                placed_at = world if node_from_part is None else world @ node_from_part
                placements.append(Placement("/".join(names), shape, placed_at))
        elif not node.get("children") and "camera" not in node and "extensions" not in node:
            empty += 1
    return placements, [*poses], worlds, empty


def _roots(tree: dict[str, Any], nodes: list[dict[str, Any]]) -> list[int]:
    """Nodes without a parent, of the default scene, or of the file if it has none."""
    scenes = objects_of(tree, "scenes")
    listed: Sequence[int] = range(len(nodes))
    if scenes:
        listed = _numbers(item(scenes, tree.get("scene", 0), "scene"), "nodes", len(nodes))
    below: set[int] = set()  # some programs list those, too
    waiting = [*listed]
    while waiting:
        found = set(_numbers(nodes[waiting.pop()], "children", len(nodes))) - below
        below |= found
        waiting += found
    return [i for i in listed if i not in below] or [*listed]


def _numbers(holder: dict[str, Any], key: str, n_nodes: int) -> list[int]:
    """Distinct node indices in a node or scene; UnreadableError out of range."""
    found = holder.get(key, [])
    if not isinstance(found, list):
        raise UnreadableError(f"it is damaged: the '{key}' of a node or scene are no list")
    for number in found:
        if whole(number, "the number of a node") >= n_nodes:
            raise UnreadableError(f"its scene refers to node {number} of {n_nodes}")
    return list(dict.fromkeys(found))


def _name(node: dict[str, Any], number: int) -> str:
    """Name of a node, or its index if it has no name."""
    return str(node.get("name") or number)

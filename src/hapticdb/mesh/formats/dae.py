"""COLLADA through pycollada: one part for each placed geometry, named along its nodes.

This module walks the nodes itself: trimesh's loader loses their names and copies the geometry for
every placement. pycollada rounds positions to float32 and makes 0 of those that are NaN, loses a
geometry with holes or for one piece of an unknown kind, and stops at a damaged light. So the text
is prepared for it, and positions are read from the text.
"""

import io
from collections import Counter
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import collada
import numpy as np
from numpy.typing import NDArray

from hapticdb.mesh.formats.painting import Colours, joined, mean_of_corners, rgba
from hapticdb.mesh.part import Defects
from hapticdb.mesh.polygons import triangulated
from hapticdb.mesh.raw import Parsed, Placement, Shape, UnreadableError, numbers, walk
from hapticdb.mesh.text import recoded

_Palette = dict[str, tuple[float, ...]]
"""Colours and opacity, 0 to 1, by the symbol that triangles name."""
_UP_AXES = {"X_UP": "x", "Y_UP": "y", "Z_UP": "z"}


_NO_SHAPE = ("library_lights", "library_cameras", "library_animations", "library_physics_models")
_PIECES = {"triangles", "tristrips", "trifans", "polylist", "polygons", "lines"}
_OF_A_MESH = _PIECES | {"source", "vertices", "extra"}
_INSTANCES = ("instance_geometry", "instance_controller", "instance_node")


def read(path: Path) -> Parsed:
    """Parts of the document's scene, in its unit and with its axes."""
    content = path.read_bytes()
    plain = recoded(content)
    # What was recoded still declares the encoding that it had.
    parser = ET.XMLParser(encoding=None if plain is content else "utf-8")  # noqa: S314 - expat stops entities that multiply
    try:
        root = ET.fromstring(plain, parser)  # noqa: S314
    except ET.ParseError as error:
        raise UnreadableError(f"its XML is damaged or cut short: {error}") from None
    if not root.tag.endswith("COLLADA"):
        raise UnreadableError("it is no COLLADA file: its first element is not 'COLLADA'")
    left_out = _prepare(root)
    document = collada.Collada(io.BytesIO(ET.tostring(root)), ignore=[collada.common.DaeError])
    if document.scene is None:
        raise UnreadableError("it has no scene")
    shapes: dict[tuple[str, ...], int] = {}
    geometries: list[tuple[Any, _Palette]] = []
    placements: list[Placement] = []
    for nodes, world_from_node in walk(_links(document.scene.nodes), _children):
        for geometry, palette in _geometries(nodes[-1]):
            key = (str(geometry.id), *(f"{name} {palette[name]}" for name in sorted(palette)))
            if key not in shapes:
                shapes[key] = len(geometries)
                geometries.append((geometry, palette))
            name = "/".join(filter(None, (node.name for node in nodes)))
            name = name or str(geometry.name or geometry.id)
            placements.append(Placement(name, shapes[key], world_from_node))
    return Parsed(
        [_shape(geometry, palette) for geometry, palette in geometries],
        placements,
        metres=_metres(root),
        up=_UP_AXES.get(str(getattr(document.assetInfo, "upaxis", None))),
        notes=[*left_out, *_notes(root, document)],
    )


def _metres(root: ET.Element) -> float | None:
    """Length of the document's unit, 1 m if it names none; None if what it names is no number."""
    asset = next((child for child in root if _tag(child) == "asset"), ())
    unit = next((child.get("meter", "1") for child in asset if _tag(child) == "unit"), "1")
    try:
        return float(unit)
    except ValueError:
        return None


def _tag(element: ET.Element) -> str:
    """Name of an element without its namespace."""
    return element.tag.rpartition("}")[2]


def _prepare(root: ET.Element) -> list[str]:
    """Take out what pycollada fails at and no surface needs; returns what is told about that."""
    for library in [child for child in root if _tag(child) in _NO_SHAPE]:
        root.remove(library)
    strange: Counter[str] = Counter()
    for mesh in root.iter():
        if _tag(mesh) == "node":
            for child in [c for c in mesh if _tag(c) in {"instance_light", "instance_camera"}]:
                mesh.remove(child)
        if _tag(mesh) != "mesh":
            continue
        for piece in list(mesh):
            if _tag(piece) not in _OF_A_MESH:
                strange[_tag(piece)] += 1
                mesh.remove(piece)
            elif _tag(piece) == "polygons":
                _join_holes(piece)
    return [f"{n} pieces of the kind '{kind}' are not read" for kind, n in strange.items()]


def _join_holes(polygons: ET.Element) -> None:
    """Write a polygon and its holes as one row of corners, with the lengths of the rows."""
    for holed in [child for child in polygons if _tag(child) == "ph"]:
        rows = [(row.text or "").split() for row in holed if _tag(row) in "ph"]
        joined = ET.SubElement(
            polygons, holed.tag[:-2] + "p", rows=" ".join(str(len(r)) for r in rows)
        )
        joined.text = " ".join(word for row in rows for word in row)
        polygons.remove(holed)


def _notes(root: ET.Element, document: Any) -> list[str]:  # noqa: ANN401 - untyped library
    """Say what of the file did not become parts, or not in the place that it has when it moves."""
    meshes = [one for one in root.iter() if _tag(one) == "geometry"]
    lost = [one for one in meshes if one.get("id") not in document.geometries]
    wanted = [one for one in root.iter() if _tag(one) in _INSTANCES]
    missing = sum(one.get("url", "")[1:] not in _known(document) for one in wanted)
    posed = Counter(type(one).__name__.lower() for one in document.controllers)
    others = len(document.scenes) - 1
    return [
        *([f"{len(lost)} of its {len(meshes)} geometries cannot be read"] if lost else []),
        *(
            [f"{missing} of its {len(wanted)} placements refer to what is not there"]
            if missing
            else []
        ),
        *(
            f"{n} geometries have a {kind}: they are read in their rest pose"
            for kind, n in posed.items()
        ),
        *([f"{others} more scenes are not read"] if others > 0 else []),
    ]


def _known(document: Any) -> set[str]:  # noqa: ANN401 - untyped library
    """Ids that a node can refer to."""
    nodes = [one.get("id", "") for one in document.xmlnode.getroot().iter() if _tag(one) == "node"]
    read_things = [*document.geometries, *document.controllers]
    return {str(one.id) for one in read_things} | set(nodes)


def _links(nodes: list[Any]) -> list[tuple[Any, NDArray[np.float64]]]:
    """Nodes with their transforms; an instance of a library node counts as that node."""
    found = []
    for node in nodes:
        if isinstance(node, collada.scene.NodeNode):
            found.append((node.node, _placed(node.node)))
        elif isinstance(node, collada.scene.Node):
            found.append((node, _placed(node)))
    return found


def _placed(node: Any) -> NDArray[np.float64]:  # noqa: ANN401 - untyped library
    """Transform (4, 4) of a node; pycollada rounds where it is far away."""
    whole = np.eye(4)
    for step in node.transforms:
        one = np.asarray(step.matrix, dtype=np.float64).copy()
        values = numbers(step.xmlnode.text or "", np.float64)
        if isinstance(step, collada.scene.MatrixTransform):
            one = values.reshape(4, 4).astype(np.float64)
        elif isinstance(step, collada.scene.TranslateTransform):
            one[:3, 3] = values
        whole @= one
    return whole


def _children(node: Any) -> list[tuple[Any, NDArray[np.float64]]]:  # noqa: ANN401 - untyped library
    """Nodes below a node."""
    return _links(node.children)


def _geometries(node: Any) -> list[tuple[Any, _Palette]]:  # noqa: ANN401 - untyped library
    """Geometries of a node itself, and colours; skinned geometries are in their rest pose."""
    found = []
    for child in node.children:
        if isinstance(child, collada.scene.GeometryNode):
            found.append((child.geometry, _palette(child.materials)))
        elif isinstance(child, collada.scene.ControllerNode):
            found.append((child.controller.geometry, _palette(child.materials)))
    return found


def _palette(bindings: list[Any]) -> _Palette:
    """Colours of the materials that a placement binds to the symbols of its triangles."""
    found = {}
    for binding in bindings:
        effect = getattr(binding.target, "effect", None)
        diffuse = getattr(effect, "diffuse", None)
        if isinstance(diffuse, tuple) and len(diffuse) in (3, 4):
            clear = getattr(effect, "transparency", None)
            opacity = clear if isinstance(clear, float) and 0 < clear < 1 else 1.0
            found[str(binding.symbol)] = (*map(float, diffuse[:3]), opacity)
    return found


def _shape(geometry: Any, palette: _Palette) -> Shape:  # noqa: ANN401 - untyped library
    """Triangles of a geometry's primitives; lines have no surface."""
    vertices: dict[str, tuple[int, NDArray[np.float64]]] = {}
    faces: list[NDArray[np.int64]] = []
    painted: list[tuple[Colours | None, int]] = []
    n_vertices = unsupported = incomplete = 0
    for primitive in geometry.primitives:
        if isinstance(primitive, collada.lineset.LineSet) or primitive.vertex is None:
            unsupported += 1
            continue
        source = primitive.sources["VERTEX"][0][4]
        if source.id not in vertices:
            vertices[source.id] = n_vertices, _positions(source)
            n_vertices += len(vertices[source.id][1])
        offset, corners = vertices[source.id]
        index = np.asarray(primitive.vertex_index, dtype=np.int64).reshape(-1)
        found, n_short = _faces(primitive, corners, index)
        incomplete += n_short
        vertex = index[found]
        inside = (vertex >= 0) & (vertex < len(corners))
        faces.append(np.where(inside, vertex + offset, -1))
        colour = palette.get(str(primitive.material))
        colours = None if colour is None else rgba(colour)
        painted.append((_corner_colours(primitive, found, colours), len(found)))
    defects = Defects(unsupported=unsupported, incomplete=incomplete)
    if not faces:
        return Shape(np.empty((0, 3)), np.empty((0, 3), dtype=np.int64), defects)
    whole = np.concatenate([piece for _, piece in vertices.values()])
    return Shape(whole, np.concatenate(faces), defects, joined(painted))


def _positions(source: Any) -> NDArray[np.float64]:  # noqa: ANN401 - untyped library
    """Positions (V, 3) as the file's text has them."""
    text = next(child.text or "" for child in source.xmlnode if _tag(child) == "float_array")
    found = np.asarray(numbers(text, np.float64), dtype=np.float64)
    return found.reshape(-1, len(source.components))[:, :3]


def _corner_colours(
    primitive: Any,  # noqa: ANN401 - untyped library
    faces: NDArray[np.int64],
    otherwise: Colours | None,
) -> Colours | None:
    """Colours (F, 4) by the primitive's own corners, or else the material's."""
    inputs = primitive.sources.get("COLOR")
    if not inputs or not len(faces):
        return otherwise
    offset, source = inputs[0][0], inputs[0][4]
    values = np.asarray(source.data, dtype=np.float64)
    if not len(values) or values.shape[1] not in (3, 4):
        return otherwise
    of_corner = np.asarray(primitive.index, dtype=np.int64).reshape(-1, primitive.nindices)
    return rgba(mean_of_corners(values, of_corner[:, offset][faces]))


def _faces(
    primitive: Any,  # noqa: ANN401 - untyped library
    vertices: NDArray[np.float64],
    index: NDArray[np.int64],
) -> tuple[NDArray[np.int64], int]:
    """Triangles (F, 3) of a primitive, and how many polygons had fewer than three corners.

    They name corners of the primitive; `index` has the vertex of each corner.
    """
    corners = np.arange(len(index))
    if isinstance(primitive, collada.triangleset.TriangleSet):
        return corners.reshape(-1, 3), 0
    ends = np.cumsum(np.asarray(primitive.vcounts, dtype=np.int64))
    polygons = [polygon.tolist() for polygon in np.split(corners, ends[:-1])]
    holes = {}
    rows = [one for one in primitive.xmlnode if _tag(one) == "p"]
    for number, row in enumerate(rows):
        if "rows" in row.attrib:
            lengths = np.array(row.get("rows").split(), dtype=np.int64)
            per_corner = max(int(lengths.sum()) // max(len(polygons[number]), 1), 1)
            holes[number] = (np.cumsum(lengths[:-1]) // per_corner).tolist()
    known = (index >= 0) & (index < len(vertices))
    places = np.where(known[:, None], vertices[np.where(known, index, 0)], np.nan)
    return triangulated(places, polygons, holes)

"""COLLADA through pycollada: one part for each placed geometry, named along its nodes.

This module walks the nodes itself: trimesh's loader loses their names and copies the geometry for
every placement. pycollada keeps numbers as float32.
"""

from pathlib import Path
from typing import Any

import collada
import numpy as np
from numpy.typing import NDArray

from hapticdb.mesh.formats.painting import Colours, joined, rgba
from hapticdb.mesh.part import Defects
from hapticdb.mesh.raw import Parsed, Placement, Shape, UnreadableError, fan, walk

_Palette = dict[str, tuple[float, ...]]
"""Colours and opacity, 0 to 1, by the symbol that triangles name."""
_UP_AXES = {"X_UP": "x", "Y_UP": "y", "Z_UP": "z"}


def read(path: Path) -> Parsed:
    """Parts of the document's scene, in its unit and with its axes."""
    # A missing texture or an unknown effect must not lose the geometry.
    lenient = [collada.common.DaeUnsupportedError, collada.common.DaeBrokenRefError]
    document = collada.Collada(str(path), ignore=lenient)
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
    unit = document.assetInfo.unitmeter if document.assetInfo is not None else None
    return Parsed(
        [_shape(geometry, palette) for geometry, palette in geometries],
        placements,
        metres=1.0 if unit is None else float(unit),
        up=_UP_AXES.get(str(getattr(document.assetInfo, "upaxis", None))),
    )


def _links(nodes: list[Any]) -> list[tuple[Any, NDArray[np.float64]]]:
    """Nodes with their transforms; an instance of a library node counts as that node."""
    found = []
    for node in nodes:
        if isinstance(node, collada.scene.NodeNode):
            found.append((node.node, np.asarray(node.node.matrix, dtype=np.float64)))
        elif isinstance(node, collada.scene.Node):
            found.append((node, np.asarray(node.matrix, dtype=np.float64)))
    return found


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
    vertices: list[NDArray[np.generic]] = []
    faces: list[NDArray[np.int64]] = []
    painted: list[tuple[Colours | None, int]] = []
    n_vertices = unsupported = incomplete = 0
    for primitive in geometry.primitives:
        found, n_short = _faces(primitive)
        if found is None or primitive.vertex is None:
            unsupported += 1
            continue
        incomplete += n_short
        inside = (found >= 0) & (found < len(primitive.vertex))
        faces.append(np.where(inside, found + n_vertices, -1))
        colour = palette.get(str(primitive.material))
        painted.append((None if colour is None else rgba(colour), len(found)))
        vertices.append(primitive.vertex)
        n_vertices += len(primitive.vertex)
    defects = Defects(unsupported=unsupported, incomplete=incomplete)
    if not faces:
        return Shape(np.empty((0, 3)), np.empty((0, 3), dtype=np.int64), defects)
    return Shape(np.concatenate(vertices), np.concatenate(faces), defects, joined(painted))


def _faces(primitive: Any) -> tuple[NDArray[np.int64] | None, int]:  # noqa: ANN401 - untyped library
    """Corners (F, 3) of a primitive, and how many polygons had fewer than three; None for lines."""
    if isinstance(primitive, collada.triangleset.TriangleSet):
        return np.asarray(primitive.vertex_index, dtype=np.int64).reshape(-1, 3), 0
    if isinstance(primitive, collada.polylist.Polylist):
        index = np.asarray(primitive.vertex_index, dtype=np.int64).reshape(-1)
        ends = np.cumsum(np.asarray(primitive.vcounts, dtype=np.int64))
        return fan([polygon.tolist() for polygon in np.split(index, ends[:-1])])
    return None, 0

"""COLLADA: one part for each placed geometry, named by its node path.

pycollada is not used: it rounds positions and rotations to 32 bits, makes 0 of NaN, ignores skews
and the matrices of skins, loses a geometry for one index out of range or one empty piece, and a
placement for a damaged material. Nor is trimesh: it loses the nodes' names.
"""

from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import reduce
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from hapticdb.mesh.formats.srgb import Colours, joined, mean_of_corners, rgba
from hapticdb.mesh.parsed import (
    ANIMATED,
    HIDDEN,
    Parsed,
    Placement,
    Shape,
    UnreadableError,
    count_note,
    missing_note,
    numbers,
    walk,
)
from hapticdb.mesh.part import Defects
from hapticdb.mesh.polygons import fan, strip, triangulated
from hapticdb.mesh.text import unit_length, xml_of
from hapticdb.poses import rotation_of

Floats = NDArray[np.float64]
_Palette = dict[str, tuple[float, ...]]
"""Colours and opacity, 0 to 1, by material symbol."""
_Geometry = tuple[ET.Element, _Palette]
_UP_AXES = {"X_UP": "x", "Y_UP": "y", "Z_UP": "z"}
_PIECES = {"triangles", "tristrips", "trifans", "polylist", "polygons"}
_OF_A_MESH = _PIECES | {"lines", "source", "vertices", "extra"}
_LUMINANCE = (0.212671, 0.715160, 0.072169)  # of red, green and blue, by COLLADA 1.4.1
_INSTANCES: dict[str, tuple[str, ...]] = {
    "instance_geometry": ("geometry",),
    "instance_controller": ("controller",),
    "instance_node": ("node",),
}


def read(path: Path) -> Parsed:
    """Parts of the document's scene, in its unit and with its axes."""
    parser = ET.XMLParser(encoding="utf-8")  # noqa: S314 - expat stops entities that multiply
    try:
        root = ET.fromstring(xml_of(path.read_bytes()), parser)  # noqa: S314
    except ET.ParseError as error:
        raise UnreadableError(f"its XML is damaged or cut short: {error}") from None
    document = _Document(root, path.parent)
    if root.tag != "COLLADA":
        raise UnreadableError("it is no COLLADA file: its first element is not 'COLLADA'")
    scene = document.referred(root.find("scene/instance_visual_scene"), "visual_scene")
    if scene is None:
        raise UnreadableError("it has no scene")
    shapes: dict[tuple[object, ...], int] = {}
    geometries: list[_Geometry] = []
    placements: list[Placement] = []
    for nodes, world_from_node in walk(document.links(scene), document.links):
        for geometry, palette, bound in document.geometries(nodes[-1]):
            key = (geometry, *(f"{name} {palette[name]}" for name in sorted(palette)))
            if key not in shapes:
                shapes[key] = len(geometries)
                geometries.append((geometry, palette))
            names = [*filter(None, (node.get("name") or node.get("id") for node in nodes))]
            name = "/".join(names) or geometry.get("name", geometry.get("id", ""))
            # The bind transform places a skin; the transform of its node has no effect.
            world = world_from_node if bound is None else bound
            placements.append(Placement(name, shapes[key], world))
    read_shapes, lost = _shapes(geometries)
    metres, doubts = _metres(root)
    return Parsed(
        read_shapes,
        placements,
        metres=None if doubts else metres,
        likely_metres=metres if doubts else None,
        up=_UP_AXES.get((root.findtext("asset/up_axis") or "").strip() or "Y_UP"),
        notes=[*doubts, *lost, *document.notes({id(geometry) for geometry, _ in geometries})],
    )


def _metres(root: ET.Element) -> tuple[float | None, list[str]]:
    """Unit length of the document, and a note if it contradicts the unit's name.

    1 m without a unit; None if its length is no number.
    """
    unit = root.find("asset/unit")
    if unit is None:
        return 1.0, []
    try:
        metres = float(unit.get("meter", "1"))
    except ValueError:
        return None, []
    name = unit.get("name", "")
    named = unit_length(name)
    if named is None or abs(metres - named) <= 0.01 * named:
        return metres, []
    lengths = f"{named:.6g} m, and given as {metres:.6g} m, which is taken"
    return metres, [f"its unit is named '{name}', {lengths}; another --unit is taken instead"]


class _Document:
    """Elements by kind and id; ids of different kinds may be equal."""

    def __init__(self, root: ET.Element, folder: Path) -> None:
        self._root, self._folder = root, folder
        self._known: dict[tuple[str, str | None], ET.Element] = {}
        self._damaged: set[ET.Element] = set()  # transforms
        for element in root.iter():
            element.tag = element.tag.rpartition("}")[2]  # without its namespace
            self._known.setdefault((element.tag, element.get("id")), element)

    def referred(self, one: ET.Element | None, *kinds: str, key: str = "url") -> ET.Element | None:
        """Target of the reference in the attribute `key`, of one of the kinds; None if missing."""
        name = "" if one is None else unquote(one.get(key, "")).removeprefix("#")
        found = (self._known.get((kind, name)) for kind in kinds)
        return next((element for element in found if element is not None), None)

    def links(self, node: ET.Element) -> list[tuple[ET.Element, Floats]]:
        """Child nodes with their transforms; an instance of a node counts as that node."""
        below = [
            child if child.tag == "node" else self.referred(child, "node")
            for child in node
            if child.tag in {"node", "instance_node"}
        ]
        return [(one, self._parent_from_node(one)) for one in below if one is not None]

    def _parent_from_node(self, node: ET.Element) -> Floats:
        """Transform (4, 4) of a node: the product of its steps."""
        steps = (self._transform(step) for step in node if step.tag in _STEPS)
        return reduce(np.matmul, steps, np.eye(4))

    def _transform(self, step: ET.Element) -> Floats:
        """Transform (4, 4) of a node's step or a skin; of NaN, and counted, if damaged."""
        whole = np.eye(4)
        try:
            with np.errstate(over="raise", invalid="raise", divide="raise"):
                found = _STEPS[step.tag](_floats(step.text))
            whole[: found.shape[0], : found.shape[1]] = found
        except (UnreadableError, ValueError, LookupError, ArithmeticError):
            self._damaged.add(step)
            whole[:] = np.nan
        return whole

    def geometries(self, node: ET.Element) -> list[tuple[ET.Element, _Palette, Floats | None]]:
        """Geometries of a node itself, their colours, and bind transforms of skins."""
        placing = [one for one in node if one.tag in {"instance_geometry", "instance_controller"}]
        found = [(*self._geometry(one), self._palette(one)) for one in placing]
        return [(one, palette, bound) for one, bound, palette in found if one is not None]

    def _geometry(self, instance: ET.Element) -> tuple[ET.Element | None, Floats | None]:
        """Geometry or node placed by an element, also through skins, and its bind transform."""
        inner: ET.Element | None = instance
        key, kinds = "url", _INSTANCES.get(instance.tag, ())
        bound: Floats | None = None
        for _ in range(4):  # a skin of a morph is two
            target = self.referred(inner, *kinds, key=key)
            if target is None or target.tag in {"geometry", "node"}:
                return target, bound
            inner = next((part for part in target if part.tag in {"skin", "morph"}), None)
            key, kinds = "source", ("geometry", "controller")
            if inner is not None and inner.tag == "skin":
                matrix = inner.find("bind_shape_matrix")
                bound = np.eye(4) if matrix is None else self._transform(matrix)
        return None, None

    def _palette(self, instance: ET.Element) -> _Palette:
        """Colours of the materials bound by a placement, by the symbols of its triangles."""
        found: _Palette = {}
        for binding in instance.iter("instance_material"):
            material = self.referred(binding, "material", key="target")
            used = None if material is None else material.find("instance_effect")
            effect = self.referred(used, "effect")
            if effect is None:
                continue
            with suppress(UnreadableError, ValueError):
                diffuse = _floats(effect.findtext(".//diffuse/color"))
                if len(diffuse) in (3, 4):
                    found[binding.get("symbol", "")] = (*diffuse[:3].tolist(), _opacity(effect))
        return found

    def notes(self, placed: set[int]) -> list[str]:
        """Notes of content without parts, and of hidden, animated or deformed content.

        placed : `id` of the placed geometries.
        """
        root = self._root
        strange = Counter(
            one.tag
            for holder in root.iter()
            for one in holder
            if one.tag == "skew" or (holder.tag == "mesh" and one.tag not in _OF_A_MESH)
        )
        wanted = [one for one in root.iter() if one.tag in _INSTANCES]
        missing = sum(self._geometry(one)[0] is None for one in wanted)
        posed = Counter(one.tag for kind in ("skin", "morph") for one in root.iter(kind))
        targets = {name for one in root.iter("IDREF_array") for name in (one.text or "").split()}
        outside = sum(
            one.get("id") not in targets and id(one) not in placed for one in root.iter("geometry")
        )
        hidden = sum((one.text or "").strip() == "0" for one in root.iter("visibility"))
        moved = {(one.get("target") or "").split("/")[0] for one in root.iter("channel")}
        nodes = sum(("node", name) in self._known for name in moved)
        images = root.iterfind(".//image/init_from")  # with 'ref' or, as numbers, 'hex' since 1.5
        pictures = ((one.findtext("ref") or one.text or "").strip() for one in images)
        others = sum(1 for _ in root.iter("visual_scene")) - 1
        unread = "piece{s} of the kind '{kind}' {are} not read"
        notes = [
            *(note for kind, n in strange.items() for note in count_note(n, unread, kind=kind)),
            *count_note(outside, "geometr{ies} {are} not in its scene and {are} left out"),
            *count_note(missing, f"of its {len(wanted)} placements {{refer}} to what is not there"),
            *count_note(len(self._damaged), "transform{s} {are} damaged: parts there are left out"),
        ]
        for kind, n in posed.items():
            notes += count_note(n, "geometr{ies} with a {kind} {are} read in rest pose", kind=kind)
        notes += [*count_note(hidden, HIDDEN), *count_note(nodes, ANIMATED)]
        notes += missing_note(self._folder, filter(None, pictures))
        return [*notes, *count_note(others, "more scene{s} {are} not read")]


def _floats(text: str | None) -> Floats:
    """Numbers of a text; none for None."""
    return np.asarray(numbers(text or "", np.float64), dtype=np.float64)


def _opacity(effect: ET.Element) -> float:
    """Opacity of an effect, above 0 to 1: exporters write 0 for 1."""
    clear = float(effect.findtext(".//transparency/float") or 1)
    by = next(effect.iter("transparent"), ET.Element("transparent"))
    kind = by.get("opaque", "A_ONE")
    shade = np.array([*_floats(by.findtext("color")), 1.0, 1.0, 1.0, 1.0])[:4]
    clear *= float(shade[:3] @ _LUMINANCE if kind.startswith("RGB") else shade[3])
    clear = 1.0 - clear if kind.endswith("_ZERO") else clear
    return clear if 1 / 510 < clear < 1 else 1.0  # what is less is 0 in 8 bits


def _turn(values: Floats) -> Floats:
    """Rotation about an axis, by an angle in degrees."""
    half = np.radians(values[3]) / 2
    length = np.linalg.norm(values[:3])
    axis = np.sin(half) * values[:3] / (length or 1.0)
    turned: Floats = rotation_of(np.array([np.cos(half), *axis]))[0]
    return turned


def _look_at_frame(values: Floats) -> Floats:
    """Frame of a 'lookat' step: at a point, -z towards another one, y up."""
    eye, interest, up = values.reshape(3, 3)
    x = np.cross(interest - eye, up)
    y = np.cross(x, interest - eye)
    axes = np.stack([x, y, eye - interest], axis=1)
    return np.column_stack([axes / np.linalg.norm(axes, axis=0), eye])


_STEPS: dict[str, Callable[[Floats], Floats]] = {
    "matrix": lambda values: values.reshape(4, 4),
    "bind_shape_matrix": lambda values: values.reshape(4, 4) if values.size else np.eye(4),
    "translate": lambda values: np.column_stack([np.eye(3), values]),
    "scale": lambda values: np.diag(values.reshape(3)),
    "rotate": _turn,
    "lookat": _look_at_frame,
}
"""Upper left (n, m) of a transform (4, 4), from the numbers of a step."""


def _shapes(geometries: list[_Geometry]) -> tuple[list[Shape], list[str]]:
    """Shapes of geometries, empty for unreadable ones, and a note of these."""
    found, lost = [], {}
    for geometry, palette in geometries:
        try:
            found.append(_shape(geometry, palette))
        except (UnreadableError, ValueError, LookupError, ArithmeticError) as error:
            lost[id(geometry)] = error
            found.append(Shape(np.empty((0, 3)), np.empty((0, 3), dtype=np.int64)))
    if not lost:
        return found, []
    first = next(iter(lost.values()))
    why = str(first) if isinstance(first, UnreadableError) else "it is damaged"
    return found, count_note(len(lost), "of its geometries cannot be read: {why}", why=why)


def _shape(geometry: ET.Element, palette: _Palette) -> Shape:
    """Triangles of a geometry's pieces; lines have no surface."""
    mesh = geometry.find("mesh")
    if mesh is None:
        raise UnreadableError("one has no mesh")
    sources = {unquote(f"#{i.get('id')}"): i for i in reversed(mesh) if i.tag not in _PIECES}
    vertices: dict[str, tuple[int, Floats]] = {}
    faces: list[NDArray[np.int64]] = []
    painted: list[tuple[Colours | None, int]] = []
    n_vertices = unsupported = incomplete = 0
    for piece in mesh:
        unsupported += piece.tag == "lines"
        if piece.tag not in _PIECES or (piece.find("p") is None and piece.find("ph") is None):
            continue
        inputs = _inputs(piece)
        at, name = inputs["VERTEX"]
        of_vertex = _inputs(sources[unquote(name)])
        place = of_vertex["POSITION"][1]
        if place not in vertices:
            vertices[place] = n_vertices, _values(sources[unquote(place)])[:, :3]
            n_vertices += len(vertices[place][1])
        offset, corners = vertices[place]
        width = 1 + max(int(one.get("offset", 0)) for one in piece.iter("input"))
        index, found, n_short = _faces(piece, width, at, corners)
        incomplete += n_short
        vertex = index[:, at][found]
        inside = (vertex >= 0) & (vertex < len(corners))
        faces.append(np.where(inside, vertex + offset, -1))
        colours = rgba(palette[symbol]) if (symbol := piece.get("material")) in palette else None
        inputs = {kind: (at, name) for kind, (_, name) in of_vertex.items()} | inputs
        with suppress(UnreadableError, LookupError, ValueError):
            referenced_path, shade = inputs["COLOR"]
            values = _values(sources[unquote(shade)])
            colours = rgba(mean_of_corners(values, index[:, referenced_path][found]))
        painted.append((colours, len(found)))
    defects = Defects(unsupported=unsupported, incomplete=incomplete)
    if not faces:
        return Shape(np.empty((0, 3)), np.empty((0, 3), dtype=np.int64), defects)
    whole = np.concatenate([found for _, found in vertices.values()])
    return Shape(whole, np.concatenate(faces), defects, joined(painted))


def _inputs(holder: ET.Element) -> dict[str, tuple[int, str]]:
    """Offset and source of the first input of each semantic."""
    found = reversed(holder.findall("input"))
    return {i.get("semantic", ""): (int(i.get("offset", 0)), i.get("source", "")) for i in found}


def _values(source: ET.Element) -> Floats:
    """Rows (n, 3 or 4) of a source: the columns named by its accessor."""
    found = _floats(source.findtext("float_array"))
    accessor = source.find("technique_common/accessor")
    columns = [] if accessor is None else accessor.findall("param")
    stride, start = len(columns) or 3, 0
    if accessor is not None:
        stride, start = int(accessor.get("stride", stride)), int(accessor.get("offset", 0))
    named = [n for n, one in enumerate(columns) if one.get("name")]
    rows = found[start : start + len(found[start:]) // stride * stride].reshape(-1, stride)
    rows = rows[:, named] if named else rows
    if rows.shape[1] < 3:
        raise UnreadableError(f"a source has rows of {rows.shape[1]} numbers, not 3")
    return rows[:, :4]


def _faces(
    piece: ET.Element, width: int, at: int, vertices: Floats
) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
    """Indices of a piece's corners, its triangles, and the number of too small polygons.

    at : vertex column of the indices (C, width). Triangles (F, 3) refer to corners. A polygon of
    fewer than three corners has none.
    """

    def row(text: ET.Element) -> NDArray[np.int64]:
        return np.asarray(numbers(text.text or "", np.int64), dtype=np.int64).reshape(-1, width)

    rows: list[NDArray[np.int64]] = []
    holes: dict[int, list[int]] = {}
    for child in piece:
        if child.tag == "p":
            rows.append(row(child))
        elif child.tag == "ph":
            loops = [row(one) for one in child if one.tag in {"p", "h"}]
            loops = loops[:1] + [hole for hole in loops[1:] if len(hole)]
            holes[len(rows)] = np.cumsum([len(loop) for loop in loops[:-1]]).tolist()
            rows.append(np.concatenate(loops))
    index = np.concatenate(rows)
    corners = np.arange(len(index))
    sizes = np.array([len(one) for one in rows])
    if piece.tag == "triangles":
        return index, corners[: len(corners) // 3 * 3].reshape(-1, 3), int(len(corners) % 3 > 0)
    if piece.tag == "polylist":
        sizes = np.asarray(numbers(piece.findtext("vcount") or "", np.int64))
        if sizes.sum() != len(corners) or (sizes < 0).any():
            raise UnreadableError("the corners of its polygons are not as many as it says")
    split = np.split(corners, np.cumsum(sizes))[:-1]
    if piece.tag in {"tristrips", "trifans"}:
        cut = strip if piece.tag == "tristrips" else fan
        long = [cut(one) for one in split if len(one) >= 3]
        found = np.concatenate([np.empty((0, 3), dtype=np.int64), *long])
        return index, found, len(split) - len(long)
    vertex = index[:, at]
    known = (vertex >= 0) & (vertex < len(vertices))
    places = np.full((len(vertex), 3), np.nan)
    places[known] = vertices[vertex[known]]
    return index, *triangulated(places, [one.tolist() for one in split], holes)

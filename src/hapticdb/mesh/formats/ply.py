"""PLY, text and binary: a mesh, or a point cloud if the file has no faces.

trimesh is not used: it refuses binary files with faces of different sizes and cuts polygons into
fans. plyfile reads them, but is under the GPL.
"""

import re
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticdb.mesh.formats.srgb import Colours, mean_of_corners, rgba
from hapticdb.mesh.parsed import Parsed, Shape, UnreadableError, count_note, numbers, placed_once
from hapticdb.mesh.part import Defects
from hapticdb.mesh.polygons import strip, triangulated, triangulated_equal
from hapticdb.mesh.text import recoded

Column = NDArray[Any] | list[NDArray[Any]]
"""Values (n,) of a property; for lists (n, k), or an array for each row if sizes differ."""

_HEADER = re.compile(
    rb"ply[^\r\n]*(\r\n?|\n)(.*?[\r\n])[ \t]*end_header[ \t]*(?:\1|\r?\n)",
    re.DOTALL | re.IGNORECASE,
)
_CODES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CHANNELS = ("red", "green", "blue", "alpha")
_CORNERS = ("vertex_indices", "vertex_index")


@dataclass
class _Property:
    """A property: its name, and numpy codes of its type and of a list's count."""

    name: str
    code: str
    count_code: str | None


@dataclass
class _Element:
    """An element: its name, number of rows, and properties."""

    name: str
    n: int
    properties: list[_Property] = field(default_factory=list)


def read(path: Path) -> Parsed:
    """One part named after the file."""
    content = recoded(path.read_bytes())
    if content[:3].lower() != b"ply":
        raise UnreadableError("it is no PLY file: its first line is not 'ply'")
    tables = tables_of(content)
    vertex = tables.get("vertex", {})
    if not vertex or not len(vertex["x"]):
        return placed_once([])
    vertices = np.stack([np.asarray(vertex[axis]) for axis in "xyz"], axis=1)
    faces, incomplete = _faces(vertices, tables)
    colours = _colours(tables, faces)
    shape = Shape(vertices, faces, Defects(incomplete=incomplete), colours)
    words = "element{s} of the kind '{kind}' {are} passed over"
    notes = [
        note
        for kind, table in tables.items()
        if kind not in {"vertex", "face", "tristrips"} and table
        for note in count_note(len(next(iter(table.values()))), words, kind=kind)
    ]
    head = content[: content.find(b"end_header")].decode("latin-1")
    return placed_once([(path.stem, shape)], notes, head)


def tables_of(content: bytes) -> dict[str, dict[str, Column]]:
    """Columns of each element by name, rows in the order of the file."""
    header = _HEADER.match(content)
    if header is None:
        raise UnreadableError("it is cut short or damaged: its header has no 'end_header'")
    order, elements = _header(header[2].decode("utf-8", "replace"))
    at = header.end()
    if not order:  # as if it was binary, of numbers of one type
        found = numbers(content[at:].decode("utf-8", "replace"), np.float64)
        content, at, order = found.astype("<f8").tobytes(), 0, "<"
        single = {e.name: [p for p in e.properties if not p.count_code] for e in elements}
        for element in elements:
            if len(found) == sum(e.n * len(single[e.name]) for e in elements):
                element.properties = single[element.name]  # Blender lists corners of vertices only
            for prop in element.properties:
                prop.code, prop.count_code = "f8", prop.count_code and "f8"
    tables = {}
    for element in elements:
        if element.name in tables:
            raise UnreadableError(f"it has two elements of the kind '{element.name}'")
        tables[element.name], at = _rows(content, at, order, element)
    if content[at:].strip():
        raise UnreadableError("it is damaged: it is longer than its header promises")
    return tables


def _header(text: str) -> tuple[str, list[_Element]]:
    """Byte order, '' for text, and the elements."""
    order: str | None = None
    elements: list[_Element] = []
    for line in text.splitlines():
        match line.split():
            case ["format", word, *_]:
                order = _ORDERS.get(word)
            case ["element", name, n]:
                elements.append(_Element(name, int(n)))
            case ["property", "list", count, kind, name]:
                elements[-1].properties.append(_Property(name, _code(kind), _code(count)))
            case ["property", kind, name]:
                elements[-1].properties.append(_Property(name, _code(kind), None))
    if order is None:
        raise UnreadableError(f"it is damaged: its format is none of {', '.join(_ORDERS)}")
    return order, elements


def _code(kind: str) -> str:
    if kind not in _CODES:
        raise UnreadableError(f"it is damaged: '{kind[:40]}' is no type of numbers")
    return _CODES[kind]


def _rows(content: bytes, at: int, order: str, element: _Element) -> tuple[dict[str, Column], int]:
    """Columns of an element with rows from byte `at` on, and the byte after them."""
    if not element.properties or element.n <= 0:
        return {}, at
    first, _ = _row(content, at, order, element)
    kinds: list[Any] = []
    for n, (prop, values) in enumerate(zip(element.properties, first, strict=True)):
        if prop.count_code:
            kinds += [(f"count {n}", order + prop.count_code)]
        kinds += [(prop.name, order + prop.code, (len(values),) if prop.count_code else ())]
    dtype = np.dtype(kinds)
    end = at + element.n * dtype.itemsize
    if end <= len(content):
        table = np.frombuffer(content, dtype, element.n, at)
        counts = [table[name] for name, *_ in kinds if "count " in name]
        if all((count == count[0]).all() for count in counts):
            return {prop.name: table[prop.name] for prop in element.properties}, end
    rows = []
    for _ in range(element.n):
        row, at = _row(content, at, order, element)
        rows.append(row)
    columns = zip(element.properties, zip(*rows, strict=True), strict=True)
    return {p.name: [*c] if p.count_code else np.concatenate(c) for p, c in columns}, at


def _row(content: bytes, at: int, order: str, element: _Element) -> tuple[list[NDArray[Any]], int]:
    """Values of each property in the row at byte `at`, and the byte after it."""
    row: list[NDArray[Any]] = []
    try:
        for prop in element.properties:
            n = 1
            if prop.count_code:
                (count,) = struct.unpack_from(order + np.dtype(prop.count_code).char, content, at)
                if not 0 <= count == int(count):
                    raise UnreadableError(f"a list of '{element.name}' has {count} numbers")
                n, at = int(count), at + int(prop.count_code[1])
            row.append(np.frombuffer(content, order + prop.code, n, at))
            at += row[-1].nbytes
    except (ValueError, struct.error):
        raise UnreadableError(
            f"it is cut short: its header promises {element.n:,} of '{element.name}'"
        ) from None
    return row, at


def _faces(
    vertices: NDArray[Any], tables: dict[str, dict[str, Column]]
) -> tuple[NDArray[np.int64] | None, int]:
    """Triangles (F, 3) and the number of faces with fewer than three corners; None for a cloud."""
    face, strips = tables.get("face", {}), tables.get("tristrips", {})
    if not face and not strips:
        return None, 0
    pieces, incomplete = [np.empty((0, 3), dtype=np.int64)], 0
    if face:
        rows = _corners(face)
        if isinstance(rows, np.ndarray) and rows.shape[1] >= 3:
            pieces.append(triangulated_equal(vertices, _whole(rows)))
        else:
            found, incomplete = triangulated(vertices, [_whole(row).tolist() for row in rows])
            pieces.append(found)
    for row in _corners(strips) if strips else ():
        whole = _whole(row)  # strips, separated by -1
        several = np.split(whole, np.flatnonzero(whole < 0))
        pieces += [strip(one[one >= 0]) for one in several]
    return np.concatenate(pieces), incomplete


def _corners(table: dict[str, Column]) -> Column:
    """Column of the vertex indices of faces or strips."""
    found = next((table[name] for name in _CORNERS if name in table), None)
    if found is None:
        raise UnreadableError(f"it is damaged: its faces have none of {', '.join(_CORNERS)}")
    return found


def _whole(rows: NDArray[Any]) -> NDArray[np.int64]:
    """Integers, read as floats from text; UnreadableError for fractions."""
    if rows.dtype.kind == "f" and (rows % 1).any():
        raise UnreadableError("it is damaged: a face refers to a vertex by a fraction")
    return rows.astype(np.int64)


def _colours(
    tables: dict[str, dict[str, Column]], faces: NDArray[np.int64] | None
) -> Colours | None:
    """Colours (F, 4) of triangles, from their faces or vertices, or (V, 4) of a cloud's points."""
    of_vertices = _shades(tables["vertex"])
    if faces is None or not len(faces):
        return of_vertices if faces is None else None
    of_faces = _shades(tables.get("face", {}))
    if of_faces is not None and len(of_faces) == len(faces):
        return of_faces
    return None if of_vertices is None else rgba(mean_of_corners(of_vertices, faces) / 255)


def _shades(table: dict[str, Column]) -> Colours | None:
    """Colours (n, 4) of an element's rows; None if it has none."""
    columns = [np.asarray(table[name]) for name in _CHANNELS if name in table]
    if len(columns) < 3 or any(column.ndim != 1 for column in columns):
        return None
    most = 1.0 if columns[0].dtype.kind == "f" and max(map(np.max, columns)) <= 1 else 255.0
    return rgba(np.stack(columns, axis=1) / most)

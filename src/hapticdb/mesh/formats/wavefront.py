"""OBJ (Wavefront): one part for each object and group, named 'object/group'.

trimesh is not used: it joins both names by '_', counts negative indices from the end of the file
instead of from their own line, takes index 0 for the first vertex, and refuses the whole file for
one face out of range.
"""

import posixpath
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from hapticdb.mesh.formats.srgb import Colours, joined, mean_of_corners, rgba
from hapticdb.mesh.parsed import (
    Parsed,
    Shape,
    UnreadableError,
    count_note,
    indices,
    missing_note,
    numbers,
    placed_once,
    positions,
    referenced_path,
)
from hapticdb.mesh.part import Defects
from hapticdb.mesh.polygons import triangulated, triangulated_equal
from hapticdb.mesh.text import text_of

_COMMENT = re.compile(r"(?<!\.)#|#(?!IND|INF|QNAN|SNAN)")  # 1.#IND is no comment
_CONTINUED = re.compile(r"\\[ \t]*(?:\r\n|\n|\r)")
_TEXTURE_AND_NORMAL = re.compile(r"/[^\s]*")
_NO_SURFACE = {"l", "p", "curv", "curv2", "surf"}
_BLANKS = " \t\0\xa0"
_FACE = {"f", "fo"}
_NUMBERS = {"v", *_FACE}
# Lines about appearance, or of curves, which `_NO_SURFACE` counts.
_NO_SHAPE = {
    "", "vt", "vn", "vp", "s", "mg", "usemap", "maplib", "bevel", "c_interp",
    "d_interp", "lod", "shadow_obj", "trace_obj", "cstype", "deg", "bmat", "step", "parm", "trim",
    "hole", "scrv", "sp", "end", "con", "ctech", "stech",
}  # fmt: skip
_PICTURES = {"map_kd", "map_d", "map_ka"}
MOST_BYTES = 16 << 20
"""Bytes of a material file, read up to this."""


@dataclass
class _Group:
    """Faces of one object and group: their lines, and the number of vertices before each line."""

    lines: list[str] = field(default_factory=list)
    n_before: list[int] = field(default_factory=list)
    unsupported: int = 0
    materials: list[str] = field(default_factory=list)
    """Material of each line, by name."""


def read(path: Path) -> Parsed:
    """Objects and groups of an OBJ file; without any, one part named after the file."""
    text = text_of(path.read_bytes())
    vertex_lines: list[str] = []
    groups: dict[tuple[str, str], _Group] = {}
    libraries: list[str] = []
    strange: Counter[str] = Counter()
    comments: list[str] = []
    key, material = ("", ""), ""
    for line in _CONTINUED.sub(" ", text).splitlines():
        word, _, rest = line.strip(_BLANKS).replace("\t", " ").partition(" ")
        if word in _NUMBERS and "#" in rest:  # names may hold one
            rest = _COMMENT.split(rest)[0]
        if word == "v":
            vertex_lines.append(rest)
        elif word in _FACE:
            group = groups.setdefault(key, _Group())
            group.lines.append(rest)
            group.n_before.append(len(vertex_lines))
            group.materials.append(material)
        elif word == "o":
            key = (rest.strip(), "")
        elif word == "g":
            key = (key[0], rest.strip())
        elif word == "usemtl":
            material = rest.strip()
        elif word == "mtllib":
            several = rest.lower().count(".mtl") > 1  # else spaces belong to the name
            libraries += rest.split() if several else [rest.strip()]
        elif word in _NO_SURFACE:
            groups.setdefault(key, _Group()).unsupported += 1
        elif word[:1] == "#":
            comments.append(line)
        elif word not in _NO_SHAPE:
            strange[word[:20]] += 1
    vertices = positions(vertex_lines)
    palette: dict[str, Colours] = {}
    pictures: list[str] = []
    unread: list[str] = []
    for name in dict.fromkeys(libraries):
        content = _content(path.parent, name)
        palette |= _materials(content or "", pictures)
        unread += [name] if content is None else []
    painted = _painted(vertex_lines)
    named = (
        ("/".join(filter(None, names)) or path.stem, _coloured(group, vertices, palette, painted))
        for names, group in groups.items()
    )
    most = ", ".join(f"'{word}' {n}" for word, n in strange.most_common(3))
    words = "line{s} {begin} with unknown words and {are} passed over: {most}"
    missing = missing_note(path.parent, pictures, *unread)
    return placed_once(
        named, [*count_note(strange.total(), words, most=most), *missing], "\n".join(comments)
    )


def _content(folder: Path, name: str) -> str | None:
    """Text of a material file in the OBJ file's own folder; None if unreadable."""
    plain = posixpath.normpath(unquote(name).replace("\\", "/"))
    file = None if "/" in plain else referenced_path(folder, name)
    with suppress(OSError):
        return None if file is None else text_of(file.read_bytes()[:MOST_BYTES])
    return None


def _materials(content: str, pictures: list[str]) -> Iterator[tuple[str, Colours]]:
    """Names and colours (1, 4) of materials; appends their texture files to `pictures`."""
    material, values = None, np.ones(4)
    for line in [*content.splitlines(), "newmtl"]:
        word, _, rest = line.strip().replace("\t", " ").partition(" ")
        with suppress(UnreadableError, ValueError):
            if word == "newmtl":
                if material is not None:
                    yield material, rgba(values)
                material, values = rest.strip(), np.array([0.8, 0.8, 0.8, 1.0])
            elif word == "Kd":
                values[:3] = numbers(rest, np.float64)
            elif word in {"d", "Tr"}:
                opacity = float(rest.split()[-1])
                values[3] = opacity if word == "d" else 1.0 - opacity
            elif word.lower() in _PICTURES:
                pictures.append(rest.split()[-1] if rest.startswith("-") else rest.strip())


def _painted(lines: list[str]) -> Colours | None:
    """Colours (V, 4) after the coordinates of vertices; None unless all have one."""
    words = [line.split()[3:6] for line in lines if len(line.split()) >= 6]
    if not lines or len(words) != len(lines):
        return None
    try:
        values = np.array(words, dtype=np.float64)
    except ValueError:
        return None
    return rgba(values / 255 if values.max() > 1 else values)


def _coloured(
    group: _Group,
    vertices: NDArray[np.float64],
    palette: dict[str, Colours],
    painted: Colours | None,
) -> Shape:
    """One group's triangles with colours, material after material if materials have colours."""
    if not palette.keys() & set(group.materials):
        shape = _shape(group, vertices)
        if painted is None or shape.faces is None:
            return shape
        faces = shape.faces.astype(np.int64)
        return replace(shape, colours=rgba(mean_of_corners(painted, faces) / 255))
    pieces: dict[str, _Group] = {}
    for line, n, material in zip(group.lines, group.n_before, group.materials, strict=True):
        piece = pieces.setdefault(material, _Group())
        piece.lines.append(line)
        piece.n_before.append(n)
    shapes = [_shape(piece, vertices) for piece in pieces.values()]
    runs = [np.asarray(shape.faces) for shape in shapes]
    defects = sum((shape.defects for shape in shapes), Defects(unsupported=group.unsupported))
    named = zip(pieces, runs, strict=True)
    colours = joined([(palette.get(name), len(run)) for name, run in named])
    return Shape(vertices, np.concatenate(runs), defects, colours)


def _shape(group: _Group, vertices: NDArray[np.float64]) -> Shape:
    """One group's triangles over the vertices of the whole file."""
    text = "\n".join(group.lines)
    corners = _TEXTURE_AND_NORMAL.sub("", text)
    sizes = {len(line.split()) for line in corners.split("\n")} if group.lines else set()
    size = sizes.pop() if len(sizes) == 1 else 0
    # The fast path: all polygons have one size and no index is negative.
    if size >= 3 and "-" not in corners:
        equal = np.asarray(numbers(corners, np.int64), dtype=np.int64).reshape(-1, size) - 1
        faces, incomplete = triangulated_equal(vertices, equal), 0
    else:
        lines = corners.split("\n") if group.lines else []
        polygons = [_polygon(line, n) for line, n in zip(lines, group.n_before, strict=True)]
        faces, incomplete = triangulated(vertices, polygons)
    return Shape(vertices, faces, Defects(incomplete=incomplete, unsupported=group.unsupported))


def _polygon(line: str, n_before: int) -> list[int]:
    """Corners of one face, 0-based; a negative index counts back from its own line."""
    found = [n + n_before + 1 if n < 0 else n for n in indices(line.split())]
    # An index that is still not above 0 is out of range, whether it was absolute or relative.
    return [n - 1 if 0 < n < 2**62 else -1 for n in found]

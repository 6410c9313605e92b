"""STL, binary and text; one part for each solid of a text file.

trimesh is not used: it drops empty solids and an unfinished last solid without an error, and takes
the word 'solid' in the name after 'endsolid' for the start of another solid.
"""

import re
from pathlib import Path

import numpy as np

from hapticdb.mesh.parsed import Parsed, Shape, UnreadableError, count_note, numbers, placed_once
from hapticdb.mesh.text import recoded, text_of

_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEADER = 84
_BORDER = re.compile(r"^[ \t]*(end[ \t]*solid|solid\b)[ \t]*(.*)$", re.MULTILINE | re.IGNORECASE)
_NO_COUNT = {0, 0xFFFFFFFF}
"""Placeholder counts of programs that write the header before the triangles."""
_STRANGE = re.compile(
    r"^[ \t]*(?!(?:end[ \t]*)?(?:solid|facet|loop)|outer\b|vertex\b|color\b)\S",
    re.MULTILINE | re.IGNORECASE,
)
_BEGINNING = re.compile(r"\b(facet|end[ \t]*solid)\b", re.IGNORECASE)
_LOOP = re.compile(r"\bouter\s*loop\b", re.IGNORECASE)
_CORNER = re.compile(r"\bvertex\b", re.IGNORECASE)
_VERTEX = re.compile(r"\bvertex\s+(\S+\s+\S+\s+\S+)", re.IGNORECASE)


def read(path: Path) -> Parsed:
    """Solids of an STL file, with their own names or the file's."""
    content = path.read_bytes()
    n_facets = int.from_bytes(content[80:_HEADER], "little") if len(content) >= _HEADER else 0
    head = content[:80].decode("latin-1")
    n_bytes = _HEADER + n_facets * _FACET.itemsize
    # A binary file's free header may start with 'solid', so its length decides first.
    if len(content) == n_bytes and len(content) >= _HEADER:
        return placed_once([(path.stem, _binary(content, 0, n_facets))], (), head)
    plain = recoded(content)
    start = plain[:512].lstrip().lower()
    if start.startswith(b"solid") and b"\0" not in start:
        return _text(text_of(plain), path.stem)
    if len(content) < _HEADER:
        raise UnreadableError("it is no STL file: neither a 'solid' nor a binary header")
    n_behind, rest = divmod(len(content) - _HEADER, _FACET.itemsize)
    if n_facets in _NO_COUNT and n_behind and not rest:
        note = f"its header counts {n_facets:,} triangles, and {n_behind:,} follow: all are read"
        return placed_once([(path.stem, _binary(content, 0, n_behind))], [note], head)
    if n_facets > 0 and n_bytes < len(content):
        return _joined(content, path.stem)
    raise UnreadableError(
        f"it is no STL file or cut short: {len(content):,} bytes where its header promises "
        f"{n_facets:,} triangles ({n_bytes:,} bytes)"
    )


def _joined(content: bytes, stem: str) -> Parsed:
    """Concatenated binary files, and the trailing bytes of some exporters."""
    solids: list[tuple[str, Shape]] = []
    at = 0
    while at + _HEADER <= len(content):
        n_facets = int.from_bytes(content[at + 80 : at + _HEADER], "little")
        end = at + _HEADER + n_facets * _FACET.itemsize
        if not n_facets or end > len(content):
            break
        solids.append((stem, _binary(content, at, n_facets)))
        at = end
    words = "byte{s} behind the last triangle {are} passed over"
    return placed_once(solids, count_note(len(content) - at, words), content[:80].decode("latin-1"))


def _binary(content: bytes, at: int, n_facets: int) -> Shape:
    """Triangles after the binary header at byte `at`."""
    facets = np.frombuffer(content, dtype=_FACET, count=n_facets, offset=at + _HEADER)
    corners = facets["corners"].reshape(-1, 3)
    return Shape(corners, np.arange(len(corners), dtype=np.int64).reshape(-1, 3))


def _text(text: str, stem: str) -> Parsed:
    """Solids of a text file.

    In concatenated files 'endsolid a' and 'solid b' may share a line. Triangles after a line with
    'endsolid' are a solid, too; a line with 'solid' may be doubled.
    """
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    if "\n" not in text.strip():
        text = _BEGINNING.sub(r"\n\1", text)
    borders = list(_BORDER.finditer(text))
    ends = [*(border.start() for border in borders[1:]), len(text)]
    is_end = [border[1].lower() != "solid" for border in borders]
    solids: list[tuple[str, Shape]] = []
    name = ""
    for n, (border, end) in enumerate(zip(borders, ends, strict=True)):
        rest = border[2].strip()
        if is_end[n]:
            behind = rest.removeprefix(name).strip()
            rest = behind[5:].strip() if behind[:5].lower() == "solid" else ""
        name = rest
        shape = _facets(text[border.end() : end], name or stem)
        is_closed = n + 1 < len(borders) and is_end[n + 1]
        must_be = len(shape.vertices) > 0 or not (is_end[n] or n + 1 < len(borders))
        if must_be and not is_closed:
            raise UnreadableError(f"it is cut short: solid '{name or stem}' has no end")
        if must_be or (is_closed and not is_end[n]):
            solids.append((name or stem, shape))
    n_strange = len(_STRANGE.findall(text))
    words = "line{s} {begin} with unknown words and {are} passed over"
    return placed_once(solids, count_note(n_strange, words))


def _facets(chunk: str, name: str) -> Shape:
    """Triangles of one solid."""
    corners = numbers(" ".join(_VERTEX.findall(chunk)), np.float64)
    loops = _LOOP.split(chunk)[1:]
    if corners.size != 9 * len(loops) or any(len(_CORNER.findall(one)) != 3 for one in loops):
        raise UnreadableError(f"a facet of solid '{name}' has other than three corners")
    faces = np.arange(corners.size // 3, dtype=np.int64).reshape(-1, 3)
    return Shape(corners.reshape(-1, 3), faces)

"""STL, binary and text. Each solid of a text file is a part of its own.

This module does not use trimesh, which drops empty solids and an unfinished last solid without an
error, and takes the word 'solid' in the name after 'endsolid' for the start of another solid.
"""

import re
from pathlib import Path

import numpy as np

from hapticdb.mesh.part import Defects
from hapticdb.mesh.raw import Parsed, Shape, UnreadableError, numbers, placed_once

_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEADER = 84
_BORDER = re.compile(r"^[ \t]*(end[ \t]*solid|solid)\b[ \t]*(.*)$", re.MULTILINE | re.IGNORECASE)
_VERTEX = re.compile(r"\bvertex\s+(\S+\s+\S+\s+\S+)", re.IGNORECASE)


def read(path: Path) -> Parsed:
    """Solids of an STL file, named as in the file, or after the file."""
    content = path.read_bytes()
    n_facets = int.from_bytes(content[80:_HEADER], "little") if len(content) >= _HEADER else 0
    n_bytes = _HEADER + n_facets * _FACET.itemsize
    # A binary file's free header may start with 'solid', so its length decides first.
    if len(content) == n_bytes and len(content) >= _HEADER:
        return placed_once([(path.stem, _binary(content, n_facets))])
    if content[:512].lstrip()[:5].lower() == b"solid":
        return _text(content.decode("utf-8", "replace"), path.stem)
    if n_facets > 0 and n_bytes < len(content):  # trailing bytes, which some exporters write
        return placed_once([(path.stem, _binary(content, n_facets))])
    if len(content) < _HEADER:
        raise UnreadableError("it is no STL file: neither a 'solid' nor a binary header")
    raise UnreadableError(
        f"it is no STL file or cut short: {len(content):,} bytes where its header promises "
        f"{n_facets:,} triangles ({n_bytes:,} bytes)"
    )


def _binary(content: bytes, n_facets: int) -> Shape:
    """Triangles of a binary file."""
    facets = np.frombuffer(content, dtype=_FACET, count=n_facets, offset=_HEADER)
    corners = facets["corners"].reshape(-1, 3)
    return Shape(corners, np.arange(len(corners), dtype=np.int64).reshape(-1, 3))


def _text(text: str, stem: str) -> Parsed:
    """Solids of a text file."""
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    borders = list(_BORDER.finditer(text))
    solids: list[tuple[str, Shape]] = []
    for n, border in enumerate(borders):
        if border[1].lower() != "solid":
            continue
        name = border[2].strip() or stem
        if n + 1 == len(borders) or borders[n + 1][1].lower() == "solid":
            raise UnreadableError(f"it is cut short: solid '{name}' has no end")
        chunk = text[border.end() : borders[n + 1].start()]
        corners = numbers(" ".join(_VERTEX.findall(chunk)), np.float64)
        if corners.size % 9:
            raise UnreadableError(f"a facet of solid '{name}' has fewer than three corners")
        faces = np.arange(corners.size // 3, dtype=np.int64).reshape(-1, 3)
        solids.append((name, Shape(corners.reshape(-1, 3), faces)))
    return placed_once(solids, Defects())

"""OFF, text: one part named after the file."""

import re
from pathlib import Path

import numpy as np

from hapticdb.mesh.parsed import (
    Parsed,
    Shape,
    UnreadableError,
    count_note,
    indices,
    numbers,
    placed_once,
    positions,
)
from hapticdb.mesh.part import Defects
from hapticdb.mesh.polygons import triangulated
from hapticdb.mesh.text import text_of

_KEYWORD = re.compile(r"(?:ST)?C?N?OFF(?![A-Z])", re.IGNORECASE)
"""Also directly before the counts, without a space, as in the files of ModelNet40."""


def read(path: Path) -> Parsed:
    """Faces of an OFF file, polygons triangulated."""
    text = text_of(path.read_bytes())
    lines = [line.split("#", 1)[0].strip() for line in text.splitlines()]
    lines = [line for line in lines if line]
    keyword = _KEYWORD.match(lines[0]) if lines else None
    if keyword is None:
        raise UnreadableError("it is no OFF file: its first word is none of OFF, COFF, NOFF")
    counts = lines[0][keyword.end() :]
    if counts.split() == ["BINARY"]:
        raise UnreadableError("it is a binary OFF file, which is not read: save it as text")
    body = lines[1:] if counts.strip() else lines[2:]
    header = numbers(counts if counts.strip() else " ".join(lines[1:2]), np.int64)
    if header.size < 2 or int(header.min()) < 0:
        raise UnreadableError("its second line does not hold the counts of vertices and faces")
    n_vertices, n_faces = int(header[0]), int(header[1])
    if n_vertices + n_faces > len(body):
        raise UnreadableError(
            f"its header promises {n_vertices:,} vertices and {n_faces:,} faces, each a line, "
            f"and {len(body):,} lines follow"
        )
    vertices = positions(body[:n_vertices])
    polygons = [_polygon(line) for line in body[n_vertices : n_vertices + n_faces]]
    faces, incomplete = triangulated(vertices, polygons)
    shape = Shape(vertices, faces, Defects(incomplete=incomplete))
    extra = len(body) - n_vertices - n_faces
    notes = count_note(extra, "line{s} behind the last face {are} passed over")
    return placed_once([(path.stem, shape)], notes, "\n".join(re.findall("#.*", text)))


def _polygon(line: str) -> list[int]:
    """Corners of one face; its first word is their number."""
    words = line.split()
    (size,) = indices(words[:1])
    corners = indices(words[1 : size + 1])
    if size < 0 or len(corners) < size:
        raise UnreadableError("a face has fewer corners than its first word says")
    return [corner if 0 <= corner < 2**62 else -1 for corner in corners]

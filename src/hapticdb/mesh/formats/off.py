"""OFF, text: one part named after the file."""

from pathlib import Path

import numpy as np

from hapticdb.mesh.part import Defects
from hapticdb.mesh.raw import Parsed, Shape, UnreadableError, fan, numbers, placed_once

_KEYWORDS = {"OFF", "COFF", "NOFF", "CNOFF", "STOFF", "STCOFF", "STNOFF", "STCNOFF"}


def read(path: Path) -> Parsed:
    """Faces of an OFF file, polygons fanned into triangles."""
    text = path.read_bytes().decode("utf-8", "replace")
    lines = [line.split("#", 1)[0].strip() for line in text.splitlines()]
    lines = [line for line in lines if line]
    keyword, _, counts = lines[0].partition(" ") if lines else ("", "", "")
    if keyword.upper() not in _KEYWORDS:
        raise UnreadableError("it is no OFF file: its first word is none of OFF, COFF, NOFF")
    body = lines[1:] if counts.strip() else lines[2:]
    header = numbers(counts if counts.strip() else " ".join(lines[1:2]), np.int64)
    if header.size < 2 or int(header.min()) < 0:
        raise UnreadableError("its second line does not hold the counts of vertices and faces")
    n_vertices, n_faces = int(header[0]), int(header[1])
    if n_vertices + n_faces > len(body):
        raise UnreadableError(
            f"its header promises {n_vertices:,} vertices and {n_faces:,} faces, "
            f"and {len(body):,} lines follow"
        )
    # Coordinates come after the position: normals, colours, texture.
    coordinates = " ".join(" ".join(line.split()[:3]) for line in body[:n_vertices])
    vertices = numbers(coordinates, np.float64)
    if vertices.size != 3 * n_vertices:
        raise UnreadableError("a vertex has fewer than three coordinates")
    polygons = [_polygon(line) for line in body[n_vertices : n_vertices + n_faces]]
    faces, incomplete = fan(polygons)
    return placed_once(
        [(path.stem, Shape(vertices.reshape(-1, 3), faces, Defects(incomplete=incomplete)))]
    )


def _polygon(line: str) -> list[int]:
    """Corners of one face; its first word says how many."""
    words = line.split()
    try:
        size = int(words[0])
        corners = [int(word) for word in words[1 : size + 1]]
    except ValueError:
        raise UnreadableError("a face holds a word where an index should be") from None
    if size < 0 or len(corners) < size:
        raise UnreadableError("a face has fewer corners than its first word says")
    return [corner if 0 <= corner < 2**62 else -1 for corner in corners]

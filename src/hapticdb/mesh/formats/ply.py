"""PLY through trimesh's loader: a mesh, or a point cloud where the file holds no faces."""

import io
from pathlib import Path
from typing import Any

import numpy as np
from trimesh.exchange.ply import load_ply
from trimesh.geometry import triangulate_quads

from hapticdb.mesh.raw import Parsed, Shape, UnreadableError, placed_once


def read(path: Path) -> Parsed:
    """One part named after the file."""
    content = path.read_bytes()
    if content[:3].lower() != b"ply":
        raise UnreadableError("it is no PLY file: its first line is not 'ply'")
    # The arguments for a mesh, before trimesh builds it: building it merges vertices and, by
    # default, drops faces with NaN corners without an error.
    loaded = load_ply(io.BytesIO(content), skip_materials=True, fix_texture=False)
    elements = loaded["metadata"]["_ply_raw"]
    if "tristrips" in elements:
        raise UnreadableError("it holds triangle strips, which PLY readers here do not support")
    for name in ("vertex", "face"):
        _check_length(name, elements.get(name, {}))
    if "vertices" not in loaded:
        return placed_once([])
    vertices, faces = loaded["vertices"], loaded.get("faces")
    if faces is None:
        return placed_once([(path.stem, Shape(vertices, None))])
    return placed_once([(path.stem, Shape(vertices, triangulate_quads(faces).reshape(-1, 3)))])


def _check_length(name: str, element: dict[str, Any]) -> None:
    """Refuse a text file with fewer rows than its header promises; trimesh's loader accepts it."""
    promised, rows = element.get("length", 0), element.get("data")
    if not promised:
        return
    if isinstance(rows, dict):
        lengths = {len(column) for column in rows.values()}
        found = min(lengths, default=0)
    else:
        found = 0 if rows is None else len(np.atleast_1d(rows))
    if found != promised:
        raise UnreadableError(
            f"it is cut short: its header promises {promised:,} of '{name}', {found:,} are there"
        )

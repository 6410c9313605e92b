"""PLY through trimesh's loader: a mesh, or a point cloud where the file holds no faces."""

import io
from pathlib import Path
from typing import Any

import numpy as np
from trimesh.exchange.ply import load_ply
from trimesh.geometry import triangulate_quads

from hapticdb.mesh.formats.painting import Colours, mean_of_corners, rgba
from hapticdb.mesh.raw import Parsed, Shape, UnreadableError, placed_once

_CHANNELS = 3


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
        shape = Shape(vertices, None, colours=_colours(elements["vertex"], len(vertices)))
        return placed_once([(path.stem, shape)])
    triangles = triangulate_quads(faces).reshape(-1, 3)
    colours = _colours(elements.get("face", {}), len(triangles))
    if colours is None:
        painted = _colours(elements["vertex"], len(vertices))
        if painted is not None:
            colours = rgba(mean_of_corners(painted, triangles) / 255)
    return placed_once([(path.stem, Shape(vertices, triangles, colours=colours))])


def _colours(element: dict[str, Any], n: int) -> Colours | None:
    """Colours (n, 4) of an element's rows; None if it has none, or another number of rows."""
    rows = element.get("data")
    names = [name for name in ("red", "green", "blue", "alpha") if name in element["properties"]]
    if rows is None or len(names) < _CHANNELS:
        return None
    columns = [np.asarray(rows[name]).reshape(-1) for name in names]
    if any(len(column) != n for column in columns):
        return None
    most = 1.0 if columns[0].dtype.kind == "f" and max(map(np.max, columns)) <= 1 else 255.0
    return rgba(np.stack(columns, axis=1) / most)


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

"""Checks whether the parts of a file fit into an environment: their names and their places."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import FileError, OutsideGridError
from hapticdb.grid import Grid
from hapticdb.mesh import MeshFile, Part

AT_BORDER = 1e-6
"""Voxels by which a part may lie beyond the grid's border without an error, because of rounding. A
larger value accepts parts that are cut off at the border."""


def check_names(mesh_file: MeshFile) -> None:
    """Refuse names that not every engine can store as text."""
    for name in (mesh_file.link, *(part.name for part in mesh_file.parts)):
        try:
            name.encode()
        except UnicodeEncodeError:
            is_text = False
        else:
            is_text = "\0" not in name
        if not is_text:
            raise FileError(f"{mesh_file.link!a}: the name {name!a} is no text: rename it")


def check_inside(parts: Iterable[Part], link: str, grid: Grid) -> None:
    """Refuse a part of the file `link` that leaves the grid at its placement in the file."""
    for part in parts:
        bounds_inside(part, link, grid)


def bounds_inside(
    part: Part, link: str, grid: Grid, world_from_part: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Bounds (2, 3) of a part in metres, world frame, at a given placement or at the file's.

    Raises `OutsideGridError` if the part leaves the grid.
    """
    points = part.world_points(world_from_part)
    bounds = np.stack([points.min(axis=0), points.max(axis=0)])
    scaled = grid.to_voxel_units(bounds)
    # a point on the upper border has no voxel; a surface there still touches the last one
    over = scaled[1] >= grid.side if part.is_cloud else scaled[1] > grid.side + AT_BORDER
    if not np.isfinite(bounds).all() or (scaled[0] < -AT_BORDER).any() or over.any():
        raise OutsideGridError(
            f"{link}: part {part.name!r} spans {_box(bounds)} m, outside the grid's "
            f"{_box(grid.bounds)} m; move it, or make an environment with a larger --extent"
        )
    return bounds


def _box(bounds: NDArray[np.float64]) -> str:
    low, high = (", ".join(f"{x:.6g}" for x in corner) for corner in bounds)
    return f"({low}) to ({high})"

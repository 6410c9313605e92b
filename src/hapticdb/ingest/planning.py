"""Plan of an import: a file compared with the grid and with the stored parts."""

import contextlib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import (
    EnvironmentExistsError,
    FileError,
    GeometryChangedError,
    ObjectNotFoundError,
    OutsideGridError,
)
from hapticdb.grid import Grid
from hapticdb.mesh import MeshFile, Part
from hapticdb.store.base import Object, Rows, Store
from hapticdb.units import length_text

MOST_ATTEMPTS = 100
"""Attempts to add a part against other processes that add and remove it; then an error is
raised."""
VOXEL_LIMIT = 1e9
"""Default of `check_cost`: a minute of one processor with distances, a quarter of that without.
Larger: longer imports of files meant for larger voxels."""
FACES_AT_ONCE = 1 << 20
"""Triangles of a batch for their area. A larger value takes more memory."""
AT_BORDER = 1e-6
"""Tolerance at the grid's border, voxels, for rounding."""


def check_names(mesh_file: MeshFile) -> None:
    """Refuse names that some engine cannot store as text."""
    for name in (mesh_file.link, *(part.name for part in mesh_file.parts)):
        if "\0" in name or name.encode(errors="replace").decode() != name:
            raise FileError(f"{mesh_file.link!a}: the name {name!a} is no text: rename it")


def check_inside(parts: Iterable[Part], link: str, grid: Grid) -> None:
    """Refuse a part of the file `link` outside the grid, at its placement in the file."""
    for part in parts:
        bounds_inside(part, link, grid)


def check_cost(parts: Iterable[Part], link: str, grid: Grid, most: float | None) -> None:
    """Refuse parts of the file `link` on more voxels than `most`, estimated by their area.

    most : `VOXEL_LIMIT` unless given. A triangle soup of 5 MB may meet 10^10 voxels, ten minutes of
    work.
    """
    size, most = grid.voxel_size, most or VOXEL_LIMIT
    n_voxels = sum(_area(part) for part in parts) / size**2
    if n_voxels > most:
        shown = float(f"{n_voxels:.2g}")
        raise FileError(
            f"{link}: its surfaces meet about {shown:,.0f} voxels of {length_text(size)}, more "
            f"than {most:,.0f}, which takes long: give larger voxels, of "
            f"{length_text(1.01 * size * (n_voxels / most) ** 0.5)}, fewer --bits, or a larger "
            "--voxel-limit"
        )


def _area(part: Part) -> float:
    """Area of the placed triangles, m^2."""
    if part.faces is None:
        return 0.0
    points, area = part.world_points(), 0.0
    for first in range(0, len(part.faces), FACES_AT_ONCE):
        a, b, c = np.moveaxis(points[part.faces[first : first + FACES_AT_ONCE]], 1, 0)
        area += 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    return area


def bounds_inside(
    part: Part, link: str, grid: Grid, world_from_part: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """`Part.bounds` at a given placement or at the file's; OutsideGridError beyond the grid."""
    placed = part if world_from_part is None else replace(part, world_from_part=world_from_part)
    points = placed.world_points()
    bounds = np.stack([points.min(axis=0), points.max(axis=0)])
    scaled = grid.to_voxel_units(bounds)
    # a point on the upper border has no voxel; a surface there still touches the last one
    over = scaled[1] >= grid.side if part.is_cloud else scaled[1] > grid.side + AT_BORDER
    if not np.isfinite(bounds).all() or (scaled[0] < -AT_BORDER).any() or over.any():
        raise OutsideGridError(
            f"{link}: part {part.name!r} spans {_box(bounds)} m, outside the grid's "
            f"{_box(grid.bounds)} m; move it, or import all files by one command into a new "
            "environment, or with a larger --extent"
        )
    return placed.bounds


def _box(bounds: NDArray[np.float64]) -> str:
    low, high = (", ".join(f"{x:.6g}" for x in corner) for corner in bounds)
    return f"({low}) to ({high})"


class StoredParts:
    """Stored parts of a file, updated from the environment's log of changes.

    by_name : their objects, by the names of the parts. Of two imports of one file of 1,500 parts at
    once the second took 4.6 s, but 33 s with a new listing for each part added by the other.
    """

    def __init__(self, store: Store, link: str) -> None:
        self._store, self._link = store, link
        # Read before the objects, so that a write between the two is seen by `refresh`.
        self._revision = store.revision()
        self._name_of: dict[int, str] = {}
        self.by_name: dict[str, Object] = {}
        for obj in store.objects():
            self._enter(obj)

    def has(self, part: Part | Object) -> bool:
        """Whether the environment has the part with the same geometry."""
        known = self.by_name.get(part.name)
        return known is not None and known.digest == part.digest

    def refresh(self) -> None:
        """Apply the changes since the last call."""
        changes = list(self._store.changes(self._revision))
        for object_id in {change.id for change in changes}:
            self.by_name.pop(self._name_of.pop(object_id, ""), None)
            with contextlib.suppress(ObjectNotFoundError):
                self._enter(self._store.object(object_id))
        if changes:
            self._revision = changes[-1].revision

    def _enter(self, obj: Object) -> None:
        if obj.link == self._link:
            self._name_of[obj.id] = obj.name
            self.by_name[obj.name] = obj


def added_or_present(
    store: Store, part: Object, rows: Rows, surface: bytes, known: StoredParts
) -> list[int]:
    """Add a part: its id, or nothing if another process has added the same part meanwhile.

    Raises `EnvironmentExistsError` for a part of that name with another geometry.
    """
    for attempt in range(MOST_ATTEMPTS):
        try:
            return [store.add(part, rows, surface)]
        except EnvironmentExistsError:
            known.refresh()
            if known.has(part):
                return []
            if part.name in known.by_name or attempt == MOST_ATTEMPTS - 1:
                raise
            # Another process has removed it since, so its name is free again.
    raise AssertionError  # the last attempt returns or raises


class Plan(NamedTuple):
    """Writes of an import, in this order.

    replaced : parts, in the file's order, with the ids of their objects; added : new parts, in the
    file's order; dropped : ids of objects without a part in the file; removed : names of the file's
    parts removed from the environment before.
    """

    replaced: list[tuple[Part, int]]
    added: list[Part]
    dropped: list[int]
    removed: set[str]


def planned(
    file: MeshFile,
    unit: str | None,
    grid: Grid,
    known: Mapping[str, Object],
    removed: set[str],
    *,
    replace: bool,
    keep_removed: bool,
    voxel_limit: float | None,
) -> Plan:
    """Plan of a file's import into an environment; nothing is read or written.

    file, unit : the file's parts, and the unit of its reading; grid : the environment's; known :
    the environment's objects of this file, by the names of their parts; removed : names of parts
    removed from the environment; replace, keep_removed, voxel_limit : as in
    `hapticdb.ingest.files.ImportOptions`.

    Raises `OutsideGridError` if a part to be written leaves the grid; `FileError` if they meet too
    many voxels; `GeometryChangedError` for a part with another geometry than the object of its
    name, without `replace`.
    """
    missing = [part for part in file.parts if part.name not in known]
    there = [(part, known[part.name]) for part in file.parts if part.name in known]
    for part, obj in there:
        if obj.digest != part.digest and not replace:
            raise GeometryChangedError(
                f"{file.link}: part {part.name!r} has changed since it was imported, or was "
                "read with another --unit or --chord; --replace puts the file's in its place"
            )
    removed = {part.name for part in missing} & removed
    added = [part for part in missing if not (keep_removed and part.name in removed)]
    replaced = [(part, obj.id) for part, obj in there if replace and _differs(part, obj, unit)]
    written = [*added, *(part for part, _ in replaced)]
    check_inside(written, file.link, grid)
    check_cost(written, file.link, grid, voxel_limit)
    names = {part.name for part in file.parts}
    dropped = [obj.id for obj in known.values() if replace and obj.name not in names]
    return Plan(replaced, added, dropped, removed)


def _differs(part: Part, obj: Object, unit: str | None) -> bool:
    """Whether geometry, placement, attributes or unit have changed."""
    return (
        obj.digest != part.digest
        or obj.attributes.get("unit") != unit
        or not part.attributes.items() <= obj.attributes.items()
        or not np.array_equal(obj.transform, part.world_from_part)
    )

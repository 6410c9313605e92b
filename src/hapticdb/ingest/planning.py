"""What an import writes: a file compared with the objects that an environment has of it."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from hapticdb.errors import GeometryChangedError
from hapticdb.grid import Grid
from hapticdb.ingest.checking import check_inside
from hapticdb.mesh import MeshFile, Part
from hapticdb.store.base import Object


class Plan(NamedTuple):
    """What an import writes, in this order.

    replaced : parts that exchange an object, in the file's order, with the object's id; added :
    parts that the environment lacks, in the file's order; dropped : ids of objects whose parts the
    file lacks; removed : names of the file's parts that were removed from the environment before.
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
) -> Plan:
    """Compare a file with an environment; nothing is read or written.

    Parameters
    ----------
    file, unit
        The file's parts, and the unit in which it was read.
    grid
        The environment's.
    known : mapping
        The environment's objects of this file, by the names of their parts.
    removed : set of str
        Names of parts that were removed from the environment.
    replace, keep_removed
        As in `hapticdb.ingest.files.ImportOptions`.

    Raises
    ------
    OutsideGridError
        If a part that is to be written leaves the grid.
    GeometryChangedError
        If a part has another geometry than the object of its name, which is not to be replaced.
    """
    missing = [part for part in file.parts if part.name not in known]
    there = [(part, known[part.name]) for part in file.parts if part.name in known]
    for part, obj in there:
        if obj.digest != part.digest and not replace:
            raise GeometryChangedError(
                f"{file.link}: part {part.name!r} has changed since it was imported, or was "
                "read with another --unit; --replace puts the file's in its place"
            )
    removed = {part.name for part in missing} & removed
    added = [part for part in missing if not (keep_removed and part.name in removed)]
    replaced = [(part, obj.id) for part, obj in there if replace and _differs(part, obj, unit)]
    check_inside([*added, *(part for part, _ in replaced)], file.link, grid)
    names = {part.name for part in file.parts}
    dropped = [obj.id for obj in known.values() if replace and obj.name not in names]
    return Plan(replaced, added, dropped, removed)


def _differs(part: Part, obj: Object, unit: str | None) -> bool:
    """Whether geometry, placement, or the unit that the file was read in are others."""
    return (
        obj.digest != part.digest
        or obj.attributes.get("unit") != unit
        or not np.array_equal(obj.transform, part.world_from_part)
    )

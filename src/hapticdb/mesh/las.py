"""LAS and LAZ through laspy: one point cloud named after the file."""

import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
from laspy.vlrs.known import GeoKeyDirectoryVlr, WktCoordinateSystemVlr

from hapticdb.mesh.raw import Parsed, Shape, UnreadableError, placed_once

_MODEL, _LINEAR_UNIT = 1024, 3076
_PROJECTED = 1
_CODES = {9001: 1.0, 9002: 0.3048, 9003: 1200.0 / 3937.0}
"""Of GeoTIFF keys: a projected system's unit of length, metres."""
_WKT_UNIT = re.compile(r'(?:LENGTH)?UNIT\["[^"]*",\s*([0-9.eE+-]+)')


def read(path: Path) -> Parsed:
    """Points of a LAS or LAZ file, in the unit of its coordinates, z up."""
    with laspy.open(path) as reader:
        promised = reader.header.point_count
        unit = _unit_of(reader.header.vlrs)
        points = reader.read()
    if len(points) != promised:
        raise UnreadableError(
            f"it is cut short: its header promises {promised:,} points, {len(points):,} are there"
        )
    parsed = placed_once([(path.stem, Shape(np.asarray(points.xyz), None))])
    return replace(parsed, likely_metres=unit, up="z")


def _unit_of(records: Iterable[object]) -> float | None:
    """Metres of the unit that the file's projected reference system names, else None."""
    for record in records:
        if isinstance(record, GeoKeyDirectoryVlr):
            keys = {key.id: key.value_offset for key in record.geo_keys}
            if keys.get(_MODEL) == _PROJECTED:
                return _CODES.get(keys.get(_LINEAR_UNIT, 0))
        if isinstance(record, WktCoordinateSystemVlr):
            return _unit_of_wkt(record.string)
    return None


def _unit_of_wkt(text: str) -> float | None:
    """Metres of a projected system's unit in well-known text: the last one, after its angles."""
    start = max(text.find("PROJCS["), text.find("PROJCRS["))
    if start < 0:
        return None
    end = min(i for i in (text.find("VERT", start), len(text)) if i >= 0)
    found = _WKT_UNIT.findall(text, start, end)
    try:
        metres = float(found[-1])
    except (IndexError, ValueError):
        return None
    return metres if 1e-3 <= metres <= 1e3 else None

"""LAS and LAZ through laspy: one point cloud named after the file."""

import struct
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import laspy
import numpy as np
from laspy.vlrs.known import GeoKeyDirectoryVlr, WktCoordinateSystemVlr
from numpy.typing import NDArray

from hapticdb.mesh.formats.srgb import Colours
from hapticdb.mesh.parsed import Parsed, Shape, UnreadableError, count_note, placed_once
from hapticdb.units import length_text

_MODEL, _LINEAR_UNIT, _VERTICAL_SYSTEM, _VERTICAL_UNIT = 1024, 3076, 4096, 4099
"""Ids of GeoTIFF keys."""
_NO_LENGTHS = (
    "which are no lengths: project it to a system in metres, for instance with PDAL's "
    "filters.reprojection, or name the unit (--unit) if its system is wrong"
)
_ENDS = np.iinfo(np.int32).min, np.iinfo(np.int32).max
_MOST_STUCK = 0.01
"""Share of a file's points that may be saturated at an end of the integers on an axis."""
_COARSE = 0.3
"""Step between coordinates, metres, from which on it is reported: whole metres, and whole feet."""
_COLOURS = ("red", "green", "blue")
_HEADER = 227
_POINTS_AT_ONCE = 50_000, 1_000_000
"""Least and greatest number of points of a batch; between them, one for each byte of the file.
laspy allocates memory for the whole batch before it reads a point."""


def read(path: Path) -> Parsed:
    """Points of a LAS or LAZ file, in the unit of its coordinates, z up unless geocentric."""
    _check_header(path)
    pieces: list[NDArray[np.float64]] = []
    painted: list[NDArray[np.uint16]] = []
    n_withheld = 0
    with laspy.open(path) as reader:
        promised = reader.header.point_count
        if not reader.header.are_points_compressed:
            behind = path.stat().st_size - reader.header.offset_to_point_data
            _refuse_cut(promised, behind // reader.header.point_format.size)
        lengths = _lengths(reader.header)
        places = _Places(reader.header.scales, lengths.metres)
        least, most = _POINTS_AT_ONCE
        for points in reader.chunk_iterator(min(most, max(least, path.stat().st_size))):
            if not len(points):
                break
            axes = [np.asarray(axis, dtype=np.float64) for axis in (points.x, points.y, points.z)]
            pieces.append(np.stack(axes, axis=1))
            places.count(np.stack([points.X, points.Y, points.Z], axis=1))
            n_withheld += int(np.count_nonzero(points.withheld))
            if {*_COLOURS}.issubset(points.point_format.dimension_names):
                channels = [np.asarray(points[name]) for name in _COLOURS]
                painted.append(np.stack(channels, axis=1))
    _refuse_cut(promised, sum(map(len, pieces)))
    whole = np.concatenate(pieces) if pieces else np.empty((0, 3))
    whole[:, 2] *= lengths.rise
    parsed = placed_once([(path.stem, Shape(whole, None, colours=_screen(painted)))])
    words = "point{s} {are} withheld (deleted) in it, and {come} in like any other"
    return replace(
        parsed, likely_metres=lengths.metres, up=lengths.up, not_lengths=lengths.not_lengths,
        notes=[*lengths.notes, *places.notes(len(whole)), *count_note(n_withheld, words)],
    )  # fmt: skip


def _refuse_cut(promised: int, found: int) -> None:
    """Raise UnreadableError for a file with fewer points than its header promises."""
    if found < promised:
        raise UnreadableError(
            f"it is cut short: its header promises {promised:,} points, {found:,} are there"
        )


def _screen(painted: list[NDArray[np.uint16]]) -> Colours | None:
    """Colours (N, 4) of 16-bit channels, or 8-bit ones of some programs; None if all are black."""
    most = max((int(some.max()) for some in painted), default=0)
    if not most:
        return None
    channels = np.concatenate(painted)
    colours = np.full((len(channels), 4), 255, dtype=np.uint8)
    colours[:, :3] = channels if most <= 255 else channels // 257
    return colours


class _Places:
    """Integer coordinates of points: counts the saturated ones, and checks the resolution.

    scales (3,) : steps of the integers, in the file's unit; metres : of that unit, None if unknown.
    """

    def __init__(self, scales: NDArray[np.float64], metres: float | None) -> None:
        self._scales, self._metres = np.abs(scales), metres
        self._n_stuck = np.zeros((2, 3), dtype=np.int64)  # at each end, on each axis
        self._low, self._high = np.full(3, _ENDS[1]), np.full(3, _ENDS[0])
        if flat := [axis for axis, scale in zip("xyz", scales, strict=True) if scale == 0.0]:
            raise UnreadableError(
                f"the scale of its {' and '.join(flat)} is 0: the places of its points are lost; "
                "write it anew from its source, with a scale such as 0.001"
            )

    def count(self, integers: NDArray[np.int32]) -> None:
        """Count the integers (n, 3) at an end of their range."""
        self._n_stuck += [np.count_nonzero(integers == end, axis=0) for end in _ENDS]
        self._low = np.minimum(self._low, integers.min(axis=0))
        self._high = np.maximum(self._high, integers.max(axis=0))

    def notes(self, n_points: int) -> list[str]:
        """Notes of lost positions; UnreadableError above `_MOST_STUCK`."""
        # a scale fitted to the extent is no fault: its points span one end, or 0, to the other end
        is_chosen = np.isin(self._high - self._low, (_ENDS[1], _ENDS[1] - _ENDS[0]))
        stuck = np.where(is_chosen, 0, self._n_stuck.sum(axis=0))
        found = []
        for axis, n in zip("xyz", stuck.tolist(), strict=True):
            found += count_note(
                n, "point{s} {are} stuck in {axis} at the end of 32-bit integers", axis=axis
            )
        if stuck.max() > _MOST_STUCK * n_points:
            raise UnreadableError(
                f"{'; '.join(found)}, so their places are lost; write it anew from its source, "
                "with a larger scale or an offset near its points"
            )
        step = float(self._scales.max()) * (self._metres or 1.0)
        if step >= _COARSE:
            guess = "" if self._metres else ", if its numbers are metres"
            grid = f"its points lie on a grid of {length_text(step)}{guess}"
            found.append(f"{grid}: what is finer was lost when it was written")
        return found


class _Lengths(NamedTuple):
    """Units of a file's coordinates, by its reference system.

    metres : unit length, None if unknown; rise : ratio of the height unit to it; not_lengths :
    error message for coordinates in degrees, or None; up : up axis, None for a geocentric system.
    """

    metres: float | None = None
    rise: float = 1.0
    notes: tuple[str, ...] = ()
    not_lengths: str | None = None
    up: str | None = "z"


def _lengths(header: laspy.LasHeader) -> _Lengths:
    """Units by the reference system in the file's records."""
    records = [*header.vlrs, *(header.evlrs or ())]
    directories = [one.geo_keys for one in records if isinstance(one, GeoKeyDirectoryVlr)]
    keys = {key.id: key.value_offset for one in directories for key in one}
    if not keys and not any(isinstance(one, WktCoordinateSystemVlr) for one in records):
        return _Lengths()
    from pyproj import CRS  # noqa: PLC0415 - only files with such a record need it
    from pyproj.database import get_units_map  # noqa: PLC0415
    from pyproj.exceptions import CRSError  # noqa: PLC0415

    try:
        system = header.parse_crs()
        vertical = CRS.from_epsg(keys[_VERTICAL_SYSTEM]) if _VERTICAL_SYSTEM in keys else None
    except CRSError:
        system = vertical = None
    if (system is not None and system.is_geographic) or keys.get(_MODEL) == 2:
        name = "" if system is None else f" ({system.name})"
        if np.abs([header.mins[:2], header.maxs[:2]]).max() > 360.0:
            return _Lengths(notes=(f"its system{name} is of degrees, which its numbers are not",))
        return _Lengths(not_lengths=f"its coordinates are degrees{name}, {_NO_LENGTHS}")
    by_code = {
        int(unit.code): float(unit.conv_factor)
        for unit in get_units_map(auth_name="EPSG", category="linear").values()
    }
    axes = [] if system is None else system.axis_info
    metres = by_code.get(
        keys.get(_LINEAR_UNIT, 0), axes[0].unit_conversion_factor if axes else None
    )
    if metres is None or not 1e-3 <= metres <= 1e3:
        return _Lengths(notes=("the unit of its reference system cannot be read",))
    heights = [*axes[2:3], *([] if vertical is None else vertical.axis_info[:1])]
    height = heights[-1].unit_conversion_factor if heights else metres
    height = by_code.get(keys.get(_VERTICAL_UNIT, 0), height)
    differ = f"its heights are in units of {height:.6g} m, its positions of {metres:.6g} m"
    up = None if system is not None and system.is_geocentric else "z"
    return _Lengths(metres, height / metres, (differ,) if height != metres else (), up=up)


def _check_header(path: Path) -> None:
    """Refuse another or a cut header: laspy would read after the file's end."""
    n_bytes = path.stat().st_size
    with path.open("rb") as stream:
        header = stream.read(_HEADER)
    if header[:4] != b"LASF":
        raise UnreadableError("it is no LAS file: it does not start with 'LASF'")
    if len(header) < _HEADER:
        raise UnreadableError("it is cut short: it ends within its header")
    size, points_at, n_records = struct.unpack_from("<HII", header, 94)
    if not _HEADER <= size <= points_at - 54 * n_records <= n_bytes - 54 * n_records:
        raise UnreadableError(
            f"it is damaged or cut short: its points begin at byte {points_at:,}, its header has "
            f"{size:,} bytes and {n_records:,} records, and the file {n_bytes:,} bytes"
        )

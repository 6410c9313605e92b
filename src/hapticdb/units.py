"""Units of length, by their names in options and parameters."""

import math
import re
from collections.abc import Iterable
from decimal import Decimal
from html import escape

from hapticdb.errors import UsageError

UNITS = {
    "um": 1e-6,
    "mm": 1e-3,
    "cm": 1e-2,
    "m": 1.0,
    "km": 1e3,
    "in": 0.0254,
    "ft": 0.3048,
    "us-ft": 1200.0 / 3937.0,
    "yd": 0.9144,
}
"""Length of each, metres; `us-ft` is the US survey foot, common in point clouds."""
NAMES = {
    "um": "micrometres",
    "mm": "millimetres",
    "cm": "centimetres",
    "m": "metres",
    "km": "kilometres",
    "in": "inches",
    "ft": "feet",
    "us-ft": "US survey feet",
    "yd": "yards",
}
"""Each unit in words."""
_LENGTH = re.compile(
    r"([-+]?(?:\d{1,99}(?:\.\d*)?|\.\d+)(?:e[-+]?\d{1,2})?)\s*([a-zµ-]+)?", re.IGNORECASE
)
"""A finite number, and an optional unit."""
_READABLE = ((1e3, "km", 10.0), (1.0, "m", 0.1), (1e-3, "mm", 0.1))
"""Units of printed lengths: metres, sign, and the least number printed in it."""
_LIKELY = ("mm", "in", "cm", "um", "ft")
"""Likely units of a tool with an implausible size in metres, the likeliest first."""
_VOLUMES = ((1.0, "m³"), (1e-6, "cm³"), (1e-9, "mm³"))


def length_text(length: float) -> str:
    """A length, metres, in a readable unit: ``3.3 mm``, ``4.21 m``, ``12.5 km``."""
    found = (pair[:2] for pair in _READABLE if length >= pair[2] * pair[0])
    size, word = next(found, (1e-6, "µm"))
    return f"{length / size:.4g} {word}"


def unit_doubt(length: float, extent: float, voxel_size: float) -> str:
    """Note on a tool, metres, longer than a scene or shorter than a voxel; empty if plausible."""
    if length > extent:
        compared = f"longer than the scene ({length_text(extent)})"
    elif length < voxel_size:
        compared = f"shorter than a voxel ({length_text(voxel_size)})"
    else:
        return ""
    unit = next((u for u in _LIKELY if voxel_size <= length * UNITS[u] <= extent), None)
    hint = "is --tool-unit right?" if unit is None else f"would --tool-unit {unit} be right?"
    return f"{length_text(length)} long, {compared}: {hint}"


def place_text(place: Iterable[float], step: float) -> str:
    """Coordinates, metres, rounded to a step, metres: ``(515369.12, 4918340.5, 0)``."""
    digits = min(max(math.ceil(-math.log10(step)), 0), 12) if step > 0.0 else 6
    numbers = (f"{round(x, digits) + 0.0:.{digits}f}" for x in place)
    return f"({', '.join(x.rstrip('0').rstrip('.') if '.' in x else x for x in numbers)})"


def notebook_html(result: object, rows: Iterable[Iterable[object]]) -> str:
    """HTML of a result for notebooks: its `repr`, and a table of escaped texts."""
    cells = ("".join(f"<td>{escape(str(cell))}</td>" for cell in row) for row in rows)
    table = "".join(f"<tr>{row}</tr>" for row in cells)
    return f"<b>{escape(repr(result))}</b><table>{table}</table>"


def length_of(text: str, unit: str) -> float:
    """Metres of a length: a number in `unit`, or with a unit of its own, such as ``0.2 in``.

    The product is rounded once, so that 0.1mm and 100um are equal; `UsageError`.
    """
    match = _LENGTH.fullmatch(text.strip())
    own = UNITS.get((match[2] or unit).replace("µ", "u")) if match else None
    if match is None or own is None:
        raise UsageError(
            f"{text[:80]!r} is no length: give {NAMES[unit]}, or such as 0.2in ({', '.join(UNITS)})"
        )
    return float(Decimal(match[1]) * Decimal(repr(own)))


def angle_of(text: str) -> float:
    """Degrees of an angle: a number in degrees, or with a unit, ``60deg``, ``1.05 rad``."""
    match = _LENGTH.fullmatch(text.strip())
    own = {"deg": 1.0, "rad": 180.0 / math.pi}.get(match[2] or "deg") if match else None
    if match is None or own is None:
        raise UsageError(f"{text[:80]!r} is no angle: give degrees, or such as 1.05rad")
    return float(match[1]) * own


def volume_of(text: str) -> float:
    """Cubic metres of a volume: cubic centimetres, or with a unit, as ``5mm3``; `UsageError`."""
    bare = re.sub(r"(?<=[a-zµ])(\^?3|³)$", "", text.strip(), flags=re.IGNORECASE)
    match = _LENGTH.fullmatch(bare)
    own = UNITS.get((match[2] or "cm").replace("µ", "u")) if match else None
    if match is None or own is None or (match[2] and bare == text.strip()):
        raise UsageError(f"{text[:80]!r} is no volume: give cubic centimetres, or such as 5mm3")
    return float(Decimal(match[1]) * Decimal(repr(own)) ** 3)


def volume_text(volume: float) -> str:
    """A volume, cubic metres, in a readable unit: ``72.7 cm³``."""
    size, word = next(pair for pair in _VOLUMES if volume >= 0.01 * pair[0] or pair[1] == "mm³")
    return f"{volume / size:.4g} {word}"


def metres_of(unit: str) -> float:
    """Length of a unit, metres; `UsageError` for an unknown one."""
    if unit not in UNITS:
        raise UsageError(f"unknown unit '{unit}'; choose one of {', '.join(UNITS)}")
    return UNITS[unit]

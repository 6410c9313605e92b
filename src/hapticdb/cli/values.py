"""Values of options: numbers and sizes in memory or on disk."""

import re
from math import isfinite

from hapticdb.errors import UsageError
from hapticdb.units import UNITS

MIB = 1 << 20
LARGEST_MIB = 1e6
"""Largest size that an option takes, MiB: a typing error beyond it is refused."""
SIZE = re.compile(r"(\d+(?:\.\d*)?) ?(MiB|GiB|M|G)?", re.IGNORECASE)
"""A size as an option takes it; a number without a unit is MiB."""

LENGTH = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?) ?([a-z-]+)?", re.IGNORECASE)
"""A number and a unit of length; a number without a unit is millimetres."""


def numbers_of(text: str, count: int, option: str, example: str) -> list[float]:
    """Finite numbers of an option, separated by commas or blanks; `example` is what to give."""
    try:
        numbers = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(isfinite, numbers)):
        raise UsageError(f"{option} {text[:80]!r}: give {example}")
    return numbers


def length_of(text: str, option: str) -> float:
    """Metres of a length that is given in millimetres, or with its unit, such as ``0.01mm``."""
    match = LENGTH.fullmatch(text.strip())
    unit = (match[2] or "mm") if match else ""
    if match is None or unit not in UNITS:
        raise UsageError(f"{option} {text[:80]!r}: give millimetres, or a length such as 10um")
    return float(f"{float(match[1]) * UNITS[unit]:.12g}")  # one number for 0.1mm and 100um


def budget_bytes(mib: float) -> int:
    """Bytes of ``--budget``, which is given in MiB."""
    if not 1.0 <= mib <= LARGEST_MIB:
        raise UsageError(f"--budget {mib}: give MiB, 1 to a million")
    return int(mib * MIB)


def size_bytes(text: str, option: str) -> int:
    """Bytes of a size that is given in MiB, or with its unit, such as ``4GiB``."""
    match = SIZE.fullmatch(text.strip())
    unit = (match[2] or "M")[0].upper() if match else "M"
    mib = float(match[1]) * (1024.0 if unit == "G" else 1.0) if match else 0.0
    if not 1.0 <= mib <= LARGEST_MIB:
        raise UsageError(f"{option} {text[:80]!r}: give MiB, 1 to a million, or such as 4GiB")
    return int(mib * MIB)

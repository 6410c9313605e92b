"""Values of options: numbers and sizes in memory or on disk."""

import re
from dataclasses import fields
from math import isfinite
from typing import TYPE_CHECKING, NamedTuple

from hapticdb.errors import UsageError
from hapticdb.units import NAMES, length_of

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

MIB = 1 << 20
LARGEST_MIB = 1e6
"""Largest size of an option, MiB; a larger one is refused as a typing error."""
SIZE = re.compile(r"(\d+(?:\.\d*)?) ?(MiB|GiB|M|G)?", re.IGNORECASE)
"""Size of an option; a number without a unit is MiB."""


def refuse(where: str, group: "DataclassInstance", names: str = "") -> None:
    """UsageError for given options of a group, some or all, without a meaning there."""
    for one in fields(group):
        if (not names or one.name in names.split()) and getattr(group, one.name) != one.default:
            flag = one.name.rstrip("_").replace("_", "-")
            raise UsageError(f"--{flag} has no meaning {where}: leave it out")


class Point(NamedTuple):
    """Coordinates of an option, metres."""

    x: float
    y: float
    z: float


def numbers_of(text: str, count: int, option: str, example: str) -> list[float]:
    """Finite numbers of an option, separated by commas or blanks; `example` : for the error."""
    try:
        numbers = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(isfinite, numbers)):
        raise UsageError(f"{option} {text[:80]!r}: give {example}")
    return numbers


def point_of(text: str, unit: str) -> Point:
    """Three lengths, separated by commas or blanks; a bare number has the last one's unit."""
    words = re.sub(r"\s+(?=[a-zµ])", "", text).replace(",", " ").split()
    last = words[-1].lstrip("+-.0123456789eE") if words else ""
    try:
        return Point(*(length_of(w if w[-1].isalpha() else w + last, unit) for w in words))
    except (TypeError, UsageError):
        raise UsageError(
            f"{text[:80]!r}: give X,Y,Z in {NAMES[unit]}, or such as 0,5,0.2in"
        ) from None


def size_of(text: str) -> int:
    """Bytes of a size in MiB, or with its own unit, such as ``4GiB``."""
    match = SIZE.fullmatch(text.strip())
    unit = (match[2] or "M")[0].upper() if match else "M"
    mib = float(match[1]) * (1024.0 if unit == "G" else 1.0) if match else 0.0
    if not 1.0 <= mib <= LARGEST_MIB:
        raise UsageError(f"{text[:80]!r}: give MiB, 1 to a million, or such as 4GiB")
    return int(mib * MIB)

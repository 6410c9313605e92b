"""Values of options: numbers and sizes in memory or on disk."""

import re
from dataclasses import fields
from math import isfinite
from typing import TYPE_CHECKING, NamedTuple

from hapticdb.errors import UsageError
from hapticdb.units import NAMES, length_of

if TYPE_CHECKING:
    import numpy as np
    from _typeshed import DataclassInstance
    from numpy.typing import NDArray

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


def pose_of(text: str, option: str) -> "NDArray[np.float64]":
    """Pose (4, 4) of an option, metres: given as numbers, millimetres, or as a file, metres."""
    import numpy as np

    from hapticdb.poses import pose_of_row, read_poses

    if text.lower().endswith(".csv"):
        poses = read_poses(text)
        if len(poses) != 1:
            raise UsageError(f"{option} {text}: it has {len(poses)} poses, give a file of one")
        return np.asarray(poses[0])
    words = text.replace(",", " ").split()
    try:
        place = point_of(" ".join(words[:3]), "mm")
        turn = numbers_of(" ".join(words[3:]), 4, option, "qw,qx,qy,qz")
    except UsageError:
        form = "x,y,z,qw,qx,qy,qz, or a file whose name ends in .csv"
        raise UsageError(f"{option} {text[:80]!r}: give {form}") from None
    return pose_of_row(place, turn)


def size_of(text: str) -> int:
    """Bytes of a size in MiB, or with its own unit, such as ``4GiB``."""
    match = SIZE.fullmatch(text.strip())
    unit = (match[2] or "M")[0].upper() if match else "M"
    mib = float(match[1]) * (1024.0 if unit == "G" else 1.0) if match else 0.0
    if not 1.0 <= mib <= LARGEST_MIB:
        raise UsageError(f"{text[:80]!r}: give MiB, 1 to a million, or such as 4GiB")
    return int(mib * MIB)

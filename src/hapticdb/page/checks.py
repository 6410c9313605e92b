"""Validation of values from a browser: UsageError for any unexpected value."""

import math
from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import UsageError

FARTHEST = 1e9
"""Greatest coordinate, metres, as of poses in files."""


def number_of(value: object, low: float, high: float, what: str) -> float:
    """A finite number in [low, high]."""
    # to Python a bool is an int
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise UsageError(f"{what}: give a number")
    number = float(value)
    if not math.isfinite(number) or not low <= number <= high:
        raise UsageError(f"{what}: give a number from {low:g} to {high:g}")
    return number


def text_of(value: object, longest: int, what: str) -> str:
    """A text of at most `longest` characters; characters that cannot be printed are dropped."""
    if not isinstance(value, str) or len(value) > longest:
        raise UsageError(f"{what}: give a text of at most {longest} letters")
    return "".join(letter for letter in value if letter.isprintable())


def choice_of(value: object, choices: Collection[str], what: str) -> str:
    """One of the current choices."""
    if not isinstance(value, str) or value not in choices:
        raise UsageError(f"{what}: choose one of the list")
    return value


def flag_of(value: object, what: str) -> bool:
    """State of a check box."""
    if not isinstance(value, bool):
        raise UsageError(f"{what}: tick the box, or clear it")
    return value


def numbers_of(value: object, n: int, most: float, what: str) -> NDArray[np.float64]:
    """`n` finite numbers (n,) with an absolute value of at most `most`."""
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    # NaN fails the comparison, too
    if numbers.shape != (n,) or not bool((np.abs(numbers) <= most).all()):
        raise UsageError(f"{what}: give {n} numbers, {most:g} at most")
    return numbers


def row_of(position: object, wxyz: object) -> NDArray[np.float64]:
    """Pose (7,) of a gizmo: metres, and a quaternion, scalar first, normalised here."""
    point = numbers_of(position, 3, FARTHEST, "a place")
    turn = numbers_of(wxyz, 4, FARTHEST, "a turn")
    length = math.hypot(*turn)
    if length < 1e-6:
        raise UsageError("a turn: give a quaternion that is not zero")
    return np.concatenate([point, turn / length])

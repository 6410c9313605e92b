"""Checks of values from a browser, which may send anything: UsageError for all others."""

import math
from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import UsageError

FARTHEST = 1e9
"""Greatest coordinate that a browser may send, metres, as of poses in files."""


def number_of(value: object, low: float, high: float, what: str) -> float:
    """Return a finite number between two bounds."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise UsageError(f"{what}: give a number")
    number = float(value)
    if not math.isfinite(number) or not low <= number <= high:
        raise UsageError(f"{what}: give a number from {low:g} to {high:g}")
    return number


def text_of(value: object, longest: int, what: str) -> str:
    """Return a text of at most `longest` letters, on one line."""
    if not isinstance(value, str) or len(value) > longest:
        raise UsageError(f"{what}: give a text of at most {longest} letters")
    return "".join(letter for letter in value if letter.isprintable())


def choice_of(value: object, choices: Collection[str], what: str) -> str:
    """Return one of the choices that are there now."""
    if not isinstance(value, str) or value not in choices:
        raise UsageError(f"{what}: choose one of the list")
    return value


def flag_of(value: object, what: str) -> bool:
    """Return a box's state, ticked or not."""
    if not isinstance(value, bool):
        raise UsageError(f"{what}: tick the box, or clear it")
    return value


def numbers_of(value: object, n: int, most: float, what: str) -> NDArray[np.float64]:
    """Return `n` finite numbers (n,), none larger than `most` without its sign."""
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != (n,) or not bool((np.abs(numbers) <= most).all()):
        raise UsageError(f"{what}: give {n} numbers, {most:g} at most")
    return numbers


def row_of(position: object, wxyz: object) -> NDArray[np.float64]:
    """Pose (7,) of a gizmo: position in metres, quaternion scalar first, made unit here."""
    point = numbers_of(position, 3, FARTHEST, "a place")
    turn = numbers_of(wxyz, 4, FARTHEST, "a turn")
    length = math.hypot(*turn)
    if length < 1e-6:
        raise UsageError("a turn: give a quaternion that is not zero")
    return np.concatenate([point, turn / length])

"""Colours as in `Part`: 8-bit sRGB and opacity.

An unreadable colour never loses the geometry: the part then has none, or `PLAIN`.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Colours = NDArray[np.uint8]

PLAIN = (200, 202, 205, 255)
"""Colour of triangles without one, among coloured ones."""


def rgba(values: ArrayLike) -> Colours:
    """Colours (n, 4) of numbers 0 to 1, (n, 3) or (n, 4); without a fourth they are opaque."""
    found = np.nan_to_num(np.atleast_2d(np.asarray(values, dtype=np.float64)), nan=1.0)
    colours = np.full((len(found), 4), 255, dtype=np.uint8)
    width = min(found.shape[1], 4)
    colours[:, :width] = np.round(255 * np.clip(found[:, :width], 0.0, 1.0))
    return colours


def of_light(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values (n, 4) of sRGB from linear light (n, 4), 0 to 1; the opacity is unchanged."""
    light = np.clip(np.nan_to_num(values, nan=1.0), 0.0, 1.0)
    seen = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    seen[:, 3:] = light[:, 3:]
    return seen


def mean_of_corners(values: NDArray[Any], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Means (F, k) of values (V, k) at the corners of faces (F, 3); indices are clipped."""
    total = np.zeros((len(faces), values.shape[1]))
    for corner in range(3):
        at = np.clip(faces[:, corner], 0, len(values) - 1)
        total += values[at]
    return total / 3


def joined(pieces: Sequence[tuple[Colours | None, int]]) -> Colours | None:
    """Concatenated colours of pieces, each with its number of triangles; None if none has any."""
    if all(colours is None for colours, _ in pieces):
        return None
    plain = np.array([PLAIN], dtype=np.uint8)
    return np.concatenate(
        [np.broadcast_to(plain if colours is None else colours, (n, 4)) for colours, n in pieces]
    )

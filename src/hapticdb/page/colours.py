"""Colours of the page: of tools, arrows and objects."""

import colorsys

import numpy as np
from numpy.typing import NDArray

from hapticdb.store.base import Object

Colour = tuple[int, int, int]

FORCE: Colour = (235, 104, 20)
"""Force: its arrow and its plot."""
TORQUE: Colour = (126, 87, 194)
"""Torque: its arrow."""
MARK: Colour = (214, 39, 60)
"""What a sweep hits, and the ends of a measured distance."""
HELD: Colour = (250, 176, 5)
"""A chosen part."""
GOLDEN = 0.61803398875
"""Part of the circle of hues from one number to the next: neighbours in number differ most."""


def _hue(number: int, lightness: float, saturation: float) -> Colour:
    red, green, blue = colorsys.hls_to_rgb(number * GOLDEN % 1.0, lightness, saturation)
    return round(255 * red), round(255 * green), round(255 * blue)


def of_object(object_id: int) -> Colour:
    """Colour of an object's contacts and of the square before its name."""
    return _hue(object_id, 0.48, 0.75)


def of_tool(number: int) -> Colour:
    """Colour of a person's tool."""
    return _hue(number + 4, 0.55, 0.72)


def of_contacts(points: NDArray[np.float64], touched: list[Object]) -> NDArray[np.uint8]:
    """Colours (n, 3) of contacts: each has that of the touched object whose box is nearest.

    points : (n, 3), metres. Of boxes that are equally near, the smallest is taken.
    """
    if not touched or not len(points):
        return np.full((len(points), 3), FORCE, dtype=np.uint8)
    ordered = sorted(touched, key=lambda obj: float(np.prod(obj.bounds[1] - obj.bounds[0])))
    away = np.stack(
        [
            np.linalg.norm(
                np.maximum(np.maximum(obj.bounds[0] - points, points - obj.bounds[1]), 0.0), axis=1
            )
            for obj in ordered
        ]
    )
    palette = np.array([of_object(obj.id) for obj in ordered], dtype=np.uint8)
    return np.asarray(palette[away.argmin(axis=0)], dtype=np.uint8)

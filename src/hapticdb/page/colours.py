"""Colours of the page: of tools, arrows, contacts and objects."""

import colorsys
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from hapticdb.store.base import Object

Colour = tuple[int, int, int]
"""Red, green and blue as a screen shows them (sRGB), 0 to 255."""

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
FAMILIES: tuple[Colour, ...] = (
    (91, 141, 184), (208, 122, 91), (127, 168, 105), (142, 124, 184), (217, 179, 108),
    (79, 150, 148), (192, 108, 132), (138, 147, 158), (176, 150, 110), (106, 132, 168),
    (150, 178, 130), (196, 148, 130),
)  # fmt: skip
"""Colours of sub-assemblies. More colours tell more sub-assemblies apart, and leave more nodes
where parts are merged, because a node has one colour."""
SHADES = (1.0, 0.86)
"""Brightness of the objects of one sub-assembly, in turns by name. More shades: as `FAMILIES`."""
MARKED: Colour = (255, 170, 0)
"""Colour of what is highlighted."""


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


def colour_of(obj: Object) -> Colour:
    """Colour of an object: the same in each session, whatever other objects there are.

    The first element of its path gives the colour, or, for a name that is no path, its geometry, so
    that equal parts look equal. The rest of the name gives the shade.
    """
    assembly, _, rest = obj.name.partition("/")
    family = FAMILIES[_number(assembly if rest else obj.digest) % len(FAMILIES)]
    shade = SHADES[_number(rest or obj.digest[::-1]) % len(SHADES)]
    red, green, blue = (round(shade * channel) for channel in family)
    return red, green, blue


def _number(text: str) -> int:
    return crc32(text.encode("utf-8", "surrogatepass")) >> 7


def sent(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Colours (..., 3) as the browser's batched meshes take them: linear light, not sRGB."""
    light = colours / 255.0
    light = np.where(light <= 0.04045, light / 12.92, ((light + 0.055) / 1.055) ** 2.4)
    return np.round(255.0 * light).astype(np.uint8)

"""Colours of objects: stable, by sub-assembly, so that neighbours differ."""

from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from hapticdb.store.base import Object

Rgb = tuple[int, int, int]
"""Red, green and blue as a screen shows them (sRGB), 0 to 255."""

FAMILIES: tuple[Rgb, ...] = (
    (91, 141, 184), (208, 122, 91), (127, 168, 105), (142, 124, 184), (217, 179, 108),
    (79, 150, 148), (192, 108, 132), (138, 147, 158), (176, 150, 110), (106, 132, 168),
    (150, 178, 130), (196, 148, 130),
)  # fmt: skip
"""Colours of sub-assemblies. More colours tell more sub-assemblies apart, and leave more nodes
where parts are merged, because a node has one colour."""
SHADES = (1.0, 0.86)
"""Brightness of the objects of one sub-assembly, in turns by name. More shades: as `FAMILIES`."""
MARKED: Rgb = (255, 170, 0)
"""Colour of what is highlighted."""


def colour_of(obj: Object) -> Rgb:
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

"""Colours of tools, arrows, contacts and objects."""

import colorsys
from typing import cast
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from hapticdb.store.base import Object

Colour = tuple[int, int, int]
"""Red, green and blue, sRGB, 0 to 255."""
Rgba = tuple[int, int, int, int]
"""sRGB colour and opacity, 0 to 255."""

FORCE: Colour = (235, 104, 20)
"""Arrow and plot of the force."""
TORQUE: Colour = (126, 87, 194)
"""Arrow of the torque."""
MARK: Colour = (214, 39, 60)
"""Tool of a sweep at its first collision."""
FAMILIES: tuple[Colour, ...] = (
    (158, 181, 207), (216, 181, 160), (174, 198, 164), (188, 178, 208), (221, 206, 168),
    (160, 194, 191), (211, 175, 187), (184, 190, 198), (200, 187, 165), (168, 181, 203),
    (187, 205, 177), (210, 188, 178),
)  # fmt: skip
"""Colours of sub-assemblies."""
SHADES = (1.0, 0.86)
"""Brightness of the objects of one sub-assembly, by a hash of the name."""
MOST_COLOURS = 32
"""Colours of one shape. More: finer steps, and a node for each."""
HEIGHTS: tuple[Colour, ...] = (
    (62, 84, 122), (74, 128, 140), (122, 162, 120), (206, 184, 126), (238, 226, 204),
)  # fmt: skip
"""Colour ramp of a cloud without colours, from low to high."""
MARKED: Colour = (255, 170, 0)
"""Highlighted objects."""
FADED: Rgba = (128, 138, 150, 20)
"""All objects outside the selected pair."""
PAIR: tuple[Colour, Colour] = ((235, 104, 20), (36, 99, 160))
"""The two parts of a pair: orange and blue."""


def _hue(number: int, lightness: float, saturation: float) -> Colour:
    # steps of the golden ratio: neighbours in number differ most
    hue = number * 0.61803398875 % 1.0
    red, green, blue = colorsys.hls_to_rgb(hue, lightness, saturation)
    return round(255 * red), round(255 * green), round(255 * blue)


def of_object(object_id: int) -> Colour:
    """Colour of an object's contacts and of the square before its name."""
    return _hue(object_id, 0.48, 0.75)


def of_tool(number: int) -> Colour:
    """Colour of a person's tool."""
    return _hue(number + 4, 0.55, 0.72)


def of_contacts(points: NDArray[np.float64], touched: list[Object]) -> NDArray[np.uint8]:
    """Colours (n, 3) of contacts (n, 3), metres: of the nearest AABB; in a tie, the smallest."""
    if not touched or not len(points):
        return np.full((len(points), 3), FORCE, dtype=np.uint8)
    ordered = sorted(touched, key=lambda obj: float(np.prod(obj.bounds[1] - obj.bounds[0])))
    low, high = np.array([obj.bounds for obj in ordered]).swapaxes(0, 1)[:, :, None]
    beside = np.maximum(np.maximum(low - points, points - high), 0.0)
    away = np.linalg.norm(beside, axis=2)
    palette = np.array([of_object(obj.id) for obj in ordered], dtype=np.uint8)
    return np.asarray(palette[away.argmin(axis=0)], dtype=np.uint8)


def colour_of(obj: Object) -> Colour:
    """Colour of an object, the same in each session, independent of other objects.

    The first element of its path selects the family, so a sub-assembly has one; an object whose
    name is no path has its family from its geometry, so equal parts look equal. A hash of the rest
    of the name selects the shade.
    """
    assembly, _, rest = obj.name.partition("/")
    family = FAMILIES[_number(assembly if rest else obj.digest) % len(FAMILIES)]
    shade = SHADES[_number(rest or obj.digest[::-1]) % len(SHADES)]
    red, green, blue = (round(shade * channel) for channel in family)
    return red, green, blue


def few(colours: NDArray[np.uint8] | None) -> tuple[list[Rgba], NDArray[np.int64]]:
    """Palette of at most `MOST_COLOURS` colours, and the index in it of each colour (n, 4)."""
    if colours is None or not len(colours):
        return [], np.empty(0, dtype=np.int64)
    # integers sort ten times faster than rows
    packed = np.ascontiguousarray(colours).view(">u4").reshape(-1).astype(np.uint32)
    shades, number = np.unique(packed, return_inverse=True)
    palette = shades.astype(">u4").view(np.uint8).reshape(-1, 4)
    if len(palette) > MOST_COLOURS:
        from PIL import Image  # noqa: PLC0415 - extra `view`

        octree = Image.Quantize.FASTOCTREE
        picture = Image.fromarray(palette[None], "RGBA").quantize(MOST_COLOURS, octree)
        drawn = np.asarray(picture.convert("RGBA"))[0]
        palette, near = np.unique(drawn, axis=0, return_inverse=True)
        number = near.reshape(-1)[number]
    return [cast("Rgba", tuple(colour)) for colour in palette.tolist()], number


def by_height(heights: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Colours (n, 3) of heights (n,); the ramp spans percentiles 1 to 99."""
    low, high = np.percentile(heights, [1, 99])
    share = (heights - low) / max(float(high - low), 1e-12) * (len(HEIGHTS) - 1)
    steps, shades = np.arange(len(HEIGHTS)), np.array(HEIGHTS)
    channels = [np.interp(share, steps, shades[:, channel]) for channel in range(3)]
    return np.stack(channels, axis=1).astype(np.uint8)


def _number(text: str) -> int:
    return crc32(text.encode("utf-8", "surrogatepass")) >> 7


def sent(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Colours (..., 3) in linear light, as viser's batched meshes take them."""
    light = colours / 255.0
    light = np.where(light <= 0.04045, light / 12.92, ((light + 0.055) / 1.055) ** 2.4)
    return np.round(255.0 * light).astype(np.uint8)

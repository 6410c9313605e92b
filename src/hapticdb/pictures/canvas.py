"""Software rasterizer: orthographic view, depth buffer, one directional light."""

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hapticdb.grid import corners_of

Floats = NDArray[np.float64]

TOWARDS, SUN = (0.50, 0.76, 0.44), (0.30, 0.45, 0.84)
"""Directions to the eye and to the light, as for `turned`."""
SAMPLES = 2
"""Samples for each pixel, an axis."""

GROWTH = 1.5
"""Greatest ratio of the widths, or heights, of triangles in one batch."""
AT_ONCE = 1 << 18
"""Pixels of a batch. More: more memory, hardly less time."""


def turned(direction: tuple[float, float, float], up: int) -> Floats:
    """Unit vector (3,) ahead, left and up, axis `up` up; with y up, z is ahead, as in glTF."""
    return np.asarray(np.roll(direction, up - 2) / np.linalg.norm(direction))


class Canvas:
    """An orthographic picture of a scene.

    boxes : (B, 2, 3) in view, metres; size : width and height, pixels; window : (2, 2) corners of
    the boxes' area, pixels; paper : (3,) background colour, 0 to 1; up : axis that points up.
    """

    def __init__(
        self, boxes: Floats, size: tuple[int, int], window: Floats, paper: Floats, up: int
    ) -> None:
        ahead = -turned(TOWARDS, up)
        right = np.cross(ahead, np.eye(3)[up])
        right /= np.linalg.norm(right)
        self._axes = np.stack([right, np.cross(ahead, right), ahead])
        self._sun = self._axes @ turned(SUN, up)
        corners = corners_of(boxes).reshape(-1, 3)
        low, high = (corners @ self._axes.T).min(axis=0), (corners @ self._axes.T).max(axis=0)
        scale = float(((window[1] - window[0]) / (high - low)[:2]).min())
        self._factors = np.array([scale, scale, 1.0])
        self._shift = np.append(window.mean(axis=0), 0.0) - 0.5 * (low + high) * self._factors
        # half depth of the view; surfaces outside are clipped
        reach = 0.75 * float(np.linalg.norm(np.ptp(corners, axis=0)))
        self._size = size
        self._depths = np.full((size[1] * SAMPLES, size[0] * SAMPLES), reach, np.float32)
        self._nearest = -reach
        self._image = np.ones((*self._depths.shape, 3), np.float32) * paper.astype(np.float32)

    def project(self, points: Floats) -> Floats:
        """Pixels across and down, and metres behind the boxes' middle, of points (..., 3)."""
        return np.asarray(points @ self._axes.T * self._factors + self._shift)

    def fill(self, triangles: Floats, tints: Floats) -> None:
        """Draw triangles (T, 3, 3), metres, in a colour (3,) or one each, both sides lit alike."""
        placed = (self.project(triangles) * (SAMPLES, SAMPLES, 1.0)).astype(np.float32)
        colours = (tints * self._light(triangles)[:, None]).astype(np.float32)
        low = np.maximum(np.ceil(placed[..., :2].min(axis=1) - 0.5), 0.0).astype(np.int64)
        sides = np.floor(placed[..., :2].max(axis=1) + 0.5).clip(max=self._depths.shape[::-1]) - low
        seen = np.flatnonzero((sides[:, 0] > 0.0) & (sides[:, 1] > 0.0))
        # triangles of about the same width and height are drawn together
        codes = np.ceil(np.log(sides[seen]) / np.log(GROWTH)).astype(np.int64) @ (64, 1)
        order = np.argsort(codes)
        for some in np.split(seen[order], np.flatnonzero(np.diff(codes[order])) + 1)[: len(seen)]:
            width, height = sides[some].max(axis=0).astype(int).tolist()
            for part in np.array_split(some, max(1, -(-len(some) * width * height // AT_ONCE))):
                self._fill(placed[part], colours[part], low[part], (width, height))

    def _fill(
        self,
        placed: NDArray[np.float32],
        colours: NDArray[np.float32],
        low: NDArray[np.int64],
        window: tuple[int, int],
    ) -> None:
        """Draw triangles (T, 3, 3), pixels and metres, within windows of one size at `low`."""
        first, edges = placed[:, 0, :, None, None], placed[:, 1:] - placed[:, :1]
        (ax, ay, az), (bx, by, bz) = np.moveaxis(edges, (1, 2), (0, 1))[..., None, None]
        column = (low[:, 0, None] + np.arange(window[0]))[:, None]
        row = (low[:, 1, None] + np.arange(window[1]))[..., None]
        x = (column + 0.5 - first[:, 0]).astype(np.float32)
        y = (row + 0.5 - first[:, 1]).astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):  # a triangle seen from its edge
            area = ax * by - ay * bx
            u, v = x * (by / area) - y * (bx / area), y * (ax / area) - x * (ay / area)
            is_seen = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0)
        is_seen &= (column < self._depths.shape[1]) & (row < self._depths.shape[0])
        of, down, across = np.nonzero(is_seen)
        depth = (first[:, 2] + u * az + v * bz)[is_seen]
        depth[depth < self._nearest] = np.inf
        pixels = (low[of, 1] + down) * self._depths.shape[1] + low[of, 0] + across
        np.minimum.at(self._depths.reshape(-1), pixels, depth)
        is_nearest = self._depths.reshape(-1)[pixels] == depth
        self._image.reshape(-1, 3)[pixels[is_nearest]] = colours[of[is_nearest]]

    def _light(self, triangles: Floats) -> Floats:
        """Brightness (T,), 0.3 to 1, of the sides of triangles towards the eye."""
        sides = (triangles[:, 1:] - triangles[:, :1]) @ self._axes.T
        normals = np.cross(sides[:, 0], sides[:, 1])
        normals *= -np.sign(normals[:, 2:])
        lengths = np.maximum(np.linalg.norm(normals, axis=1), 1e-300)
        return np.asarray(0.3 + 0.7 * np.clip(normals @ self._sun / lengths, 0.0, 1.0))

    def picture(self) -> Image.Image:
        """The picture, averaged over its samples."""
        width, height = self._size
        small = self._image.reshape(height, SAMPLES, width, SAMPLES, 3).mean(axis=(1, 3))
        return Image.fromarray((255.0 * np.clip(small, 0.0, 1.0)).astype(np.uint8))

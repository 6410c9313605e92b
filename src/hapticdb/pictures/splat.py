"""Voxels to pixels: a camera, a buffer of depths, and shading from the depths alone."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from hapticdb.grid import corners_of

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

FAR = np.iinfo(np.int64).max
NUMBER_BITS = 20
"""Bits of a buffer's entry that hold the object's number; the depth stands above them."""
DEPTH_STEPS = 1 << 40
"""Steps between near and far. With the number they fit into an int64."""
SUN, SIDE = (0.30, 0.45, 0.84), (0.95, 0.1, 0.2)
"""Directions of the two lights: ahead, left, up."""
CHUNK = 1_000_000
"""Voxels drawn at a time. More take more memory."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera."""

    eye: Floats  # (3,) metres, world frame
    axes: Floats  # (3, 3), rows right, down, ahead
    focal: float  # length, pixels
    middle: Floats  # (2,) pixels
    size: tuple[int, int]  # width, height
    near: float  # metres ahead of the eye
    far: float
    up: int = 2  # axis of the world that points up

    @classmethod
    def looking_at(
        cls, boxes: Floats, towards: Floats, size: tuple[int, int], window: Floats, up: int = 2
    ) -> "Camera":
        """Camera that has boxes (B, 2, 3), metres, in view, from a direction (3,): ahead, left, up.

        They fill the window (2, 2), corners in pixels, along one of its sides.
        """
        low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
        center, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
        ahead = -turned(towards, up) / np.linalg.norm(towards)
        right = np.cross(ahead, np.eye(3)[up])
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(ahead, right), ahead])
        eye = center - 5.5 * radius * ahead
        corners = corners_of(boxes).reshape(-1, 3)
        seen = (corners - eye) @ axes.T
        flat = seen[:, :2] / seen[:, 2:]
        left, right_most = flat.min(axis=0), flat.max(axis=0)
        focal = float(((window[1] - window[0]) / (right_most - left)).min())
        middle = window.mean(axis=0) - focal * 0.5 * (left + right_most)
        return cls(eye, axes, focal, middle, size, 4.0 * radius, 7.0 * radius, up)

    def project(self, points: Floats) -> Floats:
        """Pixels across and down, and metres ahead, of points (N, 3) in metres -> (N, 3)."""
        seen = (points - self.eye) @ self.axes.T
        seen[:, :2] = seen[:, :2] / seen[:, 2:] * self.focal + self.middle
        return np.asarray(seen)


Depths = NDArray[np.int64]
"""Nearest voxel behind each pixel: depth and number, packed, (height, width)."""


def empty_depths(camera: Camera) -> Depths:
    """Buffer without voxels."""
    return np.full(camera.size[::-1], FAR, dtype=np.int64)


def splat(depths: Depths, camera: Camera, centers: Floats, size: float, number: int) -> None:
    """Put voxels into the buffer, in place, as squares that face the eye.

    centers (V, 3) of the voxels, and size, their edge, in metres; number : what they are entered
    as, below 2^20.
    """
    width, height = camera.size
    flat = depths.reshape(-1)
    for start in range(0, len(centers), CHUNK):
        seen = camera.project(centers[start : start + CHUNK])
        scaled = (seen[:, 2] - camera.near) / (camera.far - camera.near)
        entry = (np.clip(scaled, 0, 1) * DEPTH_STEPS).astype(np.int64) << NUMBER_BITS | number
        edge = 1.25 * size * camera.focal / float(seen[:, 2].mean())
        reach = max(1, int(np.ceil(edge)))
        corner = np.floor(seen[:, :2] - 0.5 * (reach - 1)).astype(np.int64)
        for dx in range(reach):
            for dy in range(reach):
                x, y = corner[:, 0] + dx, corner[:, 1] + dy
                inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
                np.minimum.at(flat, (y * width + x)[inside], entry[inside])


def shade(depths: Depths, camera: Camera, tints: Floats, paper: Floats, size: float) -> Image:
    """Light a buffer that `splat` filled -> image (height, width, 3), 0 to 1.

    tints (K, 3) : colours by the number of a voxel; paper (3,) : colour behind the scene; size :
    edge of a voxel, metres. Steps of a few voxels are smoothed; larger ones are edges and stay.
    Places behind their surroundings are darkened (unsharp masking of the depths).
    """
    image = _backdrop(camera, paper)
    rows, columns = np.nonzero(depths != FAR)
    if len(rows) == 0:
        return image
    # only the part that holds voxels, and twice the widest blur around it
    seen = tuple(
        slice(max(int(index.min()) - 80, 0), int(index.max()) + 80) for index in (rows, columns)
    )
    nearest = depths[seen]
    is_hit = nearest != FAR
    number = np.where(is_hit, nearest & ((1 << NUMBER_BITS) - 1), 0)
    depth = (nearest >> NUMBER_BITS) * ((camera.far - camera.near) / DEPTH_STEPS)
    metres = np.where(is_hit, depth, camera.far - camera.near).astype(np.float32)
    pixel = (camera.near + camera.far) / 2 / camera.focal
    smooth = _smoothed(metres, is_hit, reach=max(3, round(3.0 * size / pixel)), edge=2.5 * size)
    down, across = np.gradient(smooth)
    normals = np.stack([across, down, np.full_like(smooth, -pixel)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    world = normals @ camera.axes.astype(np.float32)
    sun, side = (turned(np.array(light), camera.up) for light in (SUN, SIDE))
    light = 0.26 + 0.70 * _lit(world, sun) + 0.22 * _lit(world, side)
    radius = (camera.far - camera.near) / 3.0
    light *= _unoccluded(metres, 40, 0.1 * radius) * _unoccluded(metres, 8, 0.024 * radius)
    rim = 0.10 * (1.0 + normals[..., 2]) ** 3
    lit = tints.astype(np.float32)[number] * light[..., None] + rim[..., None]
    image[seen] = np.where(is_hit[..., None], lit, image[seen])
    return image


def turned(direction: Floats, up: int) -> Floats:
    """Direction (3,), ahead, left and up, in a world whose axis `up` points up.

    None is mirrored: with y up, z is ahead and x is left, as in glTF.
    """
    return np.roll(direction, up - 2)


def faded(image: Image, camera: Camera, paper: Floats, margin: int) -> Image:
    """Image (height, width, 3) that fades into the backdrop within `margin` pixels of its edges."""
    height, width = image.shape[:2]
    across = np.minimum(np.arange(width), np.arange(width)[::-1])
    down = np.minimum(np.arange(height), np.arange(height)[::-1])
    near = np.clip(np.minimum(down[:, None], across[None]) / margin, 0.0, 1.0)
    weight = (near * near * (3.0 - 2.0 * near)).astype(np.float32)[..., None]
    backdrop = _backdrop(camera, paper)
    return np.asarray(backdrop + weight * (image - backdrop))


def _lit(normals: Image, towards: Floats) -> Image:
    direction = (towards / np.linalg.norm(towards)).astype(np.float32)
    return np.asarray(np.clip(normals @ direction, 0, 1))


def _unoccluded(metres: Image, blur: float, depth: float) -> Image:
    """Factor below 1 behind the surroundings; blur in pixels, depth in metres."""
    behind = metres - gaussian_filter(metres, blur, truncate=2.5)
    return np.asarray(1.0 - 0.55 * np.clip(behind / depth, 0, 1))


def _backdrop(camera: Camera, paper: Floats) -> Image:
    width, height = camera.size
    x = (np.arange(width) / width - 0.5)[None, :, None] / 0.62
    y = (np.arange(height) / height - 0.52)[:, None, None] / 0.60
    glow = 0.055 * np.exp(-2.2 * x**2) * np.exp(-2.2 * y**2)
    return (paper + glow).astype(np.float32)


def _smoothed(metres: Image, is_hit: NDArray[np.bool_], reach: int, edge: float) -> Image:
    """Mean of the depths around each pixel, of those within `edge` metres of its own."""
    result = metres
    shifts = [shift for shift in range(-reach, reach + 1, max(1, reach // 5)) if shift]
    for axis in (0, 1):
        total, weight = result.copy(), np.ones_like(result)
        for shift in shifts:
            moved = np.roll(result, shift, axis=axis)
            # less weight beyond a step in depth, and farther along the window
            step = (moved - result) * np.float32(1 / edge)
            step *= step  # squared twice: numpy's power of four takes longer than all the rest
            near = np.float32(1.0 - 0.7 * (shift / reach) ** 2) / (1 + step * step)
            total += near * moved
            weight += near
        result = np.where(is_hit, total / weight, metres)
    return np.asarray(result)

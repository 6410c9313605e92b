"""Paths that slide a tool over the upper side of a scene.

The scene is seen from above: a map of the heights of its voxels. The tool follows a swaying line
over it, turns slowly, is tilted to lie along the surface, and at every pose is let down until its
first point touches, then pressed in.
"""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

import hapticdb
from hapticdb import Environment, PointShell
from hapticdb.poses import write_poses
from hapticdb.sample import write_sample

Floats = NDArray[np.float64]
HEADER = 84
"""Bytes of a binary STL before its triangles."""
TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
"""Triangle of a binary STL."""
MAP_CELLS = 4096
"""Cells an axis of the map of heights from which a path is made. More follow finer shapes and take
more memory."""
SAMPLE_LENGTH = 4.28
"""Length of the sample car, metres."""
ALONG_VOXELS = 10_000_000
"""Voxels that are read at most to make a path: a gigabyte. The largest objects come first."""
STEEPEST = 1.2
"""Slope of the tool's own way, rise over run: where the scene falls off faster, it glides down."""
DENSER = 4
"""Poses tried for each one kept: so many that equal steps of the tool can be picked among them."""


class _HeightMap(NamedTuple):
    """Tops of the columns of a scene.

    corner (2,) and step in metres; top (nx, ny) metres, -inf where there is nothing.
    """

    corner: Floats
    step: float
    top: Floats

    def at(self, x: Floats, y: Floats) -> Floats:
        """Heights in metres at places of any shape, -inf beyond the map."""
        i = np.floor((x - self.corner[0]) / self.step).astype(np.int64)
        j = np.floor((y - self.corner[1]) / self.step).astype(np.int64)
        nx, ny = self.top.shape
        inside = (i >= 0) & (i < nx) & (j >= 0) & (j < ny)
        heights = self.top[np.clip(i, 0, nx - 1), np.clip(j, 0, ny - 1)]
        return np.asarray(np.where(inside, heights, -np.inf))


def _heights_of(centers: Floats, voxel_size: float) -> _HeightMap:
    """Map of the tops of voxels; centers (V, 3) and voxel_size in metres."""
    corner = centers[:, :2].min(axis=0) - 0.5 * voxel_size
    cell = np.floor((centers[:, :2] - corner) / voxel_size).astype(np.int64)
    top = np.full(tuple(cell.max(axis=0) + 1), -np.inf)
    np.maximum.at(top, (cell[:, 0], cell[:, 1]), centers[:, 2] + 0.5 * voxel_size)
    return _HeightMap(corner, voxel_size, top)


def _walk(map_: _HeightMap, reach: float, count: int, longest: float) -> Floats:
    """Places (count, 2) along a swaying line over the longer side of the map.

    It keeps half the tool's reach off the ends, and is cut about its middle to `longest` metres.
    """
    phase = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi)
    size: Floats = np.array(map_.top.shape) * map_.step
    major = int(np.argmax(size))
    span = min(max(float(size[major]) - reach, 0.5 * float(size[major])), longest)
    u = np.linspace(-0.5, 0.5, count)
    places = np.empty((count, 2))
    places[:, major] = -span * u
    sway = 0.22 * min(float(size[1 - major]), span)
    places[:, 1 - major] = sway * np.sin(2.0 * np.pi * 1.25 * u + phase)
    return np.asarray(places + map_.corner + 0.5 * size)


def _slopes(map_: _HeightMap, places: Floats, reach: float) -> Floats:
    """Slopes (M, 2) of the plane through the heights around each place."""
    offset = np.linspace(-0.4, 0.4, 9) * reach
    dx, dy = (axis.ravel() for axis in np.meshgrid(offset, offset))
    z = map_.at(places[:, :1] + dx, places[:, 1:] + dy)
    known = np.isfinite(z)
    weight = known / np.maximum(known.sum(axis=1, keepdims=True), 1)
    z = np.where(known, z, 0.0)
    z -= (weight * z).sum(axis=1, keepdims=True)
    slopes = np.zeros((len(places), 2))
    for axis, d in enumerate((dx, dy)):
        centred = d - (weight * d).sum(axis=1, keepdims=True)
        spread = (weight * centred**2).sum(axis=1)
        slopes[:, axis] = (weight * centred * z).sum(axis=1) / np.maximum(spread, 1e-3 * reach**2)
    return np.clip(slopes, -STEEPEST, STEEPEST)


def _rotations(slopes: Floats, yaw: Floats) -> Floats:
    """Rotations (M, 3, 3) that lay the tool's z axis along the surface's normal, turned by yaw."""
    normal = np.column_stack([-slopes, np.ones(len(slopes))])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    ahead = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))])
    ahead -= (ahead * normal).sum(axis=1, keepdims=True) * normal
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    return np.stack([ahead, np.cross(normal, ahead), normal], axis=2)


def _let_down(map_: _HeightMap, places: Floats, rotations: Floats, tool_points: Floats) -> Floats:
    """Heights (M,) of the tool's origin at which its first point touches; -inf over nothing."""
    heights = np.empty(len(places))
    for chunk in np.array_split(np.arange(len(places)), max(1, len(places) // 500)):
        points = tool_points @ rotations[chunk].transpose(0, 2, 1)
        below = map_.at(points[..., 0] + places[chunk, :1], points[..., 1] + places[chunk, 1:])
        heights[chunk] = (below - points[..., 2]).max(axis=1)
    return heights


def _gliding(heights: Floats, rise: float) -> Floats:
    """The least way on or over the heights that rises and falls by at most `rise` a step."""
    ramp = rise * np.arange(len(heights))
    forward = np.maximum.accumulate(heights + ramp) - ramp
    backward = np.maximum.accumulate((heights - ramp)[::-1])[::-1] + ramp
    return np.asarray(np.maximum(forward, backward))


def _evenly(poses: Floats, reach: float, count: int) -> NDArray[np.int64]:
    """Numbers of `count` poses between which the tool's farthest point moves about equally."""
    shifts = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turns = np.linalg.norm(np.diff(poses[:, :3, :3], axis=0), axis=(1, 2)) * 0.5 * reach
    way = np.concatenate([[0.0], np.cumsum(shifts + turns)])
    return np.searchsorted(way, np.linspace(0.0, way[-1], count)).clip(0, len(poses) - 1)


def _slide(centers: Floats, voxel_size: float, tool: Floats, count: int) -> Floats:
    """Poses (count, 4, 4) that slide a tool over voxels, pressed in by 0.5 to 1.5 voxels.

    A step is a voxel or two: in a scene too long for that, the path keeps to its middle.
    """
    map_ = _heights_of(centers, voxel_size)
    reach = float(np.ptp(tool[:, :2], axis=0).max())
    places = _walk(map_, reach, DENSER * count, count * voxel_size)
    run = float(np.linalg.norm(places[1] - places[0]))
    blur = max(0.35 * reach / max(run, 1e-12), 1.0)
    blur = min(blur, 0.05 * len(places))
    slopes = gaussian_filter1d(_slopes(map_, places, reach), blur, axis=0, mode="nearest")
    u = np.linspace(0.0, 1.0, len(places))
    swings = min(1.5, 0.08 * run * len(places) / max(reach, 1e-12))
    rotations = _rotations(slopes, 0.5 * np.pi + 0.9 * np.sin(2.0 * np.pi * swings * u))
    heights = _let_down(map_, places, rotations, tool)
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, :3] = rotations
    poses[:, :3, 3] = np.column_stack([places, _gliding(heights, STEEPEST * run)])
    chosen = poses[_evenly(poses, reach, count)]
    press = 1.0 - 0.5 * np.cos(np.linspace(0.0, 10.0 * np.pi, count))
    chosen[:, 2, 3] -= voxel_size * press
    return np.asarray(chosen)


def write_along(
    folder: str | os.PathLike[str], url: str | os.PathLike[str], frames: int
) -> tuple[Path, Path]:
    """Write spanner.stl, scaled to an environment, and path.csv that slides it over that."""
    home = Path(folder)
    tool = write_sample(home).spanner
    with hapticdb.open(url, read_only=True) as env:
        # the same share of the scene's length as of the sample car's
        bounds = np.array([obj.bounds for obj in env.objects()] or [np.zeros((2, 3))])
        longest = float((bounds[:, 1].max(axis=0) - bounds[:, 0].min(axis=0)).max())
        content = bytearray(tool.read_bytes())
        triangles = np.frombuffer(content, TRIANGLE, offset=HEADER)
        triangles["corners"][:] *= longest / SAMPLE_LENGTH or 1.0
        tool.write_bytes(content)
        # the shell's points, not the mesh: where only the mesh touches, no point would hit
        poses = slide_along(env, PointShell.from_file(tool).points, frames)
    write_poses(home / "path.csv", poses)
    return tool, home / "path.csv"


def slide_along(env: Environment, tool_points: Floats, frames: int) -> Floats:
    """Poses (frames, 4, 4) that slide a tool over the largest objects of an environment.

    The path follows a map of the voxels' heights, whose size does not depend on the grid.
    tool_points (N, 3) of the tool's surface, metres, tool frame, its underside towards -z.
    """
    chosen, total = [], 0
    for obj in sorted(env.objects(), key=lambda obj: (-obj.voxels, obj.id)):
        if total + obj.voxels <= ALONG_VOXELS:
            chosen.append(obj)
            total += obj.voxels
    bounds = np.array([obj.bounds for obj in chosen])
    span = float((bounds[:, 1].max(axis=0) - bounds[:, 0].min(axis=0)).max())
    size = env.grid.voxel_size
    step = size * max(1, 2 ** int(np.ceil(np.log2(max(span / (size * MAP_CELLS), 1.0)))))
    tops = [_tops(env.grid.centers(env.voxels(obj.id)), step) for obj in chosen]
    centers = np.concatenate(tops)
    centers[:, 2] -= 0.5 * (step - size)  # the map adds half a cell: the tops stay where they are
    return _slide(centers, step, tool_points, frames)


def _tops(centers: Floats, step: float) -> Floats:
    """Highest of the centres (V, 3) in each column of a map of that step, metres."""
    columns = np.floor(centers[:, :2] / step).astype(np.int64)
    order = np.lexsort((centers[:, 2], columns[:, 1], columns[:, 0]))
    ranked = columns[order]
    is_last = np.append((ranked[1:] != ranked[:-1]).any(axis=1), True)
    return np.asarray(centers[order[is_last]])

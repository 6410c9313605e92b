"""The sample's tool: a combination spanner, open at one end and ringed at the other."""

import numpy as np
from numpy.typing import NDArray

from hapticdb.sample.shapes import Floats, Mesh, thickened

RING_AT = 0.105
RING_RADIUS = 0.019
JAW_AT = -0.099
JAW_RADIUS = 0.027
ACROSS = 9
HEAD_THICKNESS = 0.010
HANDLE_THICKNESS = 0.006


def _polar(radius: float | Floats, degrees: Floats, at: float) -> Floats:
    """Points (K, 2) at a radius and angles about a centre on the x axis."""
    angle = np.radians(degrees)
    return np.column_stack([at + radius * np.cos(angle), radius * np.sin(angle)])


def _band(outer: Floats, inner: Floats, rows: int) -> Floats:
    """Grid (rows, K, 2) between two curves."""
    t = np.linspace(0.0, 1.0, rows)[:, None, None]
    return outer * (1.0 - t) + inner * t


def _jaw() -> tuple[Floats, int]:
    """Open end as a grid (rows, K, 2), and where on its outer curve the handle starts.

    It opens away from the handle, turned by 15 degrees as on every spanner, with parallel flats.
    """
    local = np.linspace(145.0, -145.0, 37)
    outer = _polar(JAW_RADIUS, local, 0.0)
    reach = np.minimum(0.0120, 0.0095 / np.maximum(np.abs(np.sin(np.radians(local))), 1e-9))
    inner = _polar(reach, local, 0.0)
    flat = np.column_stack([np.linspace(-0.021, -0.0085, 6), np.full(6, 0.0095)])
    inner[:6], inner[-6:] = flat, flat[::-1] * [1.0, -1.0]
    grid = _band(outer, inner, 4)
    cos, sin = np.cos(np.radians(15.0)), np.sin(np.radians(15.0))
    start = int(np.argmin(np.abs(local + 15.0))) - ACROSS // 2
    return grid @ np.array([[cos, sin], [-sin, cos]]) + [JAW_AT, 0.0], start


def _ring() -> Floats:
    """Ring end as a grid (rows, K, 2), closed on itself, its hole with twelve points."""
    degrees = np.linspace(0.0, 352.5, 48)
    hole = np.asarray(0.0108 + 0.0012 * np.abs(((degrees / 15.0) % 2.0) - 1.0), np.float64)
    grid = _band(_polar(RING_RADIUS, degrees, RING_AT), _polar(hole, degrees, RING_AT), 4)
    return np.concatenate([grid, grid[:, :1]], axis=1)


def _cells(grid: Floats) -> Floats:
    """Corners (Q, 4, 2) of a grid's cells, counter-clockwise."""
    corners = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=2)
    corners = corners.reshape(-1, 4, 2)
    first, second = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    clockwise = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0] < 0.0
    corners[clockwise] = corners[clockwise, ::-1]
    return corners


def _numbered(corners: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Points (V, 2) that cells (Q, 4, 2) share, to a tenth of a micrometre, and their numbers."""
    rounded = np.round(corners.reshape(-1, 2), 7) + 0.0
    points, numbers = np.unique(rounded, axis=0, return_inverse=True)
    return points, numbers.reshape(-1, 4).astype(np.int64)


def build_wrench() -> Mesh:
    """Spanner, one closed shell.

    Tool frame, metres: the handle along x with the ring at +x, the flat sides towards -z and +z,
    the origin halfway along and halfway through.
    """
    jaw, start = _jaw()
    ring = _ring()
    towards_jaw = ring[0, 24 - ACROSS // 2 : 25 + ACROSS // 2]
    from_jaw = jaw[0, start : start + ACROSS]
    # slender in the middle: the straight strip between the heads, drawn in across
    handle = _band(from_jaw, towards_jaw, 25)
    handle[1:-1, :, 1] *= 0.62 + 0.38 * np.abs(np.linspace(-1.0, 1.0, 25)[1:-1, None]) ** 4
    points, quads = _numbered(np.concatenate([_cells(jaw), _cells(handle), _cells(ring)]))
    blend = np.clip((np.abs(points[:, 0]) - 0.055) / 0.020, 0.0, 1.0)
    half = 0.5 * (HANDLE_THICKNESS + (HEAD_THICKNESS - HANDLE_THICKNESS) * blend)
    return thickened(np.column_stack([points, half]), np.column_stack([points, -half]), quads)

"""Primitives of machine files as triangles around them, metres.

Clear triangles prove a clear primitive, and no hit depends on a chord error. They are farther out
by `CHORD` at most, or by 0.06 % of a radius over 0.03 m.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.grid import corners_of

Floats = NDArray[np.float64]

CHORD, MOST_SIDES = 2e-5, 128
"""Greatest distance of the triangles, metres, and most sides of a circle."""
_FACES = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
                   [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])  # fmt: skip


def box(size: ArrayLike) -> Floats:
    """Box of edges (3,) about the origin."""
    half = 0.5 * np.asarray(size, dtype=np.float64)
    return np.asarray(corners_of(np.stack([-half, half]))[_FACES])


def cylinder(radius: float, length: float) -> Floats:
    """Cylinder about the axis z and the origin."""
    sides = _sides(radius, 1.0)
    outer, half = radius / np.cos(np.pi / sides), 0.5 * length
    profile = np.array([[0.0, -half], [outer, -half], [outer, half], [0.0, half]])
    return _revolved(profile, sides)


def capsule(radius: float, length: float) -> Floats:
    """Cylinder of that length with half a ball on either end; a ball without length."""
    sides = _sides(radius, np.sqrt(2.0))
    outer = radius / np.cos(np.sqrt(2.0) * np.pi / sides)
    angles = np.linspace(-0.5 * np.pi, 0.0, sides // 4 + 1)
    below = outer * np.stack([np.cos(angles), np.sin(angles)], axis=1) - (0.0, 0.5 * length)
    below[0, 0] = 0.0
    above = below[::-1] * (1.0, -1.0)
    profile = np.concatenate([below, above if length else above[1:]])
    return _revolved(profile, sides)


def _sides(radius: float, stretch: float) -> int:
    """Sides of a circle, a multiple of 4; stretch : of a facet's radius."""
    angle = np.arccos(max(1.0 - CHORD / radius, 0.5))
    return int(min(4 * np.ceil(0.25 * stretch * np.pi / angle), MOST_SIDES))


def _revolved(profile: Floats, sides: int) -> Floats:
    """Triangles of a profile (P, 2), distance from the axis and height, turned about the axis z."""
    angles = 2.0 * np.pi * np.arange(sides) / sides
    around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    rings = np.concatenate(
        [
            profile[:, None, :1] * around,
            np.broadcast_to(profile[:, None, 1:], (len(profile), sides, 1)),
        ],
        axis=2,
    )
    a, b = rings[:-1], rings[1:]
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    both = np.concatenate([np.stack([a, d, c], axis=2), np.stack([a, c, b], axis=2)])
    found = both.reshape(-1, 3, 3)
    is_flat = (
        (found[:, 0] == found[:, 1]).all(axis=1)
        | (found[:, 1] == found[:, 2]).all(axis=1)
        | (found[:, 2] == found[:, 0]).all(axis=1)
    )
    return np.asarray(found[~is_flat])

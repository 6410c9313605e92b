"""Tools of the measures: flat ones that lie exactly along a surface, balls, pegs, single points."""

import numpy as np
from numpy.typing import NDArray

from hapticdb.pointshell.shell import PointShell

Floats = NDArray[np.float64]

PITCH = 0.7
"""Distance of neighbouring points of a flat tool, voxels. A whole number would put all points into
the same place within their voxels."""

ROUND_SIDES = 180
"""Faces around a round peg; they lie within 1e-3 voxels of one of 12 voxels. More: rounder."""


def flat_tool(n_across: int, voxel_size: float, axes: Floats, pitch: float = PITCH) -> PointShell:
    """A square of n_across^2 points in the plane of a scene's x and y; its inside is at +z."""
    across = (np.arange(n_across) - (n_across - 1) / 2.0) * pitch * voxel_size
    x, y = np.meshgrid(across, across, indexing="ij")
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(n_across**2)]) @ axes.T
    normals = np.tile(axes[:, 2], (len(points), 1))
    return PointShell(points, normals, np.zeros(3), is_closed=False)


def ball(radius_voxels: float, voxel_size: float, points: int = 300) -> PointShell:
    """A sphere about the origin."""
    return PointShell.sphere(radius_voxels * voxel_size, points)


def round_peg(
    width: float, length: float, voxel_size: float, axes: Floats, points: int, inset: float
) -> PointShell:
    """A round bar about the origin, along a scene's z, drawn inward by an inset; all in voxels."""
    angles = 2.0 * np.pi * np.arange(ROUND_SIDES) / ROUND_SIDES
    ring = 0.5 * width * np.column_stack([np.cos(angles), np.sin(angles)])
    ends = [np.column_stack([ring, np.full(ROUND_SIDES, z)]) for z in (-0.5 * length, 0.5 * length)]
    corners = np.concatenate([*ends, [[0.0, 0.0, -0.5 * length], [0.0, 0.0, 0.5 * length]]])
    low = np.arange(ROUND_SIDES)
    after, high = (low + 1) % ROUND_SIDES, low + ROUND_SIDES
    faces = np.concatenate(
        [
            np.column_stack([low, after, high]),
            np.column_stack([after, after + ROUND_SIDES, high]),
            np.column_stack([after, low, np.full(ROUND_SIDES, 2 * ROUND_SIDES)]),
            np.column_stack([high, after + ROUND_SIDES, np.full(ROUND_SIDES, 2 * ROUND_SIDES + 1)]),
        ]
    )
    return PointShell.from_mesh(
        voxel_size * corners @ axes.T, faces, points, inset=inset * voxel_size
    )


def peg(
    width: float, length: float, voxel_size: float, axes: Floats, points: int, inset: float
) -> PointShell:
    """A square bar about the origin, along a scene's z, drawn inward by an inset; all in voxels."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    faces = [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]  # fmt: skip
    halves = 0.5 * voxel_size * np.array([width, width, length])
    return PointShell.from_mesh(
        (corners * halves) @ axes.T, faces, points, inset=inset * voxel_size
    )

"""Exact distances between boxes that are placed anywhere: an oracle for sweeps."""

from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray

Floats = NDArray[np.float64]

CORNERS = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], dtype=float)
EDGES = np.array([[a, b] for a in range(8) for b in range(a) if (a ^ b).bit_count() == 1])


class Boxes(NamedTuple):
    """n boxes: poses (n, 4, 4) of their middles, half edges (n, 3), metres."""

    poses: Floats
    halves: Floats

    def corners(self) -> Floats:
        """Corners (n, 8, 3), world frame."""
        local = CORNERS * self.halves[:, None]
        return np.asarray(local @ self.poses[:, :3, :3].swapaxes(1, 2) + self.poses[:, None, :3, 3])

    def local(self, places: Floats) -> Floats:
        """Places (n, q, 3) in the frame of each box."""
        return np.asarray((places - self.poses[:, None, :3, 3]) @ self.poses[:, :3, :3])


def mesh(halves: Floats) -> trimesh.Trimesh:
    return trimesh.creation.box(2.0 * halves)


def distances(one: Boxes, other: Boxes) -> tuple[Floats, NDArray[np.bool_]]:
    """Distance (n,) of the surfaces of pairs of boxes, and whether `one` holds all of `other`."""
    mine, others = one.corners(), other.corners()
    here, there = one.local(others), other.local(mine)
    to_one = np.abs(here) - one.halves[:, None]
    to_other = np.abs(there) - other.halves[:, None]
    found = np.minimum(
        np.linalg.norm(np.maximum(to_one, 0.0), axis=2).min(axis=1),
        np.linalg.norm(np.maximum(to_other, 0.0), axis=2).min(axis=1),
    )
    found = np.minimum(found, _edges_apart(mine, others))
    holds, is_held = (to_one < 0.0).all(axis=(1, 2)), (to_other < 0.0).all(axis=(1, 2))
    found[_overlap(one, other)] = 0.0
    found[holds] = -to_one.max(axis=(1, 2))[holds]
    found[is_held] = -to_other.max(axis=(1, 2))[is_held]
    return np.asarray(found), np.asarray(holds)


def _overlap(one: Boxes, other: Boxes) -> NDArray[np.bool_]:
    """Whether pairs of boxes overlap, by the 15 axes that can separate them."""
    a, b = one.poses[:, :3, :3].swapaxes(1, 2), other.poses[:, :3, :3].swapaxes(1, 2)
    crossed = np.cross(a[:, :, None], b[:, None, :]).reshape(len(a), 9, 3)
    axes = np.concatenate([a, b, crossed], axis=1)
    between = other.poses[:, :3, 3] - one.poses[:, :3, 3]
    apart = np.abs((axes @ between[:, :, None])[..., 0])
    room = np.abs(axes @ a.swapaxes(1, 2)) @ one.halves[:, :, None]
    room += np.abs(axes @ b.swapaxes(1, 2)) @ other.halves[:, :, None]
    return np.asarray((apart <= room[..., 0]).all(axis=1))


def _edges_apart(mine: Floats, others: Floats) -> Floats:
    """Least distance (n,) between the edges of boxes, by their corners (n, 8, 3)."""
    p, q = mine[:, EDGES[:, 0]][:, :, None], others[:, EDGES[:, 0]][:, None, :]
    u = mine[:, EDGES[:, 1]][:, :, None] - p
    v = others[:, EDGES[:, 1]][:, None, :] - q
    w = p - q
    a, b, c = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    d, e = (u * w).sum(-1), (v * w).sum(-1)
    det = a * c - b * b
    flat = det <= 1e-12 * a * c
    s = np.where(flat, 0.0, (b * e - c * d) / np.where(flat, 1.0, det)).clip(0.0, 1.0)
    least = np.full(s.shape, np.inf)
    # the ends of each edge against the other edge, and the inner solution
    for s_fixed in (s, np.zeros_like(s), np.ones_like(s)):
        t = ((b * s_fixed + e) / c).clip(0.0, 1.0)
        again = ((b * t - d) / a).clip(0.0, 1.0)
        for at in (s_fixed, again):
            apart = np.linalg.norm(w + at[..., None] * u - t[..., None] * v, axis=-1)
            least = np.minimum(least, apart)
    return np.asarray(least.min(axis=(1, 2)))


def apart(tool: Floats, poses: Floats, objects: Boxes) -> tuple[Floats, NDArray[np.bool_]]:
    """Distances (B, O) of a box with half edges (3,) at poses (B, 4, 4) from O boxes.

    The second (B, O) says whether the tool holds all of the object.
    """
    n, m = len(poses), len(objects.poses)
    one = Boxes(np.repeat(poses, m, axis=0), np.tile(tool, (n * m, 1)))
    other = Boxes(np.tile(objects.poses, (n, 1, 1)), np.tile(objects.halves, (n, 1)))
    found, holds = distances(one, other)
    return found.reshape(n, m), holds.reshape(n, m)

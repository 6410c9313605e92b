"""Picking: first object along a ray."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.page.scene.nodes import Member


@dataclass(frozen=True)
class RayHit:
    """Hit of a ray: point (3,), world frame, and distance from the ray's origin; metres."""

    id: int
    point: NDArray[np.float64]
    distance: float


class Targets:
    """Ray targets: members by id, each by its shape, or by its AABB without one."""

    def __init__(self, members: Mapping[int, Member]) -> None:
        self._members = members
        self._boxes: NDArray[np.float64] | None = None  # of all members; None after a change

    def changed(self) -> None:
        """Invalidate the AABBs after a change of members."""
        self._boxes = None

    def first(
        self, origin: ArrayLike, direction: ArrayLike, sees: Callable[[int], bool]
    ) -> RayHit | None:
        """Nearest object along a ray among those of `sees`; None without a hit.

        Broad phase: AABBs in the order of the ray's entry, up to the nearest hit of the narrow
        phase.
        """
        start = np.asarray(origin, dtype=np.float64)
        ray = np.asarray(direction, dtype=np.float64)
        ray = ray / np.linalg.norm(ray)
        ids = list(self._members)
        if self._boxes is None:
            self._boxes = np.array([one.box for one in self._members.values()]).reshape(-1, 2, 3)
        enters, leaves = _slabs(self._boxes, start, ray)
        candidates = np.flatnonzero((enters <= leaves) & (leaves >= 0))
        nearest, hit = np.inf, None
        for row in candidates[np.argsort(enters[candidates])].tolist():
            if enters[row] > nearest:
                break
            if not sees(ids[row]):
                continue
            found = _hit_distance(self._members[ids[row]], start, ray, float(enters[row]))
            if found is not None and found < nearest:
                nearest, hit = found, ids[row]
        return None if hit is None else RayHit(hit, start + nearest * ray, nearest)


def _slabs(
    boxes: NDArray[np.float64], start: NDArray[np.float64], ray: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Slab test: entry and exit distances (n,) of AABBs (n, 2, 3), enlarged by rounding errors."""
    room = 1e-9 * (np.abs(boxes).max(axis=(1, 2)) + np.abs(start).max())
    with np.errstate(divide="ignore", invalid="ignore"):
        one = (boxes[:, 0] - room[:, None] - start) / ray
        other = (boxes[:, 1] + room[:, None] - start) / ray
    # fmin and fmax skip NaN: 0 / 0 for a ray in the plane of a side
    enters = np.fmax.reduce(np.fmin(one, other), axis=1)
    leaves = np.fmin.reduce(np.fmax(one, other), axis=1)
    return np.maximum(enters, 0.0), leaves


def _hit_distance(
    target: Member, start: NDArray[np.float64], ray: NDArray[np.float64], enters: float
) -> float | None:
    """Distance to an object, metres; None without a hit."""
    if target.shape is None:
        return enters
    turn = target.pose[:3, :3]
    return target.shape.first_hit(turn.T @ (start - target.pose[:3, 3]), turn.T @ ray)

"""Small motions that free surfaces which meet: they overlap by no more than such a motion."""

from collections.abc import Iterator
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.surfaces.sides import TriangleTree
from hapticdb.kernels.triangles.sweeping import MEETING
from hapticdb.sweeps.gap import Pair

Floats = NDArray[np.float64]

WAYS = np.array([way for way in product((0.0, 1.0, -1.0), repeat=3) if any(way)])
WAYS /= np.linalg.norm(WAYS, axis=1)[:, None]
"""Directions (26, 3) of the shifts that may free surfaces."""
LEAST_STRETCH = 0.01
"""Least share to which a stretch shrinks a thin part."""
THIN = 1e-9
"""Metres: least half of a box's edge that is stretched."""
MOST_TRIED = 3
"""Motions that free surfaces which are swept on. More: contacts are eased for longer."""


class Eased(NamedTuple):
    """The surfaces after a motion: a shift (3,) of the tool, world frame, and both trees."""

    shift: Floats
    object: TriangleTree
    tool: TriangleTree


class Easing:
    """Motions that move no place of tool or object by more than `reach` metres.

    They are shifts, and stretches along the axes of a box, which free a peg from its hole.
    """

    def __init__(self, pair: Pair, reach: float) -> None:
        self.reach, self._pair = reach, pair
        self._known: Eased | None = None

    def until(self, begin: float) -> float:
        """Way from `begin` on up to which one of the motions keeps the surfaces apart, at most."""
        best, length = begin, self._pair.length
        for _, eased in zip(range(MOST_TRIED), self._freeing(begin), strict=False):
            met = self._pair.first_met(begin, *eased)
            if met > best:
                best, self._known = met, eased
            if best >= length:
                break
        return best

    def _freeing(self, way: float) -> Iterator[Eased]:
        """Motions that free the surfaces at a way, the last one that did first."""
        pose = self._pair.way.at([way])[0]
        if self._known is not None and self._are_free(pose, *self._known)[0]:
            yield self._known
        theirs, own = self._pair.tree, self._pair.tool.tree
        shifts = self.reach * np.concatenate([self._normals(pose), WAYS])
        for shift in shifts[self._are_free(pose, shifts, theirs, own)]:
            yield Eased(shift, theirs, own)
        for eased in self._stretched:
            if self._are_free(pose, *eased)[0]:
                yield eased

    @cached_property
    def _stretched(self) -> list[Eased]:
        still, theirs, own = np.zeros(3), self._pair.tree, self._pair.tool.tree
        return [
            *(Eased(still, theirs, tree) for tree in self._of_tool()),
            *(Eased(still, tree, own) for tree in _stretched_trees(theirs, self.reach)),
        ]

    def _of_tool(self) -> list[TriangleTree]:
        """The tool's trees, kept for its next contact."""
        kept = self._pair.tool.stretched
        if self.reach not in kept:
            kept[self.reach] = list(_stretched_trees(self._pair.tool.tree, self.reach))
        return kept[self.reach]

    def _are_free(
        self, pose: Floats, shifts: Floats, theirs: TriangleTree, own: TriangleTree
    ) -> NDArray[np.bool_]:
        """Whether surfaces are apart with the tool at a pose after each of shifts (n, 3)."""
        poses = np.tile(pose, (len(np.atleast_2d(shifts)), 1, 1))
        poses[:, :3, 3] += shifts
        return self._pair.are_apart(poses, theirs, own, 2.0 * MEETING)

    def _normals(self, pose: Floats) -> Floats:
        """Unit normals (4, 3) of the triangles that are nearest, both ways, world frame."""
        first, second = self._pair.nearest_at(pose).pairs[0]
        theirs = self._pair.tool.tree.corners[second] @ pose[:3, :3].T
        found = np.array([normal(self._pair.tree.corners[first]), normal(theirs)])
        return np.concatenate([found, -found])


def normal(triangle: Floats) -> Floats:
    """Unit normal (3,) of a triangle (3, 3); zero where it has no area."""
    found = np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])
    length = float(np.linalg.norm(found))
    return found / length if length > 0.0 else np.zeros(3)


def _stretched_trees(tree: TriangleTree, reach: float) -> Iterator[TriangleTree]:
    """A tree stretched along the axes of its frame so that its farthest place moves by `reach`."""
    low, high = tree.boxes[0]
    corners = tree.corners.reshape(-1, 3)
    for made in stretches(low, high, reach):
        scale, shift = np.diag(made)[:3] - 1.0, made[:3, 3]
        more = reach / max(float(np.linalg.norm(corners * scale + shift, axis=1).max()), THIN)
        scale, shift = 1.0 + more * scale, more * shift
        if (scale >= LEAST_STRETCH).all():
            yield tree._replace(
                corners=tree.corners * scale + shift, boxes=tree.boxes * scale + shift
            )


def stretches(low: Floats, high: Floats, reach: float) -> Floats:
    """Maps (N, 4, 4) about the middle of a box that move no place in it by more than `reach`.

    They shrink or widen it across an axis of its frame, with a shift along the axis or without, or
    along all axes.
    """
    middle, half = 0.5 * (low + high), np.maximum(0.5 * (high - low), THIN)
    step = reach / np.sqrt(3.0)
    maps = []
    for sign, axis, shift in product((1.0, -1.0), (0, 1, 2, 3), (0.0, 1.0, -1.0)):
        if axis == 3 and shift:
            continue
        scale = np.maximum(1.0 + sign * step / half, LEAST_STRETCH)
        made = np.eye(4)
        if axis < 3:
            scale[axis] = 1.0
            made[axis, 3] = shift * step
        made[:3, 3] += middle - scale * middle
        made[:3, :3] = np.diag(scale)
        maps.append(made)
    return np.array(maps)

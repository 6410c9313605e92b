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
    """A motion: a shift (3,) of the tool, world frame; and a map (4, 4) of one surface, own frame.

    is_object : whether it is the object's surface, not the tool's.
    """

    shift: Floats
    stretch: Floats
    is_object: bool


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
            met = self._pair.first_met(begin, eased.shift, *self._trees(eased))
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
        shifts = self.reach * np.concatenate([self._normals(pose), WAYS])
        for shift in shifts[self._are_free(pose, shifts, np.eye(4), is_object=False)]:
            yield Eased(shift, np.eye(4), is_object=False)
        for eased in self._stretched:
            if self._are_free(pose, *eased)[0]:
                yield eased

    @cached_property
    def _stretched(self) -> list[Eased]:
        trees = (self._pair.tool.tree, False), (self._pair.tree, True)
        return [
            Eased(np.zeros(3), stretch, is_object)
            for tree, is_object in trees
            for stretch in _full_stretches(tree, self.reach)
        ]

    def _trees(self, eased: Eased) -> tuple[TriangleTree, TriangleTree]:
        """The trees of object and tool after a motion, but for its shift."""
        theirs, own = self._pair.tree, self._pair.tool.tree
        scale, shift = np.diag(eased.stretch)[:3], eased.stretch[:3, 3]
        tree = theirs if eased.is_object else own
        tree = tree._replace(corners=tree.corners * scale + shift, boxes=tree.boxes * scale + shift)
        return (tree, own) if eased.is_object else (theirs, tree)

    def _are_free(
        self,
        pose: Floats,
        shifts: Floats,
        stretch: Floats,
        is_object: bool,  # noqa: FBT001 - of an `Eased`
    ) -> NDArray[np.bool_]:
        """Whether surfaces are apart with the tool at a pose after each of shifts (n, 3)."""
        poses = np.tile(pose, (len(np.atleast_2d(shifts)), 1, 1))
        poses[:, :3, 3] += shifts
        return self._pair.are_apart(poses, 2.0 * MEETING, stretch, is_object=is_object)

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


def _full_stretches(tree: TriangleTree, reach: float) -> Floats:
    """Maps (N, 4, 4) that stretch a tree so that its farthest place moves by `reach`."""
    low, high = tree.boxes[0]
    middle = 0.5 * (low + high)
    maps = stretches(low, high, reach) - np.eye(4)  # what they move by
    scales = np.einsum("nii->ni", maps)[:, :3]
    shifts = maps[:, :3, 3] + scales * middle  # along axes that are not scaled
    few, which = np.unique(scales**2, axis=0, return_inverse=True)
    squares = ((tree.corners.reshape(-1, 3) - middle) ** 2 @ few.T).max(axis=0)
    farthest = np.sqrt(squares[which.reshape(-1)] + (shifts**2).sum(axis=1))
    maps = np.eye(4) + maps * (reach / np.maximum(farthest, THIN))[:, None, None]
    return np.asarray(maps[(np.einsum("nii->ni", maps) >= LEAST_STRETCH).all(axis=1)])


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

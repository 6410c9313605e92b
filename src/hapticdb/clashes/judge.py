"""What a pair of surfaces is: apart, touching, overlapping, one inside the other, or not known.

Cheap proofs come first. A distance above zero is proved by `kernels.triangles.nearest`. Surfaces
that meet only touch if a motion frees them that moves no place by more than the contact tolerance:
a shift, or a stretch along the axes of a part, which frees a bolt from its bore. What no motion
frees is cut (`sweeps.cut`), and the middles of triangles are looked up in closed bodies: flush ends
hide from a cut.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.clashes.shapes import BuiltShape, Shapes
from hapticdb.kernels.surfaces.nearest import distances_to
from hapticdb.kernels.triangles.nearest import Nearest, nearest
from hapticdb.store.base import Object
from hapticdb.store.pairs import Kind
from hapticdb.sweeps.contact import SHIFT
from hapticdb.sweeps.cut import Cut, cut
from hapticdb.sweeps.easing import WAYS, normal

Floats = NDArray[np.float64]

TINY = 1e-9
"""Metres: surfaces that are farther apart do not meet."""
STRIDES = (1.05, 1.5, 2.5)
"""Depths that a shift is tried for that frees what overlaps. More: closer bounds, slower."""


class Judged(NamedTuple):
    """What a pair is; places in the frame of the first surface.

    at_least, at_most : metres, of the gap, or of the depth where they overlap; at_most is infinite
    where no bound is known. on_a, on_b (3,) : the nearest places, or where they overlap most.
    """

    kind: Kind
    at_least: float
    at_most: float
    on_a: Floats
    on_b: Floats


class PlacedPair(NamedTuple):
    """A pair of objects; pose (4, 4) : of the second one's shape in the frame of the first's."""

    one: Object
    other: Object
    pose: Floats


def judge_placed(shapes: Shapes, pair: PlacedPair, within: float, contact: float) -> Judged | None:
    """Judge a pair of objects; None if one was written meanwhile."""
    a, b = shapes.shape(pair.one), shapes.shape(pair.other)
    return None if a is None or b is None else judge(a, b, pair.pose, within, contact)


def judge(a: BuiltShape, b: BuiltShape, pose: Floats, within: float, contact: float) -> Judged:
    """Judge two surfaces, the second one at a rigid pose (4, 4) in the frame of the first."""
    near = _nearest(a, b, pose[None], within)
    if a.is_cloud or b.is_cloud:
        return _told("not known" if near.pairs[0, 0] >= 0 else "far", near)
    gap = float(near.at_least[0])
    if gap > 0.0:
        if _is_nested(a, b, pose):
            return _told("inside", near if near.pairs[0, 0] >= 0 else _nearest(a, b, pose[None]))
        if near.pairs[0, 0] < 0:
            return _told("far", near)
        return _told("apart" if gap > contact else "touching", near)
    freed = _freed(a, b, pose, contact, near)
    if freed is not None:
        return _told(freed, near)
    found = _cut(a, b, pose, 2.0 * contact, contact)
    inner = _inner(a, b, pose, contact)
    if max(found.depth, inner.depth) - SHIFT * contact <= contact:
        return _told("touching", near)
    return _overlap(a, b, pose, contact, near, inner)


def _told(kind: Kind, near: Nearest) -> Judged:
    at_least, at_most = float(near.at_least[0]), float(near.at_most[0])
    return Judged(kind, at_least, at_most, near.on_a[0], near.on_b[0])


def _nearest(a: BuiltShape, b: BuiltShape, poses: Floats, farthest: float = np.inf) -> Nearest:
    return nearest(a.tree, b.tree, poses, np.full(len(poses), farthest))


def _is_nested(a: BuiltShape, b: BuiltShape, pose: Floats) -> bool:
    """Whether a piece of one of two surfaces that do not meet is in a closed body of the other."""
    if b.holds((a.bodies - pose[:3, 3]) @ np.linalg.inv(pose[:3, :3]).T).any():
        return True
    return bool(a.holds(b.bodies @ pose[:3, :3].T + pose[:3, 3]).any())


def _freed(
    a: BuiltShape, b: BuiltShape, pose: Floats, contact: float, near: Nearest
) -> Kind | None:
    """What surfaces that meet are where a motion frees them, no place moved by more; or None.

    Inside only if each motion that frees them leaves one inside the other.
    """
    found: Kind | None = None
    for poses in _motions(a, b, pose, contact, near):
        for free in np.flatnonzero(_nearest(a, b, poses, TINY).at_least > 0.0):
            if not _is_nested(a, b, poses[free]):
                return "touching"
            found = "inside"
    return found


def _motions(
    a: BuiltShape, b: BuiltShape, pose: Floats, contact: float, near: Nearest
) -> Iterator[Floats]:
    """Poses (N, 4, 4) at which no place of a or b is farther than `contact` from where it is."""
    normals = _normals(a, b, pose, near)
    yield _shifted(pose, contact * np.concatenate([normals, -normals]))
    yield _shifted(pose, contact * WAYS)
    yield pose @ b.stretches(contact)
    yield np.linalg.inv(a.stretches(contact)) @ pose


def _normals(a: BuiltShape, b: BuiltShape, pose: Floats, near: Nearest) -> Floats:
    """Unit normals (2, 3) of the triangles that are nearest, frame of a."""
    first, second = near.pairs[0]
    return np.stack([normal(a.tree.corners[first]), pose[:3, :3] @ normal(b.tree.corners[second])])


def _shifted(pose: Floats, shifts: Floats) -> Floats:
    """Poses (N, 4, 4), shifted by (N, 3)."""
    poses = np.tile(pose, (len(shifts), 1, 1))
    poses[:, :3, 3] += shifts
    return poses


def _cut(a: BuiltShape, b: BuiltShape, pose: Floats, most: float, contact: float) -> Cut:
    return cut(a.mesh, b.mesh, pose, most, SHIFT * contact, contact, contact)


def _inner(a: BuiltShape, b: BuiltShape, pose: Floats, contact: float) -> Cut:
    """The middle of a triangle that is deepest in a closed body of the other, beyond `contact`."""
    back = np.linalg.inv(pose)
    deepest = Cut(0.0, np.zeros(3))
    for one, other, there in ((a, b, back), (b, a, pose)):
        middles = one.tree.corners.mean(axis=1) @ there[:3, :3].T + there[:3, 3]
        low, high = other.box
        middles = middles[((middles >= low + contact) & (middles <= high - contact)).all(axis=1)]
        if not len(middles):
            continue
        middles = middles[distances_to(other.tree, middles, farthest=2.0 * contact) > contact]
        middles = middles[other.holds(middles)] if len(middles) else middles
        if len(middles):
            depths = distances_to(other.tree, middles)
            best = int(np.argmax(depths))
            if depths[best] > deepest.depth:
                place = middles[best] if other is a else pose[:3, :3] @ middles[best] + pose[:3, 3]
                deepest = Cut(float(depths[best]), place)
    return deepest


def _overlap(
    a: BuiltShape, b: BuiltShape, pose: Floats, contact: float, near: Nearest, inner: Cut
) -> Judged:
    """Measure how deep surfaces overlap that do by more than `contact`."""
    sizes = [float(np.sort(shape.box[1] - shape.box[0])[1]) for shape in (a, b)]
    found = _cut(a, b, pose, max(0.5 * min(sizes), 2.0 * contact), contact)
    found = found._replace(depth=found.depth - SHIFT * contact)
    if inner.depth > found.depth:
        found = inner
    normals = _normals(a, b, pose, near)
    ways, at_most = np.concatenate([normals, -normals, WAYS]), np.inf
    for stride in STRIDES:
        poses = _shifted(pose, stride * found.depth * ways)
        if (_nearest(a, b, poses, TINY).at_least > 0.0).any():
            at_most = stride * found.depth
            break
    return Judged("overlapping", found.depth, at_most, found.place, found.place)

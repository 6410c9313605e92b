"""What a pair of surfaces is: apart, touching, overlapping, one inside the other, or not known.

A distance above zero is proved by `kernels.triangles.surface_distance`. Surfaces that meet only
touch if a motion frees them that moves no place by more than the contact tolerance
(`exact.separation`). How deep others overlap is bounded from below by the penetration depth of one
in the closed bodies of the other, and from above by the least motion that frees them.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.exact.separation import Separation
from hapticdb.exact.shape_cache import Shapes
from hapticdb.kernels.triangles.surface_distance import Nearest, nearest
from hapticdb.pointshell.shape import CollisionShape
from hapticdb.store.base import Object
from hapticdb.verdicts import Kind

Floats = NDArray[np.float64]

TINY = 1e-9
"""Metres: surfaces that are farther apart do not meet."""


class PairResult(NamedTuple):
    """What a pair is; places in the frame of the first surface.

    at_least, at_most : metres, of the gap, or of the depth where they overlap: 0 and infinite where
    no bound is known. on_a, on_b (3,) : the nearest places, or where they overlap most.
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


def measure_placed(
    shapes: Shapes, pair: PlacedPair, within: float, contact: float
) -> PairResult | None:
    """Judge a pair of objects; None if one was written meanwhile."""
    a, b = shapes.shape(pair.one), shapes.shape(pair.other)
    return None if a is None or b is None else classify_pair(a, b, pair.pose, within, contact)


def classify_pair(
    a: CollisionShape, b: CollisionShape, pose: Floats, within: float, contact: float
) -> PairResult:
    """Judge two surfaces, the second one at a rigid pose (4, 4) in the frame of the first."""
    error = a.chord + b.chord
    near = _nearest(a, b, pose, within + error)
    if a.is_cloud or b.is_cloud:
        return _result(Kind.NOT_KNOWN if near.pairs[0, 0] >= 0 else Kind.FAR, near)
    gap, separation = float(near.at_least[0]), Separation(a, b)
    if gap > 0.0:
        # first: a body may be farther than `within` from the surface around it
        if separation.is_nested(pose):
            near = near if near.pairs[0, 0] >= 0 else _nearest(a, b, pose)
            return _result(Kind.INSIDE if gap > error or not error else Kind.NOT_KNOWN, near, error)
        if separation.is_nested(pose, is_leaky=True):
            near = near if near.pairs[0, 0] >= 0 else _nearest(a, b, pose)
            return _result(Kind.NOT_KNOWN, near, error)
        if near.pairs[0, 0] < 0:
            return _result(Kind.FAR, near, error)
        if gap - error > contact:
            return _result(Kind.APART, near, error)
        # the true gap is within the chord errors of this one: decided if both its bounds agree
        if gap + error <= contact or not error:
            return _result(Kind.TOUCHING, near, error)
        return _result(Kind.NOT_KNOWN, near, error)
    separation.note_nearest(pose, near.pairs)
    # freed by less: the true surfaces touch, too; freed by more alone: they may
    freed = _freed(separation, pose, contact - error)
    if freed in (Kind.TOUCHING, Kind.NOT_KNOWN) or (freed == Kind.INSIDE and not error):
        return _result(freed, near, error)
    if error and _freed(separation, pose, contact + error) == Kind.TOUCHING:
        return _result(Kind.NOT_KNOWN, near, error)
    return _overlap(separation, pose, contact, near, error)


def _freed(separation: Separation, pose: Floats, reach: float) -> Kind | None:
    """Kind of surfaces that meet and are freed by a motion of a reach; None without one.

    Inside, if each such motion leaves a piece of one in a closed body of the other; not known, if
    in an open surface that almost encloses it.
    """
    found: Kind | None = None
    if reach <= 0.0:
        return found
    for moved in separation.separating(pose, reach, TINY, gap=0.0, any_side=True):
        if separation.is_nested(pose, moved):
            found = found or Kind.INSIDE
        elif separation.is_nested(pose, moved, is_leaky=True):
            found = Kind.NOT_KNOWN
        else:
            return Kind.TOUCHING
    return found


def _result(kind: Kind, near: Nearest, error: float = 0.0) -> PairResult:
    at_least = max(float(near.at_least[0]) - error, 0.0)
    at_most = float(near.at_most[0]) + error
    return PairResult(kind, at_least, at_most, near.on_a[0], near.on_b[0])


def _nearest(
    a: CollisionShape, b: CollisionShape, pose: Floats, farthest: float = np.inf
) -> Nearest:
    return nearest(a.tree, b.tree, pose[None], np.array([farthest]))


def _overlap(
    separation: Separation, pose: Floats, contact: float, near: Nearest, error: float
) -> PairResult:
    """Bounds of how deep surfaces overlap that no motion of the tolerance frees."""
    depth, place = separation.depth(pose, contact)
    # no motion up to here frees them, as was just searched
    least = max(contact + error, depth)
    at_most = separation.least(pose, least, separation.most_reach, TINY, gap=0.0)
    place = place if depth else near.on_a[0]
    at_most = np.inf if at_most is None else at_most + error
    return PairResult(Kind.OVERLAPPING, max(depth - error, 0.0), at_most, place, place)

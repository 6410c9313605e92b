"""Separating motions of a tool and an object, and their penetration depth.

A motion of reach r displaces every place by r at most: a shift, or an offset of one surface along
its normals. A motion that separates the surfaces bounds their overlap from above, the penetration
depth (`kernels.triangles.depth`) from below. Conservative advancement proves the change from one
motion to another: all places move straight, and the surfaces stay apart.
"""

import math
from collections.abc import Callable, Iterator
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.surfaces.triangle_bvh import TriangleBVH, refitted
from hapticdb.kernels.triangles.depth import depth_in, pieces_kernel
from hapticdb.kernels.triangles.offsets import (
    ACROSS,
    ALONG,
    WHOLE,
    any_near_kernel,
    offset_kernel,
)
from hapticdb.kernels.triangles.surface_distance import free_shift_kernel, nearest
from hapticdb.pointshell.shape import CollisionShape

Floats = NDArray[np.float64]

DIRECTIONS = np.array([way for way in product((0.0, 1.0, -1.0), repeat=3) if any(way)])
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1)[:, None]
"""Unit vectors (26, 3) of shifts, beside the normals of the nearest triangles."""
CONTACT = 5e-5
"""Default of the contact tolerance, metres."""
NORMALS = 4
"""Shifts along normals, tried before all others: they free most surfaces that touch."""
LEAST_BALL = 0.01
"""Least factor to which a ball shrinks."""
SAME = 1e-6
"""Metres: nearer surfaces coincide; closed bodies alone decide on which side they are."""
MET, MOST_STEPS = 1e-7, 60
"""Gap at which a change of motions ends as a collision, metres; its greatest number of steps."""
GROWTH, FINE = 1.4, 0.05
"""Factor between successive reaches of the search, and relative tolerance of the least one."""
FINE_DEPTH, TOLERANCE = 0.02, 0.2
"""Tolerances of a penetration depth: relative, and as a share of the contact tolerance."""
QUICK, MOST_QUERIES = 256, 1_000_000
"""Limits of distance queries for a depth: some milliseconds, and some seconds."""
MOST_REACH, MOST_SHARE = 20e-3, 0.75
"""Greatest reach: metres, and share of the second edge of the lesser box."""
BLOCKING = 16
"""Pairs of triangles in collision after earlier motions, tested first."""
MOST_PIECES, PASSES = 16, 2_000_000
"""Pieces tried in open surfaces at most, or more where they have few triangles, up to so many
passes over one triangle: half a second."""


class Motion(NamedTuple):
    """Small motion of the tool or of the object.

    by : its kind; shift (3,) : of the tool, world frame; tool, object (T, 3, 3) or None :
    displacements of the corners of their trees, own frames; growth : of a ball's radius. Metres.
    """

    by: str
    shift: Floats
    tool: Floats | None = None
    object: Floats | None = None
    growth: float = 0.0


NOTHING = Motion("nothing", np.zeros(3))


class MovedPair(NamedTuple):
    """Both surfaces after a motion: trees, own frames, the tool's shift, and a ball's radius."""

    motion: Motion
    object: TriangleBVH
    tool: TriangleBVH
    radius: float


class Separation:
    """Separating motions of a tool and an object; poses of the tool in the object's frame.

    check : called before each distance query; its exception ends the search.
    """

    def __init__(
        self, thing: CollisionShape, tool: CollisionShape, check: Callable[[], None] = lambda: None
    ) -> None:
        self._object, self._tool, self._check = thing, tool, check
        self._blocking = np.empty((0, 2), dtype=np.int64)
        self._at_shifts, self._at_depth = (np.zeros(0), np.zeros(0)), (np.zeros(0), 0.0)

    def separating(
        self, pose: Floats, reach: float, clearance: float, *, gap: float,
        thorough: bool = True, any_side: bool = False,
    ) -> Iterator[MovedPair]:  # fmt: skip
        """Motions of a reach after which the surfaces have a clearance, without a change of sides.

        gap : of the surfaces at the pose. Surfaces with a gap must stay apart during the motion;
        coinciding ones must end without a piece in a closed body, unless `any_side`.
        """
        still = self.moved(NOTHING)
        for moved in self._candidates(pose, reach, clearance, still, gap, thorough=thorough):
            # apart at the start: conservative advancement proves that the motion crosses nothing
            if gap > SAME:
                if self.joins(still, moved, pose):
                    yield moved
            elif any_side or not self.is_nested(pose, moved):
                yield moved

    def least(
        self, pose: Floats, least: float, most: float, clearance: float, *, gap: float
    ) -> float | None:
        """Least reach of a separating motion, as above, to `FINE`; None without any."""

        def is_free(reach: float, *, thorough: bool) -> bool:
            found = self.separating(pose, reach, clearance, gap=gap, thorough=thorough)
            return next(found, None) is not None

        low, high = least, least
        # geometric search upward, then bisection of the last interval
        while True:
            low, high = high, min(GROWTH * high, most)
            if high > low and is_free(high, thorough=False):
                break
            if high >= most:
                return None
        if high > (nearly := (1.0 + FINE) * least) and is_free(nearly, thorough=True):
            return nearly  # the thorough ones are slow: only once
        # not monotone for certain: `high` is proved free, the result is an upper bound
        while high - low > FINE * high:
            middle = 0.5 * (low + high)
            low, high = (low, middle) if is_free(middle, thorough=False) else (middle, high)
        return high

    @property
    def most_reach(self) -> float:
        """Greatest reach of the search, metres."""
        edges = [float(np.sort(np.ptp(one.box, axis=0))[1]) for one in (self._object, self._tool)]
        return min(MOST_REACH, MOST_SHARE * min(edges))

    def depth(
        self, pose: Floats, contact: float, fine: float = FINE_DEPTH, most: int = MOST_QUERIES
    ) -> tuple[float, Floats]:
        """Proved penetration depth, metres, and its place (3,), the object's frame.

        The greater one of tool in object and object in tool, with tolerances `fine` and `TOLERANCE`
        and at most `most` distance queries each; 0 for depths up to `contact` and open surfaces.
        """
        deepest = 0.0, np.zeros(3)
        back = np.linalg.inv(pose)
        # not symmetric: a corner of one may be deeper than any corner of the other
        for one, other, to in ((self._tool, self._object, pose), (self._object, self._tool, back)):
            if one.radius or one.is_cloud or other.interior is None:
                continue
            there = np.array(to, dtype=np.float64)
            # the solid's corners are about an origin of its own
            there[:3, 3] -= other.interior.origin
            # branch and bound: the second direction has to beat the first
            least = max(contact, deepest[0])
            found, place = depth_in(
                other.interior.solid, one.tree, there, least, TOLERANCE * contact, fine, most
            )
            if found:
                place = place + other.interior.origin
                place = place if to is pose else pose[:3, :3] @ place + pose[:3, 3]
                deepest = found, place
        return deepest

    def is_nested(
        self, pose: Floats, moved: MovedPair | None = None, *, is_leaky: bool = False
    ) -> bool:
        """Whether a piece of one surface is in a closed body of the other; they are apart.

        is_leaky : whether it is almost enclosed by an open surface instead.
        """
        moved = moved or self.moved(NOTHING)
        motion, own, theirs = moved.motion, moved.tool.corners, moved.object.corners
        placed = _shifted(pose, motion)
        return _contains_piece(
            self._object, motion.object, self._tool, own, placed,
            is_back=False, is_leaky=is_leaky,
        ) or _contains_piece(
            self._tool, motion.tool, self._object, theirs, placed, motion.growth,
            is_back=True, is_leaky=is_leaky,
        )  # fmt: skip

    def moved(self, motion: Motion, base: Motion = NOTHING, share: float = 1.0) -> MovedPair:
        """Both surfaces on the way from one motion to another."""
        here = _between(base, motion, share)
        radius = self._tool.radius + here.growth
        return MovedPair(
            here, _moved_tree(self._object, here.object), _moved_tree(self._tool, here.tool), radius
        )

    def gap(self, moved: MovedPair, pose: Floats, farthest: float) -> float:
        """Distance of the surfaces after a motion, from below, up to `farthest` metres."""
        self._check()
        placed, far = _shifted(pose, moved.motion), np.array([farthest + moved.radius])
        found = nearest(moved.object, moved.tool, placed[None], far)
        return float(found.at_least[0]) - moved.radius

    def joins(self, before: MovedPair, after: MovedPair, pose: Floats) -> bool:
        """Whether the straight change from one motion to another meets nothing at a pose."""
        travel = _travel(before.motion, after.motion)
        share = 0.0
        for _ in range(MOST_STEPS if travel else 0):
            here = self.moved(after.motion, before.motion, share)
            gap = self.gap(here, pose, 2.0 * travel)
            # the gap at the end counts, too: the last step lands there
            if gap < MET or share >= 1.0:
                return gap >= MET
            # conservative advancement: no place moves farther than its gap; 0.999 covers rounding
            share = min(1.0, share + 0.999 * gap / travel)
        return not travel

    def is_free(self, moved: MovedPair, pose: Floats, clearance: float) -> bool:
        """Whether the surfaces keep a clearance after a motion."""
        return any(self.shifted(pose, moved.motion.shift[None], clearance, moved))

    def _note_blocking(self, pairs: NDArray[np.int64]) -> None:
        """Note pairs (N, 2) of triangles that were too near."""
        self._blocking = np.concatenate([pairs[:1], self._blocking])[:BLOCKING]

    def shifted(
        self, pose: Floats, shifts: Floats, clearance: float, base: MovedPair
    ) -> Iterator[MovedPair]:
        """Of shifts (N, 3) of the tool, those that keep the surfaces a clearance apart."""
        far, number = clearance + base.radius, 0
        while number < len(shifts):
            self._check()
            # the kernel goes on from the last free shift: one call finds the next one
            out = np.array([number, -1, -1])
            free_shift_kernel(base.object, base.tool, pose, shifts, self._blocking, far, out)
            number = int(out[0])
            if out[1] >= 0:
                # temporal coherence: the pair that blocked one motion mostly blocks the next
                self._note_blocking(out[None, 1:])
            if number < len(shifts):
                yield base._replace(motion=Motion("shift", shifts[number]))
            number += 1

    def shifts(self, pose: Floats) -> Floats:
        """Unit vectors (N, 3) of shifts that may separate, those along normals first."""
        # several reaches are tried at one pose: normals do not depend on the reach
        if np.array_equal(self._at_shifts[0], pose):
            return self._at_shifts[1]
        near = nearest(self._object.tree, self._tool.tree, pose[None], np.array([np.inf]))
        return self.note_nearest(pose, near.pairs)

    def note_nearest(self, pose: Floats, pairs: NDArray[np.int64]) -> Floats:
        """Note the nearest triangles (1, 2) at a pose; returns the `shifts` there."""
        self._note_blocking(pairs)
        first, second = pairs[0]
        theirs = self._tool.tree.corners[second] @ pose[:3, :3].T
        normals = np.array([_normal(self._object.tree.corners[first]), _normal(theirs)])
        self._at_shifts = pose, np.concatenate([normals, -normals, DIRECTIONS])
        return self._at_shifts[1]

    def _known_depth(self, pose: Floats) -> float:
        """Penetration depth of a quick search, at least, metres."""
        # by pose, as for the shifts: a search over reaches asks for it each time
        if not np.array_equal(self._at_depth[0], pose):
            self._at_depth = pose, self.depth(pose, SAME, most=QUICK)[0]
        return self._at_depth[1]

    def _candidates(
        self, pose: Floats, reach: float, clearance: float, still: MovedPair, gap: float,
        *, thorough: bool,
    ) -> Iterator[MovedPair]:  # fmt: skip
        """Motions of a reach that keep the surfaces a clearance apart: none, shifts, others.

        What is deeper than the reach is freed by none, so the slower ones are left out.
        """
        # no motion at all is the best one: reach 0
        if gap > 0.0 and self.is_free(still, pose, clearance):
            yield still
        shifts = reach * self.shifts(pose)
        yield from self.shifted(pose, shifts[:NORMALS], clearance, still)
        yield from self.shifted(pose, shifts[NORMALS:], clearance, still)
        if gap <= SAME and self._known_depth(pose) > reach:
            return
        # own axes: a hole or slot is open along one of them, oblique to the world's
        own = np.concatenate([self._object.axes, self._tool.axes @ pose[:3, :3].T])
        yield from self.shifted(pose, reach * np.concatenate([own, -own]), clearance, still)
        for motion in self._grown(reach):
            if self.is_free(moved := self.moved(motion), pose, clearance):
                yield moved
        corners = self._object.tree.corners, self._tool.tree.corners
        far = clearance + self._tool.radius
        for is_tool, shape, *offset in self._offsets(reach, thorough=thorough):
            # early out: the noted pairs alone, before corners are moved and a tree is refitted
            blocking = self._blocking
            if any_near_kernel(*corners, pose, blocking, far, shape.normals, is_tool, *offset):
                continue
            by = np.empty_like(shape.normals)
            offset_kernel(shape.normals, *offset, by)
            tool, thing = (by, None) if is_tool else (None, by)
            moved = self.moved(Motion("offset", NOTHING.shift, tool, thing))
            if self.is_free(moved, pose, clearance):
                yield moved

    def _grown(self, reach: float) -> Iterator[Motion]:
        """Offsets of a ball."""
        for growth in (-reach, reach):
            if self._tool.radius and self._tool.radius + growth > LEAST_BALL * self._tool.radius:
                yield NOTHING._replace(by="offset", growth=growth)

    def _offsets(
        self, reach: float, *, thorough: bool
    ) -> Iterator[tuple[bool, CollisionShape, float, Floats, int]]:
        """Offsets of the tool, then of the object, along their normals, inward first.

        thorough : then along their components across and along each of their axes, too, so that a
        peg or a plate gives way by all of the reach at its edges.
        """
        # a ball has no normals of triangles: `_grown` offsets it
        both = [one for one in ((True, self._tool), (False, self._object)) if not one[1].radius]
        for one, sign in product(both, (reach, -reach)):
            yield *one, sign, NOTHING.shift, WHOLE
        for one in both if thorough else []:
            for axis, sign, part in product(one[1].axes, (reach, -reach), (ACROSS, ALONG)):
                yield *one, sign, axis, part


def _shifted(pose: Floats, motion: Motion) -> Floats:
    """Pose (4, 4) of the tool after its shift."""
    placed = pose.copy()
    placed[:3, 3] += motion.shift
    return placed


def _moved_tree(shape: CollisionShape, by: Floats | None) -> TriangleBVH:
    return shape.tree if by is None else refitted(shape.tree, shape.tree.corners + by)


def _between(first: Motion, second: Motion, share: float) -> Motion:
    """Motion with a share of the second and the rest of the first."""
    if share >= 1.0:
        return second
    # linear in all displacements: each place moves on a line, so `_travel` bounds it
    rest = 1.0 - share
    return Motion(
        second.by, rest * first.shift + share * second.shift,
        _sum_of(first.tool, rest, second.tool, share),
        _sum_of(first.object, rest, second.object, share),
        rest * first.growth + share * second.growth,
    )  # fmt: skip


def _sum_of(a: Floats | None, weight: float, b: Floats | None, other: float) -> Floats | None:
    """Sum of weighted displacements; None stands for none."""
    if a is None or b is None:
        found, weight = (a, weight) if b is None else (b, other)
        return None if found is None else weight * found
    return weight * a + other * b


def _travel(first: Motion, second: Motion) -> float:
    """Metres by which the change between two motions moves surfaces together at most."""
    found = float(np.linalg.norm(second.shift - first.shift)) + abs(second.growth - first.growth)
    for a, b in ((first.tool, second.tool), (first.object, second.object)):
        change = _sum_of(a, -1.0, b, 1.0)
        if change is not None:
            found += float(np.linalg.norm(change, axis=2).max())
    return found


def _contains_piece(
    outer: CollisionShape, outer_by: Floats | None, inner: CollisionShape, corners: Floats,
    pose: Floats, growth: float = 0.0, *, is_back: bool, is_leaky: bool,
) -> bool:  # fmt: skip
    """Whether a closed body holds a piece of a surface that is apart from it.

    corners (T, 3, 3) : of the inner one, placed by the pose or back; growth : of a ball's radius,
    metres; is_leaky : as of `is_nested`. A piece with a corner outside the body's box is not in it.
    """
    if is_leaky and not outer.has_open:
        return False
    reach = growth if outer_by is None else float(np.abs(outer_by).max())
    first = np.empty((len(inner.starts), 3))
    # broad phase: only pieces within the grown box are tested against the interior
    n_in = pieces_kernel(
        corners, inner.points, inner.pieces, inner.starts, pose, is_back, outer.box, reach, first
    )
    if not n_in:
        return False
    if outer.radius:
        inside = np.linalg.norm(first[:n_in], axis=1) < outer.radius + growth
        return bool(inside.any())
    if is_leaky:
        most = max(MOST_PIECES, PASSES // len(outer.tree.corners))
        some = np.linspace(0, n_in - 1, min(n_in, most)).astype(np.int64)
        return bool(outer.almost_encloses(first[some], outer_by).any())
    interior = outer.moved_interior(outer_by)
    return interior is not None and bool(interior.holds(first[:n_in]).any())


def _normal(triangle: Floats) -> tuple[float, ...]:
    """Unit normal of a triangle (3, 3), zero without area: `numpy` takes ten times longer."""
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = triangle.tolist()
    ux, uy, uz, vx, vy, vz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
    normal = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = math.hypot(*normal) or 1.0
    return tuple(x / length for x in normal)

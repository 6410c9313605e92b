"""A machine: a tree of rigid links, joints between them, and bounds of their motion."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import FileError
from hapticdb.grid import corners_of
from hapticdb.pointshell.shape import CollisionShape
from hapticdb.pointshell.tool_surface import ToolSurface
from hapticdb.poses import rotation_of

Floats = NDArray[np.float64]

FIXED, HINGE, SLIDE = "fixed", "hinge", "slide"
"""Kinds of joints."""


class Joint(NamedTuple):
    """Joint between two links, by their numbers; the frame of the child is the joint's.

    origin (4, 4) : `parent_from_child` at the joint value `zero`; axis (3,) : unit vector, child's
    frame, through `point` (3,); low, high : limits, rad or m; driver : name of a joint, or empty:
    the value is then `factor` times the driver's plus `offset`.
    """

    name: str
    kind: str
    parent: int
    child: int
    origin: Floats
    axis: Floats
    point: Floats = np.zeros(3)
    zero: float = 0.0
    low: float = -np.inf
    high: float = np.inf
    driver: str = ""
    factor: float = 1.0
    offset: float = 0.0


class LinkSurface(ToolSurface):
    """Surface of a link, its own frame; chord error in metres."""

    def __init__(self, triangles: Floats, chord: float) -> None:
        CollisionShape.__init__(self, triangles, chord=chord)
        self.corners = corners_of(self.box)


@dataclass(frozen=True, eq=False)
class Machine:
    """Links and joints of a file; link 0 is the base.

    Attributes
    ----------
    file : str
    names : tuple of str
        Of the links.
    surfaces : mapping
        Surfaces of links, by their numbers.
    joints : tuple of Joint
        Parents first.
    excluded : frozenset of pairs of names, or None
        Pairs of links excluded by the file; None if it has no such list.
    notes : tuple of str
    """

    file: str
    names: tuple[str, ...]
    surfaces: Mapping[int, LinkSurface]
    joints: tuple[Joint, ...]
    excluded: frozenset[frozenset[str]] | None = None
    notes: tuple[str, ...] = ()

    @cached_property
    def driven(self) -> tuple[str, ...]:
        """Joints with a value of their own, in the order of `sweep_machine`'s columns."""
        return tuple(one.name for one in self.joints if one.kind != FIXED and not one.driver)

    def values(self, q: Floats) -> Floats:
        """Values (n, joints) of all joints, for those of the driven ones, (n, driven)."""
        by_name = {name: q[:, n] for n, name in enumerate(self.driven)}
        left = [one for one in self.joints if one.driver]
        while left:
            ready = [one for one in left if one.driver in by_name]
            if not ready:
                raise FileError(
                    f"{self.file}: joint {left[0].name!r} follows no joint with a value"
                )
            for one in ready:
                by_name[one.name] = one.factor * by_name[one.driver] + one.offset
            left = [one for one in left if one.name not in by_name]
        values = np.zeros((len(q), len(self.joints)))
        for n, one in enumerate(self.joints):
            values[:, n] = by_name.get(one.name, 0.0)
        return values

    @cached_property
    def _joint_of(self) -> dict[int, int]:
        """Number of the joint above each link."""
        return {joint.child: n for n, joint in enumerate(self.joints)}

    def above(self, link: int) -> list[int]:
        """Numbers of the joints from a link up to the base."""
        found = []
        while link:
            found.append(self._joint_of[link])
            link = self.joints[found[-1]].parent
        return found

    def chain(self, first: int, last: int) -> list[int]:
        """Numbers of the joints that move from one link to another, in this order."""
        up, down = self.above(first), self.above(last)
        both = set(up) & set(down)
        between = [n for n in (*up, *reversed(down)) if n not in both]
        return [n for n in between if self.joints[n].kind != FIXED]

    def placed(self, values: Floats, link: int) -> Floats:
        """Poses (n, 4, 4) of a link in the frame of the base, for values (n, joints)."""
        return self._placed(values, reversed(self.above(link)))[link]

    def all_placed(self, values: Floats) -> dict[int, Floats]:
        """The same for each link: far faster for many."""
        return self._placed(values, range(len(self.joints)))

    def _placed(self, values: Floats, joints: Iterable[int]) -> dict[int, Floats]:
        """Poses of the links below some joints, parents first, and of the base."""
        poses = {0: np.tile(np.eye(4), (len(values), 1, 1))}
        for n in joints:
            joint = self.joints[n]
            poses[joint.child] = poses[joint.parent] @ joint.origin
            if joint.kind != FIXED:
                poses[joint.child] @= _motion(joint, values[:, n] - joint.zero)
        return poses


def _motion(joint: Joint, by: Floats) -> Floats:
    """Motions (n, 4, 4) of a joint, child's frame, by angles or lengths (n,)."""
    out = np.tile(np.eye(4), (len(by), 1, 1))
    if joint.kind == SLIDE:
        out[:, :3, 3] = by[:, None] * joint.axis
    else:
        half = 0.5 * by[:, None]
        out[:, :3, :3] = rotation_of(np.hstack([np.cos(half), np.sin(half) * joint.axis]))
        out[:, :3, 3] = joint.point - out[:, :3, :3] @ joint.point
    return out


class Bounds(NamedTuple):
    """Of a link's motion between two rows, over the row's share: (rows - 1,) each.

    speed : of its fastest place, metres; bend : of the second derivative, metres; turn : radians.
    """

    speed: Floats
    bend: Floats
    turn: Floats


def motion_bounds(
    machine: Machine, values: Floats, first: int, last: int,
    placed: Mapping[int, Floats],
) -> Bounds:  # fmt: skip
    """Bounds of a link's motion in the frame of another one; values (rows, joints), linear between.

    placed : poses of all links at the values.

    A place moves by |dq| times its distance from the axis of each joint between (Schwarzer, Saha,
    Latombe 2005). That is at most the sum of the distances from each joint's point to the next one
    and to the link's box: each is constant, or convex along the row, so largest at its ends. The
    second derivative has, for each two joints, the product of both rates and the distance from the
    axis of the later one; a later slide has only the former's rate.
    """
    chain, surface = machine.chain(first, last), machine.surfaces[last]
    frame = placed[last]
    corners = surface.corners @ np.swapaxes(frame[:, :3, :3], 1, 2) + frame[:, None, :3, 3]
    rates = np.abs(np.diff(values, axis=0))
    speed, bend, turn = np.zeros((3, len(rates)))
    points = [
        (at := placed[machine.joints[n].child])[:, :3, :3] @ machine.joints[n].point + at[:, :3, 3]
        for n in chain
    ]
    reaches, reach = [], np.zeros(len(rates))
    for n in range(len(chain) - 1, -1, -1):
        after = corners if n == len(chain) - 1 else points[n + 1][:, None]
        apart = np.linalg.norm(after - points[n][:, None], axis=2).max(axis=1)
        reach = reach + np.maximum(apart[:-1], apart[1:])
        reaches.append(reach)
    for n, reach in zip(chain, reversed(reaches), strict=True):
        rate = rates[:, n]
        is_hinge = machine.joints[n].kind == HINGE
        moved = rate * reach if is_hinge else rate
        speed += moved
        bend += moved * (2.0 * turn + (rate if is_hinge else 0.0))
        turn += rate if is_hinge else 0.0
    half = 0.5 * float(np.linalg.norm(np.ptp(surface.box, axis=0)))
    return Bounds(speed, bend + half * turn**2, turn)


def pairs_of(links: Iterable[int]) -> list[tuple[int, int]]:
    """Each two of some links once."""
    found = sorted(links)
    return [(a, b) for n, a in enumerate(found) for b in found[n + 1 :]]

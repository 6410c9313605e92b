"""Reach of a tool: placements about a target's axis, each proved by a sweep on, round and off.

A placement is an angle about the axis. Angles between two steps are not decided.
"""

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from operator import itemgetter
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.environment import Environment
from hapticdb.errors import UsageError
from hapticdb.exact.movers import Mover, SweepRequest, shapes_of
from hapticdb.exact.path import ToolPath
from hapticdb.exact.separation import CONTACT
from hapticdb.exact.sweep import PathSweep, center_of, in_snapshot
from hapticdb.exact.swept import Swept
from hapticdb.kernels.surfaces.triangle_bvh import normals_of
from hapticdb.kernels.triangles.path_distance import MEETING
from hapticdb.pointshell.shape import CollisionShape
from hapticdb.pointshell.shell import PointShell
from hapticdb.pointshell.tool_surface import ToolSurface
from hapticdb.poses import rotation_of
from hapticdb.store.base import Object, Progress
from hapticdb.store.finding import Words, find_objects
from hapticdb.tabular.schema import plain
from hapticdb.tabular.tables import Columns, Tabular, columns_of
from hapticdb.verdicts import PathVerdict

Floats = NDArray[np.float64]
Approach = Literal["x", "y", "z", "-x", "-y", "-z"]

ALIKE = 0.01
"""Relative difference of two principal moments of area that count as equal."""
WITHIN = 0.02
"""Greatest gap that is measured, metres. Larger: more objects, a slower search."""
TURN_STEP, MOST_TURN = 30.0, 3600.0
"""Degrees between poses of a turn, less than half a turn; and of a turn, at most."""
REACH_KEYS = ("id", "name", "verdict", "n_free", "n_angles", "free", "gap", "obstacles")
"""Keys of a target's row."""


class TargetReach(NamedTuple):
    """Reach of one target, from the better end of its axis.

    n_free, n_angles : numbers of placements; free : first and last angle of each run of free ones,
    degrees; gap : the greatest proved one, 0.02 m at most, 0 if it slides; obstacles : first
    hits, those of most placements first; pose (4, 4) : `world_from_tool` on the target at angle 0.
    """

    object: Object
    verdict: PathVerdict
    n_free: int
    n_angles: int
    free: str
    gap: float | None
    obstacles: tuple[Object, ...]
    pose: Floats


@dataclass(frozen=True, eq=False)
class Reached(Tabular):
    """Result of `reach`: its targets in the order of their ids; elapsed : seconds."""

    targets: tuple[TargetReach, ...]
    revision: int
    elapsed: float

    def __repr__(self) -> str:
        n_reachable = sum(one.n_free > 0 for one in self.targets)
        return f"Reached({n_reachable} of {len(self.targets)}, {self.elapsed:.2f} s)"

    def columns(self) -> Columns:
        """A row for each target."""
        return columns_of(REACH_KEYS, map(plain, self.targets))


def reach(
    env: Environment, targets: Words, tool: PointShell, *, axis: ArrayLike | None = None,
    approach: Approach = "-z", about: ArrayLike | None = None,
    offset: float = 0.0, lift: float = 0.02, turn: float = 60.0, step: float = 15.0,
    where: Words = (), exclude: Words = (), contact: float = CONTACT, seconds: float | None = None,
    progress: Progress | None = None,
) -> Reached:  # fmt: skip
    """Decide from which angles a tool gets onto targets, turns there, and comes off.

    Parameters
    ----------
    targets : iterable of int or str
        Objects, each a target, and no obstacle of its own.
    axis : (3,) array or None
        Outward direction of the axis, world frame. Unless given, both directions of the target's
        axis of symmetry, by the moments of its area.
    approach : str
        Direction onto the target, tool frame. The tool's z axis points outward, inward with ``z``.
    about : (3,) array or None
        The tool's point on the target's end face, tool frame, metres; its origin unless given.
    offset, lift : float
        Metres: shift of the tool outward; length of its motion on and off.
    turn, step : float
        Degrees about the outward axis, right-handed: on the target, and between placements. At
        angle 0 the tool's x axis points along the world's x, or y if the axis lies along x.
    env, tool, where, exclude, contact, seconds, progress
        As for `sweep`, of obstacles; `progress` counts targets.

    Raises
    ------
    UsageError, ObjectNotFoundError
        As for `sweep`; for a target without a single axis of symmetry, if none is given.
    """
    began, surface = time.monotonic(), ToolSurface(tool)
    request = SweepRequest(contact, 0.0, seated=False, until_hit=True, progress=None)
    request = request.begun(WITHIN, seconds)._replace(known={})
    if not 0.1 <= step <= 360.0:
        raise UsageError(f"a step of {step} degrees: give 0.1 to 360")
    center = center_of(surface, np.zeros(3) if about is None else about)
    poses = _motion(center, approach, offset, lift, turn)
    angles = np.arange(0.0, 360.0 - 1e-6, step)  # less by rounding: 360 is 0 again

    def reached() -> Reached:
        chosen, found = find_objects(env, targets), []
        search = _Search(env, surface, center, poses, angles, request, env.select(where, exclude))
        # all axes before the first sweep: a target without one ends no long search
        each = [(obj, [*_ends(obj, shape, axis)]) for obj, shape in shapes_of(env.store, chosen)]
        for obj, ends in each:
            # of ends without a free placement, the one from which the tool gets farther
            ranked = [search.reach_from(obj, end) for end in ends]
            found.append(max(ranked, key=itemgetter(0))[1])
            if progress is not None:
                progress(len(found), len(chosen))
        return Reached(tuple(found), env.store.revision(), time.monotonic() - began)

    return in_snapshot(env, reached)


def _motion(center: Floats, approach: str, offset: float, lift: float, turn: float) -> Floats:
    """Poses (M, 4, 4) on, round and off at angle 0, in the frame of an end; UsageError."""
    if not (0.0 < lift < np.inf and abs(offset) < np.inf and abs(turn) <= MOST_TURN):
        raise UsageError(
            f"lift {lift} m, offset {offset} m, turn {turn} degrees: give a lift above 0, and a "
            f"turn of {MOST_TURN:g} at most"
        )
    if approach not in get_args(Approach):
        raise UsageError(f"approach {approach!r}: give one of {', '.join(get_args(Approach))}")
    seat, back = np.eye(4), np.eye(4)
    if approach == "z":
        seat[1, 1] = seat[2, 2] = -1.0
    seat[:3, 3] = [0.0, 0.0, offset] - seat[:3, :3] @ center
    back["xyz".index(approach[-1]), 3] = lift if approach[0] == "-" else -lift
    turned = _turns(np.linspace(0.0, turn, 1 + int(np.ceil(abs(turn) / TURN_STEP)))) @ seat
    return np.concatenate([turned[:1] @ back, turned, turned[-1:] @ back])


def _turns(degrees: Floats) -> Floats:
    """Turns (n, 4, 4) about z."""
    out, halves = np.tile(np.eye(4), (len(degrees), 1, 1)), 0.5 * np.radians(degrees)
    zeros = np.zeros_like(halves)
    out[:, :3, :3] = rotation_of(np.stack([np.cos(halves), zeros, zeros, np.sin(halves)], axis=1))
    return out


def _ends(target: Object, shape: CollisionShape, axis: ArrayLike | None) -> Iterator[Floats]:
    """Frames (4, 4) of the ends of a target's axis: z outward, the origin on the end face."""
    name, triangles = f"object {target.id} ({target.name})", shape.tree.corners
    areas = normals_of(triangles)[1]
    if not areas.any():
        raise UsageError(f"{name} has no surface: leave it out")
    center = areas @ triangles.mean(axis=1) / areas.sum()
    if axis is None:
        corners = np.concatenate([triangles, triangles.sum(axis=1, keepdims=True)], axis=1)
        corners -= center * [[1.0], [1.0], [1.0], [3.0]]
        moments, axes = np.linalg.eigh(np.einsum("t,tik,til->kl", areas, corners, corners))
        # round or regular across the axis: there, and only there, two principal moments are equal
        is_equal = np.diff(moments) <= ALIKE * moments[1:]
        if is_equal[0] == is_equal[1]:
            raise UsageError(f"{name} has no single axis of symmetry: give --axis, a direction")
        along = axes[:, 2 if is_equal[0] else 0]
        along *= np.sign(along[np.argmax(np.abs(along))])  # eigenvectors have no sign
        outward = [along, -along]
    else:
        given = np.asarray(axis, dtype=np.float64)
        if given.shape != (3,) or not 0.0 < np.linalg.norm(given) < np.inf:
            raise UsageError(f"axis {axis}: give a direction, three numbers")
        outward = [given / np.linalg.norm(given)]
    for z in outward:
        frame, x = np.eye(4), np.eye(3)[int(abs(z[0]) > 0.9)]
        y = np.cross(z, x) / np.linalg.norm(np.cross(z, x))
        height = ((triangles - center) @ z).max()
        frame[:3] = np.stack([np.cross(y, z), y, z, center + height * z], axis=1)
        yield frame


class _Search:
    """Sweeps of a tool on its motion, poses (M, 4, 4), at all angles (n,) about an axis."""

    def __init__(
        self, env: Environment, tool: ToolSurface, center: Floats, poses: Floats, angles: Floats,
        request: SweepRequest, obstacles: list[Object],
    ) -> None:  # fmt: skip
        self._env, self._tool, self._center, self._request = env, tool, center, request
        self._poses, self._angles, self._obstacles = poses, angles, obstacles
        self._bounds = np.array([obj.bounds for obj in obstacles]).reshape(-1, 2, 3)
        at = tool.corners @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]
        self._radius = np.linalg.norm(at, axis=2).max() + tool.radius + tool.chord + WITHIN

    def reach_from(
        self, target: Object, end: Floats
    ) -> tuple[tuple[int, bool, float], TargetReach]:
        """Reach from one end; before it its rank: free placements, if undecided, motion to hits."""
        if time.monotonic() > self._request.until:
            verdict, n_angles = PathVerdict.NOT_DECIDED, len(self._angles)
            late = TargetReach(target, verdict, 0, n_angles, "", None, (), end @ self._poses[1])
            return (0, True, 0.0), late
        apart = np.maximum(self._bounds[:, 0] - end[:3, 3], end[:3, 3] - self._bounds[:, 1])
        is_near = np.linalg.norm(apart.clip(0.0), axis=1) <= self._radius
        near = {obj.id: obj for obj, is_in in zip(self._obstacles, is_near, strict=True) if is_in}
        near.pop(target.id, None)
        objects = [*near.values()]
        shapes = shapes_of(self._env.store, objects, self._request.known)
        # what is near one target stays in memory for its neighbours
        self._request = self._request._replace(known={obj.id: shape for obj, shape in shapes})
        paths = (end @ _turns(self._angles))[:, None] @ self._poses
        met, hits, length = self._met(paths, objects), Counter[int](), 0.0
        found = [self._swept(poses, objects, met[:, n]) for n, poses in enumerate(paths)]
        for one in found:
            first = [(obj.id, 0.0) for obj in one.enclosed[:1]]
            first = first or [(place.object.id, place.fraction) for place in one.hits]
            hits.update(number for number, _ in first)
            length += one.path.length * (first[0][1] if first else 1.0)
        is_free = np.array([one.is_free for one in found])
        n_free, verdict = int(is_free.sum()), PathVerdict.NOT_REACHABLE
        if n_free or any(one.verdict is PathVerdict.NOT_DECIDED for one in found):
            verdict = PathVerdict.REACHABLE if n_free else PathVerdict.NOT_DECIDED
        # rounded beyond the tolerance of hits: equal ends stay equal
        rank = n_free, verdict is PathVerdict.NOT_DECIDED, round(length, 3)
        gaps = (0.0 if one.touching else one.gap.at_least for one in found if one.is_free)
        return rank, TargetReach(
            target, verdict, n_free, len(found), _runs(self._angles, is_free),
            max(gaps, default=None),
            tuple(near[number] for number, _ in hits.most_common()), end @ self._poses[1],
        )  # fmt: skip

    def _met(self, paths: Floats, objects: list[Object]) -> NDArray[np.bool_]:
        """Whether objects (O, n, M) are met at the poses of paths (n, M, 4, 4)."""
        poses, known = paths.reshape(-1, 4, 4), self._request.known or {}
        bounds = np.array([obj.bounds for obj in objects]).reshape(-1, 2, 3)
        met = self._tool.box_gaps(bounds, poses) <= MEETING
        for obj, is_met in zip(objects, met, strict=True):
            if time.monotonic() > self._request.until:  # it orders the sweeps, no more
                is_met[:] = False
            limits = np.full(is_met.sum(), 2.0 * MEETING)
            near = self._tool.nearest(known[obj.id].tree, poses[is_met], limits, MEETING)
            is_met[is_met] = near.at_most <= MEETING
        return met.reshape(len(objects), *paths.shape[:2])

    def _swept(self, poses: Floats, objects: list[Object], met: NDArray[np.bool_]) -> Swept:
        """Sweep along poses, first of short paths to what is met (O, M) at them."""
        paths = [(poses[:1], [objects[n]]) for n in np.flatnonzero(met[:, 0])]
        paths += [(poses[: n + 2], objects) for n in np.flatnonzero(met[:, 1:].any(axis=0))[:1]]
        for some, near in [*paths, (poses, objects)]:
            path = ToolPath.of(some, self._tool.corners, self._center)
            found = PathSweep(self._env, path, [Mover(self._tool, path)], self._request).swept(near)
            if found.verdict is PathVerdict.HITS:
                break
        return found


def _runs(angles: Floats, is_free: NDArray[np.bool_]) -> str:
    """First and last angle of each run of free placements, in words."""
    begins, ends = (np.flatnonzero(is_free & ~np.roll(is_free, shift)) for shift in (1, -1))
    if len(ends) and ends[0] < begins[0]:  # the last run passes 360 degrees
        ends = np.roll(ends, -1)
    pairs = zip(angles[begins].tolist(), angles[ends].tolist(), strict=True)
    runs = (f"{low:g}" if low == high else f"{low:g} to {high:g}" for low, high in pairs)
    return "all" if is_free.all() else "; ".join(runs)

"""Sweep: moves a tool along a path; its first collisions, or its least distance, proved.

Broad phase: the objects' boxes, never too few of them. Narrow phase: their surfaces.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.environment import Environment
from hapticdb.errors import ConnectionLostError, UsageError
from hapticdb.exact.contact import Contact
from hapticdb.exact.distance import Least, OverTimeError, Pair, box_gaps, error_of
from hapticdb.exact.gap_curve import gap_curve
from hapticdb.exact.movers import LinkPair, Mover, SweepRequest, shapes_of
from hapticdb.exact.path import SampledPath, ToolPath
from hapticdb.exact.separation import CONTACT, SAME, Separation
from hapticdb.exact.swept import Gap, PathPlace, Swept, TouchedObject
from hapticdb.kernels.triangles.path_distance import MEETING
from hapticdb.pointshell.shape import CollisionShape
from hapticdb.pointshell.shell import PointShell
from hapticdb.pointshell.tool_surface import ToolSurface
from hapticdb.store.base import Object, Progress
from hapticdb.store.finding import Words

FIRST_SHARE, LATER = 1 / 64, 4.0
"""First share of the path for contacts, and the factor of each later share."""
BEYOND = 4.0
"""Chord errors beyond a collision for the proof of an overlap of the true surfaces."""

Floats = NDArray[np.float64]
T = TypeVar("T")


def sweep(
    env: Environment,
    shell: PointShell,
    poses: ArrayLike,
    *,
    where: Words = (),
    exclude: Words = (),
    contact: float = CONTACT, overlap: float = 0.0, seated: bool = False,
    about: ArrayLike | None = None,
    limit: float | None = None, seconds: float | None = None,
    until_hit: bool = False, cloud_radius: float = 0.0, within: float | None = None,
    progress: Progress | None = None,
) -> Swept:  # fmt: skip
    """Move a tool along a path: its hits with their places, or its least distance.

    Parameters
    ----------
    env : Environment
        With the surfaces of its objects. The sweep reads one revision of it.
    shell : PointShell
        The tool. Its surface is what moves; its points do not matter.
    poses : (M, 4, 4) array
        `world_from_tool`, rigid, metres; at least one. Motion between two: as for `ToolPath`, so a
        turn takes the short way: give a pose between where it is half a turn or more.
    where, exclude : iterable of int or str
        What can be met: the objects that `where` chooses, all if it is empty, without those of
        `exclude`. A part that is taken out must not hit itself. Words as for `Environment.find`.
    contact : float
        Metres. Objects so near at the first pose may touch, as `Contact` says, until they are
        farther apart.
    overlap : float
        Metres by which a seated tool may overlap at the first pose, if that is more than `contact`.
    seated : bool
        Whether the tool is a part at its place: what it overlaps there by more is no hit.
    about : (3,) array or None
        The tool's point that moves straight and that turns are about, tool frame, metres; the
        middle of the tool's box unless given.
    limit, seconds : float or None
        Greatest distance that is told, metres; time after which the sweep ends undecided.
    until_hit : bool
        End at the first hit.
    cloud_radius, within : float
        Radius of the points of clouds, metres: with 0, nothing is between two of them; greatest
        distance of the curve `gaps`, which is made if it is given.
    progress : callable or None
        Called with the number of objects decided, and of all near the path.

    Raises
    ------
    UsageError
        If a pose is not rigid, a number is out of range, a turn is of 180 degrees, or the tool has
        no surface.
    ObjectNotFoundError
        If a word chooses no object; if an object's surface is not in the database.
    """
    request = SweepRequest(contact, overlap, seated, until_hit, progress, cloud_radius, within)
    request = request.begun(limit, seconds)
    tool = ToolSurface(shell)
    path = ToolPath.of(poses, tool.corners, center_of(tool, about)).checked()
    return swept_along(env, path, [Mover(tool, path)], request, where, exclude)


def swept_along(
    env: Environment, path: SampledPath, movers: Sequence[Mover], request: SweepRequest,
    where: Words, exclude: Words, pairs: Sequence[LinkPair] = (),
) -> Swept:  # fmt: skip
    """Sweep rigid bodies, and pairs of them, along one path."""
    return in_snapshot(
        env,
        lambda: PathSweep(env, path, movers, request).swept(env.select(where, exclude), pairs),
    )


def in_snapshot(env: Environment, answer: Callable[[], T]) -> T:
    """Answer in one snapshot; once more from the start if the connection is lost."""
    with suppress(ConnectionLostError), env.store.snapshot():
        return answer()
    with env.store.snapshot():  # the new connection has another one
        return answer()


def center_of(tool: ToolSurface, about: ArrayLike | None) -> Floats:
    """Centre (3,) of turns: as given, or the middle of the tool's box."""
    if about is None:
        return np.asarray(0.5 * (tool.corners.min(axis=0) + tool.corners.max(axis=0)))
    center = np.asarray(about, dtype=np.float64)
    if center.shape != (3,) or not np.isfinite(center).all():
        raise UsageError(f"a centre of turns {about}: give three lengths, metres")
    return center


class _Touched(NamedTuple):
    """A contact from the start; gap : of the surfaces there, from below, metres."""

    mover: Mover
    object: Object
    pair: Pair
    shape: CollisionShape
    gap: float
    found: Contact


class PathSweep:
    """State of one sweep."""

    def __init__(
        self, env: Environment, path: SampledPath, movers: Sequence[Mover], request: SweepRequest
    ) -> None:
        self._env, self._movers = env, movers
        self._path, self._request = path, request
        self._n_queries = 0
        self._best = request.limit
        self._closed = request.limit  # proved where nothing nearer was looked for
        self._nearest: PathPlace | None = None
        self._hits: list[PathPlace] = []
        self._contacts: list[_Touched] = []
        self._enclosed: list[Object] = []
        self._undecided: list[Object] = []
        self._leaky: list[Object] = []
        self._clouds: list[Object] = []
        self._error = 0.0  # chord errors where the gap was measured

    def swept(self, objects: list[Object], pairs: Sequence[LinkPair] = ()) -> Swept:
        """Sweep among objects, in the present snapshot."""
        began, is_stopped = time.monotonic(), False
        revision = self._env.store.revision()
        try:
            # links first: their gaps bound the search among the objects, and read no database
            for least, mover, obj, shape in pairs:
                has_hit = bool(self._hits or self._enclosed)
                if least < (self._wanted() if has_hit else self._best):
                    self._measure_object(mover(), obj, shape, is_inside=True)
            near = self._decide(objects)
            self._follow()
        except OverTimeError:
            near, is_stopped = len(objects), True
        gaps = gap_curve(self._env.store, self._path, self._movers, objects, pairs, self._request)
        # objects are decided by distance of boxes, not in the order of the path
        hits = tuple(sorted(self._hits, key=lambda place: place.fraction))
        hits = hits[:1] if self._request.until_hit else hits
        at_least = max(min(self._closed, self._best - self._error), 0.0)
        gap = Gap(at_least, self._best, self._nearest, self._error)
        if hits or self._enclosed:
            gap = Gap(0.0, 0.0, hits[0] if hits else None)
        elif is_stopped:
            gap = gap._replace(at_least=0.0)
        return Swept(
            path=self._path, gap=gap, hits=hits, touching=tuple(map(self._touched, self._contacts)),
            enclosed=tuple(self._enclosed), undecided=tuple(self._undecided),
            leaky=tuple(self._leaky),
            contact=self._request.contact, overlap=self._request.overlap, objects=near,
            queries=self._n_queries + sum(one.pair.queries for one in self._contacts),
            revision=revision, elapsed=time.monotonic() - began,
            is_stopped=is_stopped, clouds=tuple(self._clouds),
            cloud_radius=self._request.cloud_radius, gaps=gaps,
        )  # fmt: skip

    def _decide(self, objects: list[Object]) -> int:
        """Decide about objects, the nearest boxes first; returns their number."""
        if time.monotonic() > self._request.until:
            raise OverTimeError
        least_gaps, is_inside = self._box_gaps(objects)
        nearest = least_gaps.min(axis=0, initial=np.inf)
        # best first: a small gap soon bounds all others; stable, so results repeat
        order = np.argsort(nearest, kind="stable").tolist()
        n_near = int((nearest < self._request.limit).sum())
        ordered, known = [objects[i] for i in order], self._request.known
        shapes = shapes_of(self._env.store, ordered, known)
        for n, i in enumerate(order):
            least = float(nearest[i])
            if least >= self._wanted():
                self._closed = min(self._closed, least)
                return n
            obj, shape = next(shapes)
            if shape.is_cloud:
                self._clouds.append(obj)
            for n_mover, mover in enumerate(self._movers):
                least = float(least_gaps[n_mover, i])
                if least >= self._wanted():
                    self._closed = min(self._closed, least)
                elif self._is_near(mover, obj):
                    self._measure_object(mover, obj, shape, is_inside=bool(is_inside[n_mover, i]))
            if self._request.progress is not None:
                self._request.progress(n + 1, n_near)
        return len(objects)

    def _box_gaps(self, objects: list[Object]) -> tuple[Floats, NDArray[np.bool_]]:
        """Least distances (L, O) of each mover's box, and whether it meets them at the start."""
        radius = self._request.cloud_radius
        found = [box_gaps(one.tool.grown(radius), one.path, objects)[1] for one in self._movers]
        return (
            np.array([gaps.min(axis=1, initial=np.inf) for gaps in found]),
            np.array([gaps[:, 0] <= 0.0 for gaps in found]),
        )

    def _is_near(self, mover: Mover, obj: Object) -> bool:
        """Whether the boxes come near each other before the path's end of interest."""
        if self._end >= self._path.length:
            return True
        # the path ends at the first hit: boxes that meet later do not matter
        tool = mover.tool.grown(self._request.cloud_radius)
        edges, gaps = box_gaps(tool, mover.path, [obj])
        return bool(gaps[0, edges[:-1] <= mover.own(self._end)].min() < self._wanted())

    @property
    def _end(self) -> float:
        """Last path parameter of interest."""
        if not (self._request.until_hit and (self._hits or self._enclosed)):
            return self._path.length
        first = min((place.fraction for place in self._hits), default=0.0)
        return 0.0 if self._enclosed else first * self._path.length

    def _wanted(self) -> float:
        """Greatest distance with an effect on the result."""
        if self._hits or self._enclosed:
            # with a hit the gap is 0: only further hits have an effect
            return 2.0 * MEETING
        # less by the tolerance: a nearer one within it would not change the answer
        return self._best - error_of(self._best) if np.isfinite(self._best) else np.inf

    def _measure_object(
        self, mover: Mover, obj: Object, shape: CollisionShape, *, is_inside: bool
    ) -> None:
        """Decide about one object; is_inside : whether its box meets the mover's at the start.

        A contact is only followed a little at first: most hits are there.
        """
        tool, path = mover.tool, mover.path
        error = shape.chord + tool.chord
        pair = Pair(
            shape.tree, mover.against(shape, self._request.cloud_radius), path,
            self._request.until, mover.own(self._end), error,
            None if mover.parameters is None else obj.bounds,
        )  # fmt: skip
        contact, pose = self._request.contact, path.at([0.0])[0]
        gap = pair.measure(np.zeros(1), np.array([2.0 * contact]))
        apart = float(gap.at_least[0])
        is_touched = gap.at_most[0] <= contact
        # at a gap of 0 no side is decided; the separating motions do that
        separation = Separation(shape, tool)
        may_be_nested = (is_inside or is_touched) and apart > SAME
        is_nested = may_be_nested and separation.is_nested(pose)
        if may_be_nested and not is_nested and separation.is_nested(pose, is_leaky=True):
            self._leaky.append(obj)
        if is_nested:
            (self._enclosed if apart > error else self._undecided).append(obj)
            if mover.body and apart > error:
                at = pair.nearest_at(pose)
                self._hits.append(self._place(mover, obj, 0.0, at.on_b[0], at.on_a[0]))
        elif is_touched and not shape.is_cloud:
            self._touch(mover, obj, pair, shape, apart)
            return
        self._measure(mover, obj, pair, shape, 0.0)
        self._n_queries += pair.queries

    def _touch(
        self, mover: Mover, obj: Object, pair: Pair, shape: CollisionShape, gap: float
    ) -> None:
        """Begin a contact; gap : of the surfaces at the start of the path."""
        is_fine = pair.error < self._request.contact
        # positive: free is free for the true surfaces, too; negative: a hit is a hit of them
        found = self._contact(pair, shape, gap, pair.error if is_fine else -pair.error)
        if not is_fine:
            self._undecided.append(obj)
        if gap <= SAME and found.is_leaky():
            self._leaky.append(obj)
        self._contacts.append(_Touched(mover, obj, pair, shape, gap, found))
        if found.is_hit:
            self._note_hit(len(self._contacts) - 1)
        self._advance(len(self._contacts) - 1, FIRST_SHARE * self._path.length)

    def _contact(self, pair: Pair, shape: CollisionShape, gap: float, error: float) -> Contact:
        request = self._request
        return Contact(pair, shape, request.contact, gap, seated=request.seated, error=error)

    def _follow(self) -> None:
        """Follow all contacts in the order of the path, then each object from its parting on."""
        share = FIRST_SHARE
        while share < 1.0:
            # growing shares of the path: an early hit of one ends the others with `until_hit`
            share = min(LATER * share, 1.0)
            for n in range(len(self._contacts)):
                self._advance(n, share * self._path.length)
        for mover, obj, pair, shape, _, found in self._contacts:
            if found.is_apart and found.parameter < mover.own(self._end):
                self._measure(mover, obj, pair, shape, found.parameter)

    def _advance(self, n: int, end: float) -> None:
        """Follow the n-th contact to a path parameter, and note a hit."""
        mover, found = self._contacts[n].mover, self._contacts[n].found
        if not found.is_over:
            found.advance(mover.own(min(end, self._end)))
            if found.is_hit:
                self._note_hit(n)

    def _note_hit(self, n: int) -> None:
        """Note the hit at the end of the n-th contact, unless it is within the chord error."""
        mover, obj, pair, shape, gap, found = self._contacts[n]
        if found.error > 0.0:
            # again with the opposite sign: only a hit under both is one of the true surfaces
            found = self._contact(pair, shape, gap, -found.error)
            found.advance(mover.own(self._end))
            self._contacts[n] = self._contacts[n]._replace(found=found)
            if not found.is_hit:
                self._undecided.append(obj)
                return
        depth, place = found.depth()
        if not depth:
            place = pair.nearest_at(pair.path.at([found.parameter])[0]).on_a[0]
        self._hits.append(self._place(mover, obj, found.parameter, place, place, depth))

    def _touched(self, one: _Touched) -> TouchedObject:
        found = one.found
        is_open = not found.is_over and found.parameter >= one.pair.path.length
        until = 1.0 if is_open else self._path.fraction(one.mover.given(found.parameter))
        return TouchedObject(
            one.object, found.start, found.start_at_least, found.reach, until, found.by,
            found.is_sliding, one.mover.body,
        )  # fmt: skip

    def _measure(
        self, mover: Mover, obj: Object, pair: Pair, shape: CollisionShape, begin: float
    ) -> None:
        """Find the first collision with an object from a path parameter on, or the least distance.

        A former contact begins near, so it has no part in the gap.
        """
        # not counted: only a collision is of interest, so the bound below is short
        is_counted = not (begin or self._hits or self._enclosed)
        best = self._best if is_counted else 2.0 * MEETING + pair.error
        least, closed = pair.least(begin, best)
        if is_counted:
            self._closed = min(self._closed, closed - pair.error)
        if least is None:
            return
        if shape.is_cloud and least.at_most > MEETING:
            # measured from the points to a tool grown by the radius of their balls
            share = self._request.cloud_radius / least.at_most
            back = share * (least.on_tool - least.on_object)
            least = least._replace(on_tool=least.on_tool + back, on_object=least.on_object + back)
        # meshes meet within their chord errors: the true surfaces may pass one another
        if pair.error and least.at_most <= pair.error and not self._collides(pair, shape, least):
            self._undecided.append(obj)
        elif least.at_most <= MEETING:
            self._hits.append(
                self._place(mover, obj, least.parameter, least.on_tool, least.on_object)
            )
        elif is_counted:
            self._best, self._error = least.at_most, pair.error
            self._nearest = self._place(mover, obj, least.parameter, least.on_tool, least.on_object)

    def _collides(self, pair: Pair, shape: CollisionShape, least: Least) -> bool:
        """Whether the true surfaces collide: an overlap beyond the chord errors soon after."""
        parameter = min(least.parameter + BEYOND * pair.error, pair.path.length)
        if shape.is_cloud and pair.tool.radius > pair.error:
            near = pair.tool.grown(-pair.error).nearest(
                shape.tree, pair.path.at([parameter]), np.array([pair.error])
            )
            return bool(near.at_most[0] <= 0.0)
        found = Separation(shape, pair.tool, pair.check_time)
        return found.depth(pair.path.at([parameter])[0], pair.error)[0] > 0.0

    def _place(
        self, mover: Mover, obj: Object, parameter: float, on_tool: Floats, on_object: Floats,
        depth: float = 0.0,
    ) -> PathPlace:  # fmt: skip
        given, pose = mover.given(parameter), mover.path.at([parameter])[0]
        segment = int(self._path.segments(np.array([given]))[0])
        # measured in the other link's frame; places are told in the world's
        if mover.frame is not None:
            frame = mover.frame(given)
            pose = frame @ pose
            on_tool, on_object = (frame[:3, :3] @ at + frame[:3, 3] for at in (on_tool, on_object))
        return PathPlace(
            obj, self._path.fraction(given), segment, pose, on_tool, on_object, depth, mover.body
        )

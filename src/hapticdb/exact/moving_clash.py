"""Clashes of moving parts: the intervals of a motion in collision with each object.

Free intervals are proved by the search of sweeps. Within a meeting, samples a step apart bound its
end, and a few poses its depth.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.environment import Environment
from hapticdb.errors import UsageError
from hapticdb.exact.clash import classify_pair
from hapticdb.exact.distance import Pair, box_gaps
from hapticdb.exact.movers import shapes_of
from hapticdb.exact.path import ToolPath
from hapticdb.exact.separation import CONTACT
from hapticdb.exact.sweep import center_of
from hapticdb.kernels.triangles.path_distance import MEETING
from hapticdb.pointshell.shape import CollisionShape
from hapticdb.pointshell.tool_surface import ToolSurface
from hapticdb.poses import rotation_of
from hapticdb.store.base import Progress
from hapticdb.store.finding import Words
from hapticdb.verdicts import Kind

Floats = NDArray[np.float64]

STEP, MOST_STEPS = 1.5, 4096
"""Contact tolerances between two samples of a meeting, or the motion's share if more. Longer: a
parting between two samples is missed."""
HALVINGS = 12
"""Halvings of a step for the end of a meeting."""
POSES = 9
"""Poses of a meeting for its depth."""
MOST_TURN, TURN_STEP = 360.0, 30.0
"""Degrees of a whole turn, and from one of its poses to the next: less than half of it."""


class Meeting(NamedTuple):
    """An interval of a motion in collision with an object.

    id, name : of the object; begin, end : numbers of poses, with the share of the path to the next
    one; kind, at_least : the gravest at `POSES` poses of it, as of a pair; place : x, y, z, world
    frame, metres.
    """

    id: int
    name: str
    begin: float
    end: float
    kind: Kind
    at_least: float
    place: tuple[float, ...]


def find_meetings(
    env: Environment,
    of: Words,
    poses: ArrayLike,
    *,
    about: ArrayLike | None = None,
    against: Words = (),
    contact: float = CONTACT,
    progress: Progress | None = None,
) -> list[Meeting]:
    """Find when parts that move together meet other objects, in the order of the motion.

    Parameters
    ----------
    env : Environment
        With the surfaces of its objects.
    of, against : iterable of int or str
        Moving objects; the others: all other objects unless given.
    poses : (M, 4, 4) array
        Displacements of the parts from their places, rigid, world frame, metres.
    about : (3,) array or None
        The centre of turns, in straight motion, world frame; the middle of the parts' box unless
        given.
    contact : float
        Metres: the distance of the surfaces at the end of a meeting.
    progress : callable or None
        Called with the number of objects decided, and of all near the motion.
    """
    if not 0.0 < contact < np.inf:
        raise UsageError(f"contact {contact} m: give a length above 0")
    with env.store.snapshot():
        tool = ToolSurface(env.shell(*of, points=1, inset=0.0))
        path = ToolPath.of(poses, tool.corners, center_of(tool, about)).checked()
        objects = env.select(against, of)
        gaps = box_gaps(tool, path, objects)[1].min(axis=1, initial=np.inf)
        near = [objects[i] for i in np.flatnonzero(gaps <= MEETING)]
        found: list[Meeting] = []
        for n, (obj, still) in enumerate(shapes_of(env.store, near)):
            for parameters in _intervals(Pair(still.tree, tool, path), contact):
                kind, depth, place = _gravest(
                    still, tool, path.at(np.linspace(*parameters, POSES)), contact
                )
                found.append(
                    Meeting(obj.id, obj.name, *_numbers(path, parameters), kind, depth, place)
                )
            if progress is not None:
                progress(n + 1, len(near))
    return sorted(found, key=lambda one: (one.begin, one.end, one.id))


def hinge(axis: int, about: ArrayLike, begin: float, end: float) -> Floats:
    """Displacements (M, 4, 4) of a turn about a world axis through a point (3,), in equal steps.

    begin, end : degrees, by the right-hand rule; UsageError if they are equal, or more than
    `MOST_TURN` apart.
    """
    if not 0.0 < abs(end - begin) <= MOST_TURN:
        raise UsageError(
            f"a turn from {begin:g} to {end:g} degrees: give two that differ, up to 360"
        )
    angles = np.radians(np.linspace(begin, end, 1 + int(np.ceil(abs(end - begin) / TURN_STEP))))
    quaternions = np.zeros((len(angles), 4))
    quaternions[:, 0], quaternions[:, 1 + axis] = np.cos(0.5 * angles), np.sin(0.5 * angles)
    poses = np.tile(np.eye(4), (len(angles), 1, 1))
    poses[:, :3, :3] = rotation_of(quaternions)
    poses[:, :3, 3] = np.asarray(about) - poses[:, :3, :3] @ np.asarray(about)
    return poses


def _intervals(pair: Pair, contact: float) -> Iterator[tuple[float, float]]:
    """Path parameters of the begins and ends of meetings."""
    end = 0.0
    while True:
        # any bound above MEETING finds a collision; a larger one searches more
        first = pair.least(end, 2.0 * MEETING)[0]
        if first is None or first.at_most > MEETING:
            return
        end = _parted(pair, first.parameter, contact)
        # a collision at the start is found a little after it
        yield first.parameter if first.parameter > MEETING else 0.0, end
        if end >= pair.path.length:
            return


def _parted(pair: Pair, parameter: float, contact: float) -> float:
    """Path parameter of the parting by more than `contact` after a meeting, or the last one."""
    length = pair.path.length
    step = max(STEP * contact, length / MOST_STEPS)
    # blocks of samples in one call, then bisection within one step
    for start in np.arange(parameter, length, 64 * step):
        parameters = np.minimum(start + step * np.arange(1, 65), length)
        is_free = _gaps(pair, parameters, contact) > contact
        if is_free.any():
            high = float(parameters[int(np.argmax(is_free))])
            low = max(high - step, parameter)
            for _ in range(HALVINGS):
                middle = 0.5 * (low + high)
                is_apart = _gaps(pair, np.array([middle]), contact)[0] > contact
                low, high = (low, middle) if is_apart else (middle, high)
            # the upper end: there they are apart for certain
            return high
    return length


def _gaps(pair: Pair, parameters: Floats, contact: float) -> Floats:
    return pair.measure(parameters, np.full(len(parameters), 2.0 * contact)).at_least


def _gravest(
    still: CollisionShape, moved: CollisionShape, poses: Floats, contact: float
) -> tuple[Kind, float, tuple[float, ...]]:
    """The gravest kind of a pair at poses, its depth, and its place."""
    classified = [classify_pair(still, moved, pose, 2.0 * contact, contact) for pose in poses]
    # poses near the ends may be apart already: they are no kind of the meeting
    grave = [one for one in classified if one.kind.gravity <= Kind.TOUCHING.gravity] or classified
    worst = min(grave, key=lambda one: (one.kind.gravity, -one.at_least))
    kind = Kind.TOUCHING if worst.kind.is_free else worst.kind
    depth = worst.at_least if kind == Kind.OVERLAPPING else 0.0
    return kind, depth, tuple(worst.on_a.tolist())


def _numbers(path: ToolPath, parameters: tuple[float, float]) -> tuple[float, float]:
    """Numbers of poses at path parameters, with the share of the path to the next one."""
    begin, end = np.interp(parameters, path.parameters, np.arange(len(path.parameters))).tolist()
    return begin, end

"""Bounds on how deep a tool goes into objects that it touches at its start, along its path.

Two depths are bounded: that of the tool's surface inside the object, and that of the object's
surface inside the tool. A depth changes by at most the way between two places (it is
1-Lipschitz), so the depth of any place of a piece is at most that of its middle and its radius, and
between two samples at most half a step more. So a piece is looked at again only when it may have
become the deepest one.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import HapticDBError
from hapticdb.ingest.originals import found_parts
from hapticdb.mesh import Part
from hapticdb.pointshell.orientation import Surface, orient
from hapticdb.pointshell.shell import PointShell
from hapticdb.store.base import Object
from hapticdb.sweeps.path import SweepPath
from hapticdb.sweeps.pieces import Cut, cut
from hapticdb.sweeps.result import STRETCH, ContactDepth, Swept
from hapticdb.sweeps.solid import Solid

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

COARSE, FINE = 1.0, 0.2
"""Voxels: radii of the pieces of which first those are found that may get inside, and of the pieces
of these. Smaller: closer bounds, more time."""
ALLOWED = 0.5
"""Voxels: default of the depth by which a tool may go deeper than at its start. Smaller: less is
proved, since the bounds themselves are almost so wide."""
EASE = 0.02
"""Voxels: depths below are not told from 0. Larger: what slides along a surface is bounded sooner,
since it is not asked on which side it is."""
MOST_FINE = 400_000
"""Greatest number of fine pieces. Larger: larger contacts are bounded, with more memory."""
MOST_LOOKS = 3_000_000
"""Greatest number of places that are measured along one path. Larger: longer contacts are bounded,
which takes minutes."""
MOST_AT_START = 300_000
"""The same for the start alone, which mostly tells that a path cannot be bounded."""

Placing = Callable[[Floats, int], Floats]
"""Places (n, 3) of one surface in the frame of the other one, at a sample."""


class _TooMuchError(Exception):
    """The search would take too long."""


class _Greatest(NamedTuple):
    """Greatest depths of the middles of pieces along a path, metres.

    start, most : bounds from below and above, at the first sample and at any (where it is not told
    from 0, the bound from above is that of `EASE`); sample : where the depth is greatest.
    """

    start: tuple[float, float]
    most: tuple[float, float]
    sample: int


def with_depths(found: Swept, shell: PointShell, tolerance: float | None) -> Swept:
    """Add how deep the tool goes into what a sweep left out; tolerance : metres, or the default."""
    size = found.voxel_size
    depths = depths_along(
        shell, found.path, found.left_at_start, voxel_size=size,
        allowed=ALLOWED * size if tolerance is None else tolerance,
    )  # fmt: skip
    return replace(found, depths=depths)


def depths_along(
    shell: PointShell,
    path: SweepPath,
    objects: Sequence[Object],
    *,
    voxel_size: float,
    allowed: float,
    last: int | None = None,
) -> tuple[ContactDepth, ...]:
    """Bound how deep a tool and each of some objects go into one another along a path.

    Parameters
    ----------
    shell : PointShell
        The tool, with its triangles.
    path : SweepPath
        Its path.
    objects : sequence of Object
        Their geometry is read from their files.
    voxel_size, allowed : float
        Metres; depths may grow by `allowed` without counting as a cut.
    last : int or None
        The last sample that is looked at; all unless given.
    """
    if not objects:
        return ()
    if not isinstance(shell.surface, Surface):
        return tuple(_unknown(obj, allowed, "the tool has no triangles") for obj in objects)
    tool = Solid(shell.surface, COARSE * voxel_size)
    end = len(path) if last is None else min(last + 1, len(path))
    poses = path.sample(0, end)
    travels = path.travels(0, end) * voxel_size
    search = DepthSearch(path, poses, travels, voxel_size, allowed)
    found: dict[int, ContactDepth] = {}
    solids: dict[int, Solid] = {}
    for obj, surface in _surfaces(objects):
        if isinstance(surface, str):
            found[obj.id] = _unknown(obj, allowed, surface)
            continue
        solids[obj.id] = Solid(surface, COARSE * voxel_size)
        found[obj.id] = search.depth(obj, tool, solids[obj.id], 1)
    # mostly the start tells already that not all of them can be bounded
    if any(one.why for one in found.values()):
        why = "not followed, since that in another object is not known at the start"
        return tuple(found[obj.id]._replace(why=found[obj.id].why or why) for obj in objects)
    return tuple(search.depth(obj, tool, solids[obj.id], end) for obj in objects)


def _surfaces(objects: Sequence[Object]) -> Iterable[tuple[Object, Surface | str]]:
    """Objects with their oriented surfaces, world frame, or with the reason why there is none."""
    for some, part in found_parts(objects, "looked into", "import it again"):
        for obj in some:
            if not isinstance(part, Part):
                yield obj, f"its geometry cannot be read: {part}"
            elif part.is_cloud:
                yield obj, "it is a point cloud"
            else:
                try:
                    yield obj, orient(part.triangles(obj.transform))
                except HapticDBError as error:
                    yield obj, str(error)


def _unknown(obj: Object, allowed: float, why: str) -> ContactDepth:
    return ContactDepth(obj, 0.0, np.inf, 0.0, np.inf, 0.0, allowed, why)


class DepthSearch:
    """Searches the greatest depths along one path."""

    def __init__(
        self, path: SweepPath, poses: Floats, travels: Floats, size: float, allowed: float
    ) -> None:
        self._path, self._poses, self._travels = path, poses, travels
        self._size, self._allowed = size, allowed
        self._slack = 2.0 * path.slack * size
        self._looks = 0
        self._most_looks = MOST_AT_START

    def depth(self, obj: Object, tool: Solid, other: Solid, samples: int) -> ContactDepth:
        """Bound the depths of a tool and an object in one another, at the first samples."""
        if not (tool.is_closed or other.is_closed):
            why = "neither its surface nor the tool's is closed, so nothing has an inside"
            return _unknown(obj, self._allowed, why)
        self._most_looks = MOST_AT_START if samples < len(self._travels) else MOST_LOOKS
        try:
            into, into_pieces = self._greatest(other, tool, self._to_world, samples)
            back, back_pieces = self._greatest(tool, other, self._to_tool, samples)
        except _TooMuchError:
            return _unknown(obj, self._allowed, "the contact is too large or too long to bound it")
        deeper = max(into, back, key=lambda one: one.most[0])
        more = (1.0 + STRETCH) * FINE * self._size
        most = max(into.most[1], back.most[1]) + more + (1.0 + STRETCH) * self._path.off
        found = ContactDepth(
            object=obj,
            at_start=max(0.0, into.start[0], back.start[0]),
            at_start_most=max(0.0, into.start[1] + more, back.start[1] + more),
            deepest=max(0.0, deeper.most[0]),
            deepest_most=max(0.0, most),
            fraction=float(self._path.fractions(deeper.sample)),
            allowed=self._allowed,
            why="",
        )
        if found.at_start_most > found.at_start + self._allowed:
            why = "its depth at the start is not known well enough"
            return found._replace(deepest_most=np.inf, why=why)
        if samples < len(self._travels):
            return found._replace(deepest_most=np.inf)
        if not found.is_bounded:
            return found
        # places that are never deeper may still pass through what is thinner than twice the depth
        depth = 2.0 * found.deepest_most
        if tool.is_thick(into_pieces, depth) or other.is_thick(back_pieces, depth):
            return found
        return found._replace(why="both are thinner there than twice the depth that is proved")

    def _greatest(
        self, solid: Solid, moving: Solid, to: Placing, samples: int
    ) -> tuple[_Greatest, Cut]:
        """Greatest depths of a surface inside a solid, and the pieces that may get inside.

        Only the first samples of the path are looked at.
        """
        coarse, travels = moving.pieces, self._travels[:samples].tolist()
        is_near = self._near(solid, coarse, to, travels)
        fine = cut(coarse.triangles[is_near], FINE * self._size, MOST_FINE)
        if fine is None:
            raise _TooMuchError
        fine = fine._replace(sources=coarse.sources[is_near][fine.sources])
        return self._looked(solid, fine.middles, to, travels), fine

    def _near(
        self, solid: Solid, pieces: Cut, to: Placing, travels: Sequence[float]
    ) -> NDArray[np.bool_]:
        """Whether pieces (P,) may get inside: they start inside, or come near the surface."""
        reach = (1.0 + STRETCH) * (float(pieces.radii.max()) + self._path.off)
        apart = np.zeros(len(pieces.middles))
        when = np.zeros(len(apart))
        is_near = np.zeros(len(apart), dtype=bool)
        for n, travel in enumerate(travels):
            active = np.flatnonzero(~is_near & (apart - (travel - when) - self._slack <= reach))
            if not len(active):
                continue
            places = to(pieces.middles[active], n)
            apart[active], when[active] = self._measured(solid, places, reach)[0], travel
            is_near[active] = apart[active] <= reach
            if n == 0:
                is_near[active] |= solid.holds(places)
        return is_near

    def _looked(
        self, solid: Solid, middles: Floats, to: Placing, travels: Sequence[float]
    ) -> _Greatest:
        """Measure the middles of pieces (P, 3), where they may be the deepest ones so far."""
        ease = EASE * self._size
        bound = np.full(len(middles), np.inf)
        when = np.zeros(len(middles))
        start, lowest = (-np.inf, -np.inf), -np.inf
        floor, sample = ease, 0
        for n, travel in enumerate(travels):
            active = np.flatnonzero(bound + (travel - when) + self._slack > floor)
            if not len(active):
                continue
            places = to(middles[active], n)
            least, farthest = self._measured(solid, places, floor)
            low, high = -farthest, farthest.copy()  # on whichever side, it is no deeper than that
            far = np.flatnonzero(farthest > floor)
            is_inside = solid.holds(places[far])
            high[far] = np.where(is_inside, farthest[far], -least[far])
            low[far] = np.where(is_inside, least[far], -farthest[far])
            bound[active], when[active] = high, travel
            highest = int(high.argmax())
            if high[highest] > floor:  # the deepest one so far: worth to be known exactly
                low[highest] = max(low[highest], solid.exact(places[highest]))
            here = float(low.max()), float(high.max())
            start = here if n == 0 else start
            sample = n if here[0] > lowest else sample
            lowest = max(lowest, here[0])
            floor = max(floor, here[1])  # what is not looked at is no deeper
        return _Greatest(start, (lowest, floor), sample)

    def _measured(self, solid: Solid, places: Floats, enough: float) -> tuple[Floats, Floats]:
        """Least and greatest distance (n,) of places (n, 3) from a surface; they are counted."""
        self._looks += len(places)
        if self._looks > self._most_looks:
            raise _TooMuchError
        return solid.distances(places, enough)

    def _to_world(self, places: Floats, n: int) -> Floats:
        """Places (n, 3) of the tool, in the world."""
        pose = self._poses[n]
        return np.asarray(places @ pose[:3, :3].T + pose[:3, 3])

    def _to_tool(self, places: Floats, n: int) -> Floats:
        """Places (n, 3) of the world, in the tool's frame."""
        pose = self._poses[n]
        return np.asarray((places - pose[:3, 3]) @ pose[:3, :3])

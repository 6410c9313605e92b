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
from hapticdb.sweeps.core import is_near_core
from hapticdb.sweeps.path import SweepPath
from hapticdb.sweeps.pieces import Cut, cut
from hapticdb.sweeps.result import STRETCH, ContactDepth, Swept
from hapticdb.sweeps.solid import Solid
from hapticdb.units import length_text

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
MOST_LOOKS = 6_000_000
"""Greatest number of places that are measured along one path. Larger: longer contacts are bounded,
which takes minutes."""
MOST_AT_START = 300_000
"""The same for the start alone, which mostly tells that a path cannot be bounded."""

PARTS = (1, 2)
"""Parts of a step at which depths are looked at, with pieces that are finer by as much: again where
the first ones do not decide. More: more is decided, in more time."""
MOST_BESIDE = 300_000
"""Greatest number of places that are measured for a cut into an object when it is clear that not
all depths can be bounded. Larger: more cuts are found, in more time."""

Placing = Callable[[Floats, Floats], Floats]
"""Places (n, 3) of one surface in the frame of the other one, at a pose."""


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
    search = DepthSearch(path, end, voxel_size, allowed)
    found: dict[int, ContactDepth] = {}
    solids: dict[int, Solid] = {}
    for obj, surface in _surfaces(objects):
        if isinstance(surface, str):
            found[obj.id] = _unknown(obj, allowed, surface)
            continue
        solids[obj.id] = Solid(surface, COARSE * voxel_size)
        found[obj.id] = search.at_start(obj, tool, solids[obj.id])
    # where one cannot be bounded, the others are followed for cuts, as far as that is cheap
    is_open = any(one.why for one in found.values())
    for obj in objects:
        start = found[obj.id]
        if np.isfinite(start.at_start_most):
            most = MOST_BESIDE if is_open else MOST_LOOKS
            later = search.along(obj, tool, solids[obj.id], most)
            is_known = np.isfinite(later.at_start_most)
            found[obj.id] = later if is_known else start._replace(why=start.why or later.why)
    return tuple(found[obj.id] for obj in objects)


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


def _too_thin(tool: Solid, other: Solid, depth: float) -> str:
    """Say that neither is proved to be thick."""
    if tool.is_closed and other.is_closed:
        who = "the tool and it are both"
    else:
        who = "it is" if other.is_closed else "the tool is"
        who = f"{'the tool' if other.is_closed else 'it'} is not closed, and {who}"
    return (
        f"{who} too thin or too sharp near the contact: one might pass through the other and never "
        f"be deeper than {length_text(depth)}"
    )


def _unknown(obj: Object, allowed: float, why: str) -> ContactDepth:
    return ContactDepth(obj, 0.0, np.inf, 0.0, np.inf, 0.0, allowed, why)


class _Steps(NamedTuple):
    """Poses along a path at which depths are looked at, and how closely.

    poses (n, 4, 4); travels (n,): bounds on any point's way until there, metres; places (n,): in
    samples; off : metres, from any time to the nearest of them; fine : metres, radius of pieces.
    """

    poses: Floats
    travels: Floats
    places: Floats
    off: float
    fine: float

    def first(self) -> "_Steps":
        """Only the start, for which nothing moves."""
        return self._replace(
            poses=self.poses[:1], travels=self.travels[:1], places=self.places[:1], off=0.0
        )


class DepthSearch:
    """Searches the greatest depths along one path.

    Parameters
    ----------
    path : SweepPath
        The path.
    end : int
        Number of its samples that are looked at.
    size, allowed : float
        Metres: voxel size, and by how much depths may grow.
    """

    def __init__(self, path: SweepPath, end: int, size: float, allowed: float) -> None:
        self._path, self._size, self._allowed = path, size, allowed
        self._slack = 2.0 * path.slack * size
        self._steps = [self._steps_of(end, parts) for parts in PARTS]
        self._looks = 0
        self._most_looks = MOST_AT_START

    def _steps_of(self, end: int, parts: int) -> _Steps:
        """Looks at the first samples, and between them."""
        places = np.arange((end - 1) * parts + 1) / parts
        spent, offs = self._path.reaches(places, np.full(len(places), 0.5 / parts))
        return _Steps(
            self._path.at(places), spent * self._size, places,
            float(offs.max(initial=0.0)) * self._size, FINE / parts * self._size,
        )  # fmt: skip

    def at_start(self, obj: Object, tool: Solid, other: Solid) -> ContactDepth:
        """Bound the depths of a tool and an object in one another at the path's first pose."""
        self._most_looks = self._looks + MOST_AT_START
        found = self._bounded(obj, tool, other, self._steps[0].first())[0]
        return found._replace(deepest_most=np.inf)

    def along(self, obj: Object, tool: Solid, other: Solid, most: int) -> ContactDepth:
        """Bound them along the path: closer where that may decide, in `most` looks at most."""
        self._most_looks = self._looks + most
        found = _unknown(obj, self._allowed, "")
        for steps in self._steps:
            before = found
            found, pieces = self._bounded(obj, tool, other, steps)
            if not pieces or found.is_cut:
                return found if np.isfinite(found.at_start_most) else before._replace(why=found.why)
            if found.is_bounded:
                # places that are never deeper may still pass through what is thin
                depth = found.deepest_most
                if any(map(is_near_core, (tool, other), pieces, (depth, depth))):
                    return found
                return found._replace(why=_too_thin(tool, other, depth))
            if found.deepest > found.at_start_most + self._allowed - steps.fine:
                return found  # closer looks would not bound it
        return found

    def _bounded(
        self, obj: Object, tool: Solid, other: Solid, steps: _Steps
    ) -> tuple[ContactDepth, tuple[Cut, ...]]:
        """Bound depths at some steps; also gives the pieces of both that may get inside."""
        if not (tool.is_closed or other.is_closed):
            why = "neither its surface nor the tool's is closed, so nothing has an inside"
            return _unknown(obj, self._allowed, why), ()
        try:
            into, into_pieces = self._greatest(other, tool, _to_world, steps)
            back, back_pieces = self._greatest(tool, other, _to_tool, steps)
        except _TooMuchError:
            why = "the contact is too large or too long to bound it"
            return _unknown(obj, self._allowed, why), ()
        deeper = max(into, back, key=lambda one: one.most[0])
        more = (1.0 + STRETCH) * steps.fine
        most = max(into.most[1], back.most[1]) + more + (1.0 + STRETCH) * steps.off
        found = ContactDepth(
            object=obj,
            at_start=max(0.0, into.start[0], back.start[0]),
            at_start_most=max(0.0, into.start[1] + more, back.start[1] + more),
            deepest=max(0.0, deeper.most[0]),
            deepest_most=max(0.0, most),
            fraction=float(self._path.fractions(steps.places[deeper.sample])),
            allowed=self._allowed,
            why="",
        )
        if found.at_start_most > found.at_start + self._allowed:
            why = "its depth at the start is not known well enough"
            return found._replace(deepest_most=np.inf, why=why), ()
        return found, (into_pieces, back_pieces)

    def _greatest(
        self, solid: Solid, moving: Solid, to: Placing, steps: _Steps
    ) -> tuple[_Greatest, Cut]:
        """Greatest depths of a surface inside a solid, and the pieces that may get inside."""
        coarse = moving.pieces
        is_near = self._near(solid, coarse, to, steps)
        fine = cut(coarse.triangles[is_near], steps.fine, MOST_FINE)
        if fine is None:
            raise _TooMuchError
        off = np.where(moving.is_sure[is_near][fine.sources], moving.unsure, np.inf)
        fine = fine._replace(sources=coarse.sources[is_near][fine.sources])
        return self._looked(solid, fine.middles, off, to, steps), fine

    def _near(self, solid: Solid, pieces: Cut, to: Placing, steps: _Steps) -> NDArray[np.bool_]:
        """Whether pieces (P,) may get inside: they start inside, or come near the surface."""
        reach = (1.0 + STRETCH) * (float(pieces.radii.max()) + steps.off)
        apart = np.zeros(len(pieces.middles))
        when = np.zeros(len(apart))
        is_near = np.zeros(len(apart), dtype=bool)
        for n, travel in enumerate(steps.travels.tolist()):
            active = np.flatnonzero(~is_near & (apart - (travel - when) - self._slack <= reach))
            if not len(active):
                continue
            places = to(pieces.middles[active], steps.poses[n])
            self._count(len(active))
            apart[active], when[active] = solid.distances(places, reach), travel
            is_near[active] = apart[active] <= reach
            if n == 0:
                is_near[active] |= solid.holds(places)
        return is_near

    def _looked(
        self, solid: Solid, middles: Floats, off: Floats, to: Placing, steps: _Steps
    ) -> _Greatest:
        """Measure the middles of pieces (P, 3), where they may be the deepest ones so far.

        off (P,): distance of a middle from the border of its own solid; infinite: not known.
        """
        ease = EASE * self._size
        bound = np.full(len(middles), np.inf)
        when = np.zeros(len(middles))
        start, lowest = (-np.inf, -np.inf), -np.inf
        floor, sample = ease, 0
        for n, travel in enumerate(steps.travels.tolist()):
            active = np.flatnonzero(bound + (travel - when) + self._slack > floor)
            if not len(active):
                continue
            self._count(len(active))
            low, high = solid.depths(to(middles[active], steps.poses[n]), floor)
            bound[active], when[active] = high, travel
            here = float((low - off[active]).max()), float(high.max())
            start = here if n == 0 else start
            sample = n if here[0] > lowest else sample
            lowest = max(lowest, here[0])
            floor = max(floor, here[1])  # what is not looked at is no deeper
        return _Greatest(start, (lowest, floor), sample)

    def _count(self, looks: int) -> None:
        """Count places that are measured."""
        self._looks += looks
        if self._looks > self._most_looks:
            raise _TooMuchError


def _to_world(places: Floats, pose: Floats) -> Floats:
    """Places (n, 3) of the tool, in the world."""
    return np.asarray(places @ pose[:3, :3].T + pose[:3, 3])


def _to_tool(places: Floats, pose: Floats) -> Floats:
    """Places (n, 3) of the world, in the tool's frame."""
    return np.asarray((places - pose[:3, 3]) @ pose[:3, :3])

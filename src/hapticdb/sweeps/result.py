"""Results of a sweep, decided on surfaces: metres and fractions of the path."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.proportions import Proportions
from hapticdb.store.base import Object
from hapticdb.sweeps.way import Way
from hapticdb.units import length_text, notebook_html

Floats = NDArray[np.float64]

Verdict = Literal["clear", "slides", "hits", "not decided"]


class PathPlace(NamedTuple):
    """Where on the path an object is nearest, or is met.

    fraction : share of the path's motion before it, 0 .. 1; segment : index of the given pose where
    its segment starts, 0 .. M - 2; pose (4, 4) : `world_from_tool`; on_tool, on_object (3,) : the
    nearest places of the two surfaces, world frame; where the surfaces meet, both are near the
    meeting place.
    """

    object: Object
    fraction: float
    segment: int
    pose: Floats
    on_tool: Floats
    on_object: Floats


class Gap(NamedTuple):
    """Least distance of the tool's surface from any other on the whole path.

    at_least : proved; at_most : the distance at `place`, never farther above `at_least` than
    0.01 mm or 1 %; place : None if nothing is nearer than the limit, which both numbers are then.
    """

    at_least: float
    at_most: float
    place: PathPlace | None


class TouchedObject(NamedTuple):
    """An object within the contact tolerance of the tool where the path starts.

    start : how deep the surfaces overlap at the start; deepest : no deeper than this on the path
    while they touch: the deepest cut, or the motion that frees them if that is more; allowed : how
    deep they may; until : fraction of the path up to which they touch, 1 if
    they still do at its end; is_sliding : whether the tool moves on by more than the tolerance
    while they touch; cut : where they overlap by more than is allowed, or None.
    """

    object: Object
    start: float
    deepest: float
    allowed: float
    until: float
    is_sliding: bool
    cut: PathPlace | None


class Profile(NamedTuple):
    """The distance along the path: at fractions (W,), gaps (W,), the limit if nothing is nearer."""

    fractions: Floats
    gaps: Floats


@dataclass(frozen=True, eq=False)
class Swept:
    """Result of a sweep.

    Attributes
    ----------
    path : Way
        The poses given, and the motion between them: `path.at(fractions * path.length)` gives
        poses, and no place of the tool moves more than `path.length` metres.
    gap : Gap
        Of all objects that are not touched where the path starts; 0 if anything is hit.
    hits : tuple of PathPlace
        First place on the path where each object is hit, in that order: its surface is met (within
        0.01 mm), or, touched from the start, it is cut deeper than is allowed or met again.
    touching : tuple of TouchedObject
        Objects that the tool touches where the path starts.
    enclosed : tuple of Object
        Objects inside a closed body of the tool, or around the tool: they count as hit, since
        nothing leaves a closed body. Where the path starts.
    contact : float
        The contact tolerance, metres.
    objects : int
        Number of objects near the path, whose surfaces were looked at.
    looks : int
        How often two surfaces were measured.
    revision : int
        Revision of the database that was read.
    elapsed : float
        Seconds.
    proportions : Proportions
        Sizes and places of tool, path and scene; if there is a misfit, "clear" has no meaning.
    profile : Profile or None
        The distance along the path, if it was requested.
    is_stopped : bool
        Whether the time ended the sweep before all was decided.
    """

    path: Way
    gap: Gap
    hits: tuple[PathPlace, ...]
    touching: tuple[TouchedObject, ...]
    enclosed: tuple[Object, ...]
    contact: float
    objects: int
    looks: int
    revision: int
    elapsed: float
    proportions: Proportions
    profile: Profile | None = None
    is_stopped: bool = False

    def __repr__(self) -> str:
        met = [obj.name for obj in (*(place.object for place in self.hits), *self.enclosed)]
        found = f"by {', '.join(met[:3])}" if met else f"gap {length_text(self.gap.at_least)}"
        more = f" and {len(met) - 3} more" if len(met) > 3 else ""
        return f"Swept({self.verdict}, {found}{more}, {self.objects} objects, {self.elapsed:.2f} s)"

    def _repr_html_(self) -> str:
        """Table of what is hit, for notebooks."""
        rows = ((one.object.name, f"at {one.fraction:.2%} of the path") for one in self.hits)
        return notebook_html(self, rows)

    @property
    def verdict(self) -> Verdict:
        """What is proved: something is hit; the time was over; the tool slides; it is clear.

        It slides if it moves on in contact with what it touches at the start, and hits nothing.
        """
        if self.hits or self.enclosed:
            return "hits"
        if self.is_stopped:
            return "not decided"
        return "slides" if any(one.is_sliding for one in self.touching) else "clear"

    @property
    def is_free(self) -> bool:
        """Whether nothing is hit on the whole path: it is clear, or slides."""
        return self.verdict in {"clear", "slides"}

    @property
    def comes_out(self) -> bool:
        """Whether nothing is hit, and nothing is touched any more at the end of the path."""
        return self.is_free and all(one.until < 1.0 for one in self.touching)

"""Results of a sweep, decided on surfaces: metres and fractions of the path."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.exact.gap_curve import GapCurve
from hapticdb.exact.path import SampledPath
from hapticdb.store.base import Object
from hapticdb.tabular.schema import plain
from hapticdb.tabular.tables import Columns, Tabular, columns_of
from hapticdb.units import length_text, notebook_html
from hapticdb.verdicts import PathVerdict

Floats = NDArray[np.float64]

SWEPT_KEYS = (
    "what", "id", "name", "body", "fraction", "segment", "on_tool", "on_object", "at_least",
    "until", "start", "start_at_least", "reach", "by", "gap", "verdict",
)  # fmt: skip
"""Keys of a sweep's rows: an object hit, enclosed or touched at the start, and the nearest one;
`what` names the case, and cells without meaning in a case are empty."""


class PathPlace(NamedTuple):
    """Place on the path of the least distance from an object, or of the collision with it.

    fraction : share of the path's motion before it, 0 .. 1; segment : index of the given pose at
    the start of its segment, 0 .. M - 2; pose (4, 4) : `world_from_tool`; on_tool, on_object (3,) :
    the nearest places of the two surfaces, world frame; in a collision, both near its place, or the
    deepest; at_least : proved penetration depth shortly after it, metres, of a contact from the
    start; 0 without a proof; body : link of a machine, empty for a tool.
    """

    object: Object
    fraction: float
    segment: int
    pose: Floats
    on_tool: Floats
    on_object: Floats
    at_least: float = 0.0
    body: str = ""


class Gap(NamedTuple):
    """Least distance of the tool's surface from any other on the whole path.

    at_least : proved; at_most : the distance at `place`, never farther above `at_least` than
    0.01 mm or 1 %, but for chord errors; place : None if nothing is nearer than the limit, then
    equal to both numbers; error : chord errors of both surfaces there, deducted in `at_least`.
    """

    at_least: float
    at_most: float
    place: PathPlace | None
    error: float = 0.0


class TouchedObject(NamedTuple):
    """An object within the contact tolerance of the tool at the start of the path.

    start : overlap at the start, at most, metres: the least separating motion there, or the contact
    tolerance if enough; infinite without any; start_at_least : proved penetration depth there, or
    0; reach : greatest displacement by the motion with a free path; by : the kind of that motion;
    until : fraction of the path at the end of the contact, 1 at the end of the path; is_sliding :
    whether the tool moves on by more than the tolerance in contact; body : as of a place.
    """

    object: Object
    start: float
    start_at_least: float
    reach: float
    until: float
    by: str
    is_sliding: bool
    body: str = ""


@dataclass(frozen=True, eq=False)
class Swept(Tabular):
    """Result of a sweep.

    Attributes
    ----------
    path : SampledPath
        The poses given (of a machine: joint values), and the motion between them:
        `path.at(fractions * path.length)` gives poses, and no place of the tool moves more than
        `path.length` metres.
    gap : Gap
        Of all objects that are not touched where the path starts; 0 if anything is hit.
    hits : tuple of PathPlace
        First place on the path where each object is hit, in that order: its surface is met (within
        0.01 mm), or, touched from the start, no small motion frees it any more, or it is met again.
    touching : tuple of TouchedObject
        Objects that the tool touches where the path starts.
    enclosed : tuple of Object
        Objects inside a closed body of the tool, or around the tool: they count as hit, since
        nothing leaves a closed body. Where the path starts.
    undecided : tuple of Object
        Objects that are met or touched by no more than the chord error of their surfaces.
    leaky : tuple of Object
        Objects inside the tool, or around it where the path starts, of which one surface is not
        watertight, but leaves out less than 1 % of the directions.
    contact, overlap : float
        The contact tolerance, and the overlap that is allowed at the start; metres.
    objects : int
        Number of objects near the path, whose surfaces were looked at.
    queries : int
        How often two surfaces were measured.
    revision : int
        Revision of the database that was read.
    elapsed : float
        Seconds.
    is_stopped : bool
        Whether the time ended the sweep before all was decided.
    notes : tuple of str
        Of a machine: limits exceeded, pairs of links left out.
    clouds : tuple of Object
        Point clouds near the path.
    cloud_radius : float
        Radius of their points, metres.
    gaps : GapCurve or None
        The gap along the path, if `within` was given.
    """

    path: SampledPath
    gap: Gap
    hits: tuple[PathPlace, ...]
    touching: tuple[TouchedObject, ...]
    enclosed: tuple[Object, ...]
    undecided: tuple[Object, ...]
    leaky: tuple[Object, ...]
    contact: float
    overlap: float
    objects: int
    queries: int
    revision: int
    elapsed: float
    is_stopped: bool = False
    notes: tuple[str, ...] = ()
    clouds: tuple[Object, ...] = ()
    cloud_radius: float = 0.0
    gaps: GapCurve | None = None

    def __repr__(self) -> str:
        names = [obj.name for obj in (*(place.object for place in self.hits), *self.enclosed)]
        found = f"by {', '.join(names[:3])}" if names else f"gap {length_text(self.gap.at_least)}"
        more = f" and {len(names) - 3} more" if len(names) > 3 else ""
        return f"Swept({self.verdict}, {found}{more}, {self.objects} objects, {self.elapsed:.2f} s)"

    def records(self) -> Iterator[dict[str, Any]]:
        """Records of hits along the path, enclosed and touched objects, and the nearest one."""
        found: list[tuple[str, object, dict[str, Any]]] = [("hit", one, {}) for one in self.hits]
        found += [("enclosed", obj, {}) for obj in self.enclosed]
        found += [("touched", one, {}) for one in self.touching]
        if self.gap.place is not None and self.is_free:
            found.append(("nearest", self.gap.place, {"gap": self.gap.at_least, "at_least": None}))
        for what, one, more in found:
            yield {"what": what} | plain(one) | {"verdict": self.verdict} | more

    def columns(self) -> Columns:
        """A row for each object that is met, and for the nearest one."""
        return columns_of(SWEPT_KEYS, self.records())

    def _repr_html_(self) -> str:
        """Table of the hits, for notebooks."""
        rows = ((one.object.name, f"at {one.fraction:.2%} of the path") for one in self.hits)
        return notebook_html(self, rows)

    @property
    def verdict(self) -> PathVerdict:
        """Proved verdict: a hit, the time over, an overlap at the start, sliding, or clear.

        A sliding tool moves on in contact with an object touched at the start, and hits nothing.
        """
        if self.hits or self.enclosed:
            return PathVerdict.HITS
        if self.is_stopped or self.undecided or self.leaky:
            return PathVerdict.NOT_DECIDED
        if self.overlapping:
            return PathVerdict.OVERLAPS
        is_sliding = any(one.is_sliding for one in self.touching)
        return PathVerdict.SLIDES if is_sliding else PathVerdict.CLEAR

    @property
    def overlapping(self) -> tuple[TouchedObject, ...]:
        """Objects in an overlap at the start beyond the allowed one, the deepest first."""
        allowed = max(self.contact, self.overlap)
        found = [one for one in self.touching if one.start > allowed]
        return tuple(sorted(found, key=lambda one: -one.start))

    @property
    def is_free(self) -> bool:
        """Whether nothing is hit on the whole path, but for overlaps at the start."""
        return self.verdict.is_free

    @property
    def comes_out(self) -> bool:
        """Whether nothing is hit, and nothing is touched any more at the end of the path."""
        return self.is_free and all(one.until < 1.0 for one in self.touching)

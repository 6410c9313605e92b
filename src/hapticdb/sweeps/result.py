"""Results of a sweep, in metres and fractions of the path."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.proportions import Proportions
from hapticdb.store.base import Object
from hapticdb.sweeps.path import SweepPath

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


STRETCH = 1e-5
"""Relative safety margin: a given pose is rigid to 1e-6 only and may stretch the tool; the margin
also covers rounding. Larger: fewer tools are proved clear."""

Verdict = Literal["hits", "comes out", "not decided"]


class Moment(NamedTuple):
    """A sample of the path.

    fraction : share of the path's motion before the sample, 0 .. 1; segment : index of the given
    pose where its segment starts, 0 .. M - 2; pose (4, 4) : `world_from_tool`; objects : objects
    there, as the field with this moment says.
    """

    sample: int
    fraction: float
    segment: int
    pose: Floats
    objects: tuple[Object, ...]


class Deepest(NamedTuple):
    """The deepest hit: its depth below the tangent plane, its moment, its place (3,), world frame.

    Metres. A tangent plane goes through its voxel's centre, so a depth is below 0.87 voxels: it
    does not say how far the tool would penetrate.
    """

    depth: float
    moment: Moment
    point: Floats


class Clearance(NamedTuple):
    """Least distance of the shell's points at the samples to an occupied voxel's box, metres.

    distance : 0 if anything was hit; the limit if nothing is nearer; at_least, at_most : bounds of
    the distance between the surfaces on the whole path. They allow for the voxel size, the covering
    radius and the motion between two samples; if the covering radius is not known, at_least holds
    for the points only; at_most is infinite beyond the limit; is_beyond : whether nothing was
    nearer than the limit; moment : of the least distance, with the objects in that voxel, or None
    beyond the limit; point, voxel (3,) : the point and the voxel's centre, world frame, or None if
    nothing is near or something was hit.
    """

    distance: float
    at_least: float
    at_most: float
    is_beyond: bool
    moment: Moment | None = None
    point: Floats | None = None
    voxel: Floats | None = None


class Proof(NamedTuple):
    """Proof behind the verdict of a sweep without a hit, metres.

    Every place of an object's surface is in an occupied voxel. Every place of the tool's surface is
    within `cover` of a point, and at any time within `off` of its place at a sample. So no surface
    meets the tool's if the points, at the samples, are farther than `cover + off` from every
    occupied voxel's box.

    cover : the shell's covering radius, None if it is not known; off : as `SweepPath.off`; nearest
    : least distance of a point at a sample to an occupied voxel's box, or the search limit;
    is_near : whether anything was found within that limit; is_inside_known : whether the contents
    of the tool's closed bodies are known.
    """

    cover: float | None
    off: float
    nearest: float
    is_near: bool
    is_inside_known: bool

    @property
    def is_clear(self) -> bool:
        """Whether no surface of an object meets the tool's, anywhere on the path."""
        return self.cover is not None and self.nearest > (1.0 + STRETCH) * (self.cover + self.off)

    @property
    def cover_needed(self) -> float:
        """Covering radius (m) that would give a proof if no point came nearer; 0 if none would."""
        return max(self.nearest - self.off, 0.0)


class Decision(NamedTuple):
    """What the proof has shown beyond the samples, metres.

    is_clear : whether no surface meets the tool's, on the whole path; at_least : the proved
    distance of the surfaces, 0 unless `is_clear`; within : a surface comes at least so near to the
    tool's, or infinity; near : where that is so, with the objects in the nearest voxel, or None;
    tolerance : as requested, but a voxel's diagonal at most, or None; by : what bounded the
    distances, "voxels" or "distances".
    """

    is_clear: bool
    at_least: float
    within: float
    near: Moment | None
    tolerance: float | None
    by: str

    @property
    def is_near(self) -> bool:
        """Whether it is proved that surfaces come within the tolerance."""
        return self.tolerance is not None and self.within <= self.tolerance


class ContactDepth(NamedTuple):
    """Bounds on how deep the tool and an object that it touches at its start go into one another.

    The depth at a pose is the greatest distance from the object's surface of a place of the tool's
    surface that is inside the object, or the same with the two exchanged; 0 if there is none. An
    open surface has no inside, and counts for one of the two only.

    at_start, at_start_most : bounds of the depth at the first pose, metres; deepest, deepest_most :
    of the greatest depth on the path, between samples, too; fraction : share of the path's motion
    before the sample with `deepest`; allowed : metres by which the depth may grow; why : the reason
    why nothing is proved, or empty.
    """

    object: Object
    at_start: float
    at_start_most: float
    deepest: float
    deepest_most: float
    fraction: float
    allowed: float
    why: str

    @property
    def is_bounded(self) -> bool:
        """Whether it is proved that the depth never grows by more than `allowed`."""
        return not self.why and self.deepest_most <= self.at_start + self.allowed

    @property
    def is_cut(self) -> bool:
        """Whether it is proved that the depth grows by more than `allowed`."""
        return self.deepest > self.at_start_most + self.allowed


class MetObject(NamedTuple):
    """An object that the tool hits.

    intervals (K, 2) : fractions of the path, first and last hit of each run; gaps of up to a
    voxel's movement are closed; samples : number of samples that hit the object; contacts : number
    of those with a point below a tangent plane; first_contact : the first contact, or None; length
    : path from the first to the last hit of each run, metres, summed as in `SweepPath.motion`;
    points : greatest number of the tool's points in its voxels at one sample; deepest : depth of
    the deepest hit, metres, as in `Deepest`.
    """

    object: Object
    intervals: Floats
    samples: int
    contacts: int
    first_contact: Moment | None
    length: float
    points: int
    deepest: float

    @property
    def first(self) -> float:
        """Fraction of the path at the first hit."""
        return float(self.intervals[0, 0])

    @property
    def last(self) -> float:
        """Fraction of the path at the last hit."""
        return float(self.intervals[-1, 1])

    @property
    def is_left_at_once(self) -> bool:
        """Whether the tool hits the object at the path's start, leaves it, and never returns."""
        return len(self.intervals) == 1 and self.first == 0.0 and self.last < 1.0


class Profile(NamedTuple):
    """The path in W sections with about the same number of samples.

    fractions (W,) : begin of each section; hits (W,) int64 : greatest number of points hit at one
    sample; depths (W,) : greatest depth, metres; clearances (W,) : at the first sample of each
    section, metres, the limit if nothing is nearer; all NaN if they were not requested.
    """

    fractions: Floats
    hits: Ints
    depths: Floats
    clearances: Floats


@dataclass(frozen=True, eq=False)
class Swept:
    """Result of a sweep.

    Attributes
    ----------
    path : SweepPath
        The poses given and the samples between them.
    voxel_size : float
        Metres.
    samples, hits, contacts : int
        Numbers of samples: all; with a point inside a voxel; with a point below its tangent plane.
    first_hit, first_contact : Moment or None
        First hit and first contact, with the objects there.
    deepest : Deepest or None
        The deepest hit; None without a hit.
    objects : list of MetObject
        All objects hit, in the order in which the tool met them.
    enclosed : tuple of Object
        Objects at least partly inside a closed body of the tool at the path's start. They count as
        hit: the tool cannot leave without them.
    proof : Proof
        Distances that prove or do not prove "comes out".
    hit_intervals, contact_intervals : (K, 2) float64
        Fractions of the path, first and last hit (contact) of each run; gaps of up to a voxel's
        movement are closed.
    clearance : Clearance or None
        Least distance; None if it was not requested.
    profile : Profile
        The path in sections.
    revision : int
        Revision of the database that was read; others may have written meanwhile.
    elapsed : float
        Seconds, with the fetching of cells.
    cells : int
        Number of cells fetched from the database.
    proportions : Proportions
        Sizes and places of tool, path and scene; if there is a misfit, "no hit" has no meaning.
    looked : int
        How often points were looked up at a pose, for hits, clearance or the proof. Where bounds of
        earlier poses prove that nothing is near, a pose is not looked at.
    left_at_start : tuple of Object
        Objects left out because the tool hits them at the path's first pose, if that was requested.
    decision : Decision or None
        A closer look at what the samples leave open; None where they decide, or nothing more is
        requested about a hit.
    depths : tuple of ContactDepth
        Of the objects in `left_at_start`: how deep the tool goes into them on the whole path.
    """

    path: SweepPath
    voxel_size: float
    samples: int
    hits: int
    contacts: int
    first_hit: Moment | None
    first_contact: Moment | None
    deepest: Deepest | None
    objects: list[MetObject]
    enclosed: tuple[Object, ...]
    proof: Proof
    hit_intervals: Floats
    contact_intervals: Floats
    clearance: Clearance | None
    profile: Profile
    revision: int
    elapsed: float
    cells: int
    proportions: Proportions
    looked: int = 0
    left_at_start: tuple[Object, ...] = ()
    decision: Decision | None = None
    depths: tuple[ContactDepth, ...] = ()

    @property
    def cuts(self) -> tuple[ContactDepth, ...]:
        """Those of `depths` that are proved to grow by more than is allowed."""
        return tuple(one for one in self.depths if one.is_cut)

    @property
    def undecided(self) -> tuple[ContactDepth, ...]:
        """Those of `depths` that are neither bounded nor proved to cut."""
        return tuple(one for one in self.depths if not (one.is_bounded or one.is_cut))

    @property
    def caught(self) -> Moment | None:
        """First contact with an object that the tool does not only leave at the path's start."""
        in_way = [one.first_contact for one in self.objects if not one.is_left_at_once]
        contacts = [moment for moment in in_way if moment is not None]
        return min(contacts, key=lambda moment: moment.sample, default=None)

    @property
    def verdict(self) -> Verdict:
        """Proved result: the tool hits something, it comes out, or neither is proved.

        It comes out only if all `depths` are bounded, too.
        """
        if self.enclosed or self.cuts:
            return "hits"
        if self.is_clear_beside:
            return "not decided" if self.undecided else "comes out"
        if self.decision is not None and self.decision.tolerance is not None:
            return "hits" if self.decision.is_near else "not decided"
        return "hits" if self.hits else "not decided"

    @property
    def is_clear_beside(self) -> bool:
        """Whether it is proved that the tool meets nothing but what was left out at the start."""
        if self.enclosed or not self.proof.is_inside_known:
            return False
        if self.decision is not None and self.decision.is_clear:
            return True
        is_asked = self.decision is not None and self.decision.tolerance is not None
        return self.proof.is_clear and not self.hits and not is_asked

    @property
    def at_least(self) -> float:
        """Proved distance, metres, between the tool's surface and any other on the whole path."""
        if self.verdict != "comes out":
            return 0.0
        if self.decision is not None:
            return self.decision.at_least
        proof = self.proof
        return max(proof.nearest - proof.off - (proof.cover or 0.0), 0.0)

    @property
    def comes_out(self) -> bool:
        """Whether it is proved that the tool meets nothing on the whole path."""
        return self.verdict == "comes out"

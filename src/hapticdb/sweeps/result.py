"""What a sweep found, in metres and fractions of the path."""

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
"""By which a given pose, which is rigid to 1e-6, may stretch the tool, and roundings with it."""

Verdict = Literal["hits", "comes out", "not decided"]


class Moment(NamedTuple):
    """A sample of the path.

    fraction : 0 .. 1, the share of the path's motion before it; segment : of the given poses, from
    which on it comes, 0 .. M - 2; pose (4, 4) : `world_from_tool`; objects : those that are hit
    there, as the field's owner says.
    """

    sample: int
    fraction: float
    segment: int
    pose: Floats
    objects: tuple[Object, ...]


class Deepest(NamedTuple):
    """The deepest hit: metres below its tangent plane, when, and where (3,), metres, world frame.

    A tangent plane goes through its voxel's centre, so that a depth is below 0.87 voxels: it says
    how squarely a surface is met, not how far the tool would have gone in.
    """

    depth: float
    moment: Moment
    point: Floats


class Clearance(NamedTuple):
    """Least distance of the shell's points at the samples to an occupied voxel's box, metres.

    distance : 0 when anything was hit; the limit when nothing is nearer; at_least, at_most : what
    that says of the distance between the surfaces, anywhere on the path: the object's lies
    somewhere in its voxels, the tool's within the covering radius of a point (where that is not
    known, at_least is of the points alone), and the tool moves between two samples; at_most is
    infinite beyond the limit; is_beyond : nothing was nearer than the limit; moment : when, with
    the objects in that voxel, or None beyond the limit; point, voxel (3,) : the point and the
    voxel's centre, world frame, or None when nothing is near or something was hit.
    """

    distance: float
    at_least: float
    at_most: float
    is_beyond: bool
    moment: Moment | None = None
    point: Floats | None = None
    voxel: Floats | None = None


class Proof(NamedTuple):
    """What the verdict of a sweep without a hit stands on, metres.

    Every place of an object's surface is in an occupied voxel, every place of the tool's surface
    within `cover` of a point, and every time of the path within `off` of a sample. So no surface
    meets the tool's while the points, at the samples, keep more than `cover + off` from every
    occupied voxel's box.

    cover : the shell's covering radius, None where it is not known; off : how far any place of the
    tool is, at any time, from where it is at one of two samples; nearest : least distance of a
    point at a sample to an occupied voxel's box, or how far was looked; is_near : whether anything
    was found so far; is_inside_known : whether it was seen what lies in the tool's closed bodies.
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
        """Covering radius that would decide it, if no point then came nearer; 0 when none would."""
        return max(self.nearest - self.off, 0.0)


class MetObject(NamedTuple):
    """An object that the tool hits.

    intervals (K, 2) : fractions of the path, first and last hit of each run, gaps of a voxel's way
    closed; samples : that hit it; contacts : in which it was below a tangent plane; first_contact :
    the first of those, or None; length : of path from the first to the last hit of each run,
    metres, as `SweepPath.motion` counts them; points : most of the tool's points in its voxels at
    once; deepest : of the deepest hit, as in `Deepest`.
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
        """Fraction of the path at its first hit."""
        return float(self.intervals[0, 0])

    @property
    def last(self) -> float:
        """Fraction of the path at its last hit."""
        return float(self.intervals[-1, 1])

    @property
    def is_left_at_once(self) -> bool:
        """Whether the tool is in it where the path starts, leaves it, and does not come back."""
        return len(self.intervals) == 1 and self.first == 0.0 and self.last < 1.0


class Profile(NamedTuple):
    """The path in W stretches of about as many samples each.

    fractions (W,) : where each begins; hits (W,) int64 : most points hit at once; depths (W,) :
    deepest, metres; clearances (W,) : metres, at the sample where each begins, the limit where
    nothing is nearer; all NaN unless it was asked for.
    """

    fractions: Floats
    hits: Ints
    depths: Floats
    clearances: Floats


@dataclass(frozen=True, eq=False)
class Swept:
    """What came of a sweep.

    Attributes
    ----------
    path : SweepPath
        The poses given and the samples between them.
    voxel_size : float
        Metres.
    samples, hits, contacts : int
        Samples in all, with a point inside a voxel, and with one below its tangent plane.
    first_hit, first_contact : Moment or None
        With the objects that are hit, or in contact, there.
    deepest : Deepest or None
        None without a hit.
    objects : list of MetObject
        All objects hit, in the order in which the tool met them.
    enclosed : tuple of Object
        What lies, in part at least, inside a closed body of the tool where the path starts. It is
        hit, too: the tool cannot leave without it.
    proof : Proof
        What "comes out" stands on.
    hit_intervals, contact_intervals : (K, 2) float64
        Fractions of the path, first and last hit (contact) of each run; gaps of a voxel's way are
        closed.
    clearance : Clearance or None
        None when it was not looked for.
    profile : Profile
        The path in short.
    revision : int
        The database's, that all of this is of; others may have written meanwhile.
    elapsed : float
        Seconds, those included in which cells were fetched.
    cells : int
        Fetched from the database.
    proportions : Proportions
        Sizes and places of tool, path and scene beside one another; where something does not fit,
        "no hit" says nothing.
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

    @property
    def caught(self) -> Moment | None:
        """First contact with an object in the way: one that is not only left at once."""
        in_way = [one.first_contact for one in self.objects if not one.is_left_at_once]
        contacts = [moment for moment in in_way if moment is not None]
        return min(contacts, key=lambda moment: moment.sample, default=None)

    @property
    def verdict(self) -> Verdict:
        """What is proved: it hits something, it comes out, or neither."""
        if self.hits or self.enclosed:
            return "hits"
        if self.proof.is_clear and self.proof.is_inside_known:
            return "comes out"
        return "not decided"

    @property
    def comes_out(self) -> bool:
        """Whether it is proved that the tool meets nothing on the whole path."""
        return self.verdict == "comes out"

"""What a sweep found, in metres and fractions of the path."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.proportions import Proportions
from hapticdb.realtime.sweep_path import Path
from hapticdb.store.base import Object

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


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
    that says about the surfaces of the objects, which lie somewhere in their voxels, and about the
    points between two samples (at_most is infinite beyond the limit); is_beyond : nothing was
    nearer than the limit; moment : when, with the objects in that voxel, or None beyond the limit;
    point, voxel (3,) : the point and the voxel's centre, world frame, or None when nothing is near
    or something was hit.
    """

    distance: float
    at_least: float
    at_most: float
    is_beyond: bool
    moment: Moment | None = None
    point: Floats | None = None
    voxel: Floats | None = None


class MetObject(NamedTuple):
    """An object that the tool hits: fractions of its first and last hit, samples, deepest hit.

    samples : that hit it; contacts : in which it was below a tangent plane; deepest : metres.
    """

    object: Object
    first: float
    last: float
    samples: int
    contacts: int
    deepest: float


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
    path : Path
        The poses given and the samples between them.
    samples, hits, contacts : int
        Samples in all, with a point inside a voxel, and with one below its tangent plane.
    first_hit, first_contact : Moment or None
        With the objects that are hit, or in contact, there.
    deepest : Deepest or None
        None without a hit.
    objects : list of MetObject
        All objects hit, in the order in which the tool met them.
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

    path: Path
    samples: int
    hits: int
    contacts: int
    first_hit: Moment | None
    first_contact: Moment | None
    deepest: Deepest | None
    objects: list[MetObject]
    hit_intervals: Floats
    contact_intervals: Floats
    clearance: Clearance | None
    profile: Profile
    revision: int
    elapsed: float
    cells: int
    proportions: Proportions

    @property
    def comes_out(self) -> bool:
        """Whether nothing was hit on the whole path."""
        return self.hits == 0

"""Requests for sweeps: rigid bodies on paths, pairs of them, and options."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import UsageError
from hapticdb.exact.path import ToolPath
from hapticdb.ingest.geometry import parts_of
from hapticdb.pointshell.shape import CollisionShape
from hapticdb.pointshell.tool_surface import ToolSurface
from hapticdb.store.base import Object, Progress, Store

Floats = NDArray[np.float64]


Shapes = Mapping[int, CollisionShape]
"""Surfaces, world frame, by ids of objects."""


def shapes_of(
    store: Store, objects: Sequence[Object], known: Shapes | None = None
) -> Iterator[tuple[Object, CollisionShape]]:
    """Objects with their surfaces; all but known ones are read, as they are needed."""
    found = known or {}
    parts = parts_of(store, [obj for obj in objects if obj.id not in found])
    for obj in objects:
        if obj.id not in found:
            _, part = next(parts)
            cloud, chord, index = part.is_cloud, part.placed_chord, part.faces
            yield obj, CollisionShape(part.surface(), is_cloud=cloud, chord=chord, index=index)
        else:
            yield obj, found[obj.id]


class Mover(NamedTuple):
    """A rigid body on its own path.

    body : name of a machine's link; parameters (N,) : parameters of the given path at the poses of
    its own, if they differ; frame : `world_from_frame` at a parameter of the given path, for a path
    in the frame of another link; deviation : of its motion from the path, at most, metres.
    """

    tool: ToolSurface
    path: ToolPath
    body: str = ""
    parameters: Floats | None = None
    frame: Callable[[float], Floats] | None = None
    deviation: float = 0.0

    def against(self, shape: CollisionShape, cloud_radius: float) -> ToolSurface:
        """Its surface, as far from points of a cloud as the given one is from balls about them."""
        return self.tool.grown(cloud_radius) if shape.is_cloud else self.tool

    def own(self, given: float) -> float:
        """Parameter of its own path, for one of the given path."""
        return float(self.owns(np.array(given)))

    def owns(self, given: Floats) -> Floats:
        """The same for some (n,)."""
        if self.parameters is None:
            return given
        return np.asarray(np.interp(given, self.parameters, self.path.parameters))

    def given(self, own: float) -> float:
        """First parameter of the given path, for one of its own."""
        if self.parameters is None:
            return own
        n = int(np.searchsorted(self.path.parameters, own))
        # at a pose exactly: a link at rest has many given parameters there, the first one counts
        is_there = n < len(self.parameters) and self.path.parameters[n] == own
        return float(
            self.parameters[n]
            if is_there
            else np.interp(own, self.path.parameters, self.parameters)
        )


class LinkPair(NamedTuple):
    """Two links of a machine: one in the frame of the other, which stands for an object.

    least : lower bound of their gap on the path, metres.
    """

    least: float
    mover: Callable[[], Mover]
    object: Object
    shape: CollisionShape


class SweepRequest(NamedTuple):
    """Arguments as for `sweep`; until : end, `time.monotonic`; known : surfaces in memory."""

    contact: float
    overlap: float
    seated: bool
    until_hit: bool
    progress: Progress | None
    cloud_radius: float = 0.0
    within: float | None = None
    limit: float = np.inf
    until: float = np.inf
    known: Shapes | None = None

    def begun(self, limit: float | None, seconds: float | None) -> Self:
        """Check numbers, and begin to count the seconds; UsageError."""
        most = np.inf if limit is None else limit
        if not 0.0 < self.contact < np.inf:
            raise UsageError(f"contact {self.contact} m: give a length above 0")
        if not most > 0.0:
            raise UsageError(f"limit {limit} m: give a length above 0")
        if not 0.0 <= self.overlap < np.inf:
            raise UsageError(f"overlap {self.overlap} m: give 0 or a length above 0")
        if not 0.0 <= self.cloud_radius < np.inf:
            raise UsageError(f"points of radius {self.cloud_radius} m: give 0 or a length above 0")
        if self.within is not None and not 0.0 < self.within < np.inf:
            raise UsageError(f"gaps within {self.within} m: give a length above 0")
        if seconds is not None and not seconds > 0.0:
            raise UsageError(f"a sweep of {seconds} seconds: give more than 0")
        until = np.inf if seconds is None else time.monotonic() + seconds
        return self._replace(limit=most, until=until)

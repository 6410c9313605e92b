"""The gap along a path: bounds of the least distance from each near object, by intervals."""

import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.exact.distance import OverTimeError, Pair, box_gaps
from hapticdb.exact.movers import LinkPair, Mover, SweepRequest, shapes_of
from hapticdb.exact.path import SampledPath
from hapticdb.exact.separation import Separation
from hapticdb.kernels.triangles.path_distance import MEETING
from hapticdb.pointshell.shape import CollisionShape
from hapticdb.store.base import Object, Store
from hapticdb.tabular.gap_plot import gap_plot
from hapticdb.tabular.schema import plain
from hapticdb.tabular.tables import Columns, Tabular, columns_of, open_table

Floats = NDArray[np.float64]

INTERVALS = 100
"""Equal parts of the path's motion. More: a finer curve, and more samples."""
TOLERANCE, SHARE = 1e-4, 0.01
"""Greatest difference of the bounds: metres, or a share of the distance if more."""
AT_ONCE = 4096
"""Samples between two readings of the clock, at most."""


class GapInterval(NamedTuple):
    """Bounds of the least distance from an object on an interval of the path, metres.

    begin, end : numbers of poses, with the share of the path to the next one; at_least : proved, 0
    in a collision or inside a closed body; at_most : measured at `fraction` of the path; body :
    link of a machine.
    """

    object: Object
    begin: float
    end: float
    at_least: float
    at_most: float
    fraction: float
    body: str = ""


@dataclass(frozen=True, eq=False, repr=False)
class GapCurve(Tabular):
    """Intervals nearer than `within`, metres, by pairs, the nearest pair first.

    is_stopped : whether the time was over, and pairs are missing.
    """

    within: float
    intervals: tuple[GapInterval, ...]
    is_stopped: bool

    @property
    def pairs(self) -> int:
        """Number of pairs of a moving body and an object."""
        return len({(one.body, one.object.id, one.object.name) for one in self.intervals})

    def columns(self) -> Columns:
        """A row for each interval."""
        return columns_of(("id", "name", *GapInterval._fields[1:]), map(plain, self.intervals))

    def write(self, path: str | PathLike[str]) -> None:
        """Write the table as `Tabular.write`, or a plot as .svg."""
        with open_table(Path(path), "write", replaces=True, plot=gap_plot) as add:
            add(self.columns())


def gap_curve(
    store: Store, path: SampledPath, movers: Sequence[Mover], objects: Sequence[Object],
    pairs: Sequence[LinkPair], request: SweepRequest,
) -> GapCurve | None:  # fmt: skip
    """Curve of rigid bodies, and of pairs of them; None unless requested."""
    if request.within is None:
        return None
    found: list[list[GapInterval]] = []
    with suppress(OverTimeError):
        for least, mover, obj, shape in pairs:
            if least < request.within:
                found.append([*_intervals(path, mover(), obj, shape, request)])
        near = np.full((len(movers), len(objects)), np.inf)
        for n, one in enumerate(movers):
            tool = one.tool.grown(request.cloud_radius)
            near[n] = box_gaps(tool, one.path, objects)[1].min(axis=1)
        chosen = np.flatnonzero(near.min(axis=0, initial=np.inf) < request.within).tolist()
        shapes = shapes_of(store, [objects[i] for i in chosen], request.known)
        for i, (obj, shape) in zip(chosen, shapes, strict=True):
            some = np.flatnonzero(near[:, i] < request.within)
            found += [[*_intervals(path, movers[n], obj, shape, request)] for n in some.tolist()]
    found = sorted(filter(None, found), key=lambda rows: min(one.at_least for one in rows))
    intervals = tuple(one for rows in found for one in rows)
    return GapCurve(request.within, intervals, time.monotonic() > request.until)


def _intervals(
    path: SampledPath, mover: Mover, obj: Object, shape: CollisionShape, request: SweepRequest
) -> Iterator[GapInterval]:
    """Intervals of one pair."""
    within = request.within or 0.0
    edges = np.linspace(0.0, path.length, (INTERVALS if path.length else 1) + 1)
    numbers = np.interp(edges, path.parameters, np.arange(len(path.parameters)))
    numbers[[0, -1]] = 0, len(path.parameters) - 1  # the path may begin and end with a rest
    own = mover.owns(edges)
    tool = mover.against(shape, request.cloud_radius)
    errors = shape.chord + tool.chord + mover.deviation
    found = _bounds(Pair(shape.tree, tool, mover.path, request.until), own, within + errors)
    found[:, 0] -= errors
    found[:, 1] += mover.deviation
    # a body gets in or out of another only through a collision
    ends = np.flatnonzero(np.diff(np.concatenate([[0], found[:, 0] > 0.0, [0]])))
    for first, last in ends.reshape(-1, 2).tolist():
        pose = mover.path.at(own[first : first + 1])
        is_in_box = tool.box_gaps(obj.bounds[None], pose)[0, 0] <= 0.0
        if is_in_box and Separation(shape, mover.tool).is_nested(pose[0]):
            found[first:last, :2] = 0.0
    for n, (at_least, at_most, parameter) in enumerate(found.tolist()):
        if at_least < within:
            begin, end = numbers[n : n + 2].tolist()
            fraction = path.fraction(mover.given(parameter))
            yield GapInterval(obj, begin, end, max(at_least, 0.0), at_most, fraction, mover.body)


def _bounds(pair: Pair, edges: Floats, within: float) -> Floats:
    """Bounds (N, 3) of the least distance between successive path parameters (N + 1,).

    Proved, measured, and the parameter of the latter. A distance falls by no more than the
    parameter grows, so two samples bound it between them; more follow where that proves too little.
    """
    # farther than an interval's length: samples beyond it prove the whole interval
    reach = within + 3.0 * float(_tolerance(within)) + float(np.diff(edges).max())
    more = np.unique(edges)
    at, low, high = np.zeros((3, 0))
    after = np.zeros(len(more), dtype=np.int64)
    while len(more):
        near = pair.measure(more, np.full(len(more), reach))
        new = more, near.at_least, near.at_most
        at, low, high = (np.insert(a, after, b) for a, b in zip((at, low, high), new, strict=True))
        between = 0.5 * (low[:-1] + low[1:] - np.diff(at))
        parts = np.searchsorted(edges, at[:-1], side="right") - 1
        known = np.full(len(edges) - 1, reach)
        np.minimum.at(known, parts, np.minimum(high[:-1], high[1:]))
        wanted = np.clip(known - _tolerance(known), 0.0, within)[parts]
        # not without end: far from the origin, rounding may be more than the tolerance
        is_open = (np.maximum(between, 0.0) < wanted) & (np.diff(at) > MEETING)
        after = np.flatnonzero(is_open)[:AT_ONCE] + 1
        more = 0.5 * (at[after - 1] + at[after])
    found = np.empty((len(edges) - 1, 3))
    places = np.searchsorted(at, edges).tolist()
    for n, (first, last) in enumerate(pairwise(places)):
        nearest = first + int(np.argmin(high[first : last + 1]))
        proved = between[first:last].min(initial=low[nearest])
        found[n] = proved, high[nearest], at[nearest]
    return found


def _tolerance(distance: ArrayLike) -> Floats:
    """Greatest difference of the bounds; half of a small distance, so that none becomes 0."""
    given = np.asarray(distance)
    return np.maximum(np.clip(0.5 * given, MEETING, TOLERANCE), SHARE * given)

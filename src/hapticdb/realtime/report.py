"""What a session was like: rate, lateness and computing time beside an empty loop's."""

from dataclasses import asdict, dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.proportions import Proportions
from hapticdb.realtime.resident_cells import CacheFigures

BINS = 200_000
BIN = 1e-7
"""Seconds: times are counted in bins of 0.1 us up to 20 ms, and the worst is kept beside them."""


class Spread(NamedTuple):
    """How a time is spread over frames, seconds: percentiles to 0.1 us, and the worst."""

    p50: float
    p99: float
    p999: float
    worst: float


class Times:
    """Times of many frames, counted in bins: as much memory for an hour as for a second."""

    def __init__(self) -> None:
        self.counts: NDArray[np.int64] = np.zeros(BINS + 1, dtype=np.int64)
        self.worst = 0.0

    def add(self, seconds: float) -> None:
        """Count one in."""
        at = int(seconds / BIN)
        self.counts[at if at < BINS else BINS] += 1  # noqa: FURB136 - min() costs 0.2 us
        if seconds > self.worst:  # noqa: PLR1730 - likewise
            self.worst = seconds

    def spread(self) -> Spread:
        """Percentiles of what was counted; zeros for nothing."""
        total = int(self.counts.sum())
        if not total:
            return Spread(0.0, 0.0, 0.0, 0.0)
        at = np.searchsorted(
            np.cumsum(self.counts), np.ceil([0.5 * total, 0.99 * total, 0.999 * total])
        )
        p50, p99, p999 = np.where(at == BINS, self.worst, np.minimum((at + 0.5) * BIN, self.worst))
        return Spread(float(p50), float(p99), float(p999), self.worst)


@dataclass(frozen=True)
class LoopFigures:
    """How a loop kept its time.

    frames : how many; seconds : that they took; missed : deadlines for which no frame began in
    time, because the one before was still at work or the machine was elsewhere; lateness : of each
    frame's begin behind its deadline; elapsed : that each frame computed, device and all.
    """

    frames: int
    seconds: float
    missed: int
    lateness: Spread
    elapsed: Spread

    @property
    def rate(self) -> float:
        """Frames a second."""
        return self.frames / self.seconds if self.seconds else 0.0


@dataclass
class Counts:
    """What a loop counts, frame by frame."""

    frames: int = 0
    hit_frames: int = 0
    contact_frames: int = 0
    unknown_frames: int = 0
    held_frames: int = 0
    stale_frames: int = 0
    unknown_points: int = 0
    substeps: int = 0
    dropped_frames: int = 0
    cut_frames: int = 0
    nowhere_frames: int = 0
    bad_reading: str | None = None
    peak_force: float = 0.0
    peak_torque: float = 0.0
    deepest: float = 0.0
    conditions: dict[str, str] = field(default_factory=dict)


class LoopAnswer(NamedTuple):
    """What a loop's process says at its end."""

    loop: LoopFigures
    empty: LoopFigures | None
    counts: Counts
    warm_up: float
    is_warm: bool


@dataclass(frozen=True)
class Report:
    """What a session was like.

    Attributes
    ----------
    rate : float
        Asked for, Hz.
    loop, empty : LoopFigures
        The session's loop, and one of the same rate that did nothing, on this machine just before:
        a shared machine is late by itself. The latter is None where none was measured.
    hit_frames, contact_frames, unknown_frames, held_frames, stale_frames : int
        Frames with a point in a voxel, below its tangent plane, in a cell that was not resident;
        those that kept an earlier wrench; those in which the database had been silent for too long.
    points, unknown_points : int
        Looked up in all frames, and those of them in cells that were not resident.
    substeps : int
        Of the coupling, in all frames.
    dropped_frames : int
        Frames whose period was too long to be simulated to its end.
    cut_frames : int
        Frames in which the tool was held back at surfaces: a step was cut back, or not made.
    nowhere_frames : int
        Frames whose reading was no place: its numbers not finite, too large, or no rotation.
    bad_reading : str or None
        The first of them in a line: which device, what it returned, what was expected.
    peak_force, peak_torque, deepest : float
        Greatest norm sent to the device, N and N m; deepest contact, metres.
    warm_up : float
        Seconds until all wanted cells were resident, before the first frame; after
        `hapticdb.realtime.loop.WARM_PATIENCE` a session starts without them.
    is_warm : bool
        Whether they were there.
    cache : CacheFigures
        What the fetching process did.
    objects : tuple of int
        Ids of objects touched, as far as they were asked for: a hundred times a second.
    recorded_frames, lost_records : int
        Frames in the recording, and frames that nobody took out of memory in time.
    recording_ended : str or None
        Why the recording ended before the session, in a line; None when it did not.
    proportions : Proportions or None
        Sizes and places of tool, path and scene at the start, and what of them did not fit.
    conditions : dict
        Points, scheduling, processor: what the figures hold for.
    """

    rate: float
    loop: LoopFigures
    empty: LoopFigures | None
    hit_frames: int
    contact_frames: int
    unknown_frames: int
    held_frames: int
    stale_frames: int
    points: int
    unknown_points: int
    substeps: int
    dropped_frames: int
    cut_frames: int
    peak_force: float
    peak_torque: float
    deepest: float
    warm_up: float
    is_warm: bool
    cache: CacheFigures
    objects: tuple[int, ...] = ()
    recorded_frames: int = 0
    lost_records: int = 0
    recording_ended: str | None = None
    proportions: Proportions | None = None
    nowhere_frames: int = 0
    bad_reading: str | None = None
    conditions: dict[str, str] = field(default_factory=dict)

    @property
    def hit_rate(self) -> float:
        """Share of the looked-up points whose cell was resident."""
        return 1.0 - self.unknown_points / self.points if self.points else 1.0

    def figures(self) -> dict[str, object]:
        """All of it as plain numbers and words, for JSON; times in seconds."""
        plain = asdict(self)
        for name in ("loop", "empty"):
            part = getattr(self, name)
            if part is None:
                continue
            plain[name] = asdict(part) | {"rate": part.rate}
            for times in ("lateness", "elapsed"):
                plain[name][times] = getattr(part, times)._asdict()
        plain["cache"] = self.cache._asdict()
        plain["hit_rate"] = self.hit_rate
        plain["objects"] = list(self.objects)
        plain["proportions"] = None if self.proportions is None else self.proportions.record()
        return plain

"""Report of a session: its rate, lateness and computing time, and those of an empty loop."""

from dataclasses import dataclass, fields
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.records.session import TIME_BIN, TIME_BINS
from hapticdb.session.coupling import DirectRendering
from hapticdb.session.prefetch.resident_cells import CacheFigures


class Spread(NamedTuple):
    """Distribution of a time over frames, seconds.

    Percentiles are exact to 1 us; above 20 ms they are the worst.
    """

    p50: float
    p99: float
    p999: float
    worst: float


def spread_of(counts: NDArray[np.int64], worst: float) -> Spread:
    """Percentiles of a slot's histogram; zeros if it is empty.

    counts (TIME_BINS + 1,): the last bin has all longer times; worst : the longest one, s.
    """
    total = int(counts.sum())
    if not total:
        return Spread(0.0, 0.0, 0.0, 0.0)
    at = np.searchsorted(np.cumsum(counts), np.ceil([0.5 * total, 0.99 * total, 0.999 * total]))
    # the middle of a bin; in the last bin, and above the worst time, the worst time itself
    p50, p99, p999 = np.where(
        at == TIME_BINS, worst, np.minimum((at + 0.5) * TIME_BIN, worst)
    ).tolist()
    return Spread(p50, p99, p999, worst)


@dataclass(frozen=True)
class LoopFigures:
    """Timing of a loop.

    frames : number of frames; seconds : their time; missed : deadlines without a frame, because
    the frame before was not finished or the machine did other work; lateness : time
    from each deadline to the begin of its frame; elapsed : computing time of each frame, with the
    device's.
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

    @classmethod
    def of_slot(cls, slot: NDArray[np.void], seconds: float) -> Self:
        """Timing of a session; slot : its row of `SLOT`; seconds : its duration."""
        spreads = [
            spread_of(slot[name], float(slot[f"worst_{name}"])) for name in ("lateness", "elapsed")
        ]
        return cls(int(slot["n_frames"]), seconds, int(slot["missed_deadlines"]), *spreads)


class LoopAnswer(NamedTuple):
    """Last message of a worker with a device; a `Report` is made of it and the counts.

    card: name of the GPU, if one was used.
    """

    loop: LoopFigures
    empty: LoopFigures | None
    bad_reading: str | None
    is_warm: bool
    card: str | None


@dataclass(kw_only=True)
class Report:
    """Report of a session.

    Attributes
    ----------
    rate : float
        Frames a second that the session was set to.
    loop, empty : LoopFigures
        Timing of the session's loop, and of an empty loop at the same rate on this machine just
        before. The empty loop shows the machine's own lateness; None if it was not run.
    law : str
        Name of a frame's force law; a user's: its class.
    rendering : str
        "coupled" or "direct".
    coupling : SettledCoupling or DirectRendering
        The coupling between hand and tool, with what lowered its stiffness; rendered directly, what
        bounded the wrench.
    is_warm : bool
        Whether all wanted cells were resident before the first frame; after
        `hapticdb.session.device_loop.WARM_TIMEOUT` a session starts without them.
    cache : CacheFigures
        Figures of the prefetch process.
    objects, enclosing_objects : tuple of int
        Ids of objects touched, and of those that the tool lay in; sampled a hundred times a second.
    recorded_frames, lost_records : int
        Frames in the recording, and frames that were overwritten before they were recorded.
    recording_ended : str or None
        One line: why the recording ended before the session; None if it did not.
    database_lost : str or None
        One line: why the database could not be read at the end; None if it could.
    hit_frames, contact_frames, unknown_frames, held_frames, stale_frames : int
        Numbers of frames: with a hit (a point in a voxel or, with distances, near a surface); with
        a contact (a point below its tangent plane or, with distances, below the onset); with a
        point in a cell that was not resident; that kept an earlier wrench; in which the database
        had not answered for too long.
    invalid_frames : int
        Frames with an invalid reading: numbers not finite or too large, or no rotation.
    bad_reading : str or None
        One line on the first invalid reading: the device, what it returned, what was expected.
    peak_force, peak_torque : float
        Greatest norms sent to the device, N and N m.
    deepest : float
        Deepest contact, metres: below the tangent plane, or, with distances, within the distance at
        which contact begins.
    inside_frames, first_inside_frame : int
        With distances. Frames in which the tool lay in an object and felt nothing, since it began
        there or a part was put upon it; number of the first of them from 0, or -1 without any.
    ended_inside : bool
        Whether the tool still lay in something at the end.
    guard_actions : int
        How often the guard lowered the stiffness because the force went back and forth.
    least_share : float
        Share of the stiffness that the guard left.
    conditions : dict
        Conditions of the measurement: points of the tool, processor.
    """

    rate: float
    loop: LoopFigures
    empty: LoopFigures | None
    law: str
    rendering: str
    coupling: DirectRendering
    is_warm: bool
    cache: CacheFigures
    objects: tuple[int, ...]
    enclosing_objects: tuple[int, ...]
    recorded_frames: int
    lost_records: int
    recording_ended: str | None
    database_lost: str | None
    hit_frames: int
    contact_frames: int
    unknown_frames: int
    held_frames: int
    stale_frames: int
    invalid_frames: int
    bad_reading: str | None
    peak_force: float
    peak_torque: float
    deepest: float
    inside_frames: int
    first_inside_frame: int
    ended_inside: bool
    guard_actions: int
    least_share: float
    conditions: dict[str, str]

    def __repr__(self) -> str:
        return (
            f"Report({self.loop.frames:,} frames in {self.loop.seconds:.3g} s, law {self.law}, "
            f"{self.rendering}, "
            f"{self.contact_frames:,} in contact, peak {self.peak_force:.4g} N, "
            f"{self.loop.missed:,} deadlines missed)"
        )


def counts_of(slot: NDArray[np.void]) -> dict[str, Any]:
    """Counts of a session's slot, a row of `SLOT`, by their names in a `Report`."""
    reported = {one.name for one in fields(Report)}
    names = [n for n in slot.dtype.names or () if n in reported and not slot.dtype[n].shape]
    counts = {name: slot[name].item() for name in names}
    counts["ended_inside"] = bool(slot["ended_inside"])
    return counts if slot["inside_frames"] else counts | {"first_inside_frame": -1}

"""Replay: runs a recorded session's kernel over its inputs and compares the outputs bit for bit."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.environment import Environment
from hapticdb.errors import GridError, HapticDBError, UsageError
from hapticdb.kernels._machine_code import build
from hapticdb.kernels.hand.near_points import FAR, LONGEST_REST
from hapticdb.kernels.records.hand import FRAME
from hapticdb.kernels.records.layout import pose_numbers, views_of
from hapticdb.poses import poses_of
from hapticdb.query.law import reads_distances
from hapticdb.recording.file import Recording
from hapticdb.recording.frame import Frames, State
from hapticdb.resident.point_runs import clusters_of
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import CellTable
from hapticdb.session.coupling import radius_of
from hapticdb.session.prefetch.tracking import PrefetchRequest
from hapticdb.session.states import PeriodClock, SessionState

BLOCK = 256
"""Frames of a block; it is run again if a cell was not in memory. Larger: fewer copies of the
session's state, and more frames to run again."""
NEVER_NS = 1 << 62
"""Nanoseconds of silence of the database: more than any session has."""
OUTPUTS = ("tool", "applied", "hits", "contacts", "deepest", "state")
"""Compared fields of a frame."""


class Parting(NamedTuple):
    """The first frame with other outputs than the recorded ones."""

    frame: int
    time: float  # s since the recording's start
    reason: str
    recorded: Frames  # () of FRAME
    present: Frames

    def describe(self) -> str:
        """One line for people."""
        then, now = (
            f"{int(of['hits'])} hits, ({', '.join(f'{x:.6g}' for x in of['applied'])}) N, N m"
            for of in (self.recorded, self.present)
        )
        return (
            f"parts at frame {self.frame} ({self.time:.3f} s), {self.reason}: "
            f"recorded {then}; now {now}"
        )


@dataclass(frozen=True, eq=False)
class Replayed:
    """Result of a replay."""

    n_frames: int
    """Frames in the recording: all were computed again."""
    n_differing: int
    """Frames with a different output."""
    parting: Parting | None
    revision: int
    """Of the database at the end."""

    @property
    def is_equal(self) -> bool:
        """Whether there is a frame, and none differs."""
        return self.n_frames > 0 and self.parting is None

    def describe(self) -> str:
        """One line for people."""
        if self.parting is not None:
            of = f"{self.n_differing:,} of {self.n_frames:,} frames differ"
            return f"{self.parting.describe()}; {of}"
        if not self.n_frames:
            return "nothing to compare: the recording has no frames"
        return (
            f"equal: {self.n_frames:,} frames at revision {self.revision}, tool, applied wrench "
            "and contacts bit for bit"
        )


def replay(recording: Recording, environment: Environment) -> Replayed:
    """Run the session's kernel over the recorded hand, all cells in memory, and compare outputs.

    Tool, applied wrench and contacts are equal bit for bit, unless a frame had cells missing in
    memory, frames were lost, the environment was edited, the frames were computed on a GPU, or by
    another build: see `Parting.reason`. Cells take 256 MiB of memory at most.

    Parameters
    ----------
    recording : Recording
        The session.
    environment : Environment
        The environment of the session; its revision may differ.

    Raises
    ------
    GridError
        If the environment has another grid than the recording.
    UsageError
        If the session cannot be felt in the environment, or its state is of another build.
    """
    header = recording.header
    if header.grid != environment.grid:
        raise GridError(
            f"{recording.path} was recorded on {header.grid.describe()}, and {environment.url} "
            f"has {environment.grid.describe()}: give the environment of {header.environment}"
        )
    with CellTable.create(distances=reads_distances(header.law)) as table:
        residency = Residency(environment.store, table, header.exclude, where=header.where)
        again = _Again(recording, residency, table)
        frames, comparison = recording.frames(), _Comparison(recording, residency)
        for at in range(0, len(frames), BLOCK):
            block = np.array(frames[at : at + BLOCK])
            comparison.add(block, again.run(block))
        return comparison.result()


class _Again:
    """The session's state, with the recorded hand."""

    def __init__(self, recording: Recording, residency: Residency, table: CellTable) -> None:
        header, self._residency, self._table = recording.header, residency, table
        self._ring = np.zeros((1, BLOCK), FRAME)
        self._clock = PeriodClock(header.law, rings=self._ring, rendering=header.rendering)
        row = table.join()
        self._state = state = SessionState(
            self._clock.slots[0, ...], table.cells, row, table.queue.requests[row, ...],
            header.grid, clusters_of(header.shell, header.grid.voxel_size),
        )  # fmt: skip
        try:
            state.restore(header.start)
        except ValueError:
            raise UsageError(
                f"{recording.path}: its state is of another build, {header.build}: record it again"
            ) from None
        self._slot = views_of(state.slot)
        self._hand = pose_numbers(state.servo["hand"])
        self._slot.is_frame[()] = 1
        self._clock.enter(state)
        self._center = np.append(header.shell.center, 1.0)
        self._radius = radius_of(header.shell, header.grid.voxel_size)

    def run(self, frames: Frames) -> Frames:
        """Run frames with the inputs of the recorded ones."""
        state, residency = self._state, self._residency
        # saved: a block with unknown cells is run again, from the same state
        before, wanted = state.save(), self._around(frames)
        residency.make_resident(wanted)
        while True:
            missed = self._run(frames)
            if not len(missed):
                return self._ring[0, : len(frames)]
            # no progress: the cells were requested and evicted again, so a repeat would not end
            if np.isin(missed, wanted).all():
                raise HapticDBError(f"cells {missed[:3].tolist()} do not stay in memory")
            wanted = np.union1d(wanted, missed)
            residency.make_resident(wanted)
            state.restore(before)

    def _around(self, frames: Frames) -> NDArray[np.int64]:
        """Cells around the recorded tools, as many as half the table holds."""
        grid = self._residency.grid
        centers = (poses_of(frames["tool"]) @ self._center)[:, :3]
        centers = (centers - np.array(grid.origin)) / grid.voxel_size
        if not np.isfinite(centers).all():
            return np.empty(0, np.int64)
        margin = float(np.linalg.norm(centers - centers[0], axis=1).max()) + LONGEST_REST + FAR
        around = PrefetchRequest(centers[0], np.zeros(3), self._radius / grid.voxel_size, margin)
        return np.sort(around.cells(grid)[0][: self._table.n_slots // 2])

    def _run(self, frames: Frames) -> NDArray[np.int64]:
        """Run frames into the ring -> their cells (n,) missing in memory."""
        slot, servo, hand = self._slot, self._slot.servo, self._slot.servo.hand
        version, missed = servo.tool.version, [np.empty(0, np.int64)]
        state = frames["state"].astype(np.int64)
        is_open, is_stale, is_anew = (
            (state & bit != 0).tolist() for bit in (State.CLUTCH_OPEN, State.STALE, State.ANEW)
        )
        dt, unknown = frames["dt"].tolist(), self._ring[0]["unknown"]
        published = self._table.cells.control["version"]
        slot.n_frames[()] = 0
        for n, frame in enumerate(frames):
            self._hand[:], hand.velocity[:] = frame["hand"], frame["hand_velocity"]
            hand.is_open[()] = is_open[n]
            # the limit decides in place of the clock, which is another one now
            slot.staleness[()] = -NEVER_NS if is_stale[n] else NEVER_NS
            slot.springs[0] = frame["spring"]
            slot.reading.buttons[()] = frame["buttons"]
            if version:  # the cells seem to have changed where they did in the session
                version[()] = -1 if is_anew[n] else published.item()
            # the recorded duration of the period, not that of a clock
            self._clock.step(dt[n], 0)
            if unknown[n]:
                unknowns = self._state.missed
                missed.append(unknowns["cells"][: unknowns["n_cells"]].copy())
        return np.unique(np.concatenate(missed))


class _Comparison:
    """Compares recorded frames with the same frames computed now."""

    def __init__(self, recording: Recording, residency: Residency) -> None:
        self._header, self._residency = recording.header, residency
        self._n_frames = self._n_differing = 0
        self._parting: Parting | None = None
        self._last: float | None = None  # time of the last frame
        self._reasons: dict[str, tuple[int, str]] = {}  # first frame and words of each kind

    def add(self, recorded: Frames, present: Frames) -> None:
        """Compare the next frames."""
        differs = np.zeros(len(recorded), dtype=bool)
        for name in OUTPUTS:
            then, now = (
                np.ascontiguousarray(of[name]).view(np.uint8).reshape(len(of), -1)
                for of in (recorded, present)
            )
            # bytes, not numbers: NaN equals NaN, and 0.0 differs from -0.0
            differs |= (then != now).any(axis=1)
        if self._parting is None:
            self._find_reasons(recorded)
            if differs.any():
                n = int(np.argmax(differs))
                at = self._n_frames + n
                self._parting = Parting(
                    at, float(recorded["time"][n]), self._reason(at), recorded[n].copy(),
                    present[n].copy(),
                )  # fmt: skip
        self._n_differing += int(differs.sum())
        self._n_frames += len(recorded)

    def _find_reasons(self, frames: Frames) -> None:
        """Find the first frames with a reason for a difference."""
        now, times = self._residency.revision, frames["time"]
        begun = times[0] - frames["dt"][0] if self._last is None else self._last
        begins = np.append(begun, times[:-1])
        # a frame begins where the last one ended; a hole means lost ones
        gaps = np.abs(times - begins - frames["dt"]) > 1e-7
        self._last = float(times[-1])
        for kind, found, words in (
            ("unknown", frames["unknown"] > 0, "since frame {0} met cells not in memory"),
            ("lost", gaps, "since frames before frame {0} were lost"),
            (
                "edited",
                frames["revision"] != now,
                f"since the environment was edited: revision {{1}} then, {now} now",
            ),
        ):
            if kind not in self._reasons and found.any():
                n = int(np.argmax(found))
                at = self._n_frames + n
                self._reasons[kind] = at, words.format(at, int(frames["revision"][n]))

    def _reason(self, frame: int) -> str:
        """Why a frame may differ."""
        header = self._header
        for at, words in self._reasons.values():
            if at <= frame:
                return words
        if header.frames_on != "cpu":
            return "since its frames were computed on a GPU"
        if header.build != build():
            return f"since it was recorded by another build, {header.version} {header.build}"
        return "for no known reason"

    def result(self) -> Replayed:
        """Result over all frames."""
        return Replayed(self._n_frames, self._n_differing, self._parting, self._residency.revision)

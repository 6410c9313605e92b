"""Replay: computes the wrenches of a recorded session again and compares them bit for bit."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.environment import Environment
from hapticdb.errors import GridError, UsageError
from hapticdb.kernels.rigid import poses_of
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.law import ForceLaw, frames_by, is_smooth
from hapticdb.ready import make_ready
from hapticdb.recording.file import Recording
from hapticdb.recording.frame import Frames, State
from hapticdb.resident.frames import ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import CellTable
from hapticdb.store.filtering import Filter
from hapticdb.store.finding import Words

Floats = NDArray[np.float64]
Feel = Callable[[Floats], tuple[Floats, NDArray[np.int64]]]
"""Poses (M, 4, 4) world_from_tool -> contact wrenches (M, 6), N and N m, and hits (M,)."""


class Parting(NamedTuple):
    """The first frame whose wrench or number of hits differs from the recorded one."""

    frame: int
    time: float  # s since the session's start
    recorded: Floats  # wrenches (6,), N and N m
    present: Floats
    hits_recorded: int  # numbers of shell points inside a voxel
    hits_present: int
    revision_recorded: int  # of the database
    revision_present: int

    def describe(self) -> str:
        """One line for people."""
        then, now = (", ".join(f"{x:.6g}" for x in w) for w in (self.recorded, self.present))
        return (
            f"parts at frame {self.frame} ({self.time:.3f} s): {self.hits_recorded} hits and "
            f"({then}) N, N m at revision {self.revision_recorded}, {self.hits_present} and "
            f"({now}) at revision {self.revision_present}"
        )


@dataclass(frozen=True, eq=False)
class Replayed:
    """Result of a replay."""

    n_compared: int
    """Frames whose wrench was computed again."""
    n_skipped: int
    """Frames that were not compared: they had unknown points or held an earlier wrench."""
    n_differing: int
    """Frames compared whose wrench or number of hits is not the same."""
    parting: Parting | None
    revision: int
    """Of the database at the end."""
    is_same_revision: bool
    """Whether all frames were recorded at the database's present revision."""

    @property
    def is_equal(self) -> bool:
        """Whether at least one frame was compared and none differs."""
        return self.n_compared > 0 and self.parting is None

    def describe(self) -> str:
        """One line for people."""
        skipped = f"{self.n_skipped} skipped (unknown or held)"
        if self.parting is not None:
            return (
                f"{self.parting.describe()}; {self.n_differing} of {self.n_compared} frames "
                f"differ, {skipped}"
            )
        if not self.n_compared:
            return f"nothing to compare: {skipped}"
        at = "the same revision" if self.is_same_revision else "another revision, now"
        return f"equal: {self.n_compared} frames at {at} {self.revision}, {skipped}"


def touching(
    environment: Environment,
    shell: PointShell,
    law: ForceLaw,
    exclude: Words = (),
    where: Words = (),
) -> Feel:
    """Return a function that queries the database for each pose: no resident cells, slow.

    Felt is what the words of `where` and `exclude` choose now. A word that chooses nothing is no
    error: an object that was removed meanwhile exerts no force anyway.
    """
    left_out = Filter(where, exclude).left_out(environment.objects(), environment.url)
    excluded = left_out.ids.tolist()

    def feel(poses: Floats) -> tuple[Floats, NDArray[np.int64]]:
        wrenches = np.empty((len(poses), 6))
        n_hits = np.empty(len(poses), dtype=np.int64)
        for n, pose in enumerate(poses):
            touch = environment.touch(shell, pose, "array", exclude=excluded, law=law)
            wrenches[n, :3] = touch.force
            wrenches[n, 3:] = touch.torque
            n_hits[n] = len(touch.hits)
        return wrenches, n_hits

    return feel


@contextmanager
def resident(
    environment: Environment,
    shell: PointShell,
    law: ForceLaw,
    exclude: Words = (),
    where: Words = (),
    budget_points: int | None = None,
) -> Iterator[Feel]:
    """Provide a function that uses resident cells, fetched before their use: as fast as a session.

    Its wrenches and hits are those of `touching`, bit for bit, or of a session with that budget.
    Raises `UsageError` if the environment is in lexicographic order, which has no cells, or if the
    law is by distances and an object has none.
    """
    make_ready(frames_by(law))
    with CellTable.create(distances=is_smooth(law)) as table:
        residency = Residency(environment.store, table, exclude, where=where)
        frames = ResidentFrames(residency, shell, law, budget_points=budget_points)
        try:
            yield frames.wrenches
        finally:
            frames.close()


def replay(
    recording: Recording, environment: Environment, *, until_damage: bool = False
) -> Replayed:
    """Compute the contact wrench of every recorded frame again, at the recorded pose of the tool.

    Frames that held an earlier wrench, or had points in unknown cells, are not compared. Cells are
    resident in 256 MiB of memory at most; in lexicographic order each frame is a query.

    Parameters
    ----------
    recording : Recording
        The session.
    environment : Environment
        The environment of the session; its revision may differ.
    until_damage : bool
        Stop at a damaged chunk instead of raising an error.

    Raises
    ------
    GridError
        If the environment has another grid than the recording.
    FileError
        If a chunk of the recording is damaged, unless `until_damage`.
    UsageError
        If the recording has a budget of points, and the environment has no cells.
    """
    header = recording.header
    if header.grid != environment.grid:
        raise GridError(
            f"{recording.path} was recorded on {header.grid.describe()}, and {environment.url} "
            f"has {environment.grid.describe()}: give the environment of {header.environment}"
        )
    felt = (environment, header.shell, header.law, header.exclude, header.where)
    budget = header.budget_points
    with ExitStack() as stack:
        if environment.grid.is_hierarchical:
            feel = stack.enter_context(resident(*felt, budget_points=budget))
        elif budget is None:
            feel = touching(*felt)
        else:
            raise UsageError(
                f"{environment.url} in lexicographic order has no cells: a budget needs them"
            )
        comparison = _Comparison(environment, feel)
        for frames in recording.frames(until_damage=until_damage):
            comparison.add(frames)
        return comparison.result()


class _Comparison:
    """Compares recorded frames with the same frames computed now."""

    def __init__(self, environment: Environment, feel: Feel) -> None:
        self._environment = environment
        self._feel = feel
        self._n_compared = self._n_differing = self._n_done = 0
        self._parting: Parting | None = None
        self._revisions: set[int] = set()

    def add(self, frames: Frames) -> None:
        """Compare the next frames."""
        self._revisions.update(np.unique(frames["revision"]).tolist())
        is_known = (frames["unknown"] == 0) & (frames["state"] & State.HELD == 0)
        (indices,) = np.nonzero(is_known)
        if len(indices):
            known = frames[indices]
            poses = np.empty((len(known), 4, 4))
            poses_of(np.ascontiguousarray(known["tool"]), poses)
            wrenches, n_hits = self._feel(poses)
            recorded = np.ascontiguousarray(known["wrench"]).view(np.uint64)
            present = np.ascontiguousarray(wrenches, dtype=np.float64).view(np.uint64)
            differs = (recorded != present).any(axis=1) | (known["hits"] != n_hits)
            if differs.any() and self._parting is None:
                at = int(np.argmax(differs))
                self._parting = Parting(
                    self._n_done + int(indices[at]),
                    float(known["time"][at]),
                    known["wrench"][at].copy(),
                    np.array(wrenches[at]),
                    int(known["hits"][at]),
                    int(n_hits[at]),
                    int(known["revision"][at]),
                    self._environment.store.revision(),
                )
            self._n_differing += int(differs.sum())
        self._n_compared += len(indices)
        self._n_done += len(frames)

    def result(self) -> Replayed:
        """Result over all frames."""
        revision = self._environment.store.revision()
        return Replayed(
            self._n_compared,
            self._n_done - self._n_compared,
            self._n_differing,
            self._parting,
            revision,
            self._revisions <= {revision},
        )

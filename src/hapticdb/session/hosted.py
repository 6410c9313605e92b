"""HostedSession: one hand of a host, from the process of its motion."""

import math
import os
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.errors import UsageError
from hapticdb.kernels.hand.handle_motion import FARTHEST
from hapticdb.kernels.rigid import is_rigid
from hapticdb.poses import row_of_pose
from hapticdb.recording.frame import Frames, State
from hapticdb.session.coupling import Coupling
from hapticdb.session.report import LoopFigures, counts_of
from hapticdb.session.shared_table import TAKEN, SharedTable


class Recorded(NamedTuple):
    """Frames of a recording at its end, and frames lost on the way to it."""

    frames: int
    lost: int


Calls = Callable[..., object]
"""A hosted session's request to the host: a word, the session's id, arguments -> result."""


class HostedSession:
    """A hand in an environment, in a worker process of the host, among others.

    `move`, `latest`, `contacts`, `touched`, `figures` and `counts` read and write shared memory and
    take microseconds; the others wait for the host, by `call`.

    id : unique number among all sessions of the host; slot : its row of the shared table;
    lost_frames : frames missing in the last recording, once this object has ended it.
    """

    def __init__(self, shared: SharedTable, slot: int, session: int, call: Calls) -> None:
        self._shared, self.slot, self._call = shared, slot, call
        self.id = session
        self.lost_frames = 0

    @property
    def is_over(self) -> bool:
        """Whether the session has ended: by `end`, or because its process died."""
        # by id, too: the slot may belong to a later session by now
        slots = self._shared.slots
        return bool(slots["id"][self.slot] != self.id or slots["state"][self.slot] != TAKEN)

    def _open_slot(self) -> int:
        if self.is_over:
            raise UsageError(f"the hosted session {self.id} is over: begin another")
        return self.slot

    def move(self, pose: ArrayLike) -> None:
        """Put the hand at a pose (4, 4) of the scene, metres; the newest one counts.

        A position and a unit quaternion, (7,), are a pose, too, and save the conversion.

        The hand moves there in about the time between two calls, so calls at 20 to 100 Hz give a
        smooth motion. It never goes beyond the last pose.
        UsageError if the pose is no rigid transform or is beyond 1e9 m, or the session is over.
        """
        row = np.asarray(pose, dtype=np.float64)
        if row.shape == (4, 4) and is_rigid(row):
            row = row_of_pose(row)
        if row.shape != (7,) or not (
            np.abs(row).max() <= FARTHEST and abs(math.hypot(*row[3:]) - 1.0) <= 1e-6
        ):
            raise UsageError("a hand moves to a pose (4, 4) that is a rigid transform")
        self._shared.put_hand(self._open_slot(), time.monotonic_ns(), row)

    def latest(self) -> Frames | None:
        """Latest frame, (1,) of `kernels.records.hand.FRAME`; None before the first."""
        return self._shared.last_frame(self._open_slot())

    def touched(self) -> tuple[int, ...]:
        """Ids of objects in contact with the tool now, or around it; sampled 100 times a second."""
        slot = self._open_slot()
        last = self._shared.last_frame(slot)
        if last is None or not (last["hits"][0] or last["state"][0] & State.IN_OBJECT):
            return ()
        slots = self._shared.slots
        ids = slots["objects"][slot, : int(slots["n_objects"][slot])]
        return tuple(sorted(set(ids.tolist())))

    def contacts(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Points (n, 3) in contact, m, and forces there, N; world frame, n <= 64, 30 Hz."""
        found = self._shared.contacts(self._open_slot())
        return found[:, :3], found[:, 3:]

    def set_coupling(self, coupling: Coupling | None) -> None:
        """Replace the coupling between hand and tool; None: the default one."""
        self._call("set_coupling", self.id, coupling)

    def record(self, path: str | os.PathLike[str], *, replace: bool = False) -> None:
        """Record the frames from now on into a file.

        UsageError if the session is recorded already, or the file exists and `replace` is False;
        FileError if the file cannot be written.
        """
        self._call("record", self.id, os.path.abspath(path), replace)  # noqa: PTH100 - a text to send

    def stop_recording(self) -> int:
        """End the recording; its file stays. Returns the number of its frames, 0 without one."""
        return self._ended_recording("stop_recording")

    def _ended_recording(self, word: str) -> int:
        """End a recording by a request; returns the number of its frames."""
        recorded = self._call(word, self.id)
        if recorded is None:  # the session was over
            return 0
        assert isinstance(recorded, Recorded)  # noqa: S101 - the host counts
        self.lost_frames = recorded.lost
        return recorded.frames

    def figures(self) -> LoopFigures:
        """Frames of the session so far, and their times."""
        return LoopFigures.of_slot(self._shared.slots[self._open_slot()], 0.0)

    def counts(self) -> dict[str, Any]:
        """Counts of frames and greatest forces so far, by their names in a `Report`."""
        return counts_of(self._shared.slots[self._open_slot()])

    def end(self) -> None:
        """End the session and its recording; a second call does nothing."""
        if self._shared.slots["id"][self.slot] == self.id:
            self._ended_recording("end")

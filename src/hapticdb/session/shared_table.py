"""SharedTable: a slot for each session, in shared memory.

A slot is a row of `SLOT`: the state of a session. The client of a hosted hand writes its pose, the
session's worker the results. No reader waits for a writer:
an odd sequence number marks an unfinished write, and the reader reads again.
"""

import mmap
import os
import threading
import time
from collections.abc import Iterator
from itertools import repeat
from typing import Self

import numpy as np
from numpy.typing import NDArray

from hapticdb.closing import Closes
from hapticdb.errors import HapticDBError, UsageError
from hapticdb.kernels.records.hand import FRAME
from hapticdb.kernels.records.session import MOST_SHOWN, SLOT
from hapticdb.recording.frame import Frames
from hapticdb.resident.table import anonymous_memory

RING = 2048
"""Frames of a hosted session in the shared table: two seconds at 1 kHz. Larger: a recording
survives longer pauses of the host's process, and each session takes more memory."""
QUICK_ATTEMPTS = 100
"""Attempts without a pause to read an unfinished row: writing takes microseconds, unless a busy
machine stops the writer in the middle."""
READ_TIMEOUT = 1.0
"""Seconds of further attempts. Larger: a busier machine is borne, and a writer's death delays a
reader for longer."""
READ_PAUSE = 5e-4
"""Seconds between further attempts, so that the writer gets a processor."""
FREE, TAKEN, LOST = 0, 1, 2
"""States of a slot: free, in use, in use by a session with a dead worker."""

Slots = NDArray[np.void]
"""Rows of `kernels.records.session.SLOT`."""


class SharedTable(Closes):
    """Slots of sessions in shared memory.

    descriptor : of the memory from `create`; owned from now on; slots (S,) of
    `SLOT`; rings (S, ring) of `FRAME`: frame n of a session is at index n modulo ring.
    """

    def __init__(self, descriptor: int, ring: int = RING) -> None:
        self.descriptor = descriptor
        size = os.fstat(descriptor).st_size
        n_slots = size // _bytes_a_slot(ring)
        self._memory = mmap.mmap(descriptor, size)
        self.slots: Slots = np.ndarray((n_slots,), SLOT, self._memory)
        self.rings: Frames = np.ndarray(
            (n_slots, ring), FRAME, self._memory, n_slots * SLOT.itemsize
        )
        self._taking = threading.Lock()

    @classmethod
    def create(cls, n_slots: int, ring: int = RING) -> Self:
        """Make a table of free slots with `ring` frames each."""
        return cls(anonymous_memory("hapticdb-slots", n_slots * _bytes_a_slot(ring)), ring)

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle it for a process with the same descriptor."""
        return SharedTable, (self.descriptor, self.rings.shape[1])

    def close(self) -> None:
        """Free the memory in this process; the mapping goes with the last array."""
        if self.descriptor >= 0:
            os.close(self.descriptor)
            self.descriptor = -1

    def take(self, session: int) -> int:
        """Give a free slot to a session; returns its row, or UsageError if no slot is free."""
        with self._taking:
            free = np.flatnonzero(self.slots["state"] == FREE)
            if not len(free):
                raise UsageError(
                    f"the host has {len(self.slots)} sessions, the most it takes: end one first"
                )
            row = int(free[0])
            self.slots[row] = np.zeros((), SLOT)
            self.slots["id"][row] = session
            # state last: readers in other processes do not take this lock
            self.slots["state"][row] = TAKEN
            return row

    def release(self, row: int) -> None:
        """Free a slot."""
        with self._taking:
            self.slots["state"][row] = FREE

    def lose(self, row: int, session: int) -> None:
        """Mark a session's worker as dead, unless the slot is free or another's by now."""
        # id compared under the lock: a slot given to another session stays as it is
        with self._taking:
            if self.slots["state"][row] == TAKEN and self.slots["id"][row] == session:
                self.slots["state"][row] = LOST

    def put_hand(self, row: int, time: int, pose: NDArray[np.float64]) -> None:
        """Write the hand's pose (7,) and its time."""
        slots = self.slots
        # seqlock: an odd number during the write; one writer, no lock in the servo loop
        slots["hand_sequence"][row] += 1
        slots["hand_pose"][row] = pose
        slots["hand_time"][row] = time
        slots["hand_sequence"][row] += 1

    def last_frame(self, row: int) -> Frames | None:
        """Latest frame of a slot, (1,) of `FRAME`; None before the first."""
        ring = self.rings[row]
        for _ in _attempts():
            done = int(self.slots["n_frames"][row])
            if not done:
                return None
            frame: Frames = ring[[(done - 1) % len(ring)]]
            # the ring is long: a frame that was copied slowly may still be overwritten
            if int(self.slots["n_frames"][row]) - done < len(ring) // 2:
                return frame
        raise _unreadable()

    def contacts(self, row: int) -> NDArray[np.float64]:
        """Contacts of a slot now (n, 6): points, m, and forces on the tool, N, world frame."""
        slots = self.slots
        for _ in _attempts():
            before = int(slots["contacts_sequence"][row])
            # a torn count is possible here; the second reading of the number rejects it
            n_contacts = min(int(slots["n_contacts"][row]), MOST_SHOWN)
            found: NDArray[np.float64] = slots["contacts"][row, :n_contacts].copy()
            if before % 2 == 0 and before == int(slots["contacts_sequence"][row]):
                return found
        raise _unreadable()


def _bytes_a_slot(ring: int) -> int:
    return SLOT.itemsize + ring * FRAME.itemsize


def _attempts() -> Iterator[None]:
    """Attempts to read a row during a possible write, until patience ends."""
    yield from repeat(None, QUICK_ATTEMPTS)
    end = time.monotonic() + READ_TIMEOUT
    while time.monotonic() < end:
        time.sleep(READ_PAUSE)
        yield


def _unreadable() -> HapticDBError:
    return HapticDBError(
        f"a frame stayed unfinished for {READ_TIMEOUT:g} s: the session's worker process has died "
        "or does not get to run; end the session and begin another"
    )

"""SharedTable: a slot for each session, in memory that several processes share.

A slot is a row of `SEAT`: frames and counts of a session, and a hosted hand. The process that moves
a hosted hand writes the hand's pose; the worker that runs the session writes its results. No reader
waits for a writer: a sequence number, odd while a part of a row is written, asks a reader to read
again.
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
from hapticdb.kernels.records import FRAME, MOST_SHOWN, SEAT
from hapticdb.recording.frame import Frames
from hapticdb.resident.table import anonymous_memory

RING = 2048
"""Frames of a hosted session that the shared table holds: two seconds at 1 kHz. Larger: a recording
survives longer pauses of the host's process, and each session takes more memory."""
QUICK_ATTEMPTS = 100
"""Attempts, without a pause between them, to read what another process writes: that takes it
microseconds, unless it is stopped in the middle by a busy machine."""
READ_PATIENCE = 1.0
"""Seconds of further attempts. Larger: a busier machine is borne, and a reader is held up for
longer by a process that died while it wrote."""
READ_PAUSE = 5e-4
"""Seconds between further attempts, which let the writer have a processor."""
FREE, TAKEN, LOST = 0, 1, 2
"""States of a slot: nobody's; a session's; a session's whose worker process has died."""

Slots = NDArray[np.void]
"""Rows of `kernels.records.SEAT`."""


class SharedTable(Closes):
    """Slots of sessions in shared memory.

    descriptor : of the memory of a table that `create` has made; owned from now on; slots (S,) of
    `SEAT`; rings (S, ring) of `FRAME`: frame n of a session is at index n modulo ring.
    """

    def __init__(self, descriptor: int, ring: int = RING) -> None:
        self.descriptor = descriptor
        size = os.fstat(descriptor).st_size
        n_slots = size // _bytes_a_slot(ring)
        self._memory = mmap.mmap(descriptor, size)
        self.slots: Slots = np.ndarray((n_slots,), SEAT, self._memory)
        self.rings: Frames = np.ndarray(
            (n_slots, ring), FRAME, self._memory, n_slots * SEAT.itemsize
        )
        self._taking = threading.Lock()

    @classmethod
    def create(cls, n_slots: int, ring: int = RING) -> Self:
        """Make a shared table with free slots, and that many frames for each."""
        return cls(anonymous_memory("hapticdb-slots", n_slots * _bytes_a_slot(ring)), ring)

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle it for a process that inherits its descriptor."""
        return SharedTable, (self.descriptor, self.rings.shape[1])

    def close(self) -> None:
        """Free the memory in this process; the mapping goes with the last array."""
        if self.descriptor >= 0:
            os.close(self.descriptor)
            self.descriptor = -1

    def take(self, session: int, worker: int) -> int:
        """Give a free slot to a session; returns its row, or UsageError if no slot is free."""
        with self._taking:
            free = np.flatnonzero(self.slots["state"] == FREE)
            if not len(free):
                raise UsageError(
                    f"the host has {len(self.slots)} sessions, the most it takes: end one first"
                )
            row = int(free[0])
            self.slots[row] = np.zeros((), SEAT)
            self.slots["worker"][row] = worker
            self.slots["id"][row] = session
            self.slots["state"][row] = TAKEN
            return row

    def release(self, row: int) -> None:
        """Free a slot."""
        with self._taking:
            self.slots["state"][row] = FREE

    def lose(self, row: int, session: int) -> None:
        """Tell that a session's worker has died, unless the slot is free or another's by now."""
        with self._taking:
            if self.slots["state"][row] == TAKEN and self.slots["id"][row] == session:
                self.slots["state"][row] = LOST

    def put_hand(self, row: int, time: int, pose: NDArray[np.float64]) -> None:
        """Write where the hand is (7,), and when."""
        slots = self.slots
        slots["hand_sequence"][row] += 1
        slots["hand_pose"][row] = pose
        slots["n_moves"][row] += 1
        slots["hand_time"][row] = time
        slots["is_held"][row] = 1
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
            n_contacts = min(int(slots["n_contacts"][row]), MOST_SHOWN)
            found: NDArray[np.float64] = slots["contacts"][row, :n_contacts].copy()
            if before % 2 == 0 and before == int(slots["contacts_sequence"][row]):
                return found
        raise _unreadable()


def _bytes_a_slot(ring: int) -> int:
    return SEAT.itemsize + ring * FRAME.itemsize


def _attempts() -> Iterator[None]:
    """Times to try to read what another process may be writing, until patience ends."""
    yield from repeat(None, QUICK_ATTEMPTS)
    end = time.monotonic() + READ_PATIENCE
    while time.monotonic() < end:
        time.sleep(READ_PAUSE)
        yield


def _unreadable() -> HapticDBError:
    return HapticDBError(
        f"a frame stayed unfinished for {READ_PATIENCE:g} s: the session's worker process has died "
        "or does not get to run; end the session and begin another"
    )

"""The servo loop, in a process of its own: every frame on time, no frame queries the database.

Deadlines are absolute: the loop sleeps until shortly before each one, and then watches the clock.
While the loop runs, no kernel is compiled and no garbage is collected.
"""

import contextlib
import math
import mmap
import signal
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticdb.devices.protocol import (
    Device,
    Reader,
    Reading,
    SupportsClose,
    SupportsEnd,
    SupportsOpen,
    SupportsRewind,
)
from hapticdb.errors import DeviceError, HapticDBError
from hapticdb.grid import Grid
from hapticdb.kernels._jit import ENTRIES
from hapticdb.kernels.hand import holding, quasistatic, servo
from hapticdb.kernels.hand.handle import is_somewhere
from hapticdb.kernels.records import FRAME, MOST_MISSED, SERVO, TOLD, pose_numbers, views_of
from hapticdb.kernels.resident.cells import Place
from hapticdb.kernels.rigid import poses_of
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.law import ForceLaw
from hapticdb.realtime.coupling import DirectRendering, SettledCoupling
from hapticdb.realtime.deadlines import Deadlines, Timing, empty_loop, undisturbed
from hapticdb.realtime.drive import DirectDrive, SmoothDrive
from hapticdb.realtime.handle import Handle
from hapticdb.realtime.processes import MessageSender, parent_is_gone
from hapticdb.realtime.report import Counts, LoopAnswer, LoopFigures, Times
from hapticdb.recording.frame import Frames, State
from hapticdb.resident.held import held_tool
from hapticdb.resident.table import HEARTBEAT, LOST, STOP, CellTable

EMPTY_SECONDS = 2.0
"""Greatest duration (s) of the empty loop; in a shorter session it is the session's duration.
Larger: the machine's own lateness is measured better, the first frame comes later."""
TELL_EVERY = 1e-3
"""Seconds between two reports of the tool's place to the fetching process. Larger: cells are
requested later. Smaller: the loop computes more."""
ASK_EVERY = 1e-2
"""Seconds between two requests for the ids of the objects that the tool touches. Larger: ids come
later, and short touches may be missed."""
LOOK_EVERY = 0.25
"""Seconds between two checks whether the process that started the loop still runs."""
WITHDRAWN_NS = 250_000_000
"""Nanoseconds. The loop withdraws its request for ids once the database has answered this much
later: by then the objects are named, and the process that began the session has read them."""
SMOOTH_FLAGS = quasistatic.IS_LOOSE | quasistatic.IS_SOFTER | quasistatic.IS_SNAPPING
"""Flags that only the quasi-static coupling has."""
NO_POINTS = np.empty(0, dtype=np.int64)
"""Nothing is asked about."""
WARM_PATIENCE = 30.0
"""Greatest time (s) that the loop waits for its first cells and for a device's first valid pose."""


@dataclass(frozen=True)
class LoopRequest:
    """Request to a loop's process: see `hapticdb.realtime.session.Session`."""

    descriptor: int
    n_slots: int
    row: int
    ring: int
    n_ring: int
    grid: Grid
    shell: PointShell
    device: Device
    law: ForceLaw
    coupling: SettledCoupling | DirectRendering
    handle: Handle
    timing: Timing
    seconds: float
    staleness: float
    is_waiting: bool
    has_baseline: bool = True
    is_recorded: bool = True
    budget_points: int | None = None


class Loop:
    """A session's loop in this process. It is made, warmed up, and run once.

    Parameters
    ----------
    request : LoopRequest
        Its reader row of the table is already taken.
    """

    def __init__(self, request: LoopRequest) -> None:
        self.request = request
        self.device = request.device
        self.reader = Reader(request.device)
        self.table = CellTable(request.descriptor, request.n_slots)
        self.cells, self.row = self.table.cells, request.row
        grid = request.grid
        self.place = Place(*grid.origin, grid.voxel_size, float(grid.side))
        self.clusters, self.asleep = held_tool(
            request.shell, grid.voxel_size, request.budget_points
        )
        self.servo = np.zeros((), SERVO)
        self.tool, self.hand = self.servo["tool"], self.servo["hand"]
        self.sent = views_of(self.servo["sent"])
        self._hand_position = self.hand["position"]
        self._tool_pose = pose_numbers(self.tool)[None]
        self.missed = np.zeros(1 + MOST_MISSED, dtype=np.int64)
        self.told = np.zeros((), TOLD)
        self.pose = np.eye(4)
        self._pose = self.pose[None]
        self.drive = self._make_drive()
        self.ring = ring_of(request.ring, request.n_ring)
        self.session = self.table.desk.sessions[request.row, ...]
        self._n_frames, self._is_asked_to_end = (
            self.session["n_frames"],
            self.session["is_asked_to_end"],
        )
        self.counts = Counts()
        self.is_warm = False
        self._asked_at = 0  # ns; 0 without a request
        self.lateness, self.elapsed = Times(), Times()

    def _make_drive(self) -> DirectDrive | SmoothDrive:
        law, coupling = self.request.law, self.request.coupling
        if isinstance(coupling, SettledCoupling):
            return SmoothDrive(self, coupling.spring(), law)
        return DirectDrive(self, coupling.terms(), coupling.radius, law)

    # -- before the first frame --------------------------------------------------------------

    def prepare(self) -> float:
        """Place the tool at the hand and wait for its cells; returns the seconds taken.

        Without a database it does not wait: what supervises the session tells of that at once.
        """
        started = time.monotonic()
        session, asked = self.session, 0
        control = self.cells.control
        self._place()
        while time.monotonic() - started < WARM_PATIENCE and not self._is_left():
            if control[LOST]:
                break
            if asked and session["heard"] >= asked:
                if session["n_missing"] == 0:
                    self.is_warm = True
                    break
                asked = 0
            if not asked:  # a person's hand has moved while the loop waited
                self._place()
                self._tell()
                asked = int(session["sequence"])
            time.sleep(1e-3)
        self._place()
        self._tell()
        return time.monotonic() - started

    def _place(self) -> None:
        """Put the tool where the hand is, at rest."""
        if isinstance(self.device, SupportsRewind):
            self.device.rewind()
        self.request.handle.start(self._read(), self.hand)
        # reset every field: a held first frame must not report hits at an earlier place
        self.tool[()] = np.zeros((), self.tool.dtype)
        pose_numbers(self.tool)[:] = pose_numbers(self.hand)

    def _read(self) -> Reading:
        """Read the hand's pose; wait for a device that does not know it yet after its opening."""
        until = time.monotonic() + WARM_PATIENCE
        reading = self.reader.read()
        while not is_somewhere(reading.pose, reading.velocity):
            if time.monotonic() > until or self._is_left():
                raise DeviceError(
                    f"the device has not said where it is within {WARM_PATIENCE:g} s: "
                    f"{self.reader.complaint()}; check its connection and calibration"
                )
            time.sleep(1e-3)
            reading = self.reader.read()
        return reading

    def warm_up(self) -> None:
        """Run every kernel of a frame, so that none is compiled later; the tool stays in place."""
        if isinstance(self.device, SupportsOpen):
            self.device.open()
        self._place()
        for at in range(3):
            reading = self._read()
            for buttons in (-1, 0):  # a clutch that opens, and closes
                self.request.handle.follow(reading._replace(buttons=buttons), self.hand)
            self._step(1e-3, is_stale=False)
            self._ask(NO_POINTS)
            self.drive.feel()  # `_note` leaves it out while cells are unknown
            self._note(at, 0.0, 0.0, 0.0, 0.0, 0, 0)
            self._tell()
        self.session["told"]["is_active"] = False
        self.device.apply(np.zeros(6))

    # -- one frame ---------------------------------------------------------------------------

    def _step(self, dt: float, *, is_stale: bool) -> None:
        """Advance the tool by a period `dt` (s); `sent` then has the wrench for the device."""
        self.hand["is_stale"] = is_stale
        self.drive.step(dt)

    def _step_exactly(self, reading: Reading, dt: float, ends: int) -> Reading:
        """Advance by a period `dt` (s) once all cells that it needs are resident.

        After the coupling's `hold` seconds of waiting no force is sent. The wait ends at `ends`
        (ns), the end of the session. Returns the reading that was used: without force the hand
        moves meanwhile, so its latest reading is used.
        """
        clock = time.perf_counter_ns
        holds = clock() + round(min(self.request.coupling.hold, 1e9) * 1e9)
        is_let_go = False
        sent = self.sent
        self.drive.remember()
        self._step(dt, is_stale=False)
        while sent.unknown and clock() < ends and not self._is_left():
            if not is_let_go and clock() > holds:
                self.device.apply(np.zeros(6))
                is_let_go = True
            self.drive.step_back(from_zero=is_let_go)
            self._tell()
            time.sleep(2e-4)
            if is_let_go:
                reading = self.reader.read()
                self.request.handle.follow(reading, self.hand)
            self._step(dt, is_stale=False)
        if is_let_go and sent.unknown:
            sent.wrench[:] = 0.0
        return reading

    def _tell(self) -> None:
        """Report where tool and hand are, and which cells the last frame missed."""
        told, center = self.told, self.request.shell.center
        poses_of(self._tool_pose, self._pose)
        told["is_active"] = True
        told["tool"] = self.pose[:3, :3] @ center + self.pose[:3, 3]
        told["handle"] = self._hand_position + self.pose[:3, :3] @ center
        told["velocity"] = self.hand["velocity"][:3]
        told["radius"] = self.drive.radius
        servo.tell(self.session, told, self.missed)

    def _ask(self, points: NDArray[np.int64]) -> None:
        """Request the ids of the objects at some of the tool's points, by their indices (M,)."""
        grid = self.request.grid
        poses_of(self._tool_pose, self._pose)
        servo.name_voxels(
            self.session, self.clusters, self.pose, self.place, grid.bits, grid.curve_code, points,
            len(points),
        )  # fmt: skip

    def _ask_or_withdraw(self, now: int) -> None:
        """Request the ids at the last frame's hits, or of what the tool lies in.

        Without any, the last request is withdrawn.

        A request that stays would be answered again at each write, for voxels that are no longer
        touched. A request withdrawn at once would never be answered by a slow database.
        """
        if self.sent.hits or self.sent.marks & quasistatic.IS_LOOSE:
            self._ask(self.drive.touching(self.sent.hits.item()))
            self._asked_at = now
        elif self._asked_at and self.cells.control[HEARTBEAT] > self._asked_at + WITHDRAWN_NS:
            self._ask(NO_POINTS)
            self._asked_at = 0

    def _note(
        self,
        at: int,
        begun: float,
        dt: float,
        lateness: float,
        elapsed: float,
        buttons: int,
        state: int,
    ) -> None:
        if self.request.is_recorded and not self.sent.marks.item() & holding.IS_HELD:
            poses_of(self._tool_pose, self._pose)
            self.drive.feel()
        servo.note(self.ring, at, begun, dt, lateness, elapsed, self.servo, buttons, state)

    def _is_stopped(self) -> bool:
        return bool(self.cells.control[STOP]) or bool(self._is_asked_to_end)

    def _is_left(self) -> bool:
        return self._is_stopped() or parent_is_gone()

    # -- the loop ----------------------------------------------------------------------------

    def run(self) -> LoopFigures:
        """Run frames until the time is over, the device's script ends, or a stop is requested."""
        request, control = self.request, self.cells.control
        clock, device, reader = time.perf_counter_ns, self.device, self.reader
        rate = request.timing.rate
        n_deadlines = max(round(request.seconds * rate), 1)
        tell_every, ask_every, look_every = (
            max(round(every * rate), 1) for every in (TELL_EVERY, ASK_EVERY, LOOK_EVERY)
        )
        staleness = round(min(request.staleness, 1e9) * 1e9)
        ends = device if isinstance(device, SupportsEnd) else None
        deadlines = Deadlines(round(1e9 / rate), self.lateness, self.elapsed)
        applied = self.sent.wrench
        over = deadlines.started + round(request.seconds * 1e9)
        while deadlines.passed < n_deadlines:
            at = deadlines.frames
            begun = deadlines.wait()
            reading = reader.read()
            request.handle.follow(reading, self.hand)
            is_stale = begun - control[HEARTBEAT] > staleness
            if request.is_waiting:
                reading = self._step_exactly(reading, deadlines.dt, over)
            else:
                self._step(deadlines.dt, is_stale=is_stale)
            device.apply(applied)
            state = self._count(request.handle.is_open, is_stale)
            if at % tell_every == 0 or self.sent.unknown:
                self._tell()
            if at % ask_every == 0:
                self._ask_or_withdraw(begun)
            self._note(
                at,
                (begun - deadlines.started) * 1e-9,
                deadlines.dt,
                (begun - deadlines.due) * 1e-9,
                (clock() - begun) * 1e-9,
                reading.buttons,
                state,
            )
            self._count_left_out()
            self._n_frames[()] = at + 1
            deadlines.done()
            if self._is_stopped() or (ends is not None and ends.is_over):
                break
            if at % look_every == 0 and parent_is_gone():
                break
        device.apply(np.zeros(6))
        self.counts.least_share = self.drive.least_share
        self.counts.ended_loose = bool(self.sent.marks.item() & quasistatic.IS_LOOSE)
        return deadlines.figures()

    def _count(self, is_clutch_open: bool, is_stale: bool) -> int:  # noqa: FBT001 - of a frame
        """Add a frame to the counts; returns its recorded state."""
        counts, sent = self.counts, self.sent
        flags = sent.marks.item()
        state = State(0)
        if sent.hits or flags:
            wrench = sent.wrench.tolist()  # plain floats: a tenth of the time
            counts.peak_force = max(counts.peak_force, math.hypot(*wrench[:3]))
            counts.peak_torque = max(counts.peak_torque, math.hypot(*wrench[3:]))
        if sent.hits:
            counts.hit_frames += 1
            if sent.contacts:
                counts.contact_frames += 1
                counts.deepest = max(counts.deepest, sent.deepest.item())
        if sent.unknown:
            counts.unknown_frames += 1
            counts.unknown_points += sent.unknown.item()
        if flags & holding.IS_HELD:
            counts.held_frames += 1
            state |= State.HELD
            if flags & holding.IS_FADING:
                state |= State.FADING
        if flags & holding.IS_CUT:
            counts.cut_frames += 1
        if flags & SMOOTH_FLAGS:
            if flags & quasistatic.IS_LOOSE:
                if not counts.loose_frames:
                    counts.first_loose_frame = self._n_frames.item()
                counts.loose_frames += 1
                state |= State.IN_OBJECT
            counts.snapping_frames += bool(flags & quasistatic.IS_SNAPPING)
            counts.guard_actions += bool(flags & quasistatic.IS_SOFTER)
        if is_stale:
            counts.stale_frames += 1
        if math.isnan(self._hand_position[0]):
            counts.nowhere_frames += 1
            counts.bad_reading = counts.bad_reading or self.reader.complaint() or None
        if is_clutch_open:
            state |= State.CLUTCH_OPEN
        return int(state)

    def _count_left_out(self) -> None:
        """Count the points that the budget left out of a frame, and of its recorded wrench."""
        left_out = self.sent.left_out.item()
        if left_out:
            self.counts.left_out_frames += 1
            self.counts.most_left_out = max(self.counts.most_left_out, left_out)

    def close(self) -> None:
        """Set the force to zero, however the loop ended, and close the device."""
        with contextlib.suppress(Exception):  # a device that has failed may fail here, too
            self.device.apply(np.zeros(6))
        if isinstance(self.device, SupportsClose):
            self.device.close()


def ring_of(descriptor: int, n_frames: int) -> Frames:
    """Ring (n,) of recorded frames in shared memory."""
    memory = mmap.mmap(descriptor, ring_bytes(n_frames))
    return np.ndarray((n_frames,), FRAME, memory)


def ring_bytes(n_frames: int) -> int:
    """Bytes of a ring of `n_frames` frames."""
    return FRAME.itemsize * n_frames


def n_compiled() -> int:
    """Number of signatures of all kernels that have been compiled or loaded."""
    return sum(len(entry.signatures) for entry in ENTRIES if hasattr(entry, "signatures"))


def work(request: LoopRequest, sender: MessageSender) -> None:
    """Run a session's loop in this process, and send its results."""
    loop = Loop(request)
    try:
        loop.warm_up()
        with undisturbed(request.timing) as granted:
            empty = None
            if request.has_baseline:
                empty = empty_loop(request.timing, min(EMPTY_SECONDS, request.seconds))
            warm_up = loop.prepare()
            compiled = n_compiled()
            sender.send("running", warm_up)
            figures = loop.run()
            if n_compiled() != compiled:
                raise HapticDBError("a kernel was compiled while the loop ran: report this")
        loop.counts.conditions.update(granted)
        sender.send("done", LoopAnswer(figures, empty, loop.counts, warm_up, loop.is_warm))
    finally:
        try:  # the loop is ending, so SIGTERM is ignored: the device must be closed completely
            before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
        finally:
            loop.close()
        signal.signal(signal.SIGTERM, before)

"""The loop of a session with a device: every frame on time, no frame queries the database.

The loop is one kernel; it calls this module to read the device and to push it. While it runs, no
kernel is compiled and no garbage is collected.
"""

import contextlib
import math
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hapticdb.devices.handle import Handle
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
from hapticdb.kernels._jit import ENTRIES
from hapticdb.kernels.hand.calling import FUNCTION, address_of
from hapticdb.kernels.hand.handle_motion import is_valid_pose
from hapticdb.kernels.period.loop import DEVICE, NOBODY
from hapticdb.kernels.records.layout import pose_numbers, views_of
from hapticdb.query.law import ForceLaw
from hapticdb.resident.table import CellTable
from hapticdb.session.coupling import Rendering
from hapticdb.session.processes.process import POLL_EVERY, MessageSender, parent_is_gone
from hapticdb.session.report import LoopAnswer, LoopFigures
from hapticdb.session.states import PeriodClock, SlotRequest
from hapticdb.session.timing import Timing, undisturbed

if TYPE_CHECKING:
    from hapticdb.session.gpu_queries import GpuQueries

EMPTY_SECONDS = 2.0
"""Greatest duration (s) of the empty loop; in a shorter session it is the session's duration.
Larger: the machine's own lateness is measured better, the first frame comes later."""
WARM_TIMEOUT = 30.0
"""Longest wait (s) of the loop for its first cells and for a device's first valid pose."""


@dataclass(frozen=True)
class DeviceRequest:
    """Session with a device: see `hapticdb.session.session.Session`."""

    slot_request: SlotRequest
    table: CellTable
    device: Device
    handle: Handle
    seconds: float
    staleness: float
    has_baseline: bool = True
    is_on_gpu: bool = False


class DeviceLoop:
    """The loop of a session with a device. It is made, warmed up, and run once.

    request : with slot and reader row; timing : of the loop; clock : of its one slot.
    """

    def __init__(self, request: DeviceRequest, timing: Timing, clock: PeriodClock) -> None:
        self.request, self.timing, self.clock = request, timing, clock
        self.device, self.table = request.device, request.table
        self.reader = Reader(request.device)
        self.slot = clock.slots[request.slot_request.slot, ...]
        self.state = clock.add(request.slot_request, request.table)
        self.queued = self.state.request
        clock.enter(self.state)
        self.slot["source"] = DEVICE
        self.slot["staleness"] = round(min(request.staleness, 1e9) * 1e9)
        self.gpu: GpuQueries | None = None
        if request.is_on_gpu:
            from hapticdb.session import gpu_queries  # noqa: PLC0415 - loads numba.cuda

            self.gpu = gpu_queries.GpuQueries(self.state, self.table)
            self.state.follower["merges_from"] = gpu_queries.MERGES_FROM
        self.tool, self.hand = self.state.servo["tool"], self.state.servo["hand"]
        self.sent = views_of(self.state.servo["sent"])
        self._reading = views_of(self.slot["reading"])
        self.bad_reading: str | None = None
        self.is_warm = False
        self._error: BaseException | None = None
        self._signal = 0

    # -- before the first frame --------------------------------------------------------------

    def prepare(self) -> None:
        """Place the tool at the hand and wait for its cells.

        Without a database it does not wait: the supervisor reports that at once.
        """
        started = time.monotonic()
        session, requested = self.queued, 0
        control = self.table.cells.control
        self._place()
        while time.monotonic() - started < WARM_TIMEOUT and not self._is_left():
            if control["is_lost"]:
                break
            # an answer to this request or a later one; an older one was about another pose
            if requested and session["heard"] >= requested:
                if session["n_missing"] == 0:
                    self.is_warm = True
                    break
                requested = 0
            if not requested:  # a person's hand has moved while the loop waited
                self._place()
                self._step(1e-3)
                requested = int(session["sequence"])
            time.sleep(1e-3)
        self._place()

    def _place(self) -> None:
        """Put the tool at the hand, at rest."""
        if isinstance(self.device, SupportsRewind):
            self.device.rewind()
        reading, handle = self._read(), self.request.handle
        self._take(reading)
        handle.start(reading, self.hand)
        self.slot["handle"] = handle.record
        # a held first frame must not report hits at an earlier place
        self.state.rest_at(pose_numbers(self.hand).copy())

    def _read(self) -> Reading:
        """Read the hand's pose; wait for the first valid one after the device's opening."""
        until = time.monotonic() + WARM_TIMEOUT
        reading = self.reader.read()
        while not is_valid_pose(reading.pose, reading.velocity):
            if time.monotonic() > until or self._is_left():
                raise DeviceError(
                    f"the device has not said where it is within {WARM_TIMEOUT:g} s: "
                    f"{self.reader.fault()}; check its connection and calibration"
                )
            time.sleep(1e-3)
            reading = self.reader.read()
        return reading

    def warm_up(self) -> None:
        """Run every kernel of a frame, so none is compiled later; the tool stays in place."""
        if isinstance(self.device, SupportsOpen):
            self.device.open()
        self._place()
        for _ in range(3):
            self._step(1e-3)
        self.queued["prefetch"]["is_active"] = False
        self.device.apply(np.zeros(6))

    # -- one frame ---------------------------------------------------------------------------

    def _take(self, reading: Reading) -> None:
        """Write a reading for the kernel."""
        taken = self._reading
        taken.pose[:], taken.velocity[:], taken.buttons[()] = reading

    def _step(self, dt: float) -> None:
        """Run a period of `dt` s; `sent` then has the wrench for the device."""
        self.clock.step(dt, time.monotonic_ns())
        if self.gpu is not None:
            self.gpu.check()

    def _is_left(self) -> bool:
        is_over = self.table.cells.control["is_over"] or self.slot["is_asked_to_end"]
        return bool(is_over) or parent_is_gone()

    # -- the loop ----------------------------------------------------------------------------

    def run(self) -> LoopFigures:
        """Run frames until the time is over, the device's script ends, or a stop is requested."""
        slot = self.slot
        # kept alive by this local: the kernel holds the bare addresses alone
        called = self._called(self._read_hand), self._called(self._pusher())
        slot["reads"], slot["pushes"] = map(address_of, called)
        slot["is_frame"] = True
        # the handler raises inside a call of the device: nothing else ends a hanging one
        before = signal.signal(signal.SIGTERM, self._end)
        try:
            seconds = self.clock.run(self.timing.rate, self.request.seconds)
        finally:
            signal.signal(signal.SIGTERM, before)
        # the callback caught the exit as an error; the signal comes first
        if self._signal:
            signal.raise_signal(self._signal)
        if self._error is not None:
            raise self._error
        self.device.apply(np.zeros(6))
        return LoopFigures.of_slot(self.slot, seconds)

    def _end(self, number: int, _: object) -> None:
        """End the loop, and a hanging call of the device.

        An exception at the entrance of a kernel's call is lost; `run` then raises the signal.
        """
        self._signal = number
        self.clock.stop()
        raise SystemExit(128 + number)

    def _called(self, work: Callable[[], bool]) -> Any:  # noqa: ANN401 - of ctypes
        """C function for `work` -> whether the loop ends; an error ends it, too."""

        def answer() -> bool:
            try:
                return work()
            except BaseException as error:  # noqa: BLE001 - `run` raises it
                self._error = error
                return True

        return FUNCTION(answer)

    def _read_hand(self) -> bool:
        self._take(self.reader.read())
        return False

    def _pusher(self) -> Callable[[], bool]:
        """Function to push the device -> whether the loop ends."""
        device = self.device
        ends = device if isinstance(device, SupportsEnd) else None
        # views taken once: no look-up by name in the servo loop
        applied, x, n_frames = self.sent.wrench, self.hand["position"][:1], self.slot["n_frames"]
        poll_every = max(round(POLL_EVERY * self.timing.rate), 1)

        def push() -> bool:
            if self.gpu is not None:
                self.gpu.check()
            device.apply(applied)
            # NaN stands for an invalid reading: one of the three numbers is enough
            if math.isnan(x.item()) and self.bad_reading is None:
                self.bad_reading = self.reader.fault() or None
            if ends is not None and ends.is_over:
                return True
            # a system call, so not in each period
            return n_frames.item() % poll_every == 0 and parent_is_gone()

        return push

    def close(self) -> None:
        """Set the force to zero, however the loop ended, and close the device."""
        with contextlib.suppress(Exception):  # a device that has failed may fail here, too
            self.device.apply(np.zeros(6))
        if isinstance(self.device, SupportsClose):
            self.device.close()


def empty_loop(
    law: ForceLaw, rendering: Rendering | None, rate: float, seconds: float
) -> LoopFigures:
    """Run an empty loop at that rate, to measure the machine's lateness.

    It ends at once if the parent ends, or closes its channel.
    """
    clock = PeriodClock(law, rendering=rendering)
    clock.slots["source"], clock.slots["worker"] = NOBODY, clock.worker

    # sleeps meanwhile: the kernel holds no interpreter lock, and nothing else can end it
    def end() -> None:
        if parent_is_gone(seconds):
            clock.stop()

    watch = threading.Thread(target=end)
    watch.start()
    took = clock.run(rate, seconds)
    watch.join()
    return LoopFigures.of_slot(clock.slots[0], took)


def n_compiled() -> int:
    """Number of compiled or loaded signatures of all kernels."""
    return sum(len(getattr(e.compiled, "signatures", ())) for e in ENTRIES.values())


def run_device(
    request: DeviceRequest, timing: Timing, clock: PeriodClock, sender: MessageSender
) -> None:
    """Run the session of a device in this process, and send its results."""
    loop = DeviceLoop(request, timing, clock)
    try:
        loop.warm_up()
        with undisturbed(timing.processor):
            empty = None
            if request.has_baseline:
                # measured first: the machine's lateness alone, to be told from that of frames
                seconds = min(EMPTY_SECONDS, request.seconds)
                empty = empty_loop(clock.law, clock.rendering, timing.rate, seconds)
            loop.prepare()
            # after `prepare`: the last step that may compile
            compiled = n_compiled()
            sender.send("running", loop.state.save())
            figures = loop.run()
            if n_compiled() != compiled:
                raise HapticDBError("a kernel was compiled while the loop ran: report this")
        card = None if loop.gpu is None else loop.gpu.card
        answer = LoopAnswer(figures, empty, loop.bad_reading, loop.is_warm, card)
        sender.send("done", answer)
    finally:
        try:  # the loop is ending, so SIGTERM is ignored: the device must be closed completely
            before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
        finally:
            loop.close()
        signal.signal(signal.SIGTERM, before)

"""Deadlines: keeps a loop on time, and settings of the process that make it less disturbed."""

import contextlib
import ctypes
import gc
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from hapticdb.errors import UsageError
from hapticdb.realtime.report import LoopFigures, Times

SPIN = 60e-6
"""Seconds before a deadline at which the loop stops sleeping and watches the clock. A larger value
hides a later wake-up by the system, and takes more of the processor."""
SWITCH_INTERVAL = 1e-4
"""Seconds after which another thread of this process may run, while the loop runs. Python's own
value is 5e-3, five periods at 1 kHz; a smaller one costs more switches."""
_PR_SET_TIMERSLACK = 29
_PR_GET_TIMERSLACK = 30
"""Numbers of two operations of Linux's prctl."""


@dataclass(frozen=True)
class Timing:
    """How a loop is scheduled.

    Attributes
    ----------
    rate : float
        Frames a second.
    processor : int or None
        Number of the processor that the loop is bound to.

    Raises
    ------
    UsageError
        If this process may not run on that processor.
    """

    rate: float = 1000.0
    processor: int | None = None

    def __post_init__(self) -> None:
        granted = os.sched_getaffinity(0)
        if self.processor is not None and self.processor not in granted:
            shown = ", ".join(map(str, sorted(granted)))
            raise UsageError(
                f"processor {self.processor:.10g} is not granted: this process may run on {shown}"
            )


class Deadlines:
    """A fixed grid of deadlines, and statistics of how late the frames begin.

    `wait` sleeps until shortly before the next deadline, then watches the clock until the deadline,
    and returns the time at which the frame begins, ns. A frame that takes longer than its period
    misses the deadlines within its time; the loop goes on with the next deadline of the grid.

    Parameters
    ----------
    period_ns : int
        Nanoseconds between two deadlines.
    lateness, elapsed : Times
        Collect every frame's lateness and computing time, s.
    clock, sleep : callable
        Returns nanoseconds that never go back; waits for a number of seconds.
    """

    def __init__(
        self,
        period_ns: int,
        lateness: Times,
        elapsed: Times,
        *,
        clock: Callable[[], int] = time.perf_counter_ns,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        self.period = period_ns
        self.frames = self.missed = 0
        self.dt = period_ns * 1e-9
        self._lateness, self._elapsed = lateness, elapsed
        self._clock, self._sleep = clock, sleep
        self._spin = round(SPIN * 1e9)
        self.started = self.due = self._before = self._begun = clock()
        self.due += period_ns

    @property
    def passed(self) -> int:
        """Number of past deadlines, kept and missed."""
        return self.frames + self.missed

    def wait(self) -> int:
        """Wait for the deadline; returns the time after it, ns of `time.perf_counter_ns`."""
        clock = self._clock
        left = self.due - clock() - self._spin
        if left > 0:
            self._sleep(left * 1e-9)  # clock_nanosleep with an absolute deadline
        now = clock()
        while now < self.due:
            now = clock()
        if self.frames:
            self.dt = (now - self._begun) * 1e-9
        self._begun = now
        self.frames += 1
        self._lateness.add((now - self.due) * 1e-9)
        return now

    def done(self) -> None:
        """End a frame: the next deadline is the first one in the future."""
        now = self._clock()
        self._elapsed.add((now - self._begun) * 1e-9)
        self.due += self.period
        if now > self.due:
            behind = -(-(now - self.due) // self.period)
            self.missed += behind
            self.due += behind * self.period
        self._before = now

    def figures(self) -> LoopFigures:
        """Statistics of the loop so far."""
        return LoopFigures(
            frames=self.frames,
            seconds=(self._before - self.started) * 1e-9,
            missed=self.missed,
            lateness=self._lateness.spread(),
            elapsed=self._elapsed.spread(),
        )


def empty_loop(rate: float, seconds: float) -> LoopFigures:
    """Run a loop that does nothing at that rate, to measure the machine's lateness."""
    deadlines = Deadlines(round(1e9 / rate), Times(), Times())
    while deadlines.passed < seconds * rate:
        deadlines.wait()
        deadlines.done()
    return deadlines.figures()


@contextlib.contextmanager
def undisturbed(processor: int | None = None) -> Iterator[None]:
    """Disable garbage collection, shorten thread switches, sleep exactly, bind to a processor.

    At the end all settings are restored.
    """
    switch, was_enabled = sys.getswitchinterval(), gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    sys.setswitchinterval(SWITCH_INTERVAL)
    slack = _set_slack(1)
    processors = os.sched_getaffinity(0)
    try:
        if processor is not None:
            os.sched_setaffinity(0, {processor})
        yield
    finally:
        if processor is not None:
            os.sched_setaffinity(0, processors)
        _set_slack(slack)
        sys.setswitchinterval(switch)
        gc.unfreeze()
        if was_enabled:
            gc.enable()


def _set_slack(nanoseconds: int) -> int:
    """Set how late the system may wake this thread; returns the value before."""
    libc = ctypes.CDLL(None, use_errno=True)
    before = libc.prctl(_PR_GET_TIMERSLACK, 0, 0, 0, 0)
    libc.prctl(_PR_SET_TIMERSLACK, nanoseconds, 0, 0, 0)
    return int(before)

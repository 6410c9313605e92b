"""How a loop is scheduled, and settings of its process against disturbances."""

import contextlib
import ctypes
import gc
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass

from hapticdb.errors import UsageError

SWITCH_INTERVAL = 1e-4
"""Seconds before another thread of this process may run beside the loop. Python's own
value is 5e-3, five periods at 1 kHz; a smaller one costs more switches."""
_PR_SET_TIMERSLACK = 29
_PR_GET_TIMERSLACK = 30
"""Numbers of two operations of Linux's prctl."""


@dataclass(frozen=True)
class Timing:
    """How a loop is scheduled: frames a second, 10 to 20,000; processor that it is bound to."""

    rate: float = 1000.0
    processor: int | None = None

    def __post_init__(self) -> None:
        if not 10.0 <= self.rate <= 20_000.0:
            raise UsageError(f"a rate of {self.rate} Hz: give 10 to 20,000")
        granted = os.sched_getaffinity(0)
        if self.processor is not None and self.processor not in granted:
            shown = ", ".join(map(str, sorted(granted)))
            raise UsageError(
                f"processor {self.processor:.10g} is not granted: this process may run on {shown}"
            )


@contextlib.contextmanager
def undisturbed(processor: int | None = None) -> Iterator[None]:
    """Disable garbage collection, shorten thread switches, sleep exactly, bind to a processor.

    At the end all settings are restored.
    """
    switch, was_enabled = sys.getswitchinterval(), gc.isenabled()
    # collected, then frozen: survivors of the start are in no later collection
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
        # in reverse order of the changes above
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

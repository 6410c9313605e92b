"""System clock and sleep for the servo loop, without the interpreter lock."""

import time

from numba import config, types

from hapticdb.kernels._jit import leaf

MONOTONIC = int(time.CLOCK_MONOTONIC)
"""Clock id of `time.monotonic_ns`."""
SECOND = 1_000_000_000
"""Nanoseconds."""
SPIN = 60_000
"""Nanoseconds of busy waiting before a deadline. Larger: later wake-ups by the system are hidden,
and more processor time is spent."""

if config.DISABLE_JIT:

    def now_ns(moment):  # noqa: ARG001 - as below
        """Nanoseconds of `time.monotonic_ns`."""
        return time.monotonic_ns()

    def sleep_ns(moment, nanoseconds):  # noqa: ARG001 - as below
        """Sleep."""
        time.sleep(nanoseconds * 1e-9)

else:
    _clock_gettime = types.ExternalFunction("clock_gettime", types.int32(types.int32, types.uintp))
    _nanosleep = types.ExternalFunction("nanosleep", types.int32(types.uintp, types.uintp))

    @leaf
    def now_ns(moment):
        """Nanoseconds of `time.monotonic_ns`. moment (4,) int64 is scratch memory."""
        _clock_gettime(MONOTONIC, moment.ctypes.data)
        return moment[0] * SECOND + moment[1]

    @leaf
    def sleep_ns(moment, nanoseconds):
        """Sleep for less than a second. moment (4,) int64 is scratch memory."""
        moment[0] = 0
        moment[1] = nanoseconds
        # request and rest share the buffer: after a signal `wait_until` spins through the rest
        _nanosleep(moment.ctypes.data, moment.ctypes.data)


@leaf
def wait_until(moment, due):
    """Sleep until `SPIN` before a time, ns, then busy-wait until it."""
    left = due - now_ns(moment) - SPIN
    if left > 0:
        sleep_ns(moment, left)
    while now_ns(moment) < due:
        pass

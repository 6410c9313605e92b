"""Processors that do not sleep while times are measured.

A frame on a server goes to and fro between two processes that each sleep while the other works, and
a virtual processor that sleeps can take longer to wake than a frame lasts: times double and
scatter. A process of idle priority on each keeps them awake, and yields to whatever else runs.
"""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator

AWAKE = """
import os, sys
parent = int(sys.argv[1])
os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
while os.getppid() == parent:  # ends with the process that asked for it
    for _ in range(1_000_000):
        pass
"""


@contextlib.contextmanager
def awake() -> Iterator[None]:
    """Keep each processor of this process awake while the block runs."""
    started = []
    try:
        for cpu in os.sched_getaffinity(0):
            started.append(subprocess.Popen([sys.executable, "-c", AWAKE, str(os.getpid())]))
            os.sched_setaffinity(started[-1].pid, {cpu})
        yield
    finally:
        for process in started:
            process.kill()
            process.wait(60.0)

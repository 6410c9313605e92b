"""Processors that do not sleep while times are measured.

A frame on a server runs alternately in two processes, of which one sleeps while the other works. A
virtual processor can take longer to wake than a frame lasts: times double and scatter. One process
of idle priority on each processor keeps it awake, and yields to all other work.
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

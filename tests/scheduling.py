"""A scheduler of dask with two workers, each a process of its own, which ends with the run."""

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from subprocess import PIPE

from distributed import Client

from children import child

SERVE = """
import sys
from distributed import LocalCluster

if __name__ == "__main__":
    with LocalCluster(
        host="127.0.0.1", n_workers=int(sys.argv[1]), threads_per_worker=1,
        dashboard_address="127.0.0.1:0", silence_logs=50,  # critical
    ) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
"""


@contextmanager
def scheduling(n_workers: int = 2) -> Iterator[str]:
    """Address of a scheduler."""
    command = [sys.executable, "-c", SERVE, str(n_workers)]
    with child(command, stdin=PIPE, stderr=None) as process:
        assert process.stdout is not None
        yield process.stdout.readline().strip()
        os.killpg(process.pid, signal.SIGKILL)  # it would take seconds to end in order


def kill_a_worker(address: str) -> None:
    with Client(address, set_as_default=False) as client:
        pids = client.run(os.getpid)
    os.kill(min(pids.values()), signal.SIGKILL)


def stop_scheduler(address: str) -> None:
    """Let the scheduler's process stand still, as on a machine that sleeps."""
    with Client(address, set_as_default=False) as client:
        pid = client.run_on_scheduler(os.getpid)
    os.kill(pid, signal.SIGSTOP)
